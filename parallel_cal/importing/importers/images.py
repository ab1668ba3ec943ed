"""Images of a printed board, and a table of the joint readings at each image.

Each image becomes a sample. Its readings are the pixels of the board's corners,
`camera.NUMBER.u` and `camera.NUMBER.v`; a corner that is not seen has no reading. A column of the
table names the image of each row, states its number or its time. Without such a column, the rows
belong to the images in the order of their names.
"""

from __future__ import annotations

import dataclasses
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import SECONDS, find_clock_unit
from parallel_cal.imaging.board import read_board
from parallel_cal.imaging.folder import BoardImage, detect_in_files, list_images
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.file.schema import NoisePart
from parallel_cal.recordings.columns import (
    ColumnMap,
    JointColumn,
    PositionColumns,
    read_column_map,
)
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.header_names import find_conditions, find_readings
from parallel_cal.recordings.joining import fingerprint
from parallel_cal.recordings.recording import Array, Dropped
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.table import Table, read_table, split_unit
from parallel_cal.recordings.table_samples import make_dataset

ROW = "row"  # joins images and rows by their order
TIMES = ("t", "time", "timestamp", "stamp")
NUMBERS = ("image", "index", "number", "frame", "shot", "sample", "pose")
MEASURED = ("x", "y", "z", "qx", "qy", "qz", "qw")
MAX_LISTED = 20  # images in one line of text


def samples(
    paths: Sequence[Path],
    joints: str,
    board: str = "8x6",
    columns: str = "",
    by: str = "",
    within: float | None = None,
    camera: str = "camera",
    max_edge_width: float | None = None,
    joint_sigma: float | None = None,
) -> Dataset:
    """Detect the board in the images of a folder, and join them with the joint readings.

    Each further folder holds the images of another camera, `camera2`, `camera3` and so on, with
    names as in the first. `joints` is the table, `columns` its column map if the header does not
    suffice. `by` is the column that states the image of a row, or `row`; with `within` (s), its
    times are compared with those in the names of the images. `max_edge_width` (px) excludes
    blurred images.
    """
    if not isinstance(joints, str) or not joints:
        raise DatasetError(f"joints={joints}: expected the table of joint readings (CSV)")
    table = read_table(Path(joints)).drop_empty_rows()
    printed = read_board(str(board))
    cameras = {
        camera if k == 0 else f"{camera}{k + 1}": list_images(Path(folder))
        for k, folder in enumerate(paths)
    }
    matches = {name: match_images(table, files, by, within) for name, files in cameras.items()}
    key = next(iter(matches.values())).column
    wanted = _wanted_columns(table, columns, key, joint_sigma)
    dataset = make_dataset([table], wanted, columns or "import images", used=(key,))
    seen, notes = np.zeros(len(dataset), bool), list[str]()
    dropped = list(dataset.dropped)
    conditions = dict(dataset.conditions)
    for name, files in cameras.items():
        images = detect_in_files(files, printed, max_edge_width)
        rows = matches[name].rows
        conditions |= _readings(name, images, rows, len(dataset))
        seen[[row for row, one in zip(rows, images, strict=True) if row >= 0 and not _bad(one)]] = 1
        dropped += _list_unused(name, images, rows)
        notes += [matches[name].note] if matches[name].note else []
        notes += _describe(name, images, rows, printed.columns, printed.rows)
    if not seen.any():
        raise DatasetError(
            f"{joints}: no row belongs to an image that shows the board; first image "
            f"{next(iter(cameras.values()))[0].name}, first row {table.rows[0]}: name the column "
            "that states the image of a row (--option by=COLUMN, or by=row)"
        )
    if count := int((~seen).sum()):
        lines = [table.lines[k] for k in np.flatnonzero(~seen)]
        detail = f"{joints}: {_shorten([f'line {line}' for line in lines])}"
        dropped.append(Dropped(0.0, "row without a usable image", detail, count))
    dataset = dataclasses.replace(
        dataset,
        conditions=conditions,
        dropped=tuple(dropped),
        warnings=(*dataset.warnings, *notes),
        source=", ".join([*map(str, paths), joints]),
    ).select(seen)
    return dataclasses.replace(dataset, sha256=fingerprint(dataset))


@dataclass(frozen=True)
class Match:
    """The row of each image, -1 for none; the column that states it, and a note."""

    rows: list[int]
    column: str = ""
    note: str = ""


def match_images(table: Table, files: Sequence[Path], by: str, within: float | None) -> Match:
    """Find the row of a table for each image; DatasetError if nothing tells."""
    word = None if by in ("", ROW) else table.find(by)
    if by not in ("", ROW) and word is None:
        raise DatasetError(
            f"{table.path}:1: no column {by} to join by; the table has {', '.join(table.header)}"
        )
    if within is not None:
        word = word or next((w for w in table.header if w.lower() in TIMES), None)
        if word is None:
            raise DatasetError(
                f"{table.path}:1: within={within:g} compares times, but no column is named one of "
                f"{', '.join(TIMES)}: name it (--option by=COLUMN)"
            )
        return Match(_match_times(table, word, files, within), word)
    if by != ROW:
        candidates = [word] if word else table.header
        for match in (_match_names, _match_numbers):
            found = [
                (rows, column)
                for column in candidates
                if match is _match_names or word or column.lower() in NUMBERS
                for rows in [match(table, column, files)]
                if any(row >= 0 for row in rows)
            ]
            if found:
                rows, column = max(found, key=lambda item: sum(row >= 0 for row in item[0]))
                return Match(rows, column)
        if word:
            raise DatasetError(
                f"{table.path}: column {word} names no image of {files[0].parent}: expected names "
                f"such as {files[0].name}, or numbers as in them"
            )
    if len(table.rows) != len(files):
        raise DatasetError(
            f"{table.path}: {len(table.rows)} rows, but {len(files)} images in {files[0].parent}, "
            f"and no column that names an image such as {files[0].name}: add one, or name the "
            "column that states the number or the time of the image (--option by=COLUMN)"
        )
    note = (
        f"{table.path} and {files[0].parent} were matched in the order of rows and of names, "
        "because no column names the images"
    )
    return Match(list(range(len(files))), "", note)


def _match_names(table: Table, column: str, files: Sequence[Path]) -> list[int]:
    rows = _rows_by_text(table, column, lambda text: Path(text.replace("\\", "/")).name)
    return [rows.get(file.name, rows.get(file.stem, -1)) for file in files]


def _match_numbers(table: Table, column: str, files: Sequence[Path]) -> list[int]:
    """Match whole numbers with the last number in the names of the images."""
    rows = _rows_by_text(table, column, lambda text: text.lstrip("0") or "0")
    numbers = [re.findall(r"\d+", file.stem) for file in files]
    return [rows.get(found[-1].lstrip("0") or "0", -1) if found else -1 for found in numbers]


def _rows_by_text(table: Table, column: str, change: Callable[[str], str]) -> dict[str, int]:
    rows: dict[str, int] = {}
    for k, text in enumerate(table.texts(column)):
        rows.setdefault(change(text), k)
    return rows


def _match_times(table: Table, word: str, files: Sequence[Path], within: float) -> list[int]:
    """Match each image with the row whose time is nearest, at most `within` s away."""
    times = np.array([_seconds(text) for text in table.texts(word)])
    if not np.isfinite(times).all():
        k = int(np.argmin(np.isfinite(times)))
        raise DatasetError(
            f"{table.path}:{table.lines[k]}: column {word} contains {table.texts(word)[k]!r:.60}, "
            "expected a time in s, ms, us or ns"
        )
    rows = []
    for file in files:
        away = np.abs(times - _seconds(file.stem))
        near = int(np.nanargmin(away)) if np.isfinite(away).any() else 0
        rows.append(near if away[near] <= within else -1)
    return rows


def _seconds(text: str) -> float:
    """Return a time in s: the last number of a text, whose unit follows from its size."""
    found = re.findall(r"\d+(?:\.\d+)?", text)
    if not found:
        return np.nan
    digits = len(found[-1].partition(".")[0])  # leading zeros count, too
    return float(found[-1]) * SECONDS[find_clock_unit(10.0 ** (digits - 1))]


def _wanted_columns(table: Table, columns: str, key: str, sigma: float | None) -> ColumnMap:
    """Return the column map: the stated one, or that of columns whose header states a unit."""
    if columns:
        return read_column_map(Path(columns), measured_elsewhere=True)
    names = [split_unit(word) for word in table.header if word != key]
    joints = [
        name
        for name, unit in names
        if unit
        and name not in MEASURED
        and name.partition(".")[0] not in CONDITIONS
        and not name.startswith(READING)
    ]
    if not joints:
        raise DatasetError(
            f"{table.path}:1: no joints in {', '.join(table.header)}: state the unit of each joint "
            "in its header (joint1 [deg]), or a column map (--option columns=MAP.yaml)"
        )
    position, orientation = (
        [name for name in part if table.find(name) is not None]
        for part in (MEASURED[:3], MEASURED[3:])
    )
    return ColumnMap(
        joints={name: JointColumn(column=name) for name in joints},
        position=PositionColumns(columns=position) if len(position) == 3 else None,
        orientation=orientation if len(orientation) == 4 else None,
        readings=find_readings(table),
        conditions=find_conditions(table, joints),
        noise=NoisePart(joint=sigma),
    )


def _readings(
    camera: str, images: Sequence[BoardImage], rows: Sequence[int], n: int
) -> dict[str, Array]:
    """Return the pixels (n,) of each corner that any image shows; NaN where it is not seen."""
    found: dict[str, Array] = defaultdict(lambda: np.full(n, np.nan))
    shown = sorted({int(number) for one in images for number in one.corners.numbers})
    for number in shown:
        for axis in "uv":
            found[f"{READING}{camera}.{number}.{axis}"]  # in the order of the numbers
    for one, row in zip(images, rows, strict=True):
        if row < 0:
            continue
        for number, pixel in zip(one.corners.numbers, one.corners.pixels, strict=True):
            for axis, value in zip("uv", pixel, strict=True):
                found[f"{READING}{camera}.{number}.{axis}"][row] = value
    return dict(found)


def _bad(one: BoardImage) -> bool:
    return bool(one.corners.problem)


def _list_unused(camera: str, images: Sequence[BoardImage], rows: Sequence[int]) -> list[Dropped]:
    """Return every image that is not used, grouped by the reason."""
    reasons: dict[str, list[str]] = defaultdict(list)
    for one, row in zip(images, rows, strict=True):
        if _bad(one):
            detail = f" ({one.corners.detail})" if one.corners.detail else ""
            reasons[one.corners.problem].append(f"{one.name}{detail}")
        elif row < 0:
            reasons["no joint readings"].append(one.name)
    return [
        Dropped(0.0, f"{camera}: {reason}", ", ".join(names), len(names))
        for reason, names in reasons.items()
    ]


def _describe(
    camera: str, images: Sequence[BoardImage], rows: Sequence[int], columns: int, squares: int
) -> list[str]:
    """Return what was detected, and which corners were excluded."""
    used = [one for one, row in zip(images, rows, strict=True) if row >= 0 and not _bad(one)]
    if not used:
        return []
    counts = [len(one.corners.numbers) for one in used]
    width, height = used[0].corners.size
    edge = float(np.nanmedian([one.corners.edge_width for one in used]))
    notes = [
        f"{camera}: {len(used)} of {len(images)} images are used, with {np.mean(counts):.1f} "
        f"corners each; edges are {edge:.1f} px wide. Sensor: camera: {{columns: {columns}, rows: "
        f"{squares}, square: SIZE_IN_M, image_size: [{width}, {height}]}}"
    ]
    wrong = [
        f"{one.name} corner {number} ({residual:.1f} px)"
        for one in used
        for number, residual in one.corners.excluded.items()
    ]
    if wrong:
        notes.append(
            f"{camera}: {len(wrong)} corners were excluded, because they are not where the others "
            f"of their image expect them: {_shorten(wrong)}"
        )
    return notes


def _shorten(words: Sequence[str]) -> str:
    more = len(words) - MAX_LISTED
    return ", ".join(words[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")
