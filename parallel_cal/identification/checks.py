"""Check the input and the result of an identification: free parameters, poses, plausible values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.common_scale import (
    describe_scale_of_lengths,
    find_scale_of_lengths,
)
from parallel_cal.identification.estimate import Estimate, NoSolutionError
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import Errors
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import MIN_COMMON_SCALE
from parallel_cal.identification.unusual import UnusualSize, describe_by_effect
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import MAX_TOLERANCES, RANGE_MARGIN_SIGMAS, Parameter


def chosen_parameters(model: Model, options: FitOptions) -> tuple[np.ndarray, bool]:
    """Return the mask of the parameters to identify, and whether the others keep their
    covariance."""
    if not options.refit:
        return free_mask(model, options.free, options.fix), False
    if options.free or options.fix:
        raise FitError(
            "refit already names all parameters to identify: do not combine it with "
            "free or fix patterns"
        )
    return model.table.matching(options.refit), True


def free_mask(model: Model, free: Iterable[str], fix: Iterable[str]) -> np.ndarray:
    """Mask (n_parameters,) of the free parameters: those of the model file, changed by the
    patterns."""
    freed, fixed = model.table.matching(free), model.table.matching(fix)
    own = ~np.asarray(model.fixed)
    both, only_freed, only_fixed = freed & fixed, freed & ~fixed, fixed & ~freed
    if both.any() and only_freed.any() == only_fixed.any():
        names = [n for n, b in zip(model.table.names, both, strict=True) if b]
        raise FitError(f"{', '.join(names)}: free and fix both match; remove one of the patterns")
    free_is_narrower = both.any() and not only_freed.any()
    mask = (own & ~fixed) | freed if free_is_narrower else (own | freed) & ~fixed
    if not mask.any():
        raise FitError("no parameter is free: give --free a pattern, or fix fewer")
    return np.asarray(mask)


def explain_too_few_poses(
    model: Model, observations: Observations, free: np.ndarray, prior: bool | Prior | None
) -> str:
    """Explain that there are too few different poses; empty if there are enough. With a prior one
    equation is enough."""
    poses, first = np.unique(observations.group, return_index=True)
    n = len(model.joints)
    moved = [n + i for i in model.mechanism.moved]
    given = observations.measured[:, moved].sum(axis=1) + np.isfinite(observations.reading).sum(
        axis=1
    )
    equations = np.maximum(model.structure.equations - len(moved) + given, 0)[first]
    carried, most = int(equations.sum()), max(int(equations.max(initial=0)), 1)
    if carried >= (1 if prior else free.sum()):
        return ""
    return (
        f"{len(poses)} different poses give {carried} equations, but {int(free.sum())} "
        f"parameters are free: measure at least {-(-int(free.sum()) // most)} different "
        "poses (better twice as many), fix parameters, or use the tolerances as a prior (--prior)"
    )


class ContradictionError(FitError):
    """Parameters of an effect contradict each other, and the caller does not insist on them."""


class ImplausibleGeometryError(FitError):
    """All lengths of the geometry share a factor, as from a wrong unit, or one is outside its range
    although only usual sizes are accepted."""


class UnexplainedMotionError(FitError):
    """A fit leaves so much of the measured motion that it does not describe the samples."""


class WrongSignError(FitError):
    """An `effect` (its name) fits only with a sign that its physics forbids."""

    def __init__(self, words: str, effect: str):
        super().__init__(words)
        self.effect = effect


def check_plausible(
    model: Model,
    estimate: Estimate,
    free: np.ndarray,
    insist: bool = False,
    usual_only: bool = False,
    leaves_noise: bool = False,
) -> tuple[Model, dict[str, UnusualSize], str, list[str]]:
    """Judge the size of every identified parameter.

    A parameter is out of range if it lies more than three sigmas outside. The sigmas are those that
    a model file states. Its reader applies the same rule, so a model that passes here can be
    written and read again. `estimate.sigma` is infinite for a parameter that the data do not
    determine, and would let any value pass.

    Usual sizes are knowledge about other machines: a parameter outside its range is accepted, and
    its tolerance is raised to allow it, unless the owner wants `usual_only`. If it is a dimension
    or zero of the geometry, and the fit `leaves_noise` alone, then the drawing is wrong, and the
    model is not. Otherwise the geometry is implausible: it imitates what the model lacks. A factor
    that all lengths share is refused, because a unit explains it.

    Returns
    -------
    Model
        The model, with raised tolerances.
    dict of str to UnusualSize
        What is unusual of effects and sensors, by parameter.
    str
        The parameter of an implausible geometry that is furthest from its nominal value, in words;
        empty if the geometry is plausible.
    list of str
        Parameters of the geometry of a wrong drawing, and impossible values of effects that were
        accepted because the caller insists.

    Raises
    ------
    ImplausibleGeometryError
        If a parameter of the geometry is out of range, and all lengths share a factor or only usual
        sizes are wanted.
    WrongSignError
        If an elastic or dissipative quantity is negative.
    FitError
        If another parameter is physically impossible, values of an effect are impossible together,
        or a size is unusual and only usual ones are wanted.
    """
    unusual, accepted, tolerances = dict[str, UnusualSize](), list[str](), dict(model.tolerances)
    usual_tolerances, far = dict(model.usual_tolerances), dict[str, float]()
    stated_sigma = np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0))
    low, high = np.array(
        [p.plausible_range(s) for p, s in zip(model.table, stated_sigma.tolist(), strict=True)]
    ).T
    outside = free & ~((low <= model.values) & (model.values <= high))
    is_geometry = np.array([p.group not in ("effect", "sensor") for p in model.table])
    scale = find_scale_of_lengths(model, free & is_geometry)
    for i in np.flatnonzero(outside):
        p, value = model.table[i], float(model.values[i])
        least, most = p.plausible_range()
        if is_geometry[i]:
            found = _describe_place(p, value)
            if usual_only or scale is not None or not p.low <= value <= p.high:
                raise _refuse_geometry(p, found, scale, estimate.chi2_per_dof)
            tolerances[p.name] = 1.2 * abs(value - p.nominal) / MAX_TOLERANCES
            usual_tolerances.setdefault(p.name, p.tolerance)
            far[found] = abs(value - p.nominal) / p.tolerance
            continue
        bound = least if value < low[i] else most
        if bound == p.nominal:
            raise _refuse_sign(model, p, value)
        tolerances[p.name] = 1.2 * p.tolerance * (value - p.nominal) / (bound - p.nominal)
        usual_tolerances.setdefault(p.name, p.tolerance)
        unusual[p.name] = UnusualSize.of(p, value)
    if leaves_noise:
        accepted += [
            f"{found}. It was accepted, with a larger tolerance, because the fit leaves only noise "
            f"(chi2/dof {estimate.chi2_per_dof:.3g}): check this dimension or zero in the drawing"
            for found in far
        ]
    if scale is not None and abs(scale) > MIN_COMMON_SCALE:
        accepted.append(
            f"{describe_scale_of_lengths(scale)}: check the unit and the scale of the measuring "
            "device, and the drawing"
        )
    if unusual and usual_only:
        words = "; ".join(describe_by_effect(unusual.values()).values())
        raise FitError(
            f"{words}; nothing was identified, because only usual sizes were asked for: omit "
            "--usual-only, or state the machine's class or the effect's tolerance in the model file"
        )
    if why := _find_contradiction(model, free, estimate.sigma):
        if not insist:
            raise ContradictionError(why)
        accepted.append(f"{why}: accepted because of --force (in Python: insist)")
    raised = replace(model, tolerances=tolerances, usual_tolerances=usual_tolerances)
    implausible = "" if leaves_noise else _describe_imitation(far, estimate.chi2_per_dof)
    return raised, unusual, implausible, accepted


def _refuse_geometry(
    p: Parameter, found: str, scale: float | None, chi2_per_dof: float
) -> ImplausibleGeometryError:
    """Return the error for a dimension that was `found` out of its range; `scale` is the factor
    that all lengths share, if they do."""
    least, most = p.plausible_range()
    scaled = "" if scale is None else f"{describe_scale_of_lengths(scale)}; "
    return ImplausibleGeometryError(
        f"{found} (plausible {least:.6g} to {most:.6g}; chi2/dof {chi2_per_dof:.3g}): {scaled}"
        "check units and mechanism, fix the parameter, use priors (fit --prior), or correct "
        "nominal and tolerance in the model file"
    )


def _find_contradiction(model: Model, free: np.ndarray, sigma: np.ndarray) -> str:
    """Say why values are impossible together; empty if those nearest to nominal, within three
    sigmas of the estimate, are possible."""
    away = model.values - model.table.nominal
    slack = np.where(free, RANGE_MARGIN_SIGMAS * sigma, 0.0)
    nearest = model.table.nominal + np.sign(away) * np.maximum(np.abs(away) - slack, 0.0)
    return model.with_values(nearest).find_contradiction()


def _describe_place(p: Parameter, value: float) -> str:
    return (
        f"{p.name} was identified as {_show(p, value)}, "
        f"{(value - p.nominal) / p.tolerance:+.1f} tolerances from its nominal {p.nominal:.6g}"
    )


def _describe_imitation(far: Mapping[str, float], chi2_per_dof: float) -> str:
    """Say how far an implausible geometry is from the drawing; `far` has the distances in
    tolerances."""
    if not far:
        return ""
    worst = max(far, key=far.__getitem__)
    more = f", and {len(far) - 1} more are too far" if len(far) > 1 else ""
    return (
        f"{worst}{more} (chi2/dof {chi2_per_dof:.3g}): no such robot has this geometry, which "
        "imitates what the model lacks"
    )


def check_joint_errors(model: Model, found: Errors) -> None:
    """Raise FitError if a joint's errors are as large as its range, even if the caller insists:
    such a model does not describe the robot."""
    m = model.mechanism
    for i, (low, high) in enumerate(m.joint_limits):
        error = found.joint[:, i]
        error = error[np.isfinite(error)]
        rms = float(np.sqrt(np.mean(error**2))) if len(error) else 0.0
        if rms > high - low:
            raise NoSolutionError(
                f"the best fit misses the readings of joint {m.joints[i]} by {rms:.4g} "
                f"{m.joint_units[i]} rms, more than its whole range ({low:.4g} to {high:.4g}): "
                "check the readings' units, the order of the joints and the mechanism; nothing was "
                "identified"
            )


def _refuse_sign(model: Model, p: Parameter, value: float) -> WrongSignError:
    """Return the error for a value whose sign is impossible. It says which sign convention to
    check: the approach of the joints if the effect depends on it, else the model file's."""
    side = "negative" if value < p.nominal else "positive"
    advice = "check the directions that the model file states (gravity, joints)"
    needs = {name for e in model.effects if p.name.startswith(f"{e.name}.") for name in e.needs}
    if needs & {"direction", "travel"}:
        advice = (
            "check the recorded direction and travel of the joints (their sign, the order of the "
            "visits), and whether the encoders sit behind the gears"
        )
    return WrongSignError(
        f"{p.name} would have to be {_show(p, value)}, but its physics allows no {side} value: "
        f"{advice}",
        p.name.split(".")[0],
    )


def _show(p: Parameter, value: float) -> str:
    return f"{value:.6g}" if p.unit == "1" else f"{value:.6g} {p.unit}"
