"""What one recording tells about the parameters of a calibrated robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.causes.effects import find_missing_conditions
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import Model
from parallel_cal.posterior.blocks import NO_COLUMN
from parallel_cal.posterior.evidence import STATED, UNKNOWN
from parallel_cal.recordings.dataset import Dataset

WEAR = ("backlash", "ball_joint_clearance")  # effects that grow in use
WARMTH = ("thermal_expansion",)  # effects of the temperature
# Sizes of a change in tolerances, all equally probable: from what only many samples show to what a
# collision does.
SIZES = 10.0 ** np.arange(-3, 1.01, 0.25)
# The error of a calibration in sigmas of its covariance: a model that is not complete has more.
CALIBRATION_FACTORS = (1.0, 10.0, 3.0)  # the last one counts where a loose part is sought
MIN_NOISE_RESIDUALS = 8  # that show a noise which is not stated: its sigma to 25 %
SAME_DIRECTION = 1 - 1e-9  # cosine of two columns: the rest is rounding
MAX_SCATTER_ROWS = 150  # rows of the residual in which it is sought: singular values of n^3


@dataclass(frozen=True)
class Evidence:
    """The evidence of residuals about changes d (n,) of the parameters, in tolerances:

        log L(d) = pull.d - d.information.d / 2 - squares / 2

    Attributes
    ----------
    names : tuple of str
        The parameters (n).
    information : array (n, n)
    pull : array (n,)
    squares : float
        Sum of squares of the residuals, in units of the noise.
    rows : int
        Number of independent residuals.
    """

    names: tuple[str, ...]
    information: np.ndarray
    pull: np.ndarray
    squares: float
    rows: int

    def __add__(self, other: Evidence) -> Evidence:
        """The evidence of all residuals about the same parameters."""
        return Evidence(
            self.names,
            self.information + other.information,
            self.pull + other.pull,
            self.squares + other.squares,
            self.rows + other.rows,
        )


@dataclass(frozen=True)
class Innovation:
    """The residuals beside what earlier recordings let expect, and what scatter explains of them.

    Attributes
    ----------
    squares, rows : float, int
        Their sum of squares, and their number.
    explained, log_det : array (n + 1, sizes)
        The part of the squares that a part explains which scatters from sample to sample, by this
        size, and the logarithm of the determinant of its covariance; the last row is for noise of
        all readings.
    fit : int
        The number of the fit that let it expect so.
    """

    squares: float
    rows: int
    explained: np.ndarray
    log_det: np.ndarray
    fit: int

    def __add__(self, later: Innovation) -> Innovation:
        """Of both recordings; the fit is that of the later one."""
        return Innovation(
            self.squares + later.squares,
            self.rows + later.rows,
            self.explained + later.explained,
            self.log_det + later.log_det,
            later.fit,
        )


@dataclass(frozen=True)
class Visit:
    """What one recording tells about changes of the parameters.

    Attributes
    ----------
    name, sha256 : str
        The recording, and the hash of its data.
    time : float
        When it was recorded, s since 1970.
    samples : int
        Number of samples.
    evidence : Evidence
        Of its residuals.
    innovation : Innovation
        What earlier recordings do not explain of them.
    known_noise : bool
        Whether the noise was stated or measured.
    noise : float
        Its variance, in units of that of the guess where it was not stated.
    """

    name: str
    sha256: str
    time: float
    samples: int
    evidence: Evidence
    innovation: Innovation
    known_noise: bool
    noise: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        return self.evidence.names

    @property
    def noise_weight(self) -> float:
        """Degrees of freedom of what is known of the noise before any residual."""
        return STATED if self.known_noise else UNKNOWN

    def merge(self, later: Visit) -> Visit:
        """Both recordings as one, which shows no change between them."""
        names = tuple(dict.fromkeys((*self.names, *later.names)))
        one, two = self.select(names), later.select(names)
        return replace(
            two,
            samples=one.samples + two.samples,
            evidence=one.evidence + two.evidence,
            innovation=one.innovation + two.innovation,
        )

    def select(self, names: tuple[str, ...]) -> Visit:
        """The evidence about these parameters; none about those that it does not contain."""
        if names == self.names:
            return self
        n, own = len(names), [name for name in names if name in self.names]
        to, of = [names.index(x) for x in own], [self.names.index(x) for x in own]
        information, pull = np.zeros((n, n)), np.zeros(n)
        information[np.ix_(to, to)] = self.evidence.information[np.ix_(of, of)]
        pull[to] = self.evidence.pull[of]
        explained, log_det = np.zeros((2, n + 1, len(SIZES)))
        of_all = [*of, len(self.names)]
        explained[[*to, n]] = self.innovation.explained[of_all]
        log_det[[*to, n]] = self.innovation.log_det[of_all]
        evidence = replace(self.evidence, names=names, information=information, pull=pull)
        innovation = replace(self.innovation, explained=explained, log_det=log_det)
        return replace(self, evidence=evidence, innovation=innovation)

    def document(self) -> dict[str, Any]:
        """The visit as JSON data; of the symmetric information, the lower triangle."""
        evidence, innovation = self.evidence, self.innovation
        return {
            "name": self.name,
            "sha256": self.sha256,
            "time": self.time,
            "samples": self.samples,
            "rows": evidence.rows,
            "names": evidence.names,
            "information": evidence.information[np.tril_indices(len(self.names))],
            "pull": evidence.pull,
            "squares": evidence.squares,
            "explained": innovation.explained,
            "log_det": innovation.log_det,
            "innovation": innovation.squares,
            "innovation_rows": innovation.rows,
            "fit": innovation.fit,
            "known_noise": self.known_noise,
            "noise": self.noise,
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Visit:
        """Read what `document` wrote; KeyError, TypeError or ValueError for anything else."""
        names, n = tuple(map(str, document["names"])), len(document["names"])
        information = np.zeros((n, n))
        information[np.tril_indices(n)] = np.array(document["information"], float)
        information += np.tril(information, -1).T
        pull = np.array(document["pull"], float).reshape(n)
        explained, log_det = (
            np.array(document[key], float).reshape(n + 1, len(SIZES))
            for key in ("explained", "log_det")
        )
        squares, rows = document["innovation"], document["innovation_rows"]
        return cls(
            document["name"],
            document["sha256"],
            document["time"],
            document["samples"],
            Evidence(names, information, pull, document["squares"], document["rows"]),
            Innovation(squares, rows, explained, log_det, document["fit"]),
            document["known_noise"],
            document["noise"],
        )


@dataclass(frozen=True)
class Expected:
    """What earlier recordings leave of parameters: mean (n,) and covariance (n, n), in tolerances
    and, for the covariance, in units of the variance of the noise. `fit` is the number of the
    scatter and the prior that it is for."""

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    fit: int = 0

    def select(self, names: tuple[str, ...]) -> Expected:
        """Of these parameters; those that it does not contain are known to their tolerances."""
        own = [name for name in names if name in self.names]
        to, of = [names.index(x) for x in own], [self.names.index(x) for x in own]
        mean, covariance = np.zeros(len(names)), np.eye(len(names))
        mean[to] = self.mean[of]
        covariance[np.ix_(to, to)] = self.covariance[np.ix_(of, of)]
        return Expected(names, mean, covariance, self.fit)


def extend_model(model: Model, dataset: Dataset) -> Model:
    """Add the effects of wear and temperature that the model lacks and the recording can show."""
    for name in (*WEAR, *WARMTH):
        if model.has_effect(name):
            continue
        try:
            extended = model.with_effect(name)
        except ModelError:  # it does not apply to this mechanism
            continue
        if extended.mechanism is model.mechanism and not find_missing_conditions(extended, dataset):
            model = extended
    return model


def list_candidates(model: Model, observations: Observations, x: np.ndarray) -> np.ndarray:
    """The mask of the parameters that may change: what was identified, and the zero of each joint,
    which changes as easily if a fit held it because others stand for it. A zero acts on the closure
    at the configurations x (N, ...) as the reading of its joint does."""
    candidates = ~np.asarray(model.fixed)
    geometry = np.array([p.group not in ("effect", "sensor") for p in model.table])
    held = ~candidates & geometry
    _, C, J = Linearisation(model, observations, held, True).blocks(model.values, x)
    by_joint = C[:, :, : len(model.joints)].reshape(-1, len(model.joints))
    along = np.abs(_unit(J.reshape(len(by_joint), -1)).T @ _unit(by_joint))
    candidates[held] = along.max(axis=1, initial=0.0) > SAME_DIRECTION
    return candidates


def _unit(columns: np.ndarray) -> np.ndarray:
    """Columns (n, k) of length one; zero stays zero."""
    return np.asarray(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))


def visit_of(
    model: Model,
    dataset: Dataset,
    time: float,
    *,
    joint_sigma: float | None = None,
    expected: Expected | None = None,
    noise: float | None = None,
) -> Visit:
    """Linearise a recording about a calibrated model.

    Parameters
    ----------
    model : Model
        The calibrated model.
    dataset : Dataset
        The samples; poses need not be measured.
    time : float
        When they were recorded, s since 1970.
    joint_sigma : float, optional
        Standard deviation of joint readings, rad or m. Default: that of the recording or the model.
    expected : Expected, optional
        What earlier recordings leave of the parameters. Default: nothing was recorded before.
    noise : float, optional
        Variance of the noise in units of a guess, where it is not stated, as an earlier recording
        showed it. Default: this recording shows it.

    Raises
    ------
    FitError
        If the samples hold no more than what forward kinematics needs: no residual remains. If the
        noise is not stated, and they are too few to show it.
    """
    extended = extend_model(model, dataset)
    observations = observe(extended, dataset, joint_sigma, insist=True)
    x = predict_configurations(extended, observations)
    free = list_candidates(extended, observations, x)
    linearise = Linearisation(extended, observations, free, True)
    by_measured = np.empty(
        (len(x), extended.structure.rows.shape[0], len(extended.structure.scale))
    )
    system = linearise(extended.values, x, by_measured=by_measured)
    rows, most = int(system.informative.sum()), int(system.informative.max(initial=0))
    if not rows:
        raise FitError(
            f"{dataset.source}: no residuals: {extended.mechanism.name} has as many joint readings "
            "as degrees of freedom, and nothing else was read. Record redundant or passive "
            "encoders, a touch, a switch or a target"
        )
    # Fewer directions say as much as all rows where coordinates were not measured.
    turn = np.linalg.svd(linearise.whiten(by_measured))[0][:, :, :most].transpose(0, 2, 1)
    r = (turn @ system.residual[:, :, None])[:, :, 0]
    J = turn @ system.jacobian * extended.table.prior_sigma[free]
    flat, columns = r.reshape(-1), J.reshape(r.size, -1)
    names = tuple(np.array(extended.table.names)[free].tolist())
    every = -(-r.size // MAX_SCATTER_ROWS)
    prior = calibration_priors(model, names)[-1]
    if not observations.noise_assumed:
        noise = 1.0
    elif noise is None:
        noise = estimate_noise(r[::every], J[::every], prior, dataset.source)
    flat, columns, r, J = (one / noise**0.5 for one in (flat, columns, r, J))
    expected = expected or Expected(names, np.zeros(len(names)), prior)
    evidence = Evidence(names, columns.T @ columns, -columns.T @ flat, float(flat @ flat), rows)
    innovation = compare_scatter(r[::every], J[::every], expected.select(names))
    known_noise = not observations.noise_assumed
    return Visit(
        dataset.source,
        dataset.sha256,
        time,
        len(dataset),
        evidence,
        innovation,
        known_noise,
        noise,
    )


def calibration_priors(model: Model, names: Sequence[str]) -> tuple[np.ndarray, ...]:
    """The covariances (n, n) that the error of a calibration may have, in tolerances^2: that of the
    tolerances, and that of the model times each of the `CALIBRATION_FACTORS`^2.

    Expansions that the model lacks are zero: the calibration took the temperature not to count.
    """
    own = np.isin(names, model.table.names)
    expansion = np.array([name.split(".")[0] in WARMTH for name in names])
    wide = np.diag(np.where(expansion & ~own, 0.0, 1.0))
    if model.covariance is None:
        return (wide,)
    at = [model.table.index_of(name) for name in np.array(names)[own].tolist()]
    size = model.table.prior_sigma[at]
    known = Prior.from_model(model).covariance[np.ix_(at, at)] / np.outer(size, size)
    priors = [wide]
    for factor in CALIBRATION_FACTORS:
        prior = wide.copy()
        prior[np.ix_(own, own)] = factor**2 * known
        priors.append(prior)
    return tuple(priors)


def estimate_noise(r: np.ndarray, J: np.ndarray, prior: np.ndarray, source: str) -> float:
    """The most likely variance v of residuals r (N, rows) ~ N(0, v + J P J'), with the prior P of
    the error of the calibration. FitError if too few residuals depend on it."""
    from scipy.optimize import minimize_scalar

    columns = J.reshape(r.size, -1)
    squares, axes = np.linalg.eigh(columns @ prior @ columns.T)
    z, squares = (axes.T @ r.reshape(-1)) ** 2, np.maximum(squares, 0.0)
    real = (z > NO_COLUMN**2) | (squares > NO_COLUMN)
    z, squares = z[real], squares[real]

    def cost(log_v: float) -> float:
        total = np.exp(log_v) + squares
        return float(np.sum(np.log(total) + z / total))

    v = float(np.exp(minimize_scalar(cost, bounds=(-25.0, 25.0), method="bounded").x))
    if (count := float(np.sum(v / (v + squares)))) < MIN_NOISE_RESIDUALS:
        raise FitError(
            f"{source}: the noise of the joint readings is not stated, and {count:.1f} residuals "
            f"show it, {MIN_NOISE_RESIDUALS} are needed. State it (noise: joint in the model "
            "file, or --joint-sigma), or record more samples"
        )
    return v


def compare_scatter(r: np.ndarray, J: np.ndarray, expected: Expected) -> Innovation:
    """The innovation, and what parts explain of it that scatter from sample to sample.

    With the columns J (N, rows, n) and the parameters p ~ N(m, s^2 P) that earlier recordings
    leave, the residual is N(-J m, s^2 (1 + J P J')), with the noise s. The innovation y is the
    residual plus J m in the principal axes, divided by its standard deviation without s. In sample
    k, a loose part is off by w s u_k with u_k ~ N(0, 1), so that y ~ N(0, s^2 (1 + w^2 F F')) with
    the column of the part in sample k as column k of F, in the same axes. With the singular values
    l_j of F and y in its directions, it explains

        sum_j w^2 l_j^2 / (1 + w^2 l_j^2) y_j^2

    of the squares, and the log determinant is sum_j log(1 + w^2 l_j^2). The last row is for noise
    of all readings, F = 1.
    """
    n, columns = J.shape[2], J.reshape(r.size, -1)
    squares, axes = np.linalg.eigh(columns @ expected.covariance @ columns.T)
    sigma, of_sample = np.sqrt(1 + np.maximum(squares, 0.0)), axes.reshape(*r.shape, -1)
    y = axes.T @ (r.reshape(-1) + columns @ expected.mean) / sigma
    # Rows of a sample with fewer residuals than others are zero.
    real = (squares > NO_COLUMN) | (np.abs(y) > NO_COLUMN)
    explained, log_det = np.zeros((2, n + 1, len(SIZES)))
    for k in range(n + 1):
        size, along = 1 / sigma[real], y[real]
        if k < n:
            F = np.einsum("nr,nrq->qn", J[:, :, k], of_sample) / sigma[:, None]
            left, size, _ = np.linalg.svd(F, full_matrices=False)
            along = left.T @ y
        gain = (SIZES[:, None] * size) ** 2
        explained[k] = np.sum(gain / (1 + gain) * along**2, axis=1)
        log_det[k] = np.sum(np.log1p(gain), axis=1)
    return Innovation(float(y @ y), int(real.sum()), explained, log_det, expected.fit)
