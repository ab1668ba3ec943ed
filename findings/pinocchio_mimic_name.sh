#!/bin/sh
# Versions: pin 4.1.0
# Question: A slider of a URDF follows another one (<mimic>, times 2 plus 0.1). The URDF is read with
#   mimic=True. Does the position of the follower depend on the names of the two joints?
# Guess: "No. With mimic=True it follows: 1.1 m if the other one stands at 0.5 m."
# True: Only if its name comes later in the alphabet. A follower `z` of `s` stands at 1.1 m; a follower `m` of
#   `s` makes the same URDF an error: "The parent joint of the mimic joint is not in the kinematic tree".
# Matters: pinocchio sorts siblings by name, and reads a joint before the one that it follows. A parallelogram
#   or a coupled wrist can be read or not depending on what its joints are called.
cd "$(dirname "$0")" && ./with_packages pin==4.1.0 numpy==2.4.6 <<'END'
import numpy as np
import pinocchio as pin

BODY = (
    '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def slider(name, body, more=""):
    return (
        f'<link name="{body}">{BODY}</link><joint name="{name}" type="prismatic">'
        f'<parent link="base"/><child link="{body}"/><axis xyz="0 0 1"/>'
        f'<limit lower="-9" upper="9" effort="1" velocity="1"/>{more}</joint>'
    )


def place(follower):
    mimic = '<mimic joint="s" multiplier="2" offset="0.1"/>'
    text = f'<robot name="r"><link name="base"/>{slider("s", "a")}{slider(follower, "b", mimic)}</robot>'
    model = pin.buildModelFromXML(text, True)
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array([0.5]))
    return data.oMf[model.getFrameId("b")].translation[2]


print("follower z:", place("z"), "m")
assert abs(place("z") - 1.1) < 1e-12
try:
    place("m")
except ValueError as error:
    print("follower m:", error)
    assert "parent joint of the mimic joint is not in the kinematic tree" in str(error)
else:
    raise AssertionError("the follower m is read")
END
# Seen:
#   follower z: 1.1 m
#   follower m: The parent joint of the mimic joint is not in the kinematic tree
