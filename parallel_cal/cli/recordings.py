"""Commands that show, import, simulate and replay recordings."""

from __future__ import annotations

import sys
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Data, Json, ModelFile, Out
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.recordings.options import ReadOptions


NOT_TYPED = ("topics", "joints", "mechanism")  # options of reading that the command line derives


def info(
    bag: Annotated[
        Path,
        typer.Argument(
            help="rosbag2 folder or file, or saved samples (.json), or a model file (.yaml)"
        ),
    ],
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Show what a recording or a model file contains. For a recording: its topics, its samples, its
    dropped messages with the reasons, and its noise."""
    if bag.suffix in (".yaml", ".yml") and bag.is_file() and bag.name != "metadata.yaml":
        from parallel_cal.model.file.modelfile import model_hash, read_model
        from parallel_cal.model.region import IdentifiedRegion
        from parallel_cal.model.summary import summarise_model

        model = read_model(bag)
        document = {"file": str(bag), "hash": model_hash(model)} | summarise_model(model)
        if as_json:
            return console.emit(document)
        lists = {key: ", ".join(map(str, v)) for key, v in document.items() if isinstance(v, list)}
        usual = f"those of the mechanism and, for class {model.machine_class}, of the catalogue"
        replaced = ", ".join(f"{k} {v:g}" for k, v in model.tolerances.items())
        tolerances = {"tolerances": f"{replaced}; others are {usual}" if replaced else usual}
        region = IdentifiedRegion.of_model(model)
        shown = {"region": "" if region is None else region.description}
        for key, value in (document | lists | tolerances | shown).items():
            console.say(f"{key}: {value if value != '' else 'none'}")
        return None
    from parallel_cal.recordings import info as recording_info

    show_info(recording_info.info(bag, data_options(data), console.progress), as_json)


def show_info(document: dict[str, Any], as_json: bool) -> None:
    if as_json:
        return console.emit(document)
    from parallel_cal.reporting.recorded import describe_info

    console.show(describe_info(document))


def import_csv(
    tables: Annotated[
        list[Path],
        typer.Argument(
            metavar="TABLE.csv...",
            help="tables with one sample per row; if there are several, --columns "
            "states how to match their rows",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="samples to write (.json)")],
    columns: Annotated[
        Path | None,
        typer.Option(
            help="file that maps columns to quantities (YAML); the other commands read a table "
            "without such a file if its header names all columns"
        ),
    ] = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="MAKER",
            help="in place of --columns: the maker of an arm (abb, fanuc, kawasaki, kuka, staubli, "
            "ur), if the columns have the maker's names",
        ),
    ] = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Convert a table to a samples file. Several tables are joined. All commands that read a
    recording accept a samples file."""
    from parallel_cal.recordings import csv_import
    from parallel_cal.recordings.info import info_of

    dataset = csv_import.import_csv(tables, columns, data_options(data), robot)
    dataset.to_json(output)
    document = info_of(dataset)
    show_info(document | {"output": str(output)} if as_json else document, as_json)
    if not as_json:
        console.say(f"written: {output}")


def simulate(
    model: ModelFile,
    output: Out,
    effect: Annotated[
        list[str] | None, typer.Option(metavar="NAME[:PARAM=VALUE,...]", help="hidden effect")
    ] = None,
    poses: Annotated[int, typer.Option(min=1, help="number of different poses")] = 74,
    seed: Annotated[int, typer.Option(min=0, help="seed of poses and noise")] = 0,
    replicates: Annotated[int, typer.Option(min=0, help="number of poses visited twice")] = 0,
    noise_off: Annotated[bool, typer.Option("--noise-off", help="simulate without noise")] = False,
    storage: Annotated[str, typer.Option(help="format of the recording, mcap or sqlite3")] = "mcap",
    as_json: Json = False,
) -> None:
    """Simulate a measuring run and write its recording. The simulated robot is the model with
    hidden effects and noise."""
    if replicates > poses:
        raise typer.BadParameter(
            f"--replicates {replicates}: expected at most the number of poses, {poses}"
        )
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings import simulate as simulation
    from parallel_cal.recordings.writer import write_bag

    session = simulation.simulate(
        read_model(model), poses, seed, effects=effect or (), replicates=replicates, quiet=noise_off
    )
    robot = session.model
    stated = simulation.stated_noise(robot)
    if isinstance(stated.joint, float) and robot.noise.joint is None:
        console.note(
            f"{model} states no joint noise: {stated.joint:.3g} {robot.mechanism.joint_unit} "
            f"is assumed; fit with --joint-sigma {stated.joint:.3g}"
        )
    write_bag(session, output, storage)
    document = simulation.document(session, poses, replicates)
    if as_json:
        return console.emit({"bag": str(output), "seed": seed, **document})
    console.say(
        f"{output}: {poses} poses, {replicates} of them visited twice, "
        f"{document['duration']:.0f} s; "
        f"effects: {', '.join(document['effects']) or 'none'}"
    )


def replay(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or file")],
    rate: Annotated[float, typer.Option(min=0.001, help="speed as a multiple of real time")] = 1.0,
) -> None:
    """Publish a recording again on its topics. Needs ROS 2."""
    import json
    import subprocess

    from parallel_cal.recordings.bag import list_topics

    missing = [m for m in ("rclpy", "parallel_cal.nodes.replay_node") if find_spec(m) is None]
    if missing:
        raise ParallelCalError(
            f"replay needs ROS 2 ({missing[0]} was not found): source your ROS installation, or "
            "pip install 'parallel_cal[ros]'"
        )
    list_topics(bag)  # report a bad recording before the node starts
    code = "from parallel_cal.nodes.replay_node import main; main()"
    # JSON is YAML: a path that looks like a number stays a string.
    parameters = [f"bag:={json.dumps(str(bag))}", f"rate:={rate!r}"]
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    sys.exit(subprocess.run([sys.executable, "-c", code, "--ros-args", *arguments]).returncode)


def data_options(items: list[str] | None) -> ReadOptions:
    """Parse `--data KEY=VALUE`: the topic of a channel, measures, stamps, mode, ...

    `channels=PATH,...` registers your own channels by their Python paths. It comes before the
    options that name their topics.
    """
    from parallel_cal.recordings.channels import CHANNELS, find_channel, register_channels
    from parallel_cal.recordings.options import ReadOptions

    others = [f.name for f in fields(ReadOptions) if f.name not in NOT_TYPED]
    options: dict[str, Any] = {}
    topics: dict[str, str] = {}
    for item in items or []:
        key, equals, value = item.partition("=")
        known = ("channels", *filter(find_channel, CHANNELS), *others)
        if not equals or not (key in known or find_channel(key)):
            raise ParallelCalError(
                f"--data {item}: expected KEY=VALUE, KEY one of {', '.join(known)}"
            )
        if key == "channels":
            for path in value.split(","):
                register_channels(path)
        elif find_channel(key):
            topics[key] = value
        elif key == "columns":
            options[key] = str(Path(value).resolve())
        elif key == "exclude":
            try:
                options.setdefault(key, []).extend(int(word) for word in value.split(","))
            except ValueError:
                raise ParallelCalError(
                    f"--data {item}: expected sample numbers, such as exclude=3,17"
                ) from None
        else:
            options[key] = value.split(",") if key == "measures" else _value(value)
    return ReadOptions(topics=topics, **options)


def _value(text: str) -> Any:
    if "," in text:
        return [_value(word) for word in text.split(",")]
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return int(text) if text.lstrip("-").isdigit() else float(text)
    except ValueError:
        return text
