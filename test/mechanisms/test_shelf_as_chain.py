"""Robots of the shelf, described as a `chain` of bodies and joints, stand alike.

Their closures were derived with the passive joints eliminated. The chain keeps them.
"""

import numpy as np
import pytest
from chains import make_chain

from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.virtual.robot import turn

UP = [0, -1, 0]  # a hinge whose positive turn raises what points outwards


def hinge(name, parent, child, **more):
    return {"name": name, "type": "revolute", "parent": parent, "child": child, "axis": UP, **more}


def rod(name, a, b, length):
    ends = {key: {"body": body, "point": point} for key, (body, point) in (("a", a), ("b", b))}
    return {"name": name, "type": "distance", **ends, "length": length}


def three_legs(home, drives, hinges, directions, tilt=0.0):
    """Three hinged rods with a platform: one ball joint carries it, two points close the loops.

    `drives` are joints to bodies drive1.., `hinges` (3,) m in their frames, and `directions` the
    rods (3,) m from there. The frames of the drives are raised by `tilt` (rad) at home.
    """
    joints, loops = list(drives), []
    for i in (1, 2, 3):
        joints.append(
            hinge(f"hinge{i}", f"drive{i}", f"rod{i}", origin=hinges.tolist(), axis=[0, 1, 0])
        )
        ball = (turn([0, 0, (i - 1) * 2 * np.pi / 3]) @ [0.1, 0, 0]).tolist()
        if i == 1:
            level = turn([0, tilt, 0])
            ends = {"origin": (directions - level @ ball).tolist(), "anchor": ball}
            ends["quaternion"] = matrix_to_quaternion(level).tolist()
            carried = {"name": "ball1", "type": "spherical", "parent": "rod1", "child": "platform"}
            joints.append({**carried, **ends})
        else:
            a, b = {"body": f"rod{i}", "point": directions.tolist()}, {"body": "platform"}
            loops.append({"name": f"ball{i}", "type": "point", "a": a, "b": {**b, "point": ball}})
    return {
        "base": "base",
        "platform": "platform",
        "joints": joints,
        "loops": loops,
        "controls": ["z", "rx", "ry"],
        "home": {"position": [0.0, 0.0, home]},
    }


def around(i, point):
    """Origin and orientation of the drive of chain i."""
    R = turn([0, 0, i * 2 * np.pi / 3])
    return {"origin": (R @ point).tolist(), "quaternion": matrix_to_quaternion(R).tolist()}


def tripod_prs():
    q = 0.1 + np.sqrt(0.2**2 - 0.05**2)
    drives = [
        {"name": f"joint{i + 1}", "type": "prismatic", "parent": "base", "child": f"drive{i + 1}",
         "axis": [0, 0, 1], "driven": True, "home": q, **around(i, [0.15, 0, 0])}
        for i in range(3)
    ]  # fmt: skip
    return three_legs(0.1, drives, np.zeros(3), np.array([-0.05, 0, 0.1 - q]))


def plate_rrs():
    angle = np.radians(20)
    elbow = np.array([0.08 + 0.06 * np.cos(angle), 0, 0.06 * np.sin(angle)])
    height = 0.06 * np.sin(angle) + np.sqrt(0.1**2 - (elbow[0] - 0.1) ** 2)
    drives = [
        hinge(f"joint{i + 1}", "base", f"drive{i + 1}", driven=True, home=angle,
              **around(i, [0.08, 0, 0]))
        for i in range(3)
    ]  # fmt: skip
    # In the frame of the crank, which is raised.
    span = turn([0, angle, 0]) @ (np.array([0.1, 0, height]) - elbow)
    return three_legs(height, drives, np.array([0.06, 0, 0]), span, angle)


def ankle_2rsu():
    across = {"axis": [0, 1, 0], "driven": True}
    joints = [
        {"name": "ankle", "type": "universal", "parent": "shank", "child": "foot",
         "axes": [[0, 1, 0], [1, 0, 0]]},
        hinge("left", "shank", "left_crank", origin=[-0.01, 0.035, 0.25], **across),
        hinge("right", "shank", "right_crank", origin=[-0.01, -0.035, 0.2], **across),
    ]  # fmt: skip
    loops = [
        rod(f"{side}_rod", (f"{side}_crank", [-0.04, 0, 0]), ("foot", [-0.05, y, 0]), length)
        for side, y, length in (("left", 0.035, 0.25), ("right", -0.035, 0.2))
    ]
    made = {"base": "shank", "platform": "foot", "target": [0, 0, -0.05]}
    return {**made, "joints": joints, "loops": loops, "controls": ["rx", "ry"]}


def palletizer():
    upper, fore = np.radians(80), np.radians(-20)
    shoulder, elbow = {"origin": [0.1, 0, 0.35], "driven": True}, {"origin": [0.45, 0, 0]}
    joints = [
        hinge("joint1", "base", "waist", axis=[0, 0, 1], driven=True),
        hinge("joint2", "waist", "upper", home=upper, **shoulder),
        hinge("joint3", "waist", "crank", home=fore, **shoulder),
        hinge("elbow", "upper", "forearm", home=fore - upper, **elbow),
        hinge("lever", "upper", "triangle", home=-upper, **elbow),
        hinge("wrist", "forearm", "plate", origin=[0.5, 0, 0], home=-fore),
        hinge("joint4", "plate", "tool", origin=[0.08, 0, 0], axis=[0, 0, 1], driven=True),
    ]
    loops = [
        rod("push", ("crank", [-0.12, 0, 0]), ("forearm", [-0.12, 0, 0]), 0.45),
        rod("level1", ("waist", [0, 0, 0.35]), ("triangle", [-0.1, 0, 0]), 0.45),
        rod("level2", ("triangle", [0, 0, 0.1]), ("plate", [0, 0, 0.1]), 0.5),
    ]
    made = {"base": "base", "platform": "tool", "target": [0, 0, -0.06]}
    return {**made, "joints": joints, "loops": loops, "controls": ["x", "y", "z", "rz"]}


@pytest.mark.parametrize("describe", [tripod_prs, plate_rrs, ankle_2rsu, palletizer])
def test_a_robot_of_the_shelf_stands_as_the_chain_that_describes_it(describe):
    model, chain = new_model(describe.__name__), make_chain(describe())
    assert chain.joints == model.joints
    poses = poses_in_workspace(model.mechanism, 50, np.random.default_rng(0))
    q = Kinematics(model).inverse(*poses).joints
    expected, found = Kinematics(model).direct(q), Kinematics(chain).direct(q)
    assert expected.ok.all()
    assert found.ok.all()
    np.testing.assert_allclose(found.position, expected.position, atol=1e-10)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-10)
