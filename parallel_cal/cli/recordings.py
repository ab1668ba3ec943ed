"""Recordings: looking at one, making one up, playing one back."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.recording import Topics
from parallel_cal.recordings.samples import Options
from parallel_cal.reporting import console


def info(bag: Path, data: list[str], as_json: bool) -> None:
    from parallel_cal.recordings import info as looking

    options = data_options(data)
    document = looking.info(bag, progress=bag_progress, **options)
    if as_json:
        return console.emit(document)
    from rich.console import Console

    looking.print_info(document, Console())


def simulate(
    model_file: Path,
    output: Path,
    specs: list[str],
    poses: int,
    seed: int,
    replicates: int,
    noise_off: bool,
    storage: str,
    as_json: bool,
) -> None:
    from parallel_cal.recordings import simulate as simulation
    from parallel_cal.recordings.writer import write_bag

    session = simulation.simulate(
        read_model(model_file),
        poses,
        seed,
        effects=specs,
        replicates=replicates,
        quiet=noise_off,
    )
    robot = session.model
    stated = simulation.stated_noise(robot)
    if robot.noise.joint is None:
        console.note(
            f"{model_file} states no joint noise: {stated.joint:.3g} {robot.mechanism.joint_unit} "
            f"is taken; identify with --joint-sigma {stated.joint:.3g}"
        )
    write_bag(session, output, storage)
    document = simulation.document(session, poses, replicates)
    if as_json:
        return console.emit({"bag": str(output), "seed": seed, **document})
    console.say(
        f"{output}: {poses} poses, {replicates} of them twice, {document['duration']:.0f} s; "
        f"effects: {', '.join(document['effects']) or 'none'}"
    )


def replay(bag: Path, rate: float) -> None:
    """Run replay_node on a recording; its exit status becomes ours."""
    from parallel_cal.recordings.bag import list_topics

    missing = [m for m in ("rclpy", "parallel_cal.nodes.replay_node") if find_spec(m) is None]
    if missing:
        raise ParallelCalError(
            f"replay needs ROS 2 ({missing[0]} is missing): source your ROS installation, or "
            "pip install 'parallel_cal[ros]'"
        )
    list_topics(bag)  # a bad recording is better said before the node starts
    code = "from parallel_cal.nodes.replay_node import main; main()"
    # JSON is YAML: a path that looks like a number stays a string.
    parameters = [f"bag:={json.dumps(str(bag))}", f"rate:={rate!r}"]
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    sys.exit(subprocess.run([sys.executable, "-c", code, "--ros-args", *arguments]).returncode)


def bag_progress(fraction: float, text: str) -> None:
    console.progress(text, fraction)


def data_options(items: list[str]) -> dict[str, Any]:
    """`--data KEY=VALUE` as the options of load_dataset: topics, measures, stamps, mode, ..."""
    channels = [f.name for f in fields(Topics)]
    numbers = [f.name for f in fields(Options)]
    options: dict[str, Any] = {}
    topics: dict[str, str] = {}
    for item in items:
        key, equals, value = item.partition("=")
        known = (*channels, "measures", "stamps", "exclude", *numbers)
        if not equals or key not in known:
            raise ParallelCalError(
                f"--data {item}: expected KEY=VALUE, KEY one of {', '.join(known)}"
            )
        if key in channels:
            topics[key] = value
        elif key == "exclude":
            options[key] = _sample_numbers(value)
        else:
            options[key] = value.split(",") if key == "measures" else _value(value)
    return options | ({"topics": Topics(**topics)} if topics else {})


def _sample_numbers(text: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise ParallelCalError(
            f"--data exclude={text}: expected numbers of samples, such as exclude=3,17"
        ) from None


def _value(text: str) -> Any:
    if "," in text:
        return [_value(word) for word in text.split(",")]
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return int(text) if text.lstrip("-").isdigit() else float(text)
    except ValueError:
        return text
