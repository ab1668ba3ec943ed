"""Universal Robots: the Denavit-Hartenberg numbers of an arm and their factory calibration.

`urcontrol.conf` has `[DH]` with `a`, `d` and `alpha`; `calibration.conf` has `delta_theta`,
`delta_a`, `delta_d` and `delta_alpha`, which are added (m and rad). Joint i is Rz(q + delta_theta)
Tz(d) Tx(a) Rx(alpha). The axes of the joints 2, 3 and 4 are nearly parallel, so a calibrated d may
be metres, or hundreds of them: the common normal of two such axes is far away. The model therefore
has Hayati's parameters there; its poses are the same. Sources: Universal Robots, "DH Parameters for
calculations of kinematics and dynamics"; the published calibration of a UR3, with d of -6.29 m and
8.57 m.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.importing.chain import MAX_PARALLEL_SINE, chain_links
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.settings import Settings, read_fields
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.recording import Array

CONFIGURATION = (".conf",)
MACHINE_CLASS: MachineClass = "industrial"
N = 6
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
TABLE = ("theta", "d", "a", "alpha")
LINE = re.compile(r"\s*(\w+)\s*=\s*\[([^\]]*)\]")
LIMIT = 2 * np.pi  # of all joints
HOME = [0.0, -1.2, 1.5, -1.9, -1.57, 0.0]  # elbow up, the tool down; far from singularities
MAX_D_M = 2.0  # of a link; a larger d is of nearly parallel axes
BASE = (
    "{B} is the frame Base of the controller. In ROS it is called base; base_link is turned from "
    "it by 180 degrees about z"
)
NOMINAL = (
    "no delta_theta, so the arm is as drawn: give calibration.conf of this arm as well to begin "
    "with its factory calibration"
)
FAR = (
    "{} of {}: the axes are nearly parallel, and their common normal is as far away. The model has "
    "Hayati's a, alpha and beta there, which are small numbers; its poses are the same"
)


@dataclass(frozen=True)
class Turn:
    """A joint about z, or the flange, with its frame (4, 4) in the one before."""

    origin: Array
    kind: str | None = "R"

    @property
    def axis(self) -> Array:
        return np.array([0.0, 0.0, 1.0])


def recognizes(path: Path) -> bool:
    """Whether a file states Denavit-Hartenberg numbers or their changes."""
    stated = settings([path])
    return any(field in stated for field in ("a", "delta_a"))


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the arm with its factory calibration, if that is given."""
    stated = settings(paths)
    rows = read_rows(stated)
    before, steps = np.eye(4), list[Turn]()
    for theta, d, a, alpha in rows:
        steps.append(Turn(before @ move(theta)))
        before = move(0.0, d, a, alpha)
    links = chain_links([*steps, Turn(before, None)])
    for link in links:
        if link["joint"]:
            link |= {"low": -LIMIT, "high": LIMIT}
    mechanism = load_mechanism("serial", links=links, home=HOME)
    mechanism.joints = tuple(f"{name}_joint" for name in JOINTS)
    remarks = [BASE] if "delta_theta" in stated else [BASE, NOMINAL]
    far = [
        (f"d{i} = {d:.6g} m", name)
        for i, (name, (_, d, _, alpha)) in enumerate(zip(JOINTS, rows, strict=True), start=1)
        if abs(d) > MAX_D_M and abs(np.sin(alpha)) < MAX_PARALLEL_SINE
    ]
    if far:
        sizes, names = (", ".join(words) for words in zip(*far, strict=True))
        remarks.append(FAR.format(sizes, names))
    return ConfiguredRobot(new_model(mechanism), tuple(remarks))


def settings(paths: Sequence[Path]) -> Settings:
    """Read lists by their names."""
    return read_fields(paths, LINE)


def read_rows(stated: Settings) -> Array:
    """Return theta, d, a and alpha (6, 4) of the joints, m and rad, with the calibration."""
    table = np.zeros((N, len(TABLE)))
    for k, name in enumerate(TABLE):
        if name != "theta":
            table[:, k] = _six(stated, name, "urcontrol.conf, section [DH]")
        if any(f"delta_{other}" in stated for other in TABLE):
            table[:, k] += _six(stated, f"delta_{name}", "calibration.conf")
    return table


def _six(stated: Settings, name: str, where: str) -> Array:
    expected = f"six numbers in {'m' if name[-1] in 'ad' and 'alpha' not in name else 'rad'}"
    text, place = stated.text(name, f"{expected} ({where})")
    words = text.split(",")
    if len(words) != N:
        raise place.error(name, text, expected)
    return np.array([place.number(name, word, expected) for word in words])


def move(theta: float, d: float = 0.0, a: float = 0.0, alpha: float = 0.0) -> Array:
    """Return Rz(theta) Tz(d) Tx(a) Rx(alpha), (4, 4)."""
    (c, s), (ca, sa) = ((np.cos(angle), np.sin(angle)) for angle in (theta, alpha))
    return np.array(
        [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    )
