"""Real images and joint readings of an arm: `python -m bench.truth.real_arm FOLDER FOLDER`.

Each FOLDER holds `data/captured-data` of github.com/kvasios/franka-handeye (MIT, according to its
pyproject.toml) at one of the commits f909a5e and 0b9fe29: 12 images of 1280 x 720 px of a printed
board on a table, by a camera on the flange of a Franka Emika arm, and its seven joint readings at
each. The arm has the dimensions that its maker publishes. For each folder, the arm as drawn is
compared with the identified arm, at poses that the fit did not use; the arm identified from the
first folder is then tried on the others. Numbers in docs/camera_model.md.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import parallel_cal as pc
from parallel_cal.importing.importers import images
from parallel_cal.importing.urdf import arm
from parallel_cal.reporting.images import describe_robot_error, list_images
from parallel_cal.sensors.camera import Camera

BOARD, SQUARE, SIZE = "5x7:6X6_250:0.8235", 0.034, (1280, 720)  # markers of 28 mm
JOINTS = [f"joint{i}" for i in range(1, 8)]
# Place (m) of each joint after the one before, and its turn about x (rad), as published by Franka.
PLACES = (
    ((0.0, 0.0, 0.333), 0.0),
    ((0.0, 0.0, 0.0), -math.pi / 2),
    ((0.0, -0.316, 0.0), math.pi / 2),
    ((0.0825, 0.0, 0.0), math.pi / 2),
    ((-0.0825, 0.384, 0.0), -math.pi / 2),
    ((0.0, 0.0, 0.0), math.pi / 2),
    ((0.088, 0.0, 0.0), math.pi / 2),
)
FLANGE = 0.107  # m, behind the last joint
ROBOT = ["link*", "base*"]  # the parameters of the arm
HOLD_OUT = 0.01  # each fit of the cross-validation holds one pose out


def make_arm(work: Path) -> pc.Model:
    """Return the arm as drawn, with the camera on its flange."""
    lines = ['<robot name="arm"><link name="link0"/>']
    for i, ((x, y, z), turn) in enumerate(PLACES, 1):
        lines.append(
            f'<link name="link{i}"/><joint name="joint{i}" type="revolute">'
            f'<parent link="link{i - 1}"/><child link="link{i}"/><axis xyz="0 0 1"/>'
            f'<origin xyz="{x} {y} {z}" rpy="{turn} 0 0"/><limit lower="-3.8" upper="3.8"/></joint>'
        )
    lines.append(
        '<link name="flange"/><joint name="end" type="fixed"><parent link="link7"/>'
        f'<child link="flange"/><origin xyz="0 0 {FLANGE}"/></joint></robot>'
    )
    (work / "arm.urdf").write_text("\n".join(lines))
    return arm(work / "arm.urdf").model.with_sensors(
        (Camera(5, 7, SQUARE, SIZE, mounted="platform"),)
    )


def read_images(folder: Path, work: Path) -> pc.Dataset:
    """Find the board in the images of `pose_00/image.png` and so on; joints from `data.json`."""
    shots = work / folder.name
    shots.mkdir()
    lines = [",".join(["image", *(f"{name} [rad]" for name in JOINTS)])]
    for pose in sorted(folder.glob("pose_*/image.png")):
        name = f"{pose.parent.name}.png"
        (shots / name).symlink_to(pose.resolve())
        state = json.loads((pose.parent / "data.json").read_text())
        lines.append(",".join([name, *map(repr, state["joint_pose"])]))
    table = work / f"{folder.name}.csv"
    table.write_text("\n".join(lines))
    return images.samples([shots], joints=str(table), board=BOARD)


def describe(words: str, fitted: pc.FitResult) -> str:
    """Say how far corners and positions are off at poses that the fit did not use."""
    own = next(iter(describe_robot_error(fitted)), "").partition(". ")[0]
    return f"{words}: {list_images(fitted)[0].rms:.2f} px rms of a corner; {own}"


def main(folders: list[Path]) -> None:
    with TemporaryDirectory() as name:
        work = Path(name)
        drawn = make_arm(work)
        read = {folder.name: read_images(folder, work) for folder in folders}
    identified = drawn
    for where, data in read.items():
        print(f"{where}: {len(data)} images, {count_corners(data)} corners")
        print(describe("  arm as drawn", pc.fit(drawn, data, fix=ROBOT, hold_out=HOLD_OUT)))
        found = pc.fit(drawn, data, hold_out=HOLD_OUT)
        print(describe("  arm identified", found))
        if identified is drawn:
            identified = found.model
        else:
            tried = pc.fit(identified, data, fix=ROBOT, hold_out=HOLD_OUT)
            print(describe("  arm identified from the first folder", tried))


def count_corners(data: pc.Dataset) -> int:
    """Return the number of corners that were found in the images."""
    return sum(int(np.isfinite(c).sum()) for n, c in data.conditions.items() if n.endswith(".u"))


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
