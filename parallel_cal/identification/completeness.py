"""Check whether a mechanism has all parameters of a complete model, by a rank."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.identification.thresholds import ROUNDING
from parallel_cal.kinematics.kinematics import MAX_CLOSED_RESIDUAL_M, Kinematics
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model, new_model

PART_OF_TRAVEL = 0.15  # of each joint's range, to both sides of home: where poses are drawn


@dataclass(frozen=True)
class Completeness:
    """Numbers of parameters of a mechanism, counted at a robot with generic errors.

    `rank` is the number of independent parameters, `needed` the number if both frames are arbitrary
    (C with F = 2). `coordinates` is the number that one frame adds: 6 in space, 3 in a plane or on
    a sphere.
    """

    parameters: int
    rank: int
    needed: int
    coordinates: int

    def is_complete(self, frames: int = 2) -> bool:
        """Whether no parameter is missing if `frames` of {B} and {P} are arbitrary (F)."""
        return self.rank == self.needed - self.coordinates * (2 - frames)

    @property
    def redundant(self) -> int:
        """Number of superfluous parameters."""
        return self.parameters - self.rank

    @property
    def frames(self) -> int | None:
        """The number of frames ({B}, {P}) that may be arbitrary without a missing parameter; None
        if a parameter is missing even if both are given."""
        return next((F for F in (2, 1, 0) if self.is_complete(F)), None)

    @property
    def sentence(self) -> str:
        counted = f"{self.parameters} parameters, {self.rank} of them independent"
        if self.frames is None:
            missing = self.needed - self.rank
            return f"{counted}; {missing} more would let every such robot stand anywhere"
        if self.frames == 2:
            return (
                f"{counted}. They describe every geometric error, and any place of the frames of "
                "base and platform"
            )
        where = ("both frames are", "one frame is")[self.frames]
        return (
            f"{counted}. They describe every geometric error if {where} given (base, platform); "
            f"wherever both are, {self.needed} are needed"
        )

    def document(self) -> dict[str, int | None]:
        return asdict(self) | {"frames": self.frames, "redundant": self.redundant}


def compute_completeness(
    mechanism: Mechanism, spread: float = 5.0, without: Sequence[str] = (), seed: int = 0
) -> Completeness:
    """Rank of the identification Jacobian d phi / dp over poses that close exactly.

    The robot is drawn `spread` tolerances around nominal: at the nominal robot some parameters have
    no effect (a Delta's platform does not tilt). `without` names parameters to omit.
    """
    rng = np.random.default_rng(seed)
    table = mechanism.parameters
    values = table.nominal + spread * table.tolerance * rng.uniform(-1, 1, len(table))
    model = new_model(mechanism).with_values(values)
    x = closed_poses(model, 3 * len(table), rng)
    kept = ~table.matching(without) if without else slice(None)
    own, frames = identification_jacobian(model, x)[:, kept], frame_jacobian(model, x)
    needed = rank(np.hstack([own, frames]))
    return Completeness(own.shape[1], rank(own), needed, len(mechanism.moves))


def closed_poses(model: Model, n: int, rng: np.random.Generator) -> np.ndarray:
    """n configurations (q, r, R9, u) that close, with the joints around home."""
    kinematics = Kinematics(model)
    found = np.empty((0, len(model.mechanism.home.configuration)))
    for _ in range(20):
        s = kinematics.direct(_joints(kinematics, n, rng))
        closed = np.nan_to_num(s.residual, nan=np.inf) < MAX_CLOSED_RESIDUAL_M
        found = np.vstack([found, s.configuration.rows[closed]])[:n]
        if len(found) == n:
            return found
    raise ModelError(f"{model.mechanism.name}: only {len(found)} of {n} poses around home close")


def _joints(kinematics: Kinematics, n: int, rng: np.random.Generator) -> np.ndarray:
    """Joints (n, nq) drawn around home; those of redundant drives from drawn positions."""
    m = kinematics.model.mechanism
    if len(m.joints) > len(m.moves):
        position = np.tile(m.home.position, (n, 1))
        moved = [i for i in m.controlled if i < 3]
        position[:, moved] = m.sample(n, rng)[:, : len(moved)]
        return kinematics.inverse(position).joints
    low, high = np.array(m.joint_limits).T
    reach = PART_OF_TRAVEL * np.minimum(high - low, 2 * np.pi)
    return np.array(m.home.joints) + reach * rng.uniform(-1, 1, (n, len(m.joints)))


def identification_jacobian(model: Model, x: np.ndarray) -> np.ndarray:
    """d phi / dp at configurations (n, nq + 12), stacked; a column is one tolerance."""
    return np.concatenate(_blocks(model, x)[1]) * model.table.tolerance


def frame_jacobian(model: Model, x: np.ndarray) -> np.ndarray:
    """d phi for small motions of {B} and of {P}, among the coordinates that move."""
    J_x, here = _blocks(model, x)[0], model.configuration(x)
    r, R = here.r, here.R
    lever = np.stack([np.cross(axis, r) for axis in np.eye(3)], axis=2)
    zero = np.zeros_like(R)
    base = np.block([[np.broadcast_to(np.eye(3), R.shape), lever], [zero, zero + np.eye(3)]])
    platform = np.block([[R, zero], [zero, R]])
    moved, length = model.mechanism.moved, model.mechanism.length
    unit = np.array([1, 1, 1, *(3 * [1 / length])])[moved]
    columns = [J_x @ motion[:, :, moved] * unit for motion in (base, platform)]
    return np.concatenate(np.concatenate(columns, axis=2))


def rank(J: np.ndarray) -> int:
    """Number of independent columns, after scaling each to length 1; columns of zero length up to
    rounding do not count."""
    size = np.linalg.norm(J, axis=0)
    felt = size > 1e-12 * size.max(initial=0.0)
    scaled = J[:, felt] / size[felt]
    values = np.linalg.svd(scaled, compute_uv=False)
    return int(np.sum(values > ROUNDING * values[0])) if len(values) else 0


def _blocks(model: Model, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """d phi / d(r, w) (N, rows, 6) and d phi / dp (N, rows, n_p)."""
    J_x, J_v = model.structure.jacobians(x, model.condition_rows(None, len(x)), model.values)
    n = len(model.joints)
    return J_x[:, :, n : n + 6], J_v
