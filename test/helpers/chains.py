"""Robots of the shelf, written as a chain of bodies, joints and loops."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

import parallel_cal as pc
from parallel_cal.base.rotation import (
    matrix_to_quaternion,
    rot_x,
    rot_y,
    rot_z,
    rotation_matrix,
)
from parallel_cal.kinematics.start import start_function
from parallel_cal.mechanisms import delta51
from parallel_cal.mechanisms.serial import Serial


def make_chain(options: Mapping[str, Any]) -> pc.Model:
    """Make the model of a chain."""
    return pc.new_model(pc.mechanisms.load("chain", **options))


def find_start(solver: pc.Kinematics, problem: str, given: np.ndarray) -> np.ndarray:
    """The configuration (nq + 12 + nu,) from which a problem is solved that is given by another."""
    ideal = solver.model.structure.ideal
    geometry = solver.model.values[: len(ideal.table)]
    return np.array(start_function(ideal, problem)(given, geometry)).ravel()


def revolute(name: str, parent: str, child: str, **more: Any) -> dict[str, Any]:
    """Make a revolute joint about z."""
    joint = {"name": name, "type": "revolute", "parent": parent, "child": child}
    return {**joint, "axis": [0, 0, 1], **more}


def rod(name: str, a: tuple[str, Any], b: tuple[str, Any], **more: Any) -> dict[str, Any]:
    """Make a rod between two balls."""
    ends = {
        key: {"body": body, "point": list(map(float, at))}
        for key, (body, at) in (("a", a), ("b", b))
    }
    return {"name": name, "type": "distance", **ends, **more}


def five_bar(base: float = 0.1, crank: float = 0.1, bar: float = 0.15) -> dict[str, Any]:
    """A planar five-bar whose loop is closed by a revolute joint in space."""
    joints = []
    for side, sign, angle in (("left", -1, 2.2), ("right", 1, 0.9)):
        joints += [
            revolute(side, "frame", f"{side}_crank", origin=[sign * base / 2, 0, 0], driven=True,
                     home=angle, limits=[angle - 1.2, angle + 1.2]),
            revolute(f"{side}_elbow", f"{side}_crank", f"{side}_rod", origin=[crank, 0, 0],
                     home=sign * 1.3),
        ]  # fmt: skip
    tip = [
        {"body": f"{side}_rod", "point": [bar, 0, 0], "axis": [0, 0, 1]}
        for side in ("left", "right")
    ]
    return {
        "base": "frame",
        "platform": "left_rod",
        "target": [bar, 0, 0],
        "moves": ["x", "y"],
        "joints": joints,
        "loops": [{"name": "tip", "type": "axis", "a": tip[0], "b": tip[1]}],
    }


def knee() -> dict[str, Any]:
    """A knee that a linear actuator between thigh and shank bends: a triangle."""
    ends = ("thigh", [-0.06, 0, 0.23]), ("shank", [-0.06, 0, 0.03])
    return {
        "base": "thigh",
        "platform": "shank",
        "target": [0, 0, -0.36],
        "joints": [revolute("knee", "thigh", "shank", home=1.0) | {"axis": [0, 1, 0]}],
        "loops": [rod("drive", *ends, driven=True, limits=[-0.06, 0.06])],
    }


def bird_leg() -> dict[str, Any]:
    """A leg of five motors with two loops: a rod from thigh to tarsus that lets the tarsus follow
    the knee, and a rod from a crank on the tarsus to the foot."""
    across = {"axis": [0, -1, 0]}
    angles = {"roll": (-0.26, 0.39, 0), "yaw": (-0.38, 0.38, 0), "pitch": (-0.87, 1.4, 0.5)}
    angles |= {"knee": (-2.86, -0.65, -1.2), "crank": (-2.44, -0.52, -1.5)}
    driven = {
        name: {"driven": True, "limits": [low, high], "home": home}
        for name, (low, high, home) in angles.items()
    }
    joints = [
        revolute("roll", "pelvis", "hip", **driven["roll"]) | {"axis": [1, 0, 0]},
        revolute("yaw", "hip", "fork", origin=[-0.07, 0, -0.05], **driven["yaw"]),
        revolute("pitch", "fork", "thigh", origin=[0, 0, -0.09], **driven["pitch"]) | across,
        revolute("knee", "thigh", "shin", origin=[0, 0.01, -0.12], **driven["knee"]) | across,
        revolute("heel", "shin", "tarsus", origin=[0.045, 0, -0.43], home=1.4) | across,
        revolute("crank", "tarsus", "lever", origin=[-0.034, 0.01, -0.058], **driven["crank"])
        | across,
        revolute("toe", "tarsus", "foot", origin=[-0.04, 0, -0.408], home=-1.6) | across,
    ]
    loops = [
        rod("long_rod", ("thigh", [0.045, 0, 0]), ("tarsus", [0.02, 0.008, 0.108]), length=0.5),
        rod("foot_rod", ("lever", [0, 0, -0.055]), ("foot", [0, 0.01, -0.055])),
    ]
    made = {"base": "pelvis", "platform": "foot", "target": [0.05, 0.02, -0.1]}
    return {**made, "joints": joints, "loops": loops}


def five_bar_with_pin(**sizes: float) -> dict[str, Any]:
    """The five-bar whose platform is the pin between both rods."""
    given = five_bar(**sizes)
    bar = given["target"]
    pin = revolute("pin", "left_rod", "pin", origin=bar)
    axis = {"axis": [0, 0, 1]}
    end = {"body": "right_rod", "point": bar, **axis}
    tip = {"name": "tip", "type": "axis", "a": {"body": "pin", **axis}, "b": end}
    changes = {"platform": "pin", "target": [0, 0, 0], "loops": [tip]}
    return given | changes | {"joints": [*given["joints"], pin]}


def ankle() -> dict[str, Any]:
    """A humanoid ankle: a foot on a universal joint, two motors, two rods."""
    joints: list[dict[str, Any]] = [
        {"name": "ankle", "type": "universal", "parent": "shank", "child": "foot",
         "axes": [[0, 1, 0], [1, 0, 0]]},
    ]  # fmt: skip
    loops = []
    for side, y, z in (("left", 0.035, 0.25), ("right", -0.035, 0.2)):
        joints.append(revolute(f"{side}_motor", "shank", f"{side}_crank", origin=[0, y, z],
                               driven=True, limits=[-1, 1]) | {"axis": [0, 1, 0]})  # fmt: skip
        loops.append(rod(f"{side}_rod", (f"{side}_crank", [-0.05, 0, 0]),
                         ("foot", [-0.05, y, 0]), length=z))  # fmt: skip
    return {"base": "shank", "platform": "foot", "joints": joints, "loops": loops}


def spherical_four_bar() -> tuple[dict[str, Any], list[Any]]:
    """A crank turns a rocker; all four axes point at one centre, and have 6 digits. Return it with
    the axes (3,) of motor, elbow, coupler and rocker."""
    polar, azimuth = np.radians([[0, 60, 95, 70], [0, 50, 75, 0]])
    axes = np.transpose([
        np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)
    ])  # fmt: skip
    motor, elbow, ball, hinge = (d * axis for d, axis in zip((0.06, 0.07, 0.08, 0.05), axes,
                                                           strict=True))  # fmt: skip

    def joint(name: str, parent: str, child: str, axis: Any, origin: Any, **more: Any) -> Any:
        axis, origin = (np.round(vector, 6).tolist() for vector in (axis, origin))
        return revolute(name, parent, child, axis=axis, origin=origin, **more)

    joints = [
        joint("motor", "base", "crank", axes[0], motor, driven=True),
        joint("elbow", "crank", "link", axes[1], elbow - motor),
        joint("hinge", "base", "rocker", axes[3], hinge),
    ]
    ends = {
        key: {"body": body, "point": np.round(ball - origin, 6).tolist()}
        for key, body, origin in (("a", "link", elbow), ("b", "rocker", hinge))
    }
    platform = {"platform": "rocker", "target": [0.02, 0.03, 0.05]}
    loops = [{"name": "ball", "type": "point", **ends}]
    return {"base": "base", **platform, "joints": joints, "loops": loops}, list(axes)


def from_stewart42(model: pc.Model) -> dict[str, Any]:
    """Write a Stewart platform as a platform on six actuators."""
    legs = []
    for k, leg in enumerate(model.joints):
        C, B = ([model.value(f"{leg}.{end}_{axis}") for axis in "xyz"] for end in "CB")
        legs.append(rod(leg, ("base", C), ("plate", B), length=model.value(f"{leg}.L0"),
                        driven=True, home=model.mechanism.home.joints[k],
                        limits=list(model.mechanism.joint_limits[k])))  # fmt: skip
    home = {"position": list(model.mechanism.home.position)}
    return {"base": "base", "platform": "plate", "joints": [], "loops": legs, "home": home}


def from_delta54(model: pc.Model) -> dict[str, Any]:
    """Write a Delta as three arms and six rods between their balls."""
    values = delta51.from_delta54(model.table.mapping(model.values))
    joints, rods = [], []
    for i in (1, 2, 3):
        beta, p = ([values[f"chain{i}.{name}_{k}"] for k in "xyz"] for name in ("beta", "p"))
        turn = rotation_matrix(np.array(beta)) @ np.array(ca.DM(rot_z(delta51.THETA[i - 1])))
        joints.append(revolute(f"joint{i}", "base", f"arm{i}", origin=p, driven=True,
                               quaternion=matrix_to_quaternion(turn).tolist(),
                               home=model.mechanism.home.joints[i - 1],
                               limits=list(model.mechanism.joint_limits[i - 1]))
                      | {"axis": [1, 0, 0]})  # fmt: skip
    for name in delta51.RODS:
        a, b = ([values[f"rod{name}.{end}_{k}"] for k in "xyz"] for end in "ab")
        rods.append(rod(f"rod{name}", (f"arm{name[0]}", a), ("plate", b),
                        length=values[f"rod{name}.l"]))  # fmt: skip
    home = {"position": list(model.mechanism.home.position)}
    return {"base": "base", "platform": "plate", "joints": joints, "loops": rods, "home": home}


def from_planar_stewart(model: pc.Model) -> dict[str, Any]:
    """Write a planar platform as three legs: turning barrel, slide, and pivot on the platform."""
    joints, loops = [], []
    for k, leg in enumerate(model.joints):
        C, B = ([*(model.value(f"{leg}.{end}_{axis}") for axis in "xy"), 0.0] for end in "CB")
        r = np.array(model.mechanism.home.position)
        way = r + B - C
        joints += [
            revolute(f"foot{k}", "base", f"barrel{k}", origin=C,
                     home=float(np.arctan2(way[1], way[0]))),
            {"name": leg, "type": "prismatic", "parent": f"barrel{k}", "child": f"slide{k}",
             "origin": [model.value(f"{leg}.L0"), 0, 0], "axis": [1, 0, 0], "driven": True,
             "home": model.mechanism.home.joints[k],
             "limits": list(model.mechanism.joint_limits[k])},
        ]  # fmt: skip
        if k == 0:  # the first leg carries the platform
            joints.append(revolute("pivot0", f"slide{k}", "plate", home=-float(
                np.arctan2(way[1], way[0]))) | {"origin": [0, 0, 0], "anchor": B})  # fmt: skip
            joints[-1]["origin"] = [-v for v in B]
        else:
            ends = {"a": {"body": f"slide{k}", "axis": [0, 0, 1]},
                    "b": {"body": "plate", "point": B, "axis": [0, 0, 1]}}  # fmt: skip
            loops.append({"name": f"pivot{k}", "type": "axis", **ends})
    home = {"position": list(model.mechanism.home.position)}
    return {"base": "base", "platform": "plate", "joints": joints, "loops": loops, "home": home}


def from_rssr(model: pc.Model) -> dict[str, Any]:
    """Write the loop of the short-cut set-up as two cranks and a rod."""
    ends = {}
    for crank in ("input", "output"):
        r, s, q0 = (model.value(f"{crank}.{name}") for name in ("r", "s", "q0"))
        ends[crank] = [r * np.cos(q0), r * np.sin(q0), s]
    angle = model.mechanism.home.joints[0]
    turn = np.array(ca.DM(rot_x(model.value("alpha"))))
    quaternion = matrix_to_quaternion(turn).tolist()
    return {
        "base": "base",
        "platform": "arm",
        "joints": [
            revolute("input", "base", "crank", origin=[model.value("a"), 0, 0], driven=True,
                     quaternion=quaternion, home=angle,
                     limits=list(model.mechanism.joint_limits[0])),
            revolute("output", "base", "arm", home=angle),
        ],
        "loops": [rod("bar", ("crank", ends["input"]), ("arm", ends["output"]),
                      length=model.value("L"))],
    }  # fmt: skip


def from_serial(arm: Serial) -> dict[str, Any]:
    """Write a serial arm as a chain without loops."""
    joints, body, origin = [], "base", (np.zeros(3), np.eye(3))
    for k, link in enumerate(arm.links):
        t = link.nominal
        turn = np.array(ca.DM(rot_z(t["theta"]) @ rot_x(t["alpha"]) @ rot_y(t["beta"])))
        shift = np.array(ca.DM(rot_z(t["theta"]))) @ [t["a"], t["b"], t["d"]]
        if link.joint:
            kind = {"R": "revolute", "P": "prismatic"}[link.joint]
            i = arm.driven.index(link)
            joints.append({
                "name": f"joint{i + 1}", "type": kind, "parent": body, "child": f"body{k}",
                "origin": origin[0].tolist(),
                "quaternion": matrix_to_quaternion(origin[1]).tolist(),
                "axis": [0, 0, 1], "driven": True, "home": arm.home.joints[i],
                "limits": list(arm.joint_limits[i]),
            })  # fmt: skip
            body, origin = f"body{k}", (np.zeros(3), np.eye(3))
        origin = origin[0] + origin[1] @ shift, origin[1] @ turn
    return {
        "base": "base",
        "platform": body,
        "target": origin[0].tolist(),
        "target_quaternion": matrix_to_quaternion(origin[1]).tolist(),
        "joints": joints,
        "controls": list(arm.controls),
    }
