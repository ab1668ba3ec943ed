#!/bin/sh
# Versions: ezc3d 1.7.2, c3d 0.6.0
# Question: ezc3d writes a C3D file of 70,000 frames (11.7 minutes at 100 Hz). How many frames are read?
# Guess: "70,000: the header has 16 bits, but the parameters of TRIAL or POINT hold the true number."
# True: ezc3d reads 65,535 of its own 70,000 frames without a word. c3d reads none, with a warning of an
#   overflow.
# Matters: A long capture loses its end, and the poses of the last minutes have no measurements.
cd "$(dirname "$0")" && ./with_packages ezc3d==1.7.2 c3d==0.6.0 numpy==2.4.6 <<'END'
import os
import warnings

import numpy as np

warnings.simplefilter("ignore")
import c3d
import ezc3d

FRAMES = 70_000
file = ezc3d.c3d()
file["parameters"]["POINT"]["RATE"]["value"] = [100]
file["parameters"]["POINT"]["LABELS"]["value"] = ["marker"]
points = np.ones((4, 1, FRAMES))
points[0, 0] = np.arange(FRAMES)
file["data"]["points"] = points
file.write("long.c3d")
read = ezc3d.c3d("long.c3d")["data"]["points"].shape[2]
with open("long.c3d", "rb") as stream:
    other = sum(1 for _ in c3d.Reader(stream).read_frames())
print(f"written {FRAMES}, {os.path.getsize('long.c3d')} bytes; read by ezc3d {read}, by c3d {other}")
assert os.path.getsize("long.c3d") >= 16 * FRAMES  # all frames are in the file
assert (read, other) == (65_535, 0)
END
# Seen:
#   written 70000, 1121792 bytes; read by ezc3d 65535, by c3d 0
