"""Select the identification method by name, with a prior and a robust loss."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.robust import estimate_robustly
from parallel_cal.model.shelf import load_module, wrap_plugin_function

Estimator = Callable[..., Estimate]  # of a model, observations, the mask of what is free
# These minimise residuals in noise units until they settle; what rests on such a minimum
# (robust losses, partial re-calibration) makes no sense for the others.
CONVERGENT_METHODS = ("implicit", "forward", "inverse")
SHELF = "identification.methods"


def estimator(method: str, prior: bool | Prior | None = False, loss: str = "linear") -> Estimator:
    """Make the estimator (model, observations, free) -> estimate; FitError if the options
    contradict."""
    chosen = partial(load_method(method), prior=prior)
    if loss == "linear":
        return chosen
    check_convergent_method(method, f"the loss '{loss}'")
    return partial(estimate_robustly, chosen, loss=loss)


def load_method(name: str) -> Callable[..., Estimate]:
    """The `estimate` function of parallel_cal/identification/methods/<name>.py, or of the file at
    a Python path."""
    function = getattr(load_module(SHELF, name, FitError), "estimate", None)
    if function is None:
        raise FitError(
            f"{name} is not a method: it has no estimate(model, observations, free, prior)"
        )
    return wrap_plugin_function(name, function)


def check_convergent_method(method: str, wanted: str) -> None:
    """Raise FitError for a method that does not weight samples by their noise until convergence."""
    if method not in CONVERGENT_METHODS:
        raise FitError(
            f"{wanted} needs an iterative method that weights samples, and '{method}' is not one: "
            f"use {' or '.join(CONVERGENT_METHODS)}"
        )
