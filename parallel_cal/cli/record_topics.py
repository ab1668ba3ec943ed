"""The command that lists the topics of a recording to be made."""

from __future__ import annotations

import shlex
from typing import Annotated

import typer

from parallel_cal.cli.arguments import Data, Json
from parallel_cal.cli.recordings import data_options
from parallel_cal.reporting import console


def record_topics(
    data: Data = None,
    namespace: Annotated[str, typer.Option(help="namespace of topics without a leading /")] = "",
    command: Annotated[
        bool, typer.Option("--command", help="print the command line of ros2 bag record")
    ] = False,
    output: Annotated[
        str, typer.Option("-o", "--output", help="folder of the recording, for --command")
    ] = "recording",
    as_json: Json = False,
) -> None:
    """List the topics to record with `ros2 bag record`. Give the options --data with which you will
    read the recording."""
    from parallel_cal.recordings.record_topics import list_record_topics, make_record_command

    topics = list_record_topics(data_options(data), namespace)
    words = make_record_command(topics, output)
    if as_json:
        return console.emit({"topics": topics, "command": words})
    console.write(shlex.join(words) if command else "\n".join(topics))
