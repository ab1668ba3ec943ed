"""How the makers of serial arms state joints and poses: `robot: fanuc` in a column map.

A convention completes a column map: units, the order of the angles or of the quaternion, and joints
that the controller counts relative to another one. Sources: "Pose formats" of the documentation of
the rc_visard (ABB, FANUC, Kawasaki, KUKA, Universal Robots); RoboDK/RoboDK-API 84099bb,
Python/robodk/robomath.py (Fanuc_2_Pose, KUKA_2_Pose, Staubli_2_Pose, UR_2_Pose); ROS-Industrial's
fanuc_driver (J23_factor: joint 3 = J3 + factor J2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

XYZ = ("X", "Y", "Z")


@dataclass(frozen=True)
class Convention:
    """Columns of the joints and of the pose under their usual names, and what they mean.

    `turn` is the key of a column map that states the orientation, and `turns` its columns in the
    maker's order. `axes` are those of three angles. `coupled` states a joint as the sum of columns.
    With `scalar_first`, a quaternion is w x y z.
    """

    joints: tuple[str, ...]
    turn: str
    turns: tuple[str, ...]
    axes: str = ""
    length: str = "mm"
    angle: str = "deg"
    position: tuple[str, ...] = XYZ
    coupled: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scalar_first: bool = False


def _numbered(letters: str, first: int = 1) -> tuple[str, ...]:
    return tuple(f"{letters}{i}" for i in range(first, first + 6))


CONVENTIONS = {
    "abb": Convention(_numbered("J"), "orientation", ("Q1", "Q2", "Q3", "Q4"), scalar_first=True),
    "fanuc": Convention(
        _numbered("J"), "angles", ("W", "P", "R"), "xyz", coupled={"J3": {"J3": 1, "J2": 1}}
    ),
    "kawasaki": Convention(_numbered("JT"), "angles", ("O", "A", "T"), "ZYZ"),
    "kuka": Convention(_numbered("A"), "angles", ("A", "B", "C"), "ZYX"),
    "staubli": Convention(_numbered("J"), "angles", ("RX", "RY", "RZ"), "XYZ"),
    "ur": Convention(
        _numbered("actual_q_", 0),
        "rotation_vector",
        ("rx", "ry", "rz"),
        length="m",
        angle="rad",
        position=("x", "y", "z"),
    ),
}
MEASUREMENTS = ("position", "orientation", "angles", "rotation_vector", "matrix", "readings")


def complete_map(given: Any) -> Any:
    """Return the data of a column map with what its `robot` says about keys that it does not state.

    Without any measurement, position and orientation have the maker's usual columns. `joints` may
    be a list of six names, those of the model file. ValueError for a robot that is not known.
    """
    if not isinstance(given, dict) or given.get("robot") is None:
        return given
    if given["robot"] not in CONVENTIONS:
        known = ", ".join(CONVENTIONS)
        raise ValueError(f"robot is '{given['robot']}', expected one of {known}")
    own, found = CONVENTIONS[given["robot"]], dict(given)
    joints = found.get("joints", [f"joint{i}" for i in range(1, 7)])
    if isinstance(joints, list) and len(joints) == len(own.joints):
        found["joints"] = {
            str(name): {"columns": dict(own.coupled.get(column, {column: 1})), "unit": own.angle}
            for name, column in zip(joints, own.joints, strict=True)
        }
    measured = any(key in found for key in MEASUREMENTS) or found.get("joints_only")
    if not measured:
        found["position"] = {"columns": list(own.position)}
        turns = list(own.turns)
        found[own.turn] = turns if own.turn == "orientation" else {"columns": turns}
    for key, usual in (
        ("position", {"unit": own.length}),
        ("angles", {"unit": own.angle, "axes": own.axes} if own.axes else {}),
        ("rotation_vector", {"unit": own.angle}),
    ):
        if isinstance(found.get(key), dict):
            found[key] = usual | found[key]
    turned = found.get("orientation")
    if own.scalar_first and isinstance(turned, list) and len(turned) == 4:
        found["orientation"] = [*turned[1:], turned[0]]
    return found
