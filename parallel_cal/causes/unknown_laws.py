"""What no effect describes: smooth unknown laws of joints, conditions and places, and drift."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import chain

import numpy as np

from parallel_cal.posterior.blocks import DRIFT, FIELD, LAW, LOG_ODDS, Block
from parallel_cal.posterior.scene import Scene

# Likelier by less than five nats, an unknown law is no reason against a known effect.
LOG_PRIOR = LOG_ODDS - 5.0
CENTRES = 30
ONE_JOINT = "law of one joint"
ALL_LENGTHS = (0.7, 1.2, 2.5)  # of functions of all readings, in their standard deviations
# Lengths of a law of a joint's own reading (in standard deviations of it), and their centres. The
# finest follows scratches and chirping gears; without it waves of a known effect would describe
# them best, as they would a dent, a kink or a step of one joint without a law of this joint alone.
OWN_LENGTHS = ((0.1, 30), (0.3, 12), (0.7, 12), (1.5, 12))
# Lengths of drift, in standard deviations of the order. Up to so many rows of residuals drift is
# exact: known at some samples only, it leaves a jump between two of them to the bump of a device.
DRIFT_LENGTHS, MAX_EXACT_ROWS = (1.2, 0.4, 0.2, 0.1), 450


def list_unknown_blocks(scene: Scene, kinds: Collection[str] = (LAW, FIELD, DRIFT)) -> list[Block]:
    """A block for each law of these kinds that is in no catalogue."""
    makers = {
        LAW: (_joint_laws, _laws_of_conditions, _laws_of_motion, _deflections),
        FIELD: (_fields,),
        DRIFT: (_drifts,),
    }
    found = (
        block for kind in makers if kind in kinds for make in makers[kind] for block in make(scene)
    )
    return [block for block in found if block is not None]


def smooth(x: np.ndarray, length: float, centres: int, rough: bool = False) -> np.ndarray:
    """Columns (N, m) of a random function of x (N, d) with variance one, that changes over a length
    in standard deviations of x: a Gaussian process with squared exponential covariance, by its
    values at `centres` of the x, the furthest from each other (Quinonero-Candela and Rasmussen,
    JMLR 6, 2005).

    With `rough`, the covariance is exponential, as that of noise whose neighbours are similar.
    """
    x = x.reshape(len(x), -1)
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-12)
    # Begin with the x nearest to the mean; each further one is the furthest from those chosen.
    chosen = [int(np.argmin(np.sum((x - x.mean(axis=0)) ** 2, axis=1)))]
    away = np.sum((x - x[chosen[0]]) ** 2, axis=1)
    while len(chosen) < centres and away.max() > 0:
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.sum((x - x[chosen[-1]]) ** 2, axis=1))
    c = x[chosen]

    def covariance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squares = np.sum((a[:, None] - b[None]) ** 2, axis=2)
        return np.exp(-np.sqrt(squares) / length if rough else -squares / (2 * length**2))

    factor = np.linalg.cholesky(covariance(c, c) + 1e-6 * np.eye(len(c)))
    return np.asarray(np.linalg.solve(factor, covariance(c, x)).T)


def _unit(J: np.ndarray) -> np.ndarray:
    """Columns (N, rows, k) in units of their own root mean square per sample."""
    return np.asarray(J / np.sqrt(max(np.sum(J**2) / (J.shape[2] * len(J)), 1e-300)))


def _pose_jacobian(scene: Scene) -> np.ndarray:
    """d rows/d pose (N, rows, 6), positions and turns each in units of their own root mean square:
    a metre is not as likely as a radian."""
    by_pose = scene.measured_jacobian[:, :, len(scene.model.joints) :][:, :, :6]
    return np.concatenate([_unit(by_pose[:, :, :3]), _unit(by_pose[:, :, 3:])], axis=2)


def _flat(scene: Scene, J: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """Columns (n, k m): each of the derivatives J (N, rows, k) times each function (N, m)."""
    return np.einsum("nrk,nm->nrkm", _unit(J), functions).reshape(len(scene.residual), -1)


def _smooth_each(own: np.ndarray, lengths: Sequence[tuple[float, int]]) -> list[list[np.ndarray]]:
    """For each length and number of centres, functions (N, m) of the own value (N, n_joints) of
    each joint."""
    return [[smooth(values, *one) for values in own.T] for one in lengths]


def _of_each_own(
    scene: Scene, J: np.ndarray, functions: Sequence[Sequence[np.ndarray]]
) -> Iterator[list[np.ndarray]]:
    """Yield for each length the columns for each joint of an error of it by these functions."""
    for each in functions:
        yield [_flat(scene, J[:, :, [i]], one) for i, one in enumerate(each)]


def _principal(B: np.ndarray) -> np.ndarray:
    """Columns (n, k) as at most n orthogonal ones, with the same evidence."""
    if B.shape[1] <= len(B):
        return B
    values, vectors = np.linalg.eigh(B @ B.T)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _joint_laws(scene: Scene) -> Iterator[Block | None]:
    n = len(scene.model.joints)
    J, q = scene.measured_jacobian[:, :, :n], scene.x[:, :n]
    if not scene.shows_pose:
        # The height at which a probe touches is stored as joint readings: its noise is in them, and
        # the residual itself is a smooth function of them. It is none of where the model touches.
        residual = scene.residual.reshape(len(q), -1)
        q = q - np.einsum("nij,nj->ni", np.linalg.pinv(J), residual)
    own = _smooth_each(q, OWN_LENGTHS)
    each = map(np.hstack, _of_each_own(scene, J, own))  # one at a time: the columns are large
    yield Block.of(scene, "law of each joint's own reading", LAW, LOG_PRIOR, each)
    functions = [smooth(q, length, CENTRES) for length in ALL_LENGTHS]
    whole = (_flat(scene, J, one) for one in functions)
    yield Block.of(scene, "law of all joint readings", LAW, LOG_PRIOR, whole)
    single = (_flat(scene, J[:, :, [i]], one) for one in functions for i in range(n))
    alone = chain.from_iterable(_of_each_own(scene, J, own))
    yield Block.of(scene, ONE_JOINT, LAW, LOG_PRIOR, chain(alone, single))


def name_law(name: str, setting: int, joints: Sequence[str]) -> str:
    """The name of a law for people, by its setting: `law of joint2` for the law of one joint."""
    return f"law of {joints[setting % len(joints)]}" if name == ONE_JOINT else name


def _laws_of_conditions(scene: Scene) -> Iterator[Block | None]:
    n, data = len(scene.model.joints), scene.dataset
    J, q = scene.measured_jacobian[:, :, :n], scene.x[:, :n]

    def centred(v: np.ndarray) -> np.ndarray:
        return np.asarray((v - v.mean(axis=0)) / np.maximum(v.std(axis=0), 1e-12))

    for name in ("payload", "temperature", "time", "direction", "travel"):
        names = [name] * n if name in data.conditions else [f"{name}.{j}" for j in data.joint_names]
        if not all(one in data.conditions for one in names):
            continue
        values = np.column_stack([data.conditions[one] for one in names])
        if not (np.isfinite(values).all() and np.ptp(values, axis=0).any()):
            continue
        functions = np.stack([centred(values) * centred(q) ** power for power in range(3)], axis=2)
        columns = (_unit(J)[:, :, :, None] * functions[:, None]).reshape(len(scene.residual), -1)
        yield Block.of(scene, f"law of {name}", LAW, LOG_PRIOR, [columns])


def _laws_of_motion(scene: Scene) -> Iterator[Block | None]:
    """Each joint lags by any function of its own velocity, or acceleration: friction saturates."""
    n, conditions = len(scene.model.joints), scene.dataset.conditions
    J = scene.measured_jacobian[:, :, :n]
    for name in ("velocity", "acceleration"):
        names = [f"{name}.{joint}" for joint in scene.dataset.joint_names]
        if not all(one in conditions and np.ptp(conditions[one]) > 0 for one in names):
            continue
        own = np.column_stack([conditions[one] for one in names])
        columns = map(np.hstack, _of_each_own(scene, J, _smooth_each(own, OWN_LENGTHS[1:])))
        yield Block.of(scene, f"law of {name}", LAW, LOG_PRIOR, columns)


def _deflections(scene: Scene) -> Iterator[Block | None]:
    """The platform yields under the payload, which no device knows."""
    payload = scene.dataset.conditions.get("payload")
    if payload is None or not np.ptp(payload) > 0:
        return
    share = payload / np.sqrt(np.mean(payload**2))
    J = _pose_jacobian(scene)
    columns = (
        _flat(scene, J, share[:, None] * smooth(scene.places, length, CENTRES))
        for length in (0.7, 1.5, 3.0)
    )
    yield Block.of(scene, "deflection under the payload", LAW, LOG_PRIOR, columns)


def _fields(scene: Scene) -> Iterator[Block | None]:
    n = len(scene.model.joints)
    J = scene.measured_jacobian[:, :, n : n + 3]
    if not (scene.shows_pose and J.any()):
        return
    columns = (
        _flat(scene, J, smooth(scene.places, length, CENTRES)) for length in (0.4, 0.7, 1.2, 2.5)
    )
    yield Block.of(scene, "field of the device", FIELD, LOG_PRIOR, columns)


def _drifts(scene: Scene) -> Iterator[Block | None]:
    if "time" not in scene.dataset.conditions:
        return
    J = _pose_jacobian(scene)
    order = np.argsort(np.argsort(scene.dataset.time)).astype(float)
    exact = len(scene.residual) <= MAX_EXACT_ROWS
    centres = len(order) if exact else MAX_EXACT_ROWS // J.shape[2]
    columns = (
        _principal(_flat(scene, J, smooth(order, length, centres, rough=True)))
        for length in DRIFT_LENGTHS
    )
    yield Block.of(scene, "drifting noise", DRIFT, LOG_PRIOR, columns)
