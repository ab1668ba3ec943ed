#!/bin/sh
# Versions: ezc3d 1.7.2, c3d 0.6.0
# Question: A marker is hidden in one frame of a C3D file. What do the two readers return for this frame?
# Guess: "NaN, or a flag, in both: the format marks a hidden point by a residual of -1."
# True: ezc3d returns NaN. c3d returns x = y = z = 0 with -1 in the fourth of its five columns, and a marker
#   that really is at the origin with 0 there.
# Matters: Whoever takes the first three columns gets a pose at the origin of the cameras for each hidden
#   frame. Averaged over a standstill with 2 % hidden frames, a marker at 2 m is 40 mm off.
cd "$(dirname "$0")" && ./with_packages ezc3d==1.7.2 c3d==0.6.0 numpy==2.4.6 <<'END'
import warnings

import numpy as np

warnings.simplefilter("ignore")
import c3d
import ezc3d

file = ezc3d.c3d()
file["parameters"]["POINT"]["RATE"]["value"] = [100]
file["parameters"]["POINT"]["LABELS"]["value"] = ["marker"]
points = np.ones((4, 1, 3))
points[:3, 0] = np.array([[10, 20, 30], [np.nan] * 3, [0, 0, 0]]).T
file["data"]["points"] = points
file.write("hidden.c3d")
one = ezc3d.c3d("hidden.c3d")["data"]["points"][:3, 0].T
with open("hidden.c3d", "rb") as stream:
    other = np.array([frame[1][0] for frame in c3d.Reader(stream).read_frames()])
for name, a, b in zip(("seen", "hidden", "at the origin"), one, other):
    print(f"{name}: ezc3d {a}, c3d {b}")
assert np.isnan(one[1]).all() and not np.isnan(one[[0, 2]]).any()
assert other[:, :3].tolist() == [[10, 20, 30], [0, 0, 0], [0, 0, 0]]
assert other[:, 3].tolist() == [0, -1, 0]
END
# Seen:
#   seen: ezc3d [10. 20. 30.], c3d [10. 20. 30.  0.  0.]
#   hidden: ezc3d [nan nan nan], c3d [ 0.  0.  0. -1.  0.]
#   at the origin: ezc3d [0. 0. 0.], c3d [0. 0. 0. 0. 0.]
