"""Compute the pattern that a candidate predicts, to compare it with the residuals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.lack_of_fit import regressors
from parallel_cal.model.mechanism import POSE
from parallel_cal.posterior.scene import Scene

BINS = 8  # of an abscissa, to see whether a pattern follows it
MAX_PANELS = 3  # panels of an effect that touches no joint by itself
# of the pattern of a coordinate, in its means over an abscissa; below, joints may show it better
MIN_FOLLOWED = 0.5
RESOLUTION_TOLERANCE = 1e-3  # how far from one a component's own share in its estimate may be


@dataclass(frozen=True)
class Components:
    """What the rows of a scene say of some quantities, by weighted least squares: `names` (k),
    a sample's values (N, k) from a column of the scene, `sigma` (N, k); NaN where not told."""

    names: tuple[str, ...]
    inverse: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, names: Sequence[str], A: np.ndarray) -> Components:
        """Estimate from whitened rows A (N, rows, k) per unit of each quantity; quantities that no
        sample determines are omitted."""
        inverse = np.linalg.pinv(A, rcond=1e-6)
        share = np.einsum("ikr,irk->ik", inverse, A)
        sigma = np.where(
            abs(share - 1) < RESOLUTION_TOLERANCE, np.linalg.norm(inverse, axis=2), np.nan
        )
        told = np.asarray(np.isfinite(sigma).any(axis=0))
        kept = tuple(name for name, one in zip(names, told.tolist(), strict=True) if one)
        return cls(kept, inverse[:, told], sigma[:, told])

    def values(self, rows: np.ndarray) -> np.ndarray:
        """(N, k) of rows (N, rows) in noise units."""
        return np.where(np.isfinite(self.sigma), (self.inverse @ rows[:, :, None])[:, :, 0], np.nan)


def compute_joint_components(scene: Scene) -> Components:
    """Measured joint minus the inverse of the measured pose, to first order (rad or m): a reading
    too large by d leaves T (d phi/dq) d in the rows. Only a part of the pose may be measured."""
    n = len(scene.model.joints)
    return Components.of(scene.model.joints, scene.measured_jacobian[:, :, :n])


def compute_measured_components(scene: Scene) -> Components:
    """Measured minus predicted pose (m, rad) where any was measured, else what sensors read."""
    n, observations = len(scene.model.joints), scene.observations
    shown = [k for k in scene.model.mechanism.moved if observations.measured[:, n + k].any()]
    pose = Components.of(
        [POSE[k] for k in shown], scene.measured_jacobian[:, :, [n + k for k in shown]]
    )
    channels = scene.model.structure.channels
    return (
        pose
        if pose.names or not channels
        else Components.of(channels, -scene.whitener[:, :, -len(channels) :])
    )


@dataclass(frozen=True)
class Panel:
    """A component's residual (N,) in its sigmas over the most informative quantity, `at` (N,) in SI
    units, and the candidate's `pattern` (N,); a periodic pattern is folded into one `period`.
    Samples without information are not in it; `sample` (N,) numbers the others. `sigma` is the
    median of the component's sigmas, in SI units."""

    component: str
    abscissa: str
    period: float | None
    sample: np.ndarray
    at: np.ndarray
    residual: np.ndarray
    pattern: np.ndarray
    sigma: float


@dataclass(frozen=True)
class Signature:
    """A candidate's pattern: the part of the residuals that it explains and the geometry cannot, U
    U^T r; `joints` (N, k) of the joints that the data determine (rad or m), and the panels."""

    effect: str
    joints: np.ndarray
    panels: tuple[Panel, ...]


def signature(one: Candidate) -> Signature:
    """Compute the pattern of a candidate that could be tested."""
    scene, score = one.scene, one.score
    if scene is None or score is None:
        raise ValueError(f"{one.name} could not be tested: {one.reason}")
    found = compute_explained_residual(one)
    of_joints = compute_joint_components(scene)
    panels = tuple(_panels(one, scene, of_joints, found))
    return Signature(one.name, of_joints.values(scene.by_sample(found)), panels)


def compute_explained_residual(one: Candidate) -> np.ndarray:
    """U U^T r (n,): of the scene's residual what a candidate's columns take, off the geometry."""
    assert one.scene is not None
    assert one.score is not None
    return np.asarray(one.score.U @ (one.score.U.T @ one.scene.residual))


def compute_overlay_pattern(panel: Panel, other: Candidate) -> np.ndarray:
    """The pattern (N,) of another candidate of the same scene in a panel's component."""
    scene = other.scene
    assert scene is not None
    shown = (
        compute_joint_components(scene)
        if panel.component in scene.model.joints
        else compute_measured_components(scene)
    )
    values = shown.values(scene.by_sample(compute_explained_residual(other))) / shown.sigma
    told = np.isin(scene.dataset.numbers, panel.sample)
    return np.asarray(values[told, shown.names.index(panel.component)])


def _panels(
    one: Candidate, scene: Scene, of_joints: Components, found: np.ndarray
) -> Iterator[Panel]:
    """One panel for each joint with parameters or conditions of the effect, else the best one."""
    mechanism, known = scene.model.mechanism, dict(regressors(scene))
    conditions = one.effect.conditions(mechanism)
    own = {p.name.split(".")[0] for p in one.effect.parameters(mechanism)}
    own |= {name.partition(".")[2] for name in conditions}
    if touched := [joint for joint in of_joints.names if joint in own]:
        for joint in touched:
            needed = [name for name in conditions if name.endswith(f".{joint}")]
            shared = [n for n in one.effect.needs if n in known]
            abscissa = next((n for n in (*needed, *shared) if n in known), joint)
            yield from _panel(one, of_joints, found, joint, abscissa)
        return
    needed = [name for name in conditions if name in known]
    along = needed or [name for name in known if name in (*mechanism.joints, *"xyz")]
    shown = compute_measured_components(scene)
    pairs = _rank_pairs(shown, scene, found, known, along)
    # An error of lengths may move each coordinate differently from pose to pose, and each joint
    # in one way.
    if pairs and pairs[0].followed < MIN_FOLLOWED:
        by_joint = _rank_pairs(of_joints, scene, found, known, along)
        if by_joint and by_joint[0].followed > pairs[0].followed:
            shown, pairs = of_joints, by_joint
    best: dict[str, str] = {}
    for pair in pairs:
        best.setdefault(pair.component, pair.abscissa)
    for component, name in list(best.items())[:MAX_PANELS]:
        yield from _panel(one, shown, found, component, name)


class _Pair(NamedTuple):
    """How much of a component's pattern an abscissa shows: its mean square, and the share that
    this is of the whole."""

    strength: float
    component: str
    abscissa: str
    followed: float


def _rank_pairs(
    shown: Components,
    scene: Scene,
    found: np.ndarray,
    known: Mapping[str, np.ndarray],
    along: Sequence[str],
) -> list[_Pair]:
    """Components and which of the `known` abscissae they may be shown against, the strongest
    pattern first."""
    z = np.nan_to_num(shown.values(scene.by_sample(found)) / shown.sigma)
    pairs = []
    for component, values in zip(shown.names, z.T, strict=True):
        whole = float(np.mean(values**2))
        for name in along:
            strength = compute_pattern_strength(known[name], values)
            pairs.append(_Pair(strength, component, name, strength / whole if whole else 0.0))
    return sorted(pairs, reverse=True)


def _panel(
    one: Candidate, shown: Components, found: np.ndarray, component: str, abscissa: str
) -> Iterator[Panel]:
    """None if the abscissa never changes."""
    scene, k = one.scene, shown.names.index(component)
    assert scene is not None
    values = dict(regressors(scene)).get(abscissa)
    if values is None:
        return
    period = one.effect.period(one.settings) if abscissa == component else None
    if period is not None and period < np.ptp(values) / 2:
        values = values % period
    else:
        period = None
    residual, pattern = (
        (shown.values(scene.by_sample(column)) / shown.sigma)[:, k]
        for column in (scene.residual, found)
    )
    told = np.isfinite(residual)
    yield Panel(
        component,
        abscissa,
        period,
        scene.dataset.numbers[told],
        values[told],
        residual[told],
        pattern[told],
        float(np.median(shown.sigma[told, k])),
    )


def compute_pattern_strength(values: np.ndarray, pattern: np.ndarray) -> float:
    """Mean square of a pattern (N,) that its means over ranges of an abscissa (N,) show."""
    levels, index = np.unique(values, return_inverse=True)
    if len(levels) > BINS:
        order = np.argsort(values, kind="stable")
        index = np.empty(len(values), dtype=int)
        index[order] = np.arange(len(values)) * BINS // len(values)
    count = np.bincount(index)
    means = np.bincount(index, pattern) / np.maximum(count, 1)
    return float(count @ means**2 / len(values))
