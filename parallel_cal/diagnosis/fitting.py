"""Fit a model, and refuse a result that does not describe the samples, with the likeliest cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import with_changes
from parallel_cal.base.progress import Progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.columns import check_fitted, naming_wrong_columns
from parallel_cal.identification import fit as identification
from parallel_cal.identification.checks import UnexplainedMotionError
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.unexplained import describe_unexplained_motion
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

if TYPE_CHECKING:
    from typing_extensions import Unpack

WAYS_ON = (
    "Sound measurements leave less than 3 %. No single exchange of columns, sign, zero, unit, "
    "coupling of two joints or convention of the poses explains it: two of them may be wrong, the "
    "rows of joints and poses may not belong together, or the model describes another machine: "
    "check the mechanism, and the unit and the drive (spool, screw or belt) of each joint. If a "
    "large effect may be missing, diagnose names it: parallel-cal diagnose MODEL RECORDING (in "
    "Python: pc.diagnose(model, dataset)). If the device is so coarse, state its noise. --force "
    "(in Python: insist=True) accepts the fit"
)


@check_arguments(FitError)
@single_threaded()
def fit(
    model: Model,
    dataset: Dataset,
    options: FitOptions | None = None,
    progress: Progress | None = None,
    *,
    effects: Sequence[str] = (),
    **changes: Unpack[FitKeywords],
) -> FitResult:
    """Identify the free parameters of a model from measurements.

    Weighted least squares on the closure equations phi(q, x, p) = 0 of the joint readings q, the
    measured pose x and the parameters p. The noise of q and x, propagated to each equation, gives
    its weight. If the poses are measured in the device's own frame,
    the model is registered first. Cross-validation gives the errors at held-out poses; the
    estimates use all samples.

    Parameters
    ----------
    model : Model
        The start values, the list of the free parameters, and their tolerances.
    dataset : Dataset
        N samples: joint readings (N, nq) in rad or m, and measured poses.
    options : FitOptions, optional
        All options as one object.
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1). An exception that it raises
        cancels the fit.
    effects : sequence of str, optional
        Effects to add to the model before the fit, each `"NAME"` or `"NAME:parameter=value"`. Use
        it if the geometry alone runs away because a large effect is missing. The errors before the
        fit are those of the given model.
    **changes
        Single options by name. They replace the same fields of `options`:

        - `hold_out` (default 0.25): share of the poses held out in each fold; 0 skips the
          validation.
        - `joint_sigma`: noise of the joint readings, 1 sigma, in rad or m. It replaces what
          recording and model file state.
        - `free`, `fix`: name patterns, such as `["chain1.*"]`, of parameters to estimate or to
          keep.
        - `refit`: name patterns. Only these are identified, and the others keep the covariance
          that the model has.
        - `prior`: where tolerances act as priors. None (the default): only for combinations of
          parameters that the data determine less precisely than the tolerances. True: for all
          parameters. False: for none. A Prior states mean and covariance instead.
        - `method` (default `"implicit"`), `loss` (`"linear"`, or a robust one such as `"huber"`),
          `seed` of the folds, `insist` (accept implausible joint readings, motion that the
          fit does not explain, and combinations of an effect's values that are physically
          impossible), `usual_only` (refuse effects that are
          larger than usual).

    Returns
    -------
    FitResult
        `model` is the identified one. `after` holds its errors at the samples, `held_out` those at
        held-out poses, `noise_floor` the noise floor. `parameters()` lists every estimate with its
        sigma. `implausible` says, if it is not empty, that no such robot has this geometry: do not
        use the model, but let `diagnose` name what the geometry imitates.

    Raises
    ------
    FitError
        If the data cannot determine the parameters, an estimate is physically impossible, or the
        fitted model misses more than 3 % of the measured motion. If other columns or conventions of
        the samples describe them, the message names these.
    ModelError
        If an effect is unknown or does not apply to the model.

    References
    ----------
    Vischer, P. (1996). Improving the Accuracy of Parallel Robots. Thesis 1570, EPFL, eq. 5.1 to
    5.20.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> result = pc.fit(model, data, hold_out=0.2)
    >>> result.held_out.summary.position_rms < result.before.summary.position_rms / 5
    True
    """
    options = with_changes(options, FitOptions, changes, FitError)
    with naming_wrong_columns(model, dataset, options):
        result = identification.fit(model, dataset, options, progress, effects=effects)
        against = describe_unexplained_motion(result)
        odd = result.outliers
        if against and not odd and not options.insist:
            raise UnexplainedMotionError(f"{against}. {WAYS_ON}")
    if against and odd and not options.insist:  # they explain it, whatever other columns would
        raise UnexplainedMotionError(f"{odd.description}. With all samples, {against}")
    check_fitted(result, model, dataset, options)
    if not against:
        return result
    forced = f"{against}: accepted because of --force (in Python: insist)"
    return replace(result, warnings=(*result.warnings, forced))
