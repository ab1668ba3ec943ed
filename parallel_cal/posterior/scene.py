"""Linearise a fitted model at its predicted poses; the scene holds its residuals."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from parallel_cal.base.rotation import turns_from_mean
from parallel_cal.identification.linearisation import Linearisation, rms_by_sample
from parallel_cal.identification.observations import Observations, blocks, conditions
from parallel_cal.identification.predictions import predict_configurations, reading_residuals
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.registration import shows_pose
from parallel_cal.identification.thresholds import MIN_SIGMAS_PER_TOLERANCE, RELATIVE_RANK
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

MIN_POSES_OF_PART = 100  # as many as a usual session has: they determine the geometry
MAX_SHARED_BYTES = 2**27  # of derivatives of effects that the scenes of one diagnosis share


class SharedDerivatives:
    """Derivatives of what the closure sees by the parameters of effects, computed once for all
    models of the same samples.

    They depend on the joint readings, the conditions and the pose. From one model to another the
    predicted pose changes by the errors of the robot, which hardly changes them.
    """

    def __init__(self) -> None:
        self._known: dict[Hashable, tuple[np.ndarray, np.ndarray]] = {}
        self._bytes = 0

    def get(
        self, key: Hashable, compute: Callable[[], tuple[np.ndarray, np.ndarray]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return which derivatives of a key are not zero at all samples, and these (k, N); compute
        them if they are not known."""
        if key in self._known:
            return self._known[key]
        numbers, values = compute()
        if self._bytes + values.nbytes <= MAX_SHARED_BYTES:
            self._known[key] = numbers, values
            self._bytes += values.nbytes
        return numbers, values


@dataclass(frozen=True)
class Scene:
    """The residuals that candidates are scored on, in noise units.

    residual (n,) and basis (n, rank) of the geometry's columns, with the rows of a sample together;
    x (N, nq+12+nu) the configurations predicted from the joints. Regressors are evaluated there,
    never at the measured pose: a noisy measurement would explain its own error. `by_measured` (N,
    rows, nq + 6 + nu) are the derivatives of the rows by (q, r, w, u) there. `whitener` (N, rows,
    rows of the closure) turns these into noise units, without unmeasured coordinates; `informative`
    (N,) is the number of independent rows that remain for each sample, of at most `rows`. Where
    these are fewer than the rows of the closure, `turn` (N, rows, rows of the closure) are their
    orthonormal directions among those.

    The free parameters take a direction of the basis as a whole, except those that are known
    `within` a prior, from whose mean the residual is then: `sizes` (rank,) are the standard
    deviations of the residual along the basis that the parameters allow, in noise units, infinite
    for the others. Residual and columns are multiplied by S^-1/2, with S = 1 + U diag(sizes^2) U'
    and U the basis, so that their products are those of the evidence.
    """

    model: Model
    dataset: Dataset
    observations: Observations = field(repr=False)
    free: np.ndarray = field(repr=False)
    x: np.ndarray = field(repr=False)
    by_measured: np.ndarray = field(repr=False)
    whitener: np.ndarray = field(repr=False)
    informative: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)
    basis: np.ndarray = field(repr=False)
    dof: int
    turn: np.ndarray | None = field(default=None, repr=False)
    shared: SharedDerivatives | None = field(default=None, repr=False)
    sizes: np.ndarray | None = field(default=None, repr=False)
    within: Prior | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        model: Model,
        dataset: Dataset,
        observations: Observations,
        free: np.ndarray,
        shared: SharedDerivatives | None = None,
        within: Prior | None = None,
    ) -> Scene:
        """Make the scene of a fitted model; the residual is what its free parameters leave, those
        that a prior names only `within` it. Scenes of other models of the same samples may have the
        same `shared` derivatives."""
        x = predict_configurations(model, observations)
        linearise = Linearisation(model, observations, free, True)
        C = np.empty((len(x), model.structure.rows.shape[0], len(model.structure.scale)))
        system = linearise(model.values, x, by_measured=C)
        whitener, r, J = linearise.whiten(C), system.residual[:, :, None], system.jacobian
        turn: np.ndarray | None = None
        rows = int(system.informative.max(initial=0))
        if rows < r.shape[1]:  # along the directions of their whitener, fewer say as much as all
            turn = np.linalg.svd(whitener)[0][:, :, :rows].transpose(0, 2, 1)
            whitener, r, J = turn @ whitener, turn @ r, turn @ J
        r = r.reshape(-1)
        table = model.table
        J = J.reshape(len(r), -1) * table.prior_sigma[free]
        known = () if within is None else within.names
        held = free & np.array([name in known for name in table.names])
        is_held = held[free]
        basis = compute_orthonormal_basis(
            J[:, ~is_held], RELATIVE_RANK, MIN_SIGMAS_PER_TOLERANCE
        )  # what a fit holds takes nothing away
        dof = int(system.informative.sum()) - basis.shape[1]
        sizes: np.ndarray | None = None
        if within is not None:
            away = (within.of_table(table).mean - model.values) / table.prior_sigma
            r = r + J[:, is_held] @ away[held]
            root = (table.tolerance / table.prior_sigma)[held][:, None] * within.factor(table, held)
            columns = J[:, is_held] @ root
            columns -= basis @ (basis.T @ columns)
            directions, allowed, _ = np.linalg.svd(columns, full_matrices=False)
            sizes = np.concatenate([np.full(basis.shape[1], np.inf), allowed])
            basis = np.hstack([basis, directions])
        residual = _project_off(r, basis, sizes)
        return cls(
            model,
            dataset,
            observations,
            free,
            x,
            C,
            whitener,
            system.informative,
            residual,
            basis,
            dof,
            turn,
            shared,
            sizes,
            within,
        )

    def in_units_of(self, variance: float) -> Scene:
        """The same scene in units of a noise with this variance, in units of the present one."""
        if variance == 1.0:
            return self
        scale = variance**-0.5
        residual, sizes = scale * self.residual, self.sizes
        if sizes is not None:
            # Along the basis, S was another one; along directions without a size, nothing is left.
            known, sizes = np.where(np.isinf(sizes), 0.0, sizes), scale * sizes
            more = np.sqrt((1 + known**2) / (1 + (scale * known) ** 2)) - 1
            residual = residual + self.basis @ (more * (self.basis.T @ residual))
        return replace(self, residual=residual, whitener=scale * self.whitener, sizes=sizes)

    def divide(self, most: int) -> Iterator[Scene]:
        """Yield scenes of the same model that share the samples: each has about `most` of them, but
        no fewer than MIN_POSES_OF_PART poses, evenly spread over the recording, with all visits of
        them. The scene itself if it has no more."""
        poses, pose = np.unique(self.dataset.pose_id, return_inverse=True)
        count = min(-(-len(self.x) // most), len(poses) // MIN_POSES_OF_PART)
        if count < 2:
            yield self
            return
        # Of `count` poses that follow one another, each part has one that is drawn: every third of
        # a raster may be at one side.
        turns = np.tile(np.arange(count), (-(-len(poses) // count), 1))
        part = np.random.default_rng(0).permuted(turns, axis=1).ravel()[pose]
        for k in range(count):
            its = np.flatnonzero(part == k)
            some, seen = self.dataset.select_numbered(its), self.observations.select(its)
            yield Scene.of(self.model, some, seen, self.free, within=self.within)

    @property
    def rows(self) -> int:
        """Number of rows of each sample."""
        return int(self.whitener.shape[1])

    @property
    def closure_residual(self) -> np.ndarray:
        """The residual (N, rows of the closure) along the rows of the closure, which mean alike at
        all samples, in noise units."""
        residual = self.by_sample(self.residual)
        return residual if self.turn is None else np.einsum("nr,nrk->nk", residual, self.turn)

    @property
    def chi2_per_dof(self) -> float:
        return float(self.residual @ self.residual) / self.dof if self.dof > 0 else float("nan")

    @cached_property
    def shows_pose(self) -> bool:
        """Whether a device measured coordinates of a pose, or a camera shows them.

        Touches, gauges and joints that check each other do not.
        """
        n = len(self.model.joints)
        poses = self.observations.measured[:, n : n + 6]
        return bool(poses.any()) or shows_pose(self.model)

    @cached_property
    def reading_residuals(self) -> np.ndarray:
        """What sensors read minus what was predicted (N, n_channels), NaN where nothing was."""
        return reading_residuals(self.model, self.observations, self.x)

    @property
    def length_residuals(self) -> np.ndarray:
        """The `reading_residuals` of sensors that read lengths, m; NaN for others, such as the
        pixels of an image."""
        in_metres = self.model.structure.channel_units == "m"
        return np.where(in_metres, self.reading_residuals, np.nan)

    @cached_property
    def group(self) -> np.ndarray:
        """Number (N,) of the block that a sample belongs to."""
        return blocks(self.dataset)

    @cached_property
    def seen(self) -> np.ndarray:
        """q, r, R9, u and geometry as the effects let the closure see them: (N, k)."""
        return self.model.structure.rows_batch.see(self.x, self.observations.a, self.model.values)

    @cached_property
    def seen_jacobian(self) -> np.ndarray:
        """d rows/d what the closure sees, in noise units: (N, rows, k)."""
        closure = self.model.structure.phi.shape[0]
        by_seen = self.model.structure.ideal.closure_seen(self.seen)[1]
        J = by_seen.reshape(len(self.x), -1, closure).transpose(0, 2, 1)
        J = self.whitener[:, :, :closure] @ J
        return np.ascontiguousarray(J.transpose(2, 1, 0)).transpose(2, 1, 0)  # all of one at a time

    @cached_property
    def measured_jacobian(self) -> np.ndarray:
        """d rows/d(q, r, w, u) at the predicted configurations, in noise units: (N, rows, nq + 6 +
        nu)."""
        return np.asarray(self.whitener @ self.by_measured)

    def project_off_geometry(self, columns: np.ndarray) -> np.ndarray:
        """Remove from columns (n, k) the part that the free parameters can imitate."""
        return _project_off(columns, self.basis, self.sizes)

    @cached_property
    def places(self) -> np.ndarray:
        """Where the platform is (N, 3): its predicted position (m), or its turns from the mean
        orientation (rad) if only the orientation was measured."""
        predicted, n = self.model.configuration(self.x), len(self.model.joints)
        position, orientation = np.split(self.observations.measured[:, n : n + 6].any(axis=0), 2)
        if orientation.any() and not position.any():
            return turns_from_mean(predicted.R)
        return predicted.r

    @property
    def sigmas(self) -> np.ndarray:
        """Rms residual (N,) of each sample."""
        return rms_by_sample(self.by_sample(self.residual), self.informative)

    def by_sample(self, column: np.ndarray) -> np.ndarray:
        """A column (n,) as (N, rows), or columns (n, k) as (N, rows, k)."""
        return column.reshape(-1, self.rows, *column.shape[1:])


def columns(
    extended: Model,
    scene: Scene,
    new: np.ndarray,
    a: np.ndarray | None = None,
    share: bool = False,
) -> np.ndarray:
    """d residual / d (new parameters, in tolerances), (n, n_new), of a model with one more effect
    at zero, under conditions a (N, n_conditions), else those recorded; its mechanism and sensors
    are those of the scene. With `share`, under the conditions recorded, the derivatives of another
    scene of the same samples are taken if they are known. FitError where a condition lacks."""
    a = conditions(extended, scene.dataset) if a is None else a
    s, n, which = extended.structure, len(scene.x), np.flatnonzero(new)
    name = extended.effects[-1].name if extended.effects else ""
    own = [k for k, parameter in enumerate(s.table.names) if parameter.startswith(f"{name}.")]
    reads = any(effect.acts_on(c) for effect in extended.effects[-1:] for c in s.channels)
    if extended.mechanism is scene.model.mechanism and set(which) <= set(own) and not reads:
        seen_by, moved = s.ideal.effect_jacobian(name, tuple(np.searchsorted(own, which).tolist()))
        at = a[:, [s.conditions.index(c) for c in extended.effects[-1].conditions(s.mechanism)]]
        values = extended.values[own]

        def compute() -> tuple[np.ndarray, np.ndarray]:
            by_number = seen_by(scene.seen, at, values)[0].T
            used = np.flatnonzero(by_number.any(axis=1))
            return used, by_number[used]

        key = name, id(extended.mechanism), tuple(which - own[0]), values.tobytes()
        used, slopes = scene.shared.get(key, compute) if share and scene.shared else compute()
        by = np.zeros((len(which), scene.rows, n))
        for number, through, slope in zip(*np.divmod(used, len(moved)), slopes, strict=True):
            by[number] += scene.seen_jacobian[:, :, moved[through]].T * slope
        J = by.transpose(2, 1, 0)
    else:  # another closure, or a reading that changes with it
        by_v = s.columns(tuple(which.tolist()))(scene.x, a, extended.values)[0]
        J = scene.whitener @ by_v.reshape(n, len(which), -1).transpose(0, 2, 1)
    return np.asarray(J.reshape(len(scene.residual), -1) * extended.table.tolerance[new])


def _project_off(columns: np.ndarray, basis: np.ndarray, sizes: np.ndarray | None) -> np.ndarray:
    """Columns (n,) or (n, k) without the basis; times S^-1/2 if its `sizes` are known."""
    onto = basis.T @ columns
    if sizes is not None:
        taken = 1 - 1 / np.sqrt(1 + sizes**2)
        onto = taken.reshape(-1, *[1] * (onto.ndim - 1)) * onto
    taken_away = basis @ onto
    return np.asarray(np.subtract(columns, taken_away, out=taken_away))


def compute_orthonormal_basis(J: np.ndarray, least: float, weak: float = 0.0) -> np.ndarray:
    """A basis of the columns' span, directions below `least` of the largest, or `weak`, left."""
    if not J.shape[1] or not J.any():
        return np.zeros((len(J), 0))
    left, sizes, _ = np.linalg.svd(J, full_matrices=False)
    return np.asarray(left[:, sizes > max(least * sizes[0], weak)])
