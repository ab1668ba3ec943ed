"""RSSR loops of a Delta's own parts: balls, rod, and their relation to the Delta's parameters.

A loop is two arms without platform, joined by a rod (section 4.2.7, figure 4.7). Its nine
parameters g(p) (section 5.4.5) are functions of model 54's parameters p.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Single, dense
from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import matrix_to_quaternion, rotation_matrix
from parallel_cal.identification.observations import observe
from parallel_cal.mechanisms.rssr import Circle, Rssr, compute_parameters
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.parameters import Named, ParameterTable
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.samples import READING

RODS = ("11", "12", "21", "22", "31", "32")  # figure 3.9: chain, then first or second rod
QUARTERS = (0.0, np.pi / 2, np.pi)
POINTS = 3 * len(RODS) * len(QUARTERS)  # number of coordinates of the balls


@dataclass(frozen=True)
class Loop:
    """Balls `one` and `other` joined by `rod`; `12` is the second ball of arm 1, or its rod."""

    one: str
    other: str
    rod: str

    @classmethod
    def parse(cls, text: str) -> Loop:
        """Parse `12:21:11`; FitError for other text."""
        names = text.split(":")
        if len(names) != 3 or not set(names) <= set(RODS) or names[0][0] == names[1][0]:
            raise FitError(
                f"loop '{text}': expected BALL:BALL:ROD with balls of two different arms, like "
                f"12:21:11 (second ball of arm 1, first ball of arm 2, first rod of chain 1)"
            )
        return cls(*names)

    def __str__(self) -> str:
        return f"{self.one}:{self.other}:{self.rod}"

    @property
    def arms(self) -> tuple[int, int]:
        """Indices of the two encoders, input and output."""
        return int(self.one[0]) - 1, int(self.other[0]) - 1


@lru_cache(maxsize=16)
def _parts(mechanism: Mechanism) -> Single:
    v = ca.SX.sym("v", len(mechanism.parameters))
    p = Named(mechanism.parameters.names, v)
    turned = [mechanism.rods([angle] * 3, p) for angle in QUARTERS]  # type: ignore[attr-defined]
    parts = ca.vertcat(*[ca.vertcat(*C) for C, _, _ in turned], *turned[0][2])
    return Single(dense("parts", (v,), (parts, ca.jacobian(parts, v))))


@lru_cache(maxsize=64)
def _numbers(loop: Loop) -> Single:
    parts, length = ca.SX.sym("parts", POINTS + len(RODS)), ca.SX.sym("length")
    scaled = length / parts[POINTS + RODS.index(loop.rod)] * parts[:POINTS]
    points = ca.vertsplit(scaled, 3)
    one, other = (Circle(*points[RODS.index(ball) :: len(RODS)]) for ball in (loop.one, loop.other))
    g = compute_parameters(one, other, length)
    return Single(dense("numbers", (parts, length), (g, ca.jacobian(g, parts))))


def compute_parts(robot: Model, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the parts of loops (60,) and their derivative by the parameters (60, n), in m.

    They are the positions of each ball at three angles of its arm, then the rods' lengths.
    """
    parts, flat = _parts(robot.mechanism)(values)
    return parts, flat.reshape(-1, len(parts)).T


def loop_numbers(
    robot: Model, loop: Loop, values: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the loop's parameters g (9,) in the order of `rssr`, and G = d g/dp (9, n).

    Two encoders do not determine the size. The loop is therefore scaled to a rod of `length` (m).
    """
    parts, by_p = compute_parts(robot, values)
    g, flat = _numbers(loop)(parts, [length])
    return g, flat.reshape(-1, len(g)).T @ by_p


def split_by_loop(dataset: Dataset) -> list[tuple[Loop, Dataset]]:
    """Split samples by loop: the channel `reading.12:21:11` is finite if that loop was joined."""
    channels = [name for name in dataset.conditions if name.startswith(READING)]
    if not channels:
        raise FitError(
            f"{dataset.source}: no sample says which loop was tied; record its name, like "
            "12:21:11, on the topic 'constraint'"
        )
    rest = {k: v for k, v in dataset.conditions.items() if k not in channels}
    bare = replace(dataset, conditions=rest)
    return [
        (Loop.parse(name.removeprefix(READING)), bare.select(np.isfinite(dataset.conditions[name])))
        for name in channels
    ]


def loop_model(robot: Model, loop: Loop, home: Home) -> Model:
    """Make the RSSR model of a loop; values and tolerances follow from the Delta's.

    `home` is a configuration in the recorded assembly mode. The rod's length is fixed. Parameters
    that are fixed in the Delta have the tolerance of the mechanism `rssr`.
    """
    length = compute_parts(robot, robot.values)[0][POINTS + RODS.index(loop.rod)]
    values, G = loop_numbers(robot, loop, robot.values, length)
    spread = np.linalg.norm(G * (robot.table.tolerance * ~robot.fixed), axis=1)
    mechanism, (i, o) = Rssr(), loop.arms
    own = zip(Rssr.parameters, values, spread, strict=True)
    mechanism.parameters = ParameterTable(
        replace(p, nominal=float(v), tolerance=float(s) or p.tolerance) for p, v, s in own
    )
    limits = robot.mechanism.joint_limits
    mechanism.joints, mechanism.joint_limits = (robot.joints[i],), (limits[i],)
    mechanism.workspace = Workspace((limits[o][0],), (limits[o][1],))
    mechanism.fixed, mechanism.home = ("L",), home
    return replace(new_model(mechanism), noise=robot.noise)


def loop_dataset(
    robot: Model, loop: Loop, dataset: Dataset, joint_sigma: float | None = None
) -> Dataset:
    """Convert joint readings to samples of a loop: the second encoder is its rotation about z."""
    observations, (i, o) = observe(robot, dataset, joint_sigma), loop.arms
    q, sigma = observations.x, np.sqrt(np.diagonal(observations.S, axis1=1, axis2=2))
    turn = np.zeros((len(q), 3))
    turn[:, 2] = q[:, o]
    return Dataset.from_arrays(
        (robot.joints[i],),
        q[:, [i]],
        np.zeros((len(q), 3)),
        rotation_matrix(turn),
        measured=[False] * 5 + [True],
        pose_cov=np.diag([1.0] * 5 + [sigma[0, o] ** 2]),
        joint_sigma=[sigma[0, i]],
        pose_id=dataset.pose_id,
        source=f"{dataset.source} ({loop})",
        sha256=dataset.sha256,
    )


def recorded_home(dataset: Dataset) -> Home:
    """Return the recorded configuration in the middle of the first arm's travel."""
    middle = np.argsort(dataset.q[:, 0], kind="stable")[len(dataset) // 2]
    turned = matrix_to_quaternion(dataset.R[middle])
    return Home((float(dataset.q[middle, 0]),), quaternion=tuple(turned.tolist()))  # type: ignore[arg-type]
