"""A virtual Delta holds a printed board in front of a camera: images and a table of its joints.

The images are rendered, with lens distortion, blur and noise. The robot is built with errors of
some tenths of a millimetre. Import the images with `parallel-cal import images` (docs/camera.md).
"""

from pathlib import Path

import cv2  # pip install 'parallel_cal[camera]'
import numpy as np

from parallel_cal.imaging.board import Board
from parallel_cal.virtual.camera import Camera, FlatBoard
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.robot import turn

N_IMAGES, SEED = 60, 1
BOARD, SQUARE = Board(columns=8, rows=6), 0.03  # as `parallel-cal board charuco` prints it

rng = np.random.default_rng(SEED)
machine = MACHINES["delta"]
built = machine.make_built(SEED)

# The board is under the platform; its middle is near the platform's origin.
board_R = turn(np.array([0.02, -0.01, 0.3]))  # z points into the board, up to the platform
board_r = np.array([0.0, 0.0, -0.05]) - board_R @ [4 * SQUARE, 3 * SQUARE, 0.0]
lens = (-0.18, 0.06, 4e-4, -3e-4)
camera = Camera(focal=(1210.0, 1206.0), centre=(644.0, 508.0), distortion=lens)

# The camera stands obliquely below the robot and looks at the middle of the workspace.
q = machine.make_nominal().home_joints + rng.uniform(-0.5, 0.5, (N_IMAGES, 3))
r, R = built.forward(q)
camera_R = turn(np.array([0.5, 0.15, 0.0]))
camera_r = r.mean(axis=0) + [0.0, 0.0, -0.05] - camera_R @ [0.0, 0.0, 0.6]

folder = Path("shots")
folder.mkdir(exist_ok=True)
flat = FlatBoard(BOARD.raster(56), SQUARE / 56)
rows = ["image,joint1 [deg],joint2 [deg],joint3 [deg]"]
for k in range(N_IMAGES):
    in_base = r[k] + R[k] @ board_r, R[k] @ board_R
    in_camera = camera_R.T @ (in_base[0] - camera_r), camera_R.T @ in_base[1]
    name = f"shot_{k:03d}.png"
    cv2.imwrite(str(folder / name), camera.render(flat, *in_camera, rng))
    shown = np.degrees(q[k] + machine.noise.joint * rng.standard_normal(3))
    rows.append(",".join([name, *(f"{angle:.6f}" for angle in shown)]))
Path("joints.csv").write_text("\n".join(rows) + "\n")
print(f"{N_IMAGES} images in {folder}, joints in joints.csv")

# Prints:
# 60 images in shots, joints in joints.csv
