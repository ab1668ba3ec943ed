"""Bayes factors of changes since a calibration, by samples of any kind.

The hypotheses are linear Gaussian models of one closure, linearised about the calibrated model. If
nothing has changed, the parameters are off by the error of the calibration, N(0, C0). Each possible
change adds F z to them, with z ~ N(0, s^2): F is one usual drift, and s is one of 1/3, 1, 3, 10 and
30. The Bayes factor of a change against none has a closed form,

    log B = 1/2 sum_k [s^2 z_k^2 / (1 + s^2 l_k) - log(1 + s^2 l_k)],

with the eigenvalues l of F^T M F and z = Q^T F^T u; M and u are the information and the pull of the
samples, from which the error of the calibration was integrated out. Without a change, the mean of
their mixture is 1 after every sample. By Ville's inequality, the probability that it ever exceeds
1 / a is at most a: one may look after each sample, and stop (J. Ville, Etude critique de la notion
de collectif, 1939; A. Wald, Sequential Analysis, 1947).

A change counts if it would have moved the samples of the calibration by more than their noise
(rms). To say that nothing has changed, each single change that is just as large, +-c, must be
excluded: its

    log B = log cosh(c u) - c^2 l / 2

must be below log a. By the same inequality, such a change is missed with a probability of at most
a.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.identification.update import (
    list_culprits,
    list_drift_parts,
    list_robot_parameters,
    update_prior,
)
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Parameter
from parallel_cal.model.shelf import load_effect
from parallel_cal.model.words import describe

TARGET_EFFECT = "target_offset"
SCALES = np.array([1 / 3, 1.0, 3.0, 10.0, 30.0])  # usual drifts; a collision is 30
ZERO, TEMPERATURE, PART, DEVICE = "zero", "temperature", "part", "measuring device"
TARGET = "target of the device"  # of the kind DEVICE
HOMING, EVERYTHING = "zeros and temperature", "all parts"
MIN_PROBABILITY = 1e-9  # of a case that counts, beside that of the likeliest change


class Part(NamedTuple):
    """One number of a change in words, and its usual size, 1 sigma, in an SI unit; negative if a
    change by +1 sigma is one of the columns by -1 sigma."""

    title: str
    size: float
    unit: str


@dataclass(frozen=True)
class Change:
    """What may have changed: its name, the `kind` of change, and the usual size F (n, k), in units
    of the columns: these change by F z, z ~ N(0, 1). `parts` are the k numbers that z scales.
    `device` names what of the measuring device moved. If the robot changed, too, that of the device
    is `beside`, by a size of its own, and its parts are the last ones. The `title` is the name in
    words."""

    name: str
    kind: str
    factor: np.ndarray
    parts: tuple[Part, ...] = ()
    device: str = ""
    title: str = ""
    beside: Change | None = None

    @property
    def is_of_robot(self) -> bool:
        return self.kind != DEVICE

    @property
    def is_of_both(self) -> bool:
        return self.beside is not None

    def expand(self, scale: float, beside: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the columns (n, k) of its parts, if it is `scale` usual ones, and that of a device
        `beside` ones; and how many usual ones each part is (k,)."""
        scales = np.full(self.factor.shape[1], scale)
        if self.beside is None:
            return scale * self.factor, scales
        F = np.hstack([scale * self.factor, beside * self.beside.factor])
        return F, np.append(scales, np.full(self.beside.factor.shape[1], beside))

    def with_device(self, other: Change) -> Change:
        """This change of the robot and that of a device at once."""
        return Change(
            f"{other.name} and {self.name}",
            self.kind,
            self.factor,
            (*self.parts, *other.parts),
            other.device,
            f"{other.title} and {self.title}",
            other,
        )


class Moved(NamedTuple):
    """By how much a part has changed, with the standard deviation, in an SI unit."""

    title: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Columns:
    """Residuals (N, rows) in units of the noise, and their derivatives (N, rows, n + k) by the free
    parameters, in tolerances, and by the displacements (m, rad) of the measuring device and of its
    target on the platform: those of each, k together, are in `device` by its name.
    `rows` is the mean number of independent residuals of a sample.

    A device that a fit places anyway, because it is a sensor of the model, has no columns."""

    residual: np.ndarray
    jacobian: np.ndarray
    device: Mapping[str, tuple[Part, ...]]
    rows: float

    @classmethod
    def of(cls, model: Model, observations: Observations) -> Columns:
        free = ~np.asarray(model.fixed)
        x = predict_configurations(model, observations)
        linearise = Linearisation(model, observations, free, True)
        C = np.empty((len(x), model.structure.rows.shape[0], len(model.structure.scale)))
        system = linearise(model.values, x, by_measured=C)
        rows, nq = float(system.informative.mean()), len(model.joints)
        jacobian = system.jacobian * model.table.tolerance[free]
        placed = any(p.group == "sensor" for p in model.table)
        if placed or not observations.measured[:, nq : nq + 6].any():
            return cls(system.residual, jacobian, {}, rows)
        seen = np.where(observations.measured[:, None, :], C, 0.0)
        shift, turn = seen[:, :, nq : nq + 3], seen[:, :, nq + 3 : nq + 6]
        columns, device = list[np.ndarray](), dict[str, tuple[Part, ...]]()
        bumps = load_effect("device_bump").parameters(model.mechanism)[1:]
        for bump in bumps:
            kind, axis = bump.name.split("_")
            k = "xyz".index(axis)
            moved = shift[:, :, k]
            if kind == "w":
                across = np.cross(np.eye(3)[k], observations.x[:, nq : nq + 3])
                moved = np.einsum("nij,nj->ni", shift, across) + turn[:, :, k]
            columns.append(moved)
        device[DEVICE] = tuple(_as_part(DEVICE, one) for one in bumps)
        target = load_effect(TARGET_EFFECT)
        if not model.has_effect(TARGET_EFFECT) and not target.applies(model.mechanism):
            offsets = target.parameters(model.mechanism)
            R = model.configuration(observations.x).R
            for offset in offsets:
                along = R[:, :, "xyz".index(offset.name[-1])]
                columns.append(np.einsum("nij,nj->ni", shift, along))
            device[TARGET] = tuple(_as_part(TARGET, one) for one in offsets)
        displaced = linearise.whiten(C) @ np.stack(columns, axis=2)
        every = np.concatenate([jacobian, displaced], axis=2)
        return cls(system.residual, every, device, rows)

    def sum(self, begin: int = 0, end: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The information (n, n) and the pull (n,) of some samples."""
        J = self.jacobian[begin:end].reshape(-1, self.jacobian.shape[2])
        return J.T @ J, -J.T @ self.residual[begin:end].reshape(-1)


def _as_part(owner: str, parameter: Parameter) -> Part:
    """The displacement of a device or its target along an axis, or about one."""
    kind = "turn about" if parameter.unit == "rad" else "shift along"
    title = f"{kind} {parameter.name[-1]} of the {owner}"
    # The columns are those of a change of the measured pose, which the pose without it undoes.
    return Part(title, -parameter.tolerance, parameter.unit)


def list_changes(model: Model, device: Mapping[str, tuple[Part, ...]]) -> list[Change]:
    """List what may have changed; `device` has the usual displacements of a measuring device and of
    its target that the columns behind those of the parameters stand for."""
    free = ~np.asarray(model.fixed)
    displaced = sum(map(len, device.values()))
    tolerance, names = model.table.tolerance[free], np.array(model.table.names)[free]

    def change(name: str, kind: str, rows: np.ndarray, parts: Sequence[Part]) -> Change:
        columns = np.atleast_2d(rows)[:, free].T / tolerance[:, None]
        title = parts[0].title if kind == PART else name
        factor = np.pad(columns, ((0, displaced), (0, 0)))
        return Change(name, kind, factor, tuple(parts), title=title)

    culprits, parts = list_culprits(model), list_drift_parts(model)
    usual = [Part(one.name, one.size, one.unit) for one in culprits]
    settled = np.vstack([parts["lengths"], parts["others"]])
    single = [row for row in settled if row[free].any()]
    found = [
        change(one.name, TEMPERATURE if part.unit == "K" else ZERO, one.change, [part])
        for one, part in zip(culprits, usual, strict=True)
    ]
    for row in single:
        name = str(names[np.argmax(np.abs(row[free]))])
        part = Part(describe(name, model.table), float(np.abs(row).max()), model.table[name].unit)
        found.append(change(name, PART, row, [part]))
    settling = [one.parts[0] for one in found if one.kind == PART]
    # The usual culprits together, as after homing on another day, and all parts together.
    found.append(change(HOMING, HOMING, np.array([one.change for one in culprits]), usual))
    every = np.array([*(one.change for one in culprits), *single])
    found.append(change(EVERYTHING, EVERYTHING, every, [*usual, *settling]))
    found = [one for one in found if np.abs(one.factor).max() > 0]
    begin, moved = len(tolerance), list[Change]()
    for name, members in device.items():
        end = len(tolerance) + displaced - begin - len(members)
        F = np.pad(np.diag([abs(one.size) for one in members]), ((begin, end), (0, 0)))
        moved.append(Change(name, DEVICE, F, members, name, name))
        begin += len(members)
    return [*found, *moved, *(one.with_device(other) for other in moved for one in found)]


def read_calibration(model: Model) -> tuple[int, float]:
    """Return how many samples the calibration had (0 if the history does not state it), and the
    factor of the noise's variance that its residuals showed, at least 1: a model that is not
    complete leaves more than noise. Of the fits in the history, the last one of those with the most
    samples counts, because an update keeps what the fit before it knew."""
    fits = [one for one in model.history if one.get("samples") and one.get("chi2_per_dof")]
    most = max((int(one["samples"]) for one in fits), default=0)
    last = next((one["chi2_per_dof"] for one in reversed(fits) if one["samples"] == most), 1.0)
    return most, max(1.0, float(last))


@dataclass(frozen=True)
class DriftTest:
    """The possible changes of a robot, in front of the error of its calibration.

    Attributes
    ----------
    changes : tuple of Change
        (H)
    C0 : array (n, n)
        Covariance of the calibration's error, in units of the columns.
    variance : float
        Of the noise, in units of the stated one.
    typical : array (n, n)
        Information of one sample like those of the calibration.
    singles : array (n, E)
        The single changes, each as large as just counts, and their `names` (E).
    """

    changes: tuple[Change, ...]
    C0: np.ndarray
    variance: float
    typical: np.ndarray
    singles: np.ndarray
    names: tuple[str, ...]

    @classmethod
    def of(cls, model: Model, columns: Columns) -> DriftTest:
        """FitError if the model was never fitted."""
        free = ~np.asarray(model.fixed)
        n, k = int(free.sum()), sum(map(len, columns.device.values()))
        tolerance = model.table.tolerance[free]
        samples, variance = read_calibration(model)
        C0 = np.zeros((n + k, n + k))
        C0[:n, :n] = update_prior(model, 0.0).covariance[np.ix_(free, free)]
        C0[:n, :n] *= variance / np.outer(tolerance, tolerance)
        A, b = columns.sum()
        typical = _integrate_out(C0, A / variance, b[:, None])[0] / len(columns.residual)
        if samples:
            # A fit knew nothing of the measuring set-up; today it may stand elsewhere.
            robot = np.flatnonzero(list_robot_parameters(model)[free])
            typical[:n, :n] = 0.0
            typical[np.ix_(robot, robot)] = np.linalg.inv(C0[np.ix_(robot, robot)]) / samples
        changes, names, singles = tuple(list_changes(model, columns.device)), [], []
        for change in changes:
            several = change.is_of_both or change.kind in (HOMING, EVERYTHING)
            for factor in () if several else change.factor.T:
                squares = factor @ typical @ factor
                # What is invisible even as large as a collision cannot be excluded.
                if columns.rows <= SCALES[-1] ** 2 * squares:
                    names.append(change.name)
                    singles.append(factor * np.sqrt(columns.rows / squares))
        counted = np.array(singles).reshape(-1, n + k).T
        return cls(changes, C0, variance, typical, counted, tuple(names))

    def log_factors(self, A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log Bayes factors against none, by information A (n, n) and pulls b (n, D) in the stated
        noise: of the changes by the `SCALES` of a device beside them, and by their own
        (D, H, 5, 5); and of the single ones (D, E)."""
        M, u = _integrate_out(self.C0, A / self.variance, b / self.variance)
        alone = [k for k, one in enumerate(self.changes) if not one.is_of_both]
        found = np.full((u.shape[1], len(self.changes), len(SCALES), len(SCALES)), -np.inf)
        found[:, alone, 0] = _weigh([self.changes[k].factor for k in alone], M, u)
        for d in alone:
            device = self.changes[d]
            both = [k for k, one in enumerate(self.changes) if one.beside is device]
            for t, scale in enumerate(SCALES if both else ()):
                beside = _integrate_out(scale**2 * device.factor @ device.factor.T, M, u)
                added = _weigh([self.changes[k].factor for k in both], *beside)
                found[:, both, t] = found[:, d, 0, t, None, None] + added
        pull, squares = self.singles.T @ u, np.sum(self.singles * (M @ self.singles), axis=0)
        return found, (np.logaddexp(pull, -pull) - np.log(2) - squares[:, None] / 2).T

    def look(self, samples: int, A: np.ndarray, b: np.ndarray) -> Look:
        """Return what some `samples` show, by their information A (n, n) and pull b (n,)."""
        logs, singles = self.log_factors(A, b[:, None])
        [unchanged], [changed] = probabilities(logs + self.log_prior)
        k = int(np.argmax(singles[0])) if self.names else None
        rival = ("", -np.inf) if k is None else (self.names[k], float(singles[0, k]))
        return Look(samples, float(unchanged), changed, rival)

    def list_cases(self, look: Look) -> Iterator[Case]:
        """Iterate over the sizes of each change that have a probability."""
        least = MIN_PROBABILITY * look.changed.max()
        for k, t, s in np.argwhere(look.changed > least).tolist():
            columns, scales = self.changes[k].expand(SCALES[s], SCALES[t])
            yield Case(k, float(look.changed[k, t, s]), columns, scales)

    def estimate(self, cases: Sequence[Case], A: np.ndarray, b: np.ndarray) -> tuple[Moved, ...]:
        """Estimate the parts of a change by information A (n, n) and pull b (n,) in the stated
        noise, over all its sizes (law of total variance); the most significant first."""
        M, u = _integrate_out(self.C0, A / self.variance, b[:, None] / self.variance)
        parts, total = self.changes[cases[0].change].parts, sum(one.probability for one in cases)
        mean, squares = np.zeros((2, len(parts)))
        for one in cases:
            F, share = one.columns, one.probability / total
            C = np.linalg.inv(F.T @ M @ F + np.eye(len(parts)))
            z = one.scales * (C @ (F.T @ u[:, 0]))
            mean += share * z
            squares += share * (z**2 + one.scales**2 * np.diag(C))
        sigma = np.sqrt(squares - mean**2)
        sizes = np.array([one.size for one in parts])
        order = np.argsort(-np.abs(mean) / sigma).tolist()
        values, sigmas = (sizes * mean).tolist(), (np.abs(sizes) * sigma).tolist()
        return tuple(Moved(parts[i].title, values[i], sigmas[i], parts[i].unit) for i in order)

    @property
    def log_prior(self) -> np.ndarray:
        """Log prior odds (H, 1, 1) of each change, by each of the `SCALES`, against none: something
        has changed as probably as nothing; kinds, and changes of a kind, are equally probable.
        Robot and device change independently of each other."""
        members = Counter(one.kind for one in self.changes if not one.is_of_both)
        one_of = {kind: len(members) * count * len(SCALES) for kind, count in members.items()}
        both = np.array([one.is_of_both for one in self.changes])
        share = np.array([one_of[one.kind] for one in self.changes], float)
        odds = 1 / np.where(both, share * one_of.get(DEVICE, 1), share)
        # Those of the changes alone add up to 1: the factor f with f + f^2 sum(both) = 1.
        factor = 2 / (1 + np.sqrt(1 + 4 * len(SCALES) ** 2 * odds[both].sum()))
        return np.log(odds * np.where(both, factor**2, factor))[:, None, None]


@dataclass(frozen=True)
class Look:
    """The probabilities after some `samples`: that nothing has changed, and of each change by each
    of the `SCALES` of a device beside it, and of its own (H, 5, 5). Together they are 1. The
    `rival` of "nothing" is the single change that the samples exclude least, of those that just
    count, with its log Bayes factor against it."""

    samples: int
    unchanged: float
    changed: np.ndarray
    rival: tuple[str, float]

    @cached_property
    def by_change(self) -> np.ndarray:
        """The probability (H,) of each change."""
        return np.asarray(self.changed.sum(axis=(1, 2)))


class Case(NamedTuple):
    """A change (its number) of one size, with its probability, the columns (n, k) of its parts, and
    how many usual changes each part is (k,)."""

    change: int
    probability: float
    columns: np.ndarray
    scales: np.ndarray


def _weigh(factors: Sequence[np.ndarray], M: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Log Bayes factors (D, h, 5) of changes with some factors (n, k) against none, by each of the
    `SCALES`, by information M (n, n) and pulls u (n, D) about changes."""
    found = np.empty((u.shape[1], len(factors), len(SCALES)))
    for width in {F.shape[1] for F in factors}:
        same = [k for k, F in enumerate(factors) if F.shape[1] == width]
        F = np.stack([factors[k] for k in same])
        size, Q = np.linalg.eigh(F.swapaxes(1, 2) @ M @ F)
        z = ((F @ Q).swapaxes(1, 2) @ u)[..., None] ** 2
        spread = 1 + SCALES**2 * np.maximum(size, 0.0)[..., None, None]
        found[:, same] = (SCALES**2 * z / spread - np.log(spread)).sum(axis=1).swapaxes(0, 1) / 2
    return found


def _integrate_out(C0: np.ndarray, A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information (n, n) and pulls (n, D) about changes, with an error N(0, C0) beside them."""
    AC = A @ C0
    solved = np.linalg.solve(np.eye(len(A)) + AC, np.column_stack([A, b]))
    return solved[:, : len(A)], solved[:, len(A) :]


def probabilities(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the probability (D,) that nothing has changed, and those of the changes (D, H, 5, 5),
    by their log posterior odds against it."""
    highest = np.maximum(logs.max(axis=(1, 2, 3)), 0.0)
    changed, unchanged = np.exp(logs - highest[:, None, None, None]), np.exp(-highest)
    total = changed.sum(axis=(1, 2, 3)) + unchanged
    return unchanged / total, changed / total[:, None, None, None]
