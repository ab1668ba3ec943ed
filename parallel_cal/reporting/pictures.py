"""Results as figures for a notebook, the same that a report has."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.diagnosis.comparison import Comparison
from parallel_cal.diagnosis.diagnose import Diagnosis
from parallel_cal.identification.fit import Result
from parallel_cal.reporting import contents, figures, spaces
from parallel_cal.reporting.readable import shown_kinds, unit_of

if TYPE_CHECKING:
    from plotly.graph_objects import Figure


@singledispatch
def figure(result: Any) -> Figure:
    """A plotly figure of what `compare` (residual arrows), `diagnose` (the falling error) or `fit`
    (how far parameters moved) gives; ParallelCalError where there is nothing to draw."""
    kind = type(result).__name__
    raise TypeError(f"figure takes what fit, compare or diagnose gives, not {kind}")


def _drawn(spec: figures.Spec) -> Figure:
    from plotly.graph_objects import Figure

    return Figure(spec)


@figure.register
def _(comparison: Comparison) -> Any:
    field, kind = comparison.field, comparison.field.kind
    drawn = spaces.residual_arrows(
        {
            "kind": kind,
            "place": contents.places(comparison.scene, kind),
            "now": field.vectors.tolist(),
            "found": None,
            "sample": comparison.dataset.numbers.tolist(),
        }
    )
    if drawn is None:
        raise ParallelCalError("no pose was measured: there are no residuals in space")
    return _drawn(drawn[0])


@figure.register
def _(diagnosis: Diagnosis) -> Any:
    errors, mechanism = contents.errors(diagnosis), diagnosis.model.mechanism
    kinds = shown_kinds(errors)
    if not kinds:
        raise ParallelCalError("no error can be given: nothing was measured that tells")
    unit = unit_of(kinds[0], dict(zip(mechanism.joints, mechanism.joint_units, strict=True)))
    rows = contents.history(diagnosis)
    return _drawn(figures.history(rows, errors["noise"], kinds[0], "noise alone", unit))


@figure.register
def _(result: Result) -> Any:
    return _drawn(figures.parameter_bars(contents.parameters(result)))
