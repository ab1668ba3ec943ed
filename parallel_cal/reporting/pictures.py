"""Figures of results for a notebook; the report has the same."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any

from parallel_cal.base.arguments import describe_argument
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.diagnosis.comparison import Comparison
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.discovery.law import Discovery
from parallel_cal.identification.fit import FitResult
from parallel_cal.reporting import contents, figures, spaces
from parallel_cal.reporting.error_steps import draw_steps
from parallel_cal.reporting.readable import unit_of

if TYPE_CHECKING:
    from plotly.graph_objects import Figure


def figure(result: Any) -> Figure:
    """Draw a result as a Plotly figure.

    Parameters
    ----------
    result : FitResult, Comparison, Diagnosis or Discovery
        A fit shows how far parameters moved, a comparison the residual arrows, a diagnosis the
        falling error, a discovery the error along its driver with the law over it.

    Returns
    -------
    plotly.graph_objects.Figure

    Raises
    ------
    ParallelCalError
        If there is nothing to draw, for example no measured pose. Also for another kind of result.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> len(pc.figure(pc.compare(model, data)).data) > 0
    True
    """
    return _draw(result)


@singledispatch
def _draw(result: Any) -> Figure:
    raise ParallelCalError(
        f"{describe_argument('result', result)}; expected the result of fit, compare, diagnose or "
        "discover"
    )


def _make_figure(spec: figures.Spec) -> Figure:
    from plotly.graph_objects import Figure

    return Figure(spec)


@_draw.register
def _(comparison: Comparison) -> Any:
    field, kind = comparison.field, comparison.field.kind
    if kind is None:
        raise ParallelCalError("no residuals in space to draw: no pose was measured")
    places, numbers = contents.places(comparison.scene, kind), comparison.dataset.numbers
    arrows = contents.vectors_in_base(comparison.scene, field)
    return _make_figure(spaces.residual_arrows(places, [arrows], kind, numbers)[0])


@_draw.register
def _(diagnosis: Diagnosis) -> Any:
    errors, mechanism = contents.HeldOutErrors.of(diagnosis), diagnosis.model.mechanism
    if not errors.kinds:
        raise ParallelCalError("no error to draw: no suitable quantity was measured")
    unit = unit_of(errors.kinds[0], dict(zip(mechanism.joints, mechanism.joint_units, strict=True)))
    rows = contents.history(diagnosis, errors)
    drawn = draw_steps(figures.find_steps(rows, errors.noise, errors.kinds[0], unit))
    return _make_figure({key: drawn[key] for key in ("data", "layout")})


@_draw.register
def _(found: Discovery) -> Any:
    shapes = [law.shape for law in (*found.laws, *found.suspected) if law.shape is not None]
    if not shapes:
        raise ParallelCalError("no law of one quantity was found, so there is no curve to draw")
    return _make_figure(figures.law_over_shape(shapes[0]))


@_draw.register
def _(result: FitResult) -> Any:
    return _make_figure(figures.parameter_bars(contents.parameters(result)))
