"""How wrong a model is on measured samples: position, orientation and joint errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.evidence import Evidence
from parallel_cal.kinematics import Kinematics, Solutions, Status
from parallel_cal.mechanism import Mechanism
from parallel_cal.model import Model
from parallel_cal.rotation import rotation_vector

ERRORS = ("position", "orientation", "joint", "reading")


@dataclass(frozen=True)
class Errors:
    """Measured minus predicted (table 5.9): position (N, 3) m, orientation (N, 3) rad about
    base axes from the direct problem, joint (N, nq) from the inverse, reading (N, n_channels) m
    of the sensors beside the pose device from the direct problem; closure (N, n_rows) m at what
    was measured; NaN where not known."""

    position: np.ndarray
    orientation: np.ndarray
    joint: np.ndarray
    reading: np.ndarray
    closure: np.ndarray

    def norms(self, kind: str) -> np.ndarray:
        """(N,) norms over what is known of a sample, NaN where nothing is."""
        part = getattr(self, kind)
        known = np.isfinite(part)
        norms = np.linalg.norm(np.where(known, part, 0.0), axis=1)
        return np.where(known.any(axis=1), norms, np.nan)

    def select(self, index: np.ndarray) -> Errors:
        return Errors(*(part[index] for part in vars(self).values()))

    def document(self) -> dict[str, float | None]:
        """Mean and rms of the norms of each kind (table 5.15), and rms of the closure's rows:
        with more of these than freedoms it is the one error that weighs all of them. None where
        not measured."""
        entries: dict[str, float | None] = {}
        for kind in ERRORS:
            norms = self.norms(kind)
            norms = norms[np.isfinite(norms)]
            entries[f"{kind}_mean"] = float(norms.mean()) if len(norms) else None
            entries[f"{kind}_rms"] = _rms(norms)
        entries["closure_rms"] = _rms(self.closure[np.isfinite(self.closure)])
        return entries


def _rms(values: np.ndarray) -> float | None:
    return float(np.sqrt((values**2).mean())) if len(values) else None


def errors(model: Model, evidence: Evidence) -> Errors:
    """Both kinds of prediction at every sample: pose from joints, joints from pose."""
    kinematics = Kinematics(model)
    n, m = len(model.joints), model.mechanism
    at = condition_columns(model, evidence)
    x, measured = evidence.x, evidence.measured
    rotation = x[:, n + 3 :].reshape(-1, 3, 3)
    # The robot is solved in {B}; the device shows its poses in frames of its own.
    reached = kinematics.direct(x[:, :n], at)
    pose = shown(model, reached)
    position, turned = model.structure.located(x[:, n:], model.values)
    # In the assembly mode that was measured: an arm's wrist need not be flipped as at home.
    joints = kinematics.inverse(position, turned.reshape(-1, 3, 3), at, reached)
    given = measured[:, [n + i for i in m.controlled]].all(axis=1)
    turn = rotation_vector(
        rotation @ np.where(np.isfinite(pose.rotation), pose.rotation, np.eye(3)).transpose(0, 2, 1)
    )
    placed, orientation = (judged(m, measured[:, n:], part) for part in (range(3), range(3, 6)))
    apart = np.where(measured[:, n : n + 3], x[:, n : n + 3] - pose.position, 0.0)
    return Errors(
        _where(placed & _solved(pose), apart),
        _where(orientation & _solved(pose), np.where(measured[:, n + 3 :], turn, 0.0)),
        _where(given & _solved(joints), _unwound(m, x[:, :n] - joints.joints)),
        _readings_apart(model, evidence, pose),
        _closure(model, evidence),
    )


def _unwound(mechanism: Mechanism, difference: np.ndarray) -> np.ndarray:
    """Joint errors without whole turns, which change nothing (a spool's do)."""
    return difference - mechanism.turns * np.round(difference / (2 * np.pi))


def _closure(model: Model, evidence: Evidence) -> np.ndarray:
    """Rows of the closure (N, n_rows) at measured joints and pose; NaN where a coordinate that
    the mechanism moves was not measured."""
    phi = model.structure.rows_batch(evidence.x, evidence.a, model.values)[0]
    return _where(_complete(model, evidence), phi[:, : model.structure.phi.shape[0]])


def _complete(model: Model, evidence: Evidence) -> np.ndarray:
    moved = [len(model.joints) + i for i in model.mechanism.moved]
    return np.asarray(evidence.measured[:, moved].all(axis=1))


def shown(model: Model, solutions: Solutions) -> Solutions:
    """Poses of {P} in {B} as the model's pose device shows them."""
    pose = np.concatenate([solutions.position, solutions.rotation.reshape(-1, 9)], axis=1)
    r, R9 = model.structure.shown(pose, model.values)
    return replace(solutions, position=r, rotation=R9.reshape(-1, 3, 3))


def reading_errors(model: Model, evidence: Evidence) -> np.ndarray:
    """Read minus predicted (N, n_channels), m: what every sensor shows at the pose that the
    model's direct problem puts the platform in; NaN where not read or not solved."""
    n = len(model.joints)
    pose = Kinematics(model).direct(evidence.x[:, :n], condition_columns(model, evidence))
    return _readings_apart(model, evidence, shown(model, pose))


def _readings_apart(model: Model, evidence: Evidence, pose: Solutions) -> np.ndarray:
    """Read minus predicted (N, n_channels) where the pose device would show `pose`."""
    n = len(model.joints)
    x = np.concatenate([evidence.x[:, :n], pose.position, pose.rotation.reshape(-1, 9)], axis=1)
    rows = model.structure.rows_batch(x, evidence.a, model.values)[0]
    predicted = rows[:, model.structure.phi.shape[0] :]
    return np.where(_solved(pose)[:, None], evidence.reading - predicted, np.nan)


def judged(mechanism: Mechanism, measured: np.ndarray, part: range) -> np.ndarray:
    """Samples (N,) whose position (or orientation) can be judged: every coordinate of it that
    the mechanism moves was measured; where it moves none, all three were."""
    moved = [i for i in part if i in mechanism.moved]
    return np.asarray(measured[:, moved or list(part)].all(axis=1))


def condition_columns(model: Model, evidence: Evidence) -> dict[str, Any]:
    return {name: evidence.a[:, k] for k, name in enumerate(model.conditions)}


def _solved(solutions: Solutions) -> np.ndarray:
    return np.isin(solutions.status, (Status.CONVERGED, Status.OUTSIDE_LIMITS, Status.SINGULAR))


def _where(known: np.ndarray, difference: np.ndarray) -> np.ndarray:
    return np.where(known[:, None], difference, np.nan)


def improvement(
    before: Mapping[str, float | None], after: Mapping[str, float | None]
) -> dict[str, float | None]:
    """Factors of improvement: sum of error norms before over after (table 5.9, eq. 5.20)."""
    factors: dict[str, float | None] = {}
    for kind in ERRORS:
        a, b = before[f"{kind}_mean"], after[f"{kind}_mean"]
        factors[kind] = a / b if a is not None and b else None
    return factors


def noise_floor(model: Model, evidence: Evidence, seed: int = 0) -> dict[str, float | None]:
    """The errors a perfect model of this robot would show: measurement noise alone.

    Joint noise reaches the pose and what sensors show there through the direct problem, pose
    noise the joints through the inverse; means of norms by 64 draws a sample with a fixed seed.
    None where the noise was only assumed.
    """
    if evidence.noise_assumed:
        return Errors(*[np.empty((0, 1))] * 5).document()
    n, m = len(model.joints), model.mechanism
    closure = model.structure.phi.shape[0]
    rows = _row_jacobians(model, evidence)
    C, shown_by = rows[:, :closure], rows[:, closure:]
    moved = [n + i for i in m.moved]
    solved_for = [*range(n), *[n + i for i in m.passive]]
    given = [n + i for i in m.controlled]
    rng = np.random.default_rng(seed)
    draws = rng.standard_normal((64, *evidence.S.shape[:2]))
    noise = np.einsum("nij,dnj->dni", np.linalg.cholesky(evidence.S + 1e-30 * np.eye(n + 6)), draws)
    to_pose = -np.linalg.pinv(C[:, :, moved]) @ C[:, :, :n]
    to_joint = -(np.linalg.pinv(C[:, :, solved_for]) @ C[:, :, given])[:, :n]
    pose = noise[:, :, n:].copy()
    pose[:, :, m.moved] -= np.einsum("nij,dnj->dni", to_pose, noise[:, :, :n])
    joint = noise[:, :, :n] - np.einsum("nij,dnj->dni", to_joint, noise[:, :, given])
    by_joint = shown_by[:, :, :n] + shown_by[:, :, moved] @ to_pose
    read = model.structure.accuracy * rng.standard_normal((*draws.shape[:2], shown_by.shape[1]))
    read -= np.einsum("nij,dnj->dni", by_joint, noise[:, :, :n])
    read = np.where(np.isfinite(evidence.reading), read, np.nan)
    measured = np.broadcast_to(evidence.measured, (len(draws), *evidence.measured.shape))
    each = (pose[:, :, :3], pose[:, :, 3:], joint, read)
    flat = [a.reshape(len(draws) * len(evidence), a.shape[-1]) for a in each]
    mask = measured.reshape(-1, n + 6)
    known = [judged(m, mask[:, n:], part) for part in (range(3), range(3, 6))]
    known.append(np.all(mask[:, given], axis=1))
    gaps = np.einsum("nij,dnj->dni", C, noise)[:, _complete(model, evidence)]
    kept = [mask[:, n : n + 3], mask[:, n + 3 :], np.ones_like(flat[2], dtype=bool)]
    parts = [_where(k, np.where(c, a, 0.0)) for k, c, a in zip(known, kept, flat[:3], strict=True)]
    return Errors(*[*parts, flat[3], gaps]).document()


def _row_jacobians(model: Model, evidence: Evidence) -> np.ndarray:
    """d rows / d (q, r, w) of closure and readings (N, n_rows, nq + 6), where the platform is."""
    from parallel_cal.methods.implicit import Linearisation

    linearise = Linearisation(model, evidence, np.zeros(len(model.values), dtype=bool), True)
    return np.asarray(linearise.blocks(model.values, linearise.start())[1])
