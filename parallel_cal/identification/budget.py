"""Error budget: contributions of geometry, each effect and noise; and the figures of ISO 9283."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import Errors, Summary, find_judgeable_samples
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.identification.registration import registered_by
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model
from parallel_cal.recordings.replicates import average_groups

KINDS = {"position": slice(0, 3), "orientation": slice(3, 6)}


@dataclass(frozen=True)
class Part:
    """One line of a budget: its contribution to the total, and its own rms (None if it has no
    vector), m or rad."""

    name: str
    contribution: float
    alone: float | None


@dataclass(frozen=True)
class Budget:
    """The rms error of the nominal model, registered only, and its parts.

    With e = measured minus nominal pose = sum of d_k, part k contributes mean(d_k . e) / rms(e).
    Contributions sum to rms(e) and may be negative if parts compensate each other. The last two
    parts share the error that the model does not explain: the stated `noise`, and the `rest`.
    """

    kind: str
    total: float
    parts: tuple[Part, ...]


@single_threaded()
def budgets(
    model: Model, observations: Observations, noise: Summary, registered: bool = False
) -> tuple[Budget, ...]:
    """Make a budget for each kind of error that was measured.

    If `registered`, the nominal model has the frames that fit these samples best: where the device
    stands is no error of the robot.
    """
    n = len(model.joints)
    # The parts of the budget, and the mask (n_p,) of the parameters of each; sensors have no part.
    groups = {"geometry": np.isin(model.table.names, model.mechanism.parameters.names)}
    for effect in model.effects:
        which = model.table.matching([f"{effect.name}.*"])
        groups[effect.name] = which & ~model.table.matching(effect.fixed_patterns())
    values = model.values.copy()
    for which in groups.values():
        values[which] = model.table.nominal[which]
    nominal = model.with_values(values)
    if registered:
        nominal = registered_by(nominal, observations) or nominal
    poses = [_pose(nominal, observations)]
    for which in groups.values():
        values[which] = model.values[which]
        poses.append(_pose(model.with_values(values), observations))
    poses.append(Configuration.from_rows(observations.x))
    steps = [after.change_from(before)[:, n:] for before, after in pairwise(poses)]
    found = []
    for kind, part in KINDS.items():
        judged = find_judgeable_samples(
            model.mechanism, observations.measured[:, n:], range(6)[part]
        )
        if judged.any():
            taken = [step[judged, part] for step in steps]
            found.append(_budget(kind, list(groups), taken, noise.rms(kind)))
    return tuple(found)


def _pose(model: Model, observations: Observations) -> Configuration:
    return Configuration.from_rows(predict_configurations(model, observations))


def _budget(kind: str, names: list[str], steps: list[np.ndarray], noise: float | None) -> Budget:
    e = np.sum(steps, axis=0)
    total = _rms(e)
    share = [float(np.mean(np.sum(step * e, axis=1))) / total if total else 0.0 for step in steps]
    parts = [Part(n, s, _rms(step)) for n, s, step in zip(names, share, steps, strict=False)]
    left = share[-1]
    if noise is not None and total:
        parts.append(Part("noise", noise**2 / total, noise))
        left -= noise**2 / total
    return Budget(kind, total, (*parts, Part("rest", left, None)))


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


@dataclass(frozen=True)
class Iso9283:
    """Pose accuracy and repeatability of a robot that the model commands (ISO 9283, 7.2).

    The accuracy is the distance from the predicted pose to the barycentre of the attained poses,
    mean and maximum over the poses. The repeatability is the mean distance from the barycentre plus
    three of its standard deviations, pooled over all poses with several visits (`poses`, and
    `visits` in total); None if no pose was visited twice. Both contain the noise of the device.
    """

    kind: str
    accuracy_mean: float
    accuracy_max: float
    repeatability: float | None
    poses: int
    visits: int


def iso_9283(errors: Errors, observations: Observations) -> tuple[Iso9283, ...]:
    """Figures for each kind of error that was measured; the measured pose counts as the attained
    pose."""
    return tuple(
        _figures(kind, getattr(errors, kind)[known], observations.group[known])
        for kind in KINDS
        if (known := np.isfinite(errors.norms(kind))).any()
    )


def _figures(kind: str, e: np.ndarray, group: np.ndarray) -> Iso9283:
    e = np.nan_to_num(e)
    _, inverse, visits = np.unique(group, return_inverse=True, return_counts=True)
    middle = average_groups(e, group)
    accuracy = np.linalg.norm(middle, axis=1)
    again = visits[inverse] > 1
    # n visits scatter about their own mean by (n - 1) / n of their variance
    widened = np.sqrt(visits / np.maximum(visits - 1, 1))[inverse]
    l = (widened * np.linalg.norm(e - middle[inverse], axis=1))[again]
    repeatability = float(l.mean() + 3 * l.std()) if len(l) else None
    return Iso9283(
        kind,
        float(accuracy.mean()),
        float(accuracy.max()),
        repeatability,
        int((visits > 1).sum()),
        int(visits[visits > 1].sum()),
    )
