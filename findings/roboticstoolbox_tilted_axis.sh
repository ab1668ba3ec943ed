#!/bin/sh
# Versions: roboticstoolbox-python 1.5.0
# Question: A calibrated URDF has a joint with the axis `0 0.001 1` (tilted by 1 mrad). Where is the arm at
#   zero?
# Guess: "Where the origins say; the tilt changes the motion by 1 mrad per radian."
# True: The whole arm is turned by 1 rad (57 degrees) at zero. The origin of the frame on the inclined axis
#   is wrong, and the error does not shrink with the tilt. With the axis `0 0 1` and the tilt in rpy it is
#   right.
# Matters: A calibration writes small tilts. Write them as rpy of the origin and a plain axis.
cd "$(dirname "$0")" && ./with_packages roboticstoolbox-python==1.5.0 numpy==2.4.6 <<'END'
import warnings
from pathlib import Path

import numpy as np

warnings.simplefilter("ignore")
import roboticstoolbox


def tip(axis, rpy="0 0 0", back="0 0 0"):
    file = Path("robot.urdf").absolute()
    file.write_text(
        '<robot name="r"><link name="base"/><link name="arm"/><link name="tip"/>'
        f'<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>'
        f'<origin xyz="0 0 0.1" rpy="{rpy}"/><axis xyz="{axis}"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        '<joint name="f" type="fixed"><parent link="arm"/><child link="tip"/>'
        f'<origin xyz="1 0 0" rpy="{back}"/></joint></robot>'
    )
    return roboticstoolbox.Robot.URDF(str(file)).fkine([0], end="tip").t


true = [1, 0, 0.1]
for tilt in ("0.001", "0.00001"):
    wrong = tip(f"0 {tilt} 1")
    print(f"axis 0 {tilt} 1, joint at 0: tip at", np.round(wrong, 4))
    np.testing.assert_allclose(wrong[:2], [np.cos(1), np.sin(1)], atol=2e-3)
plain = tip("0 0 1", rpy="-0.001 0 0")
print("axis 0 0 1, rpy -0.001 0 0: tip at", np.round(plain, 4))
np.testing.assert_allclose(plain, true, atol=1e-9)
END
# Seen:
#   axis 0 0.001 1, joint at 0: tip at [0.5403 0.8415 0.0992]
#   axis 0 0.00001 1, joint at 0: tip at [0.5403 0.8415 0.1   ]
#   axis 0 0 1, rpy -0.001 0 0: tip at [1.  0.  0.1]
