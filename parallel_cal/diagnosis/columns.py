"""Say which columns or conventions of the samples are wrong, where the samples show it.

Where no geometry describes the samples, or only one that no such robot has, an effect may be
missing. But a wrong column does the same, and with it every effect found would be wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.identification.acceptance import FOREIGN_SHARE
from parallel_cal.identification.checks import (
    ImplausibleGeometryError,
    UnexplainedMotionError,
)
from parallel_cal.identification.column_doubts import doubt_columns
from parallel_cal.identification.estimate import NoSolutionError
from parallel_cal.identification.fit import FitResult, fit
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.outliers import describe_far_values
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

GAIN = "encoder_gain"


@contextmanager
def naming_wrong_columns(model: Model, dataset: Dataset, options: FitOptions) -> Iterator[None]:
    """If no geometry describes the samples, say which other columns or conventions fit them."""
    try:
        yield
    except (ImplausibleGeometryError, NoSolutionError, UnexplainedMotionError) as error:
        _check_columns(model, dataset, options, str(error))
        check_far_values(dataset, str(error))
        raise


def check_fitted(result: FitResult, model: Model, dataset: Dataset, options: FitOptions) -> None:
    """Raise FitError if the samples themselves explain why the geometry of a fit is implausible,
    unless it follows a few that contradict all others."""
    if result.implausible and not result.outliers:
        check_samples(model, dataset, options, result.implausible)


def check_samples(model: Model, dataset: Dataset, options: FitOptions, against: str) -> None:
    """Raise FitError if the samples themselves explain what is said `against` their fit: other
    columns or conventions fit them, or most of their motion is not explained wherever the device
    stands, so that no effect is the cause."""
    there = _check_columns(model, dataset, options, against)
    if there is not None and (share := there.find_unexplained_share()) > FOREIGN_SHARE:
        check_far_values(dataset, against)
        raise FitError(
            f"{against}. Wherever the device stands, {100 * share:.0f} % of the measured motion "
            "is not explained, so no effect was tried. Check the mechanism, and the units, "
            "columns, signs and zeros of the joints and poses: two of them may be wrong, or "
            "the rows of joints and poses do not belong together"
        )


def check_far_values(dataset: Dataset, against: str) -> None:
    """Raise FitError if values of some samples are far outside those of most, which explains what
    is said `against` a fit."""
    if not (far := describe_far_values(dataset)):
        return
    first, values = next(iter(far.items()))
    verb = "samples have" if len(far) > 1 else "sample has"
    raise FitError(
        f"{dataset.source or 'samples'}: {len(far)} {verb} values far outside those of most "
        f"others, as a device writes that saw nothing (sample {first}: {values}). Correct these "
        f"samples, or exclude them: --data exclude={','.join(map(str, far))}. As they are, "
        f"{against}"
    ) from None


def _check_columns(
    model: Model, dataset: Dataset, options: FitOptions, against: str
) -> DevicePoses | None:
    """Return the poses of the samples, predicted and seen; FitError if other columns or conventions
    fit them."""
    observations = observe(model, dataset, options.joint_sigma, options.insist)
    there = DevicePoses.of(model, observations)
    if words := doubt_columns(model, observations, there, dataset.source, suspected=True):
        # Joints that contradict each other by a few per cent look like exchanged ones.
        most = np.inf
        with suppress(FitError, ModelError):
            gained = fit(model.with_effect(GAIN), dataset, options, hold_out=0)
            if (seen := DevicePoses.of(gained.model, gained.observations)) is not None:
                most = seen.compute_median_error(seen.now)
        words = doubt_columns(model, observations, there, dataset.source, True, most)
    if words:
        check_far_values(dataset, against)
        raise FitError(f"{words}. As they are, {against}") from None
    return there
