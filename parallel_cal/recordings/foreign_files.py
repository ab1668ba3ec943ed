"""Files of measuring devices that are not read: what they hold, and how else to give it."""

from __future__ import annotations

from pathlib import Path

C3D = (
    "a C3D file of a motion capture. Export the bodies or trajectories as CSV (Motive, Tracker and "
    "Nexus do; see docs/import_csv.md)"
)
RENISHAW = (
    "a file of Renishaw with the deviations of one axis at its targets, and no poses. Write a "
    "table with one row for each run and target: the readings of all joints, and as x the target "
    "plus its deviation (position: {columns: [x, null, null]} in the column map)"
)
HEIGHT_MAP = (
    "a height map of RepRapFirmware, which has no joint readings. Import it with the configuration "
    "with which it was probed (parallel-cal import rrf {path} config.g -o touches.json), and use "
    "touches.json in its place"
)


def describe_foreign(path: Path) -> str | None:
    """Return what a file of a device holds that is not read, and the cure; None for other files.

    A C3D file has the byte 0x50 behind the number of the block in which its parameters begin. A
    `.rtl` file of Renishaw begins with the section `HEADER::`, a height map with its title.
    """
    with path.open("rb") as stream:
        begin = stream.read(32)
    if path.suffix.lower() == ".c3d" or (begin[:1] == b"\x02" and begin[1:2] == b"\x50"):
        return C3D
    if begin.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"HEADER::"):
        return RENISHAW
    if begin.startswith(b"RepRapFirmware height map"):
        return HEIGHT_MAP.format(path=path.name)
    return None
