"""Klipper's stored bed meshes: where the nozzle was when the probe touched the bed.

A mesh holds heights of the bed by the kinematics that were configured when it was probed: the
nozzle was z_offset higher, and beside the point by the probe's offset. A round bed's mesh is padded
to a square. Sources: Klipper documentation, "Bed Mesh"; klippy/extras/bed_mesh.py (84104bbbd).
"""

from __future__ import annotations

import re

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import MM
from parallel_cal.importing.settings import Settings
from parallel_cal.recordings.recording import Array

DEFAULT, NONE = "default", "none"
MAX_HEIGHT_MM = 20.0  # from the nominal plane; no probe searches for a bed further away
# A mesh whose heights count from one of its points: its height above the other touches is unknown.
REFERENCES = ("zero_reference_position", "relative_reference_index")


def choose_mesh(
    stated: Settings, wanted: str, beside_heights: bool, warnings: list[str]
) -> str | None:
    """Return the name of the mesh to use; None without one. Warnings say what is not used, or
    under which condition a mesh is right."""
    ends = "[bed_mesh ", "] points"
    fields = [f for f in stated.texts if f.startswith(ends[0]) and f.endswith(ends[1])]
    meshes = [field[len(ends[0]) : -len(ends[1])] for field in fields]
    if wanted not in (*meshes, DEFAULT, NONE):
        expected = " or ".join([*meshes, NONE])
        raise DatasetError(f"{stated.paths[0]}: no mesh '{wanted}', expected {expected}")
    name = wanted if wanted in meshes else None
    counted = [key for key in REFERENCES if f"[bed_mesh] {key}" in stated]
    if name is not None and beside_heights and counted:
        warnings.append(
            f"[bed_mesh {name}] is not used: its heights count from the point of {counted[0]}, so "
            "they do not fit those of [delta_calibrate]"
        )
        name = None
    if name is not None:
        warnings.append(
            f"[bed_mesh {name}] holds only for the geometry with which it was probed: if it was "
            f"changed since, as by DELTA_CALIBRATE, probe again, or pass --option mesh={NONE}"
        )
    if wanted != NONE and (others := [mesh for mesh in meshes if mesh != wanted]):
        warnings.append(
            f"not used: [bed_mesh {'], [bed_mesh '.join(others)}]; --option mesh=NAME uses another"
        )
    return name


def read_mesh(stated: Settings, name: str, offset: Array) -> Array:
    """Return the positions (N, 3) in m of the nozzle by the firmware at the touches of a mesh.

    `offset` (3,) in m is the probe's, from the nozzle: beside it, and the height at a touch.
    """
    section = f"[bed_mesh {name}]"
    axes = []
    for axis in "xy":
        n = stated.number(f"{section} {axis}_count", "a number of points", low=2)
        low, high = (stated.number(f"{section} {end}_{axis}", "mm") for end in ("min", "max"))
        axes.append(np.linspace(low, high, int(n)))
    text, place = stated.text(f"{section} points", "heights in mm")
    words = [word for word in re.split(r"[,\s]+", text) if word]
    x, y = (grid.ravel() for grid in np.meshgrid(*axes))
    if len(words) != len(x):
        raise place.error(f"{section} points", f"{len(words)} heights", f"{len(x)} heights")
    within = f"a height in mm within {MAX_HEIGHT_MM:g} of the bed"
    z = [
        place.number(f"{section} points", word, within, -MAX_HEIGHT_MM, MAX_HEIGHT_MM)
        for word in words
    ]
    probed = np.ones(len(x), bool)
    if "[bed_mesh] mesh_radius" in stated:
        radius = stated.number("[bed_mesh] mesh_radius", "mm", low=1.0)
        centre = (axes[0][[0, -1]].mean(), axes[1][[0, -1]].mean())
        probed = np.hypot(x - centre[0], y - centre[1]) <= radius + 1e-3
    bed = np.column_stack([x, y, z])[probed] * MM
    return np.asarray(bed + offset * [-1, -1, 1])
