"""What one recording tells about the parameters of a calibrated robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.causes.effects import find_missing_conditions
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import observe
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
MAX_SCATTER_ROWS = 150  # rows of the residual in which it is sought: singular values of n^3


@dataclass(frozen=True)
class Visit:
    """The evidence of one recording about changes d (n,) of the parameters, in tolerances:

        log L(d) = pull.d - d.information.d / 2 - squares / 2

    Attributes
    ----------
    name, sha256 : str
        The recording, and the hash of its data.
    time : float
        When it was recorded, s since 1970.
    samples, rows : int
        Number of samples, and of their independent residuals.
    names : tuple of str
        The parameters (n).
    information : array (n, n)
    pull : array (n,)
    squares : float
        Sum of squares of the residuals, in units of the noise.
    left : float
        Sum of squares of `left_rows` residuals, each in units of the noise and the error of the
        calibration.
    left_rows : int
    loose : array (n + 1, sizes)
        Log likelihood ratio of a part that scatters from sample to sample, by this size; the last
        row is for noise of all readings.
    known_noise : bool
        Whether the noise was stated or measured.
    """

    name: str
    sha256: str
    time: float
    samples: int
    rows: int
    names: tuple[str, ...]
    information: np.ndarray
    pull: np.ndarray
    squares: float
    left: float
    left_rows: int
    loose: np.ndarray
    known_noise: bool

    @property
    def noise_weight(self) -> float:
        """Degrees of freedom of what is known of the noise before any residual."""
        return STATED if self.known_noise else UNKNOWN

    def merge(self, later: Visit) -> Visit:
        """Both recordings as one, which shows no change between them."""
        names = tuple(dict.fromkeys((*self.names, *later.names)))
        one, two = self.select(names), later.select(names)
        added = ("samples", "rows", "information", "pull", "squares", "left", "left_rows", "loose")
        return replace(two, **{key: getattr(one, key) + getattr(two, key) for key in added})

    def select(self, names: tuple[str, ...]) -> Visit:
        """The evidence about these parameters; none about those that it does not contain."""
        if names == self.names:
            return self
        n, own = len(names), [name for name in names if name in self.names]
        to, of = [names.index(x) for x in own], [self.names.index(x) for x in own]
        information, pull = np.zeros((n, n)), np.zeros(n)
        information[np.ix_(to, to)] = self.information[np.ix_(of, of)]
        pull[to] = self.pull[of]
        loose = np.zeros((n + 1, len(SIZES)))
        loose[[*to, n]] = self.loose[[*of, len(self.names)]]
        return replace(self, names=names, information=information, pull=pull, loose=loose)

    def document(self) -> dict[str, Any]:
        """The visit as JSON data; of the symmetric information, the lower triangle."""
        lower = self.information[np.tril_indices(len(self.names))]
        return {f.name: getattr(self, f.name) for f in fields(self)} | {"information": lower}

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Visit:
        """Read what `document` wrote; KeyError, TypeError or ValueError for anything else."""
        given = {field.name: document[field.name] for field in fields(cls)}
        names, n = tuple(map(str, given["names"])), len(given["names"])
        information = np.zeros((n, n))
        information[np.tril_indices(n)] = np.array(given["information"], float)
        information += np.tril(information, -1).T
        pull = np.array(given["pull"], float).reshape(n)
        loose = np.array(given["loose"], float).reshape(n + 1, len(SIZES))
        arrays = {"information": information, "pull": pull, "loose": loose}
        return cls(**given | {"names": names} | arrays)


def extend_model(model: Model, dataset: Dataset) -> Model:
    """Add the effects of wear and temperature that the model lacks and the recording can show."""
    for name in (*WEAR, *WARMTH):
        if any(effect.name == name for effect in model.effects):
            continue
        try:
            extended = model.with_effect(name)
        except ModelError:  # it does not apply to this mechanism
            continue
        if extended.mechanism is model.mechanism and not find_missing_conditions(extended, dataset):
            model = extended
    return model


def visit_of(
    model: Model,
    dataset: Dataset,
    time: float,
    *,
    joint_sigma: float | None = None,
    variance: float = 1.0,
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
    variance : float
        Variance of the residuals, in units of that of the stated noise, as earlier recordings show
        it; a part that scatters is sought above it.

    Raises
    ------
    FitError
        If the samples hold no more than what forward kinematics needs: no residual remains.
    """
    extended = extend_model(model, dataset)
    observations = observe(extended, dataset, joint_sigma, insist=True)
    free = ~np.asarray(extended.fixed)
    x = predict_configurations(extended, observations)
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
    loose, left = compare_scatter(r[::every], J[::every], prior, variance)
    return Visit(
        dataset.source,
        dataset.sha256,
        time,
        len(dataset),
        rows,
        names,
        columns.T @ columns,
        -columns.T @ flat,
        float(flat @ flat),
        left,
        int(system.informative[::every].sum()),
        loose,
        not observations.noise_assumed,
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


def compare_scatter(
    r: np.ndarray, J: np.ndarray, prior: np.ndarray, variance: float
) -> tuple[np.ndarray, float]:
    """Log likelihood ratios (n + 1, sizes) of parts that scatter from sample to sample, and the sum
    of squares of the residuals (N, rows) in units of their standard deviation.

    With the columns J (N, rows, n), the prior P of the error of the calibration and the variance v
    of the noise, the residual is N(0, v (1 + J P J')). In its principal axes, divided by its
    standard deviation without v, it is y. In sample k, a loose part is off by w u_k with
    u_k ~ N(0, 1), so that y ~ N(0, v + w^2 F F') with the column of the part in sample k as column
    k of F, in the same axes. With the singular values l_j of F, y in its directions and
    g_j = w^2 l_j^2 / v:

        log LR = sum_j (g_j / (1 + g_j) y_j^2 / v - log(1 + g_j)) / 2

    The last row is for noise of all readings, F = 1.
    """
    n, columns = J.shape[2], J.reshape(r.size, -1)
    squares, axes = np.linalg.eigh(columns @ prior @ columns.T)
    sigma = np.sqrt(1 + np.maximum(squares, 0.0))
    y, ratio = axes.T @ r.reshape(-1) / sigma, SIZES[:, None] ** 2 / variance
    found = np.zeros((n + 1, len(SIZES)))
    of_sample = (axes / sigma).reshape(*r.shape, -1)
    for k in range(n + 1):
        if k < n:
            F = np.einsum("nr,nrq->qn", J[:, :, k], of_sample)
            left, size, _ = np.linalg.svd(F, full_matrices=False)
            gain, along = ratio * size**2, left.T @ y
        else:  # rows of a sample with fewer residuals than others are zero
            real = (squares > NO_COLUMN) | (np.abs(y) > NO_COLUMN)
            gain, along = ratio / sigma[real] ** 2, y[real]
        found[k] = np.sum(gain / (1 + gain) * along**2 / variance - np.log1p(gain), axis=1) / 2
    return found, float(y @ y)
