"""Real images of a printed board that a real robot holds.

FOLDER is `examples/data/test_set_charuco` of github.com/ros-industrial/industrial_calibration
(Apache-2.0, commit fe62b7c): 16 images of 1600 x 1200 px by a camera on a stand, and the pose of
the robot's flange at each. The set has no joint readings. So the "joints" of the robot are the
coordinates of its pose, and the fit identifies the camera, not the robot. Numbers in
docs/camera_model.md. Usage: `python -m bench.truth.real_images FOLDER`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

import parallel_cal as pc
from parallel_cal.base.rotation import exponential
from parallel_cal.importing.importers import images
from parallel_cal.reporting.text import show
from parallel_cal.sensors.camera import Camera

BOARD, SQUARE, SIZE = "5x7:6X6_250:0.5044", 0.036195, (1600, 1200)
LENGTH = 0.2  # m by which angles are multiplied
JOINTS = ("px", "py", "pz", "pa", "pb", "pc")  # position, rotation vector from the first pose


class FreePose(pc.Mechanism):
    """A robot of which only the poses are known."""

    joints = JOINTS
    parameters = pc.ParameterTable(pc.Parameter(f"gain.{c}", "1", 0.0, 1e-3) for c in "xyz")
    home = pc.Home(joints=(0.0,) * 6)
    workspace = pc.Workspace(low=(-2.0,) * 3 + (-1.0,) * 3, high=(2.0,) * 3 + (1.0,) * 3)
    joint_limits = ((-4.0, 4.0),) * 6
    periodic = False
    length = LENGTH

    @property
    def joint_units(self) -> tuple[str, ...]:
        return ("m",) * 3 + ("rad",) * 3

    def closure(self, q: Any, r: Any, R: Any, p: Any) -> Any:
        place = ca.vertcat(*[q[i] * (1 + p["gain"][c]) for i, c in enumerate("xyz")])
        turn = R @ exponential(q[3:]).T
        return ca.vertcat(r - place, LENGTH * ca.inv_skew(turn - turn.T) / 2)


def read_poses(folder: Path) -> dict[str, np.ndarray]:
    """Return the coordinates (6,) of each image's pose, relative to the first rotation."""
    listed = yaml.safe_load((folder / "cal_data.yaml").read_text())["data"]
    poses = {
        one["image"]: yaml.safe_load((folder / one["pose"]).read_text())
        for one in sorted(listed, key=lambda one: int(Path(one["image"]).stem))
    }
    turns = [Rotation.from_quat([p[f"q{c}"] for c in "xyzw"]) for p in poses.values()]
    middle = Rotation.concatenate(turns).mean()
    return {
        Path(image).name: np.r_[[p[c] for c in "xyz"], (turn * middle.inv()).as_rotvec()]
        for (image, p), turn in zip(poses.items(), turns, strict=True)
    }


def main(folder: Path) -> None:
    poses = read_poses(folder)
    with TemporaryDirectory() as work:
        table = Path(work) / "joints.csv"
        units = ["m"] * 3 + ["rad"] * 3
        header = [f"{name} [{unit}]" for name, unit in zip(JOINTS, units, strict=True)]
        rows = [",".join([name, *(f"{v:.9f}" for v in q)]) for name, q in poses.items()]
        table.write_text("\n".join([",".join(["image", *header]), *rows]))
        data = images.samples([folder / "images"], joints=str(table), board=BOARD)
    sensor = Camera(5, 7, SQUARE, SIZE)
    model = pc.new_model(FreePose(), sensors=[sensor])
    print(show(pc.fit(model, data, fix=["gain.*"])))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
