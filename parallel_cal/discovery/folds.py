"""Folds: choose the form of a law anew without the held-out poses, and judge it at these.

`add` identifies the coefficients of a law without the held-out poses, but terms and scanned
constants were chosen with all samples. Here both are chosen without them, on linearised residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.parallel import Runner, run_on_cores, running
from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER
from parallel_cal.discovery.formula import Formula, build_columns
from parallel_cal.discovery.screening import Hypothesis, Targets
from parallel_cal.discovery.selection import find_formula

FOLDS = 4
MIN_SHARE_OF_DIRECTION = 0.05  # of a direction of the model that the samples of a fold determine


@dataclass(frozen=True)
class Choice:
    """Squares of the residuals at the held-out samples (N,), in noise units: without the law, with
    the law, and with the law whose terms and constants were chosen without these samples."""

    without: np.ndarray = field(repr=False)
    chosen: np.ndarray = field(repr=False)
    anew: np.ndarray = field(repr=False)
    group: np.ndarray = field(repr=False)

    @property
    def ratio(self) -> float:
        """Rms residual with the law, over that without it."""
        return float(np.sqrt(self.chosen.sum() / max(self.without.sum(), 1e-300)))

    @property
    def ratio_anew(self) -> float:
        """The same ratio if each fold chooses terms and constants itself."""
        return float(np.sqrt(self.anew.sum() / max(self.without.sum(), 1e-300)))

    @property
    def is_clear(self) -> bool:
        """Whether the law that each fold chooses lowers the squares by more than the uncertainty of
        their mean, pose by pose."""
        fall = np.bincount(self.group, self.without - self.anew)
        return bool(fall.mean() > fall.std() / np.sqrt(len(fall)))


def choose_in_folds(targets: Targets, formula: Formula, run: Runner = run_on_cores) -> Choice:
    """Choose terms and constants of a law anew in each fold, for its place and drivers; visits of a
    pose stay together."""
    order = np.random.default_rng(0).permutation(int(targets.group.max()) + 1)
    folds = order[targets.group] % FOLDS
    held_out = [folds == k for k in range(FOLDS)]
    squares = np.zeros((3, len(folds)))
    with running(run, _judge_fold, (targets, formula), held_out) as judged:
        for own, found in zip(held_out, judged, strict=True):
            squares[:, own] = found
    without, chosen, anew = squares
    return Choice(without, chosen, anew, targets.group)


def _judge_fold(shared: tuple[Targets, Formula], held_out: np.ndarray) -> list[np.ndarray]:
    """Squares of the residuals at samples that are held out: without the law, with it, and with
    that which the other samples choose."""
    targets, formula = shared
    nothing = np.zeros((len(targets.residuals), 0))
    anew = find_formula(_select(targets, ~held_out), _select_samples(formula.hypothesis, ~held_out))
    chosen = build_columns(formula.hypothesis, anew.terms) if anew else nothing
    left = [_predict(targets, one, held_out) for one in (nothing, formula.columns, chosen)]
    return [np.sum(one.reshape(-1, targets.rows) ** 2, axis=1) for one in left]


def _select(targets: Targets, these: np.ndarray) -> Targets:
    """The targets at some samples, whose directions the model can imitate there."""
    rows = np.repeat(these, targets.rows)
    U, sizes, _ = np.linalg.svd(targets.directions[rows], full_matrices=False)
    U = U[:, sizes > MIN_SHARE_OF_DIRECTION]
    residuals = targets.residuals[rows]
    total = targets.dof + targets.directions.shape[1]
    return replace(
        targets,
        directions=U,
        residuals=residuals - U @ (U.T @ residuals),
        dof=max(round(total * float(np.mean(these))) - U.shape[1], 1),
        group=targets.group[these],
    )


def _select_samples(hypothesis: Hypothesis, these: np.ndarray) -> Hypothesis:
    """The hypothesis at some samples."""
    members = tuple(
        replace(place, columns=place.columns[these]) for place in hypothesis.site.members
    )
    drivers = tuple(
        tuple(replace(one, values=one.values[these]) for one in own) for own in hypothesis.drivers
    )
    return replace(hypothesis, site=replace(hypothesis.site, members=members), drivers=drivers)


def _predict(targets: Targets, columns: np.ndarray, held_out: np.ndarray) -> np.ndarray:
    """What geometry and law, identified at the other samples, leave at those held out."""
    Q = targets.directions
    for _ in range(2):  # again, without the rounding of large columns that the model imitates
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        columns = columns - Q @ (Q.T @ columns)
    U, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    everything = np.hstack([Q, U[:, sizes > MIN_COLUMN_REMAINDER]])
    rows, r = np.repeat(held_out, targets.rows), targets.residuals[:, 0]
    found = np.linalg.lstsq(everything[~rows], r[~rows], rcond=MIN_SHARE_OF_DIRECTION)[0]
    return np.asarray(r[rows] - everything[rows] @ found)
