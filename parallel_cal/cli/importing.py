"""The command that imports the files of a controller or of a measuring device."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.cli.arguments import Json
from parallel_cal.cli.models import parse_options
from parallel_cal.cli.recordings import show_info
from parallel_cal.reporting import console


def import_(
    kind: Annotated[
        str,
        typer.Argument(
            help="rrf, klipper, marlin, linuxcnc, fluidnc, maslow, touches, table or images; or "
            "the Python path of your own importer"
        ),
    ],
    files: Annotated[
        list[Path],
        typer.Argument(
            help="files of the controller, and its configuration; a tracker's table and a joint "
            "log; or folders of images"
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="samples to write (.json)")],
    option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help="option of the importer")
    ] = None,
    joints: Annotated[
        Path | None, typer.Option(help="table of the joint readings at each image (CSV)")
    ] = None,
    as_json: Json = False,
) -> None:
    """Convert files of a controller or device to samples. The files are one of these: those of a
    controller; a tracker's table and a joint log; images of a printed board, with --joints. For
    tables with any other columns, use import-csv."""
    from parallel_cal.importing.controller_files import samples
    from parallel_cal.recordings.info import info_of

    options = parse_options(option)
    if joints is not None:
        options["joints"] = str(joints)
    dataset = samples(kind, files, **options)
    dataset.to_json(output)
    document = info_of(dataset)
    show_info(document | {"output": str(output)} if as_json else document, as_json)
    if not as_json:
        console.say(f"written: {output}")
