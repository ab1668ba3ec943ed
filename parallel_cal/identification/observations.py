"""Observations: a dataset as measured configurations with their covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.identification.readings import doubt_readings
from parallel_cal.identification.thresholds import BLOCKS, GUESSED_NOISE_SHARE
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model, Noise
from parallel_cal.model.sensor import Sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.samples import READING, list_channel_groups

ASSUMED = "assumed"  # source of a noise that was not measured
UNSTATED = "not stated"  # source of a noise that nothing is known about
ESTIMATED = "estimated from the residuals"  # source of such a noise after a fit
LAST = "last calibration"  # source of a noise that it estimated
SCATTER = "scatter within dwells"  # which is less than a robot shows that returns to a pose
UNMEASURED = (ASSUMED, UNSTATED, SCATTER, ESTIMATED)
UNIT_NAMES = {"rad": "angular joints", "m": "linear joints"}


@dataclass(frozen=True)
class UnknownNoise:
    """A kind of noise whose size is not stated: S and the readings hold a guess of it.

    `coordinates` (N, nq+6) and `channels` (N, n_channels) mark the entries that this guess scales.
    The guess has one value for each joint, so the proportions within the kind remain.
    `variance_error` is the relative standard error of its variance, if an estimate has replaced the
    guess. `times_jitter` is how many times as large it is as the scatter within dwells; None where
    that was not measured.
    """

    name: str
    unit: str
    coordinates: np.ndarray
    channels: np.ndarray
    variance_error: float | None = None
    times_jitter: float | None = None

    @property
    def estimated(self) -> bool:
        return self.variance_error is not None

    @property
    def at_most(self) -> float | None:
        """How many times as large its standard deviation may be as the estimate: two standard
        errors of the variance above it; None for a guess."""
        return None if self.variance_error is None else (1 + 2 * self.variance_error) ** 0.5

    @property
    def source(self) -> str:
        """Where its present size comes from."""
        if self.estimated:
            return ESTIMATED
        return UNSTATED if self.times_jitter is None else SCATTER

    def scale(self, factor: float) -> UnknownNoise:
        """This kind of noise, with a standard deviation that is larger by a factor."""
        jitter = self.times_jitter
        return replace(self, times_jitter=None if jitter is None else factor * jitter)

    def select(self, index: np.ndarray) -> UnknownNoise:
        return replace(self, coordinates=self.coordinates[index], channels=self.channels[index])


@dataclass(frozen=True)
class Observations:
    """N measured samples of one mechanism.

    x (N, nq+12) configurations (q, r, R9); S (N, nq+6, nq+6) covariance of (q, r, w); measured (N,
    nq+6) mask; a (N, n_conditions); group (N,) equal for replicates; reading (N, n_channels) of the
    model's sensors (in their units), NaN if not read, with the standard deviations
    `reading_sigma`; None: those of the model's sensors. `noise_from` names the source of S for
    joints and pose, and of the readings' noise if it is not stated. `unknown` lists the noise that
    is not stated. `doubts` explains why the joint readings are implausible, if the caller insisted
    on them.
    """

    x: np.ndarray
    S: np.ndarray
    measured: np.ndarray
    a: np.ndarray
    group: np.ndarray
    reading: np.ndarray
    noise_from: dict[str, str]
    doubts: str = ""
    reading_sigma: np.ndarray | None = None
    unknown: tuple[UnknownNoise, ...] = ()

    def __len__(self) -> int:
        return len(self.x)

    def __repr__(self) -> str:
        return f"Observations({len(self)} samples, noise from {self.noise_from})"

    @property
    def noise_assumed(self) -> bool:
        """Whether some noise is assumed or estimated from the residuals: S gives weights, but chi2
        cannot show whether the model is complete."""
        return not set(UNMEASURED).isdisjoint(self.noise_from.values())

    def get_reading_sigma(self, model: Model) -> np.ndarray:
        """Standard deviations (N, n_channels) of the readings, in their units."""
        if self.reading_sigma is not None:
            return self.reading_sigma
        return np.broadcast_to(model.structure.standard_uncertainty, self.reading.shape)

    def select(self, index: np.ndarray) -> Observations:
        names = ("x", "S", "measured", "a", "group", "reading")
        sigma = None if self.reading_sigma is None else self.reading_sigma[index]
        return replace(
            self,
            **{name: getattr(self, name)[index] for name in names},
            reading_sigma=sigma,
            unknown=tuple(kind.select(index) for kind in self.unknown),
        )

    def scale_unknown_noise(self, factors: np.ndarray) -> Observations:
        """Multiply the standard deviation of each kind of unknown noise by its factor."""
        S = self.S.copy()
        diagonal = np.einsum("nii->ni", S)  # a view
        sigma = self.reading_sigma
        for kind, factor in zip(self.unknown, factors, strict=True):
            diagonal[kind.coordinates] *= factor**2
            if sigma is not None:
                sigma = np.where(kind.channels, factor * sigma, sigma)
        pairs = zip(self.unknown, factors.tolist(), strict=True)
        unknown = tuple(kind.scale(factor) for kind, factor in pairs)
        return replace(self, S=S, reading_sigma=sigma, unknown=unknown)

    @property
    def at_rest(self) -> Observations | None:
        """These samples with the scatter within dwells as the noise that is not stated; None if it
        was not measured for all of that noise, or all is stated."""
        jitter = [kind.times_jitter for kind in self.unknown]
        if not jitter or None in jitter:
            return None
        return self.scale_unknown_noise(1 / np.array(jitter, dtype=float))

    def with_noise_of(self, other: Observations) -> Observations:
        """These samples with the noise that another fit used."""
        return replace(
            self,
            S=other.S,
            reading_sigma=other.reading_sigma,
            noise_from=other.noise_from,
            unknown=other.unknown,
        )


def blocks(dataset: Dataset) -> np.ndarray:
    """Number (N,) of the block that a sample belongs to: visits of one pose, or a stretch of a
    continuous motion."""
    if dataset.mode == "continuous":
        return np.arange(len(dataset)) // max(1, len(dataset) // BLOCKS)
    return np.unique(dataset.pose_id, return_inverse=True)[1]


def observe(
    model: Model,
    dataset: Dataset,
    joint_sigma: float | None = None,
    insist: bool = False,
    doubts: str | None = None,
) -> Observations:
    """Make observations for a model: joints in its order, noise from option, recording or file.

    FitError for joint readings that no such robot shows, unless the caller insists. `doubts` are
    those about the same readings that were found before, if the readings were examined.
    """
    missing = [j for j in model.joints if j not in dataset.joint_names]
    if missing:
        raise FitError(
            f"{dataset.source}: joint {', '.join(missing)} is missing; recorded are "
            f"{', '.join(dataset.joint_names)}. Rename the joints in the model file"
        )
    order = [dataset.joint_names.index(j) for j in model.joints]
    reading = _readings(model, dataset)
    n = len(order)
    a = conditions(model, dataset)
    passive = _find_passive(model, dataset.q[:, order], a)
    x = Configuration(dataset.q[:, order], dataset.r, dataset.R, passive).rows
    measured = np.zeros((len(x), n + 6 + passive.shape[1]), dtype=bool)
    measured[:, :n], measured[:, n : n + 6] = True, dataset.measured
    # Set unmeasured coordinates to home: they are projected out, but must be finite.
    home = model.mechanism.home.configuration
    for k in range(n, n + 3):
        x[~measured[:, k], k] = home[k]
    R, R0 = model.configuration(x).R, model.configuration(home).R
    w = np.where(measured[:, n + 3 : n + 6], rotation_vector(R @ R0.T), 0.0)
    turned = ~measured[:, n + 3 : n + 6].all(axis=1)
    R[turned] = rotation_matrix(w[turned]) @ R0  # in place: a view of x
    joint, joint_from, guessed_joints = _joint_sigma(model, dataset, joint_sigma, order)
    pose, pose_from, guessed_pose = _pose_covariance(model, dataset)
    S = np.zeros((len(x), measured.shape[1], measured.shape[1]))
    S[:, range(n), range(n)] = joint**2
    S[:, n : n + 6, n : n + 6] = pose
    noise_from = {"joint": joint_from, "pose": pose_from}
    silent = np.isin(model.structure.channels, model.structure.channels_without_sigma)
    guessed_channels = silent & np.isfinite(reading)
    if guessed_channels.any():
        noise_from["reading"] = UNSTATED
    guessed = np.zeros_like(measured)
    guessed[:, :n], guessed[:, n : n + 6] = guessed_joints, guessed_pose
    guessed &= measured
    group = np.asarray(dataset.pose_id)
    if doubts is None:
        doubts = doubt_readings(model, x, measured, a, dataset.source)
    if doubts and not insist:
        raise FitError(doubts)
    reading_sigma = np.broadcast_to(model.structure.standard_uncertainty, reading.shape).copy()
    scatter = [joint_from == SCATTER, pose_from == SCATTER, False]
    scattered = np.repeat(scatter, [n, 6, len(model.mechanism.passive)])
    unknown = _list_unknown_noise(model, guessed, guessed_channels, scattered)
    return Observations(
        x, S, measured, a, group, reading, noise_from, doubts, reading_sigma, unknown
    )


def _find_passive(model: Model, q: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Passive coordinates (N, nu) at joints (N, nq) and conditions (N, n_conditions), from which a
    fit starts; those of home where forward kinematics has no solution."""
    home = np.tile(model.mechanism.home.passive, (len(q), 1))
    if not home.size:
        return home
    found = Kinematics(model).direct(q, dict(zip(model.conditions, a.T, strict=True)))
    return np.where(found.solved[:, None], found.passive, home)


def list_noise_kinds(model: Model) -> list[tuple[str, str, np.ndarray]]:
    """Name, unit and columns (nq+6+nu,) of every kind of noise of joints and device."""
    n = len(model.joints)
    passive = [""] * len(model.mechanism.passive)
    units = np.array(
        [*model.mechanism.joint_units, *["position"] * 3, *["orientation"] * 3, *passive]
    )
    kinds = [(UNIT_NAMES.get(u, f"joints ({u})"), u, units == u) for u in dict.fromkeys(units[:n])]
    if len(kinds) == 1:
        kinds = [("joints", kinds[0][1], kinds[0][2])]
    device = (("position", "m"), ("orientation", "rad"))
    return kinds + [(f"device {part}", unit, units == part) for part, unit in device]


def _list_unknown_noise(
    model: Model, guessed: np.ndarray, guessed_channels: np.ndarray, scattered: np.ndarray
) -> tuple[UnknownNoise, ...]:
    """List the kinds of noise that the entries (N, nq+6+nu) and channels (N, n_channels) guess; the
    guess of the columns `scattered` (nq+6+nu,) is their scatter within dwells."""
    none, nowhere = np.zeros_like(guessed_channels), np.zeros_like(guessed)
    found = list[UnknownNoise]()
    for name, unit, own in list_noise_kinds(model):
        if (own_guess := guessed & own).any():
            jitter = 1.0 if scattered[own_guess.any(axis=0)].all() else None
            found.append(UnknownNoise(name, unit, own_guess, none, times_jitter=jitter))
    for sensor in model.sensors:
        own = guessed_channels & np.isin(model.structure.channels, sensor.channels)
        if own.any():
            found.append(UnknownNoise(sensor.name, sensor.unit, nowhere, own))
    return tuple(found)


def _joint_sigma(
    model: Model, dataset: Dataset, given: float | None, order: list[int]
) -> tuple[np.ndarray, str, np.ndarray]:
    """Joint noise (nq,), its source, and a mask (nq,) of the joints for which it is a guess."""
    nowhere = np.zeros(len(order), dtype=bool)
    if given is not None:
        if not 0 < given < np.inf:
            raise FitError(f"joint sigma {given} rad: expected a positive number")
        return np.full(len(order), given), "option", nowhere
    if dataset.joint_sigma is not None:
        return np.asarray(dataset.joint_sigma, dtype=float)[order], "dataset", nowhere
    stated, guess = model.joint_noise, _guess_joint_sigma(model, dataset.q[:, order])
    lacking = np.isnan(stated)
    if not lacking.all():
        sigma = np.where(lacking, guess, stated)
        if model.noise.assumed:
            return sigma, ASSUMED, ~nowhere
        source = UNSTATED if lacking.any() else _name_source(model.noise, "joint")
        return sigma, source, lacking
    scatter = _pool_scatter(dataset.scatter_q[:, order])
    if (scatter > 0).all():
        return scatter, SCATTER, ~nowhere
    return guess, UNSTATED, ~nowhere


def _name_source(noise: Noise, *parts: str) -> str:
    """Who states these parts of the noise of a model: its file, or the last calibration."""
    own = noise.as_stated
    return "model file" if all(getattr(noise, p) == getattr(own, p) for p in parts) else LAST


def _guess_joint_sigma(model: Model, q: np.ndarray) -> np.ndarray:
    """A share of the joints' travel (nq,), equal for joints of one unit."""
    travel = np.ptp(q, axis=0) if len(q) else np.zeros(q.shape[1])
    limits = np.ptp(np.array(model.mechanism.joint_limits), axis=1)
    travel = np.where(travel > 0, travel, np.where(np.isfinite(limits), limits, 1.0))
    units = np.array(model.mechanism.joint_units)
    for unit in set(units):
        travel[units == unit] = travel[units == unit].max()
    return np.asarray(GUESSED_NOISE_SHARE * travel)


def _guess_pose_sigma(model: Model, dataset: Dataset) -> np.ndarray:
    """An equal share (6,) of the largest travel, for angles divided by the mechanism's length."""
    r = np.where(dataset.measured[:, :3], dataset.r, np.nan)
    seen = r[:, np.isfinite(r).all(axis=0)]
    length = model.mechanism.length
    travel = np.ptp(seen, axis=0).max(initial=0.0) if len(seen) else 0.0
    position = GUESSED_NOISE_SHARE * (travel or length)
    return np.repeat([position, position / length], 3)


def _pool_scatter(scatter: np.ndarray) -> np.ndarray:
    """Root mean square of the known values of each column, else NaN."""
    known = np.isfinite(scatter)
    total = np.sum(np.where(known, scatter, 0.0) ** 2, axis=0)
    return np.sqrt(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))


def _pose_covariance(model: Model, dataset: Dataset) -> tuple[np.ndarray, str, np.ndarray]:
    """Covariance (N, 6, 6), its source (the device, the model file, the scatter within dwells), and
    a mask (N, 6) of the variances that are a guess."""
    covariance = np.nan_to_num(np.array(dataset.pose_cov, dtype=float))
    lacking = ~(np.diagonal(covariance, axis1=1, axis2=2) > 0)
    wanted = np.any(lacking & dataset.measured, axis=0)
    noise = model.noise
    given = np.repeat([noise.position or np.nan, noise.orientation or np.nan], 3)
    scatter = _pool_scatter(dataset.scatter_pose)
    sigma = np.where(np.isfinite(given), given, scatter)
    unstated = ~(sigma > 0)
    sigma = np.where(unstated, _guess_pose_sigma(model, dataset), sigma)
    for i in np.flatnonzero(lacking.any(axis=1)):
        bad = lacking[i]
        covariance[i][bad, :], covariance[i][:, bad] = 0.0, 0.0
        covariance[i][bad, bad] = sigma[bad] ** 2
    _check_definite(covariance, dataset)
    guessed = ~np.isfinite(given) | noise.assumed
    if not wanted.any():
        source = "dataset"
    elif (unstated & wanted).any():
        source = UNSTATED
    elif np.isfinite(given[wanted]).any():
        source = ASSUMED if noise.assumed else _name_source(noise, "position", "orientation")
    else:
        source = SCATTER
    return covariance, source, lacking & guessed


def _check_definite(covariance: np.ndarray, dataset: Dataset) -> None:
    """Raise FitError for a matrix that is no covariance."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    seen = dataset.measured[:, :, None] & dataset.measured[:, None, :]
    correlation = np.where(seen, covariance / (sigma[:, :, None] * sigma[:, None, :]), np.eye(6))
    skew = np.abs(correlation - correlation.transpose(0, 2, 1)).max(axis=(1, 2))
    least = np.linalg.eigvalsh(correlation)[:, 0]
    for i in np.flatnonzero((skew > 1e-6) | (least < -1e-6)):
        raise FitError(
            f"{dataset.source}: sample {dataset.numbers[i]}: the recorded pose covariance is not "
            "symmetric, or gives a combination of coordinates a negative variance; correct the "
            "device's driver, or set all but the diagonal to zero"
        )


def conditions(model: Model, dataset: Dataset) -> np.ndarray:
    """Recorded conditions (N, n_conditions); FitError if one that the effects need is missing."""
    missing = [c for c in model.conditions if c not in dataset.conditions]
    if missing:
        names = ", ".join(effect.name for effect in model.effects if effect.needs)
        raise FitError(
            f"{dataset.source}: {', '.join(missing)} was not recorded, but the model's effects "
            f"({names}) need it"
        )
    columns: Any = [np.asarray(dataset.conditions[c], dtype=float) for c in model.conditions]
    return np.stack(columns, axis=1) if columns else np.zeros((len(dataset.q), 0))


def _readings(model: Model, dataset: Dataset) -> np.ndarray:
    """(N, n_channels): the dataset's columns `reading.CHANNEL`, NaN if not read."""
    names = [k for k in dataset.conditions if k.startswith(READING)]
    read = [k.removeprefix(READING) for k in names if np.isfinite(dataset.conditions[k]).any()]
    channels = model.structure.channels
    # A recording may name a contact, such as a ball in a socket, in place of its coordinates.
    contact_of = {
        channel: contact
        for sensor in model.sensors
        for contact, held in sensor.contacts.items()
        for channel in held
        if contact in read and channel not in read
    }
    read = [c for c in read if c not in contact_of.values() or c in channels]
    read += contact_of
    lacking = {s.name: few for s in model.sensors if (few := _list_missing_channels(s, read))}
    missing = [channel for few in lacking.values() for channel in few]
    if missing:
        posed = ": the measured poses need no sensor" if dataset.measured.any() else ""
        raise FitError(
            f"{dataset.source}: no measurement with {', '.join(missing)}, which the model's "
            f"sensors expect (recorded: {', '.join(list_channel_groups(read)) or 'no reading'}); "
            f"measure it, or remove {', '.join(lacking)} from the list `sensors` in the model "
            f"file{posed}"
        )
    if strange := [c for c in read if c not in channels]:
        expected = ", ".join(  # those of an image by their range
            f"{s.channels[0]} to {s.channels[-1]}"
            if s.shows_pose
            else ", ".join(s.contacts or s.channels)
            for s in model.sensors
            if s.channels
        )
        raise FitError(
            f"{dataset.source}: readings of {', '.join(list_channel_groups(strange))}, but the "
            f"model's sensors have {expected or 'no channel'}: state the "
            "set-up under `sensors` in the model file, or make the model anew with `new --sensor` "
            "(`parallel-cal sensors` lists them with their options)"
        )
    none = np.full(len(dataset.q), np.nan)
    columns = [dataset.conditions.get(READING + contact_of.get(c, c), none) for c in channels]
    return np.stack(columns, axis=1) if columns else np.zeros((len(dataset.q), 0))


def _list_missing_channels(sensor: Sensor, read: list[str]) -> list[str]:
    """Channels of a sensor without a reading; if an image may lack some, or a contact need not be
    made, only when all are."""
    missing = [c for c in sensor.channels if c not in read]
    if sensor.contacts and not sensor.needs_each_contact:
        return [*sensor.contacts] if len(missing) == len(sensor.channels) else []
    if not sensor.shows_pose:
        return missing
    return [f"the corners of {sensor.name}"] if len(missing) == len(sensor.channels) else []
