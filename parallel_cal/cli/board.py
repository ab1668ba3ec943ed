"""The command that draws boards to print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.cli.arguments import Json
from parallel_cal.reporting import console

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Draw a board to print for a camera."
)


@app.callback()
def _choose_kind() -> None: ...


@app.command()
def charuco(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="sheet to write, .pdf or .svg, in true size")
    ],
    columns: Annotated[int, typer.Option(help="number of squares from left to right")] = 8,
    rows: Annotated[int, typer.Option(help="number of squares from top to bottom")] = 6,
    square: Annotated[float, typer.Option(min=1.0, help="size of a square, mm")] = 30.0,
    marker: Annotated[
        float | None, typer.Option(help="size of a marker, mm; by default 3/4 of a square")
    ] = None,
    dictionary: Annotated[str, typer.Option(help="dictionary of the markers")] = "5X5_100",
    page: Annotated[
        str, typer.Option(help="A0 to A5, letter, legal, tabloid, or WIDTHxHEIGHT in mm")
    ] = "A4",
    legacy: Annotated[
        bool, typer.Option("--legacy", help="the pattern of OpenCV 4.5 and older")
    ] = False,
    as_json: Json = False,
) -> None:
    """Draw a ChArUco board with rulers to check the print. State the printed size of the squares
    in the model file (camera: square, m)."""
    from parallel_cal.imaging.board import Board
    from parallel_cal.imaging.sheet import make_sheet

    share = Board.marker if marker is None else marker / square
    board = Board(columns, rows, dictionary, share, legacy)
    sheet = make_sheet(board, square, page)
    sheet.write(output)
    document = {
        "output": str(output),
        "board": board.text,
        "square": 1e-3 * square,
        "corners": board.corner_count,
        "page": [1e-3 * sheet.width, 1e-3 * sheet.height],
    }
    if as_json:
        return console.emit(document)
    console.say(
        f"{output}: {board.text}, {board.corner_count} corners, squares of {square:g} mm on "
        f"{sheet.width:g} x {sheet.height:g} mm. Print at 100 % and check both rulers"
    )
