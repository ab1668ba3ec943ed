"""The command that discovers laws outside the catalogue."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.base.parallel import Runner, run_on_cores
from parallel_cal.cli.arguments import (
    Bags,
    Data,
    FittingByMethod,
    Json,
    ModelFile,
    Scheduler,
    with_options,
)
from parallel_cal.cli.calibration import Given, read_model_and_data
from parallel_cal.reporting import console

EffectOut = Annotated[
    Path | None,
    typer.Option(
        "-o", "--output", metavar="my_effect.py", help="effect file to write [default: none]"
    ),
]


@with_options
def discover(
    model: ModelFile,
    bags: Bags,
    *,
    output: EffectOut = None,
    scheduler: Scheduler = None,
    options: FittingByMethod,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Find the law of an error that no effect describes. `-o` writes it as an effect that `add`
    takes."""
    from parallel_cal.discovery import discovery
    from parallel_cal.discovery.effect_file import check_effect_path

    if output is not None:
        check_effect_path(output)  # before a search of seconds
    judged, dataset = read_model_and_data(model, bags, data)
    with _choose_runner(scheduler) as run:
        found = discovery.discover(
            judged, dataset, options=options, progress=console.progress, run=run
        )
    files = found.write(output) if output is not None else []
    console.progress("", 1.0)
    if as_json:
        return console.emit(found.document(files))
    from parallel_cal.reporting import text
    from parallel_cal.reporting.summary import list_step, summary_table

    console.show(text.list_blocks(found))
    if output is not None and not files:
        console.say(f"nothing was written to {output}: no law was proven to be the robot's")
    if files:
        # Together: each law was proven beside those before it.
        console.say(f"written: {', '.join(map(str, files))}")
        laws = "+".join(file.stem for file in files)
        given = Given(model, bags, data, options.update)
        lines = list_step("next:", f"parallel-cal add MODEL {laws} RECORDING -o better.yaml")
        console.show([summary_table(given.fill(lines, judged, folders=[files[0].parent]))])


@contextmanager
def _choose_runner(scheduler: str | None) -> Iterator[Runner]:
    """The runner of a Dask cluster at an address, else that of this machine's cores."""
    if scheduler is None:
        yield run_on_cores
        return
    from parallel_cal.fleet.cluster import check_extra_installed, cluster, run_on_cluster

    check_extra_installed()
    with cluster(scheduler, None) as client:
        yield run_on_cluster(client)
