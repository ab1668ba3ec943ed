"""Where the model fails: residuals in space, by joint, and against recorded quantities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nicegui import ui

from parallel_cal.reporting.colours import BAND, PATTERN, QUIET
from parallel_cal.workbench.marking import FigureSlot, Marking
from parallel_cal.workbench.widgets import FIGURE_MARGIN, card

HINT = (
    "Drag a box or a lasso in a flat view to mark samples. They are then marked in all flat views."
)
LIKELY = "99 % band of the mean without dependence"
HEIGHT = 320  # of a figure
RMS = "rms residual [sigmas] over the workspace"


class ResidualsCard:
    """The card Where it fails; drawn once and then updated, so that its settings stay."""

    def __init__(self, marking: Marking):
        self.view: dict[str, Any] = {}
        self.strongest: str | None = None  # of the quantities offered
        self.turned_to = ""  # the tab of the picture
        with card("Where it fails"):
            ui.label(HINT).classes("text-sm quiet")
            self.shown = ui.label().props("id=shown").classes("text-sm")
            self.map = FigureSlot(marking)
            self.tabs = ui.tabs(on_change=self._turn).props("dense inline-label no-caps")
            self.picture = FigureSlot(marking)
            with ui.row().classes("items-center") as self.asked:
                self.component = ui.select([], label="residual of", on_change=self._draw_profile)
                self.along = ui.select([], label="against", on_change=self._draw_profile)
                self.component.classes("w-32")
                self.along.classes("w-48")
            self.course = FigureSlot(marking)

    def show(self, view: dict[str, Any]) -> None:
        self.view = view
        residuals = view["residuals"]
        self.shown.set_text(view["shown"])
        self.shown.set_visibility(bool(view["shown"]))
        sizes = [sample["sigmas"] or 0 for sample in view["samples"]["rows"]]
        marker = {"color": sizes, "colorscale": "Cividis", "showscale": True, "size": 9}
        x, y = ([p[k] for p in residuals["place"]] for k in (0, 1))
        across, up = (residuals["where"].format(axis) for axis in "xy")
        figure = _make_flat_figure([self._samples(x, y, marker)], across, up)
        figure["layout"]["yaxis"] |= {"scaleanchor": "x", "constrain": "domain"}
        figure["layout"]["xaxis"]["constrain"] = "domain"
        self.map.show(figure, RMS, RMS)
        names = [one["name"] for one in view["pictures"]]
        selected = self.tabs.value if self.tabs.value in names else next(iter(names), None)
        if names != [tab.props["name"] for tab in self.tabs]:
            self.tabs.clear()
            with self.tabs:
                for name in names:
                    ui.tab(name)
        self.tabs.set_value(selected)
        self._turn()
        _offer(self.component, residuals["components"])
        # The quantity with the strongest dependence, unless a person chose another one.
        names = list(residuals["along"])
        _offer(self.along, names, keep=self.along.value != self.strongest)
        self.strongest = next(iter(names), None)
        self._draw_profile()

    def _turn(self) -> None:
        chosen = [one for one in self.view["pictures"] if one["name"] == self.tabs.value]
        if not chosen:
            return self.picture.show(None)
        if self.turned_to != chosen[0]["name"]:
            self.turned_to = chosen[0]["name"]
            self.picture.clear()
        self.picture.show(chosen[0]["figure"], chosen[0]["words"], chosen[0]["words"])

    def _draw_profile(self) -> None:
        """Draw the chosen component of the residuals against the chosen quantity."""
        residuals, name = self.view["residuals"], self.component.value
        along = residuals["along"].get(self.along.value)
        usable = along is not None and name in residuals["components"]
        self.asked.set_visibility(usable)
        if not usable:
            return self.course.show(None)
        k = residuals["components"].index(name)
        marker = {"color": residuals["colours"][k], "size": 7, "opacity": 0.6}
        samples = self._samples(along["values"], [row[k] for row in residuals["sigmas"]], marker)
        across = f"{self.along.value} [{along['unit']}]" if along["unit"] else self.along.value
        title = f"residual of {name} against {self.along.value}"
        figure = _make_flat_figure([samples, *_means(along, k)], across, f"{name} [sigmas]")
        self.course.show(figure, title, title)

    def _samples(self, x: Any, y: Any, marker: dict[str, Any]) -> dict[str, Any]:
        """Make a trace with one point per sample, in the order of the samples."""
        numbers = [s["sample"] for s in self.view["samples"]["rows"]]
        return {
            "type": "scatter",
            "mode": "markers",
            "x": x,
            "y": y,
            "marker": marker,
            "text": [f"sample {n}" for n in numbers],
            "customdata": numbers,
            "showlegend": False,
        }


def _offer(select: Any, names: list[str], keep: bool = True) -> None:
    """Set the choices of a menu; with `keep`, the present choice stays if it is still possible."""
    chosen = select.value if keep and select.value in names else next(iter(names), None)
    select.set_options(names, value=chosen)


def _make_flat_figure(data: Sequence[dict[str, Any]], across: str, up: str) -> dict[str, Any]:
    axes = {"xaxis": {"title": {"text": across}}, "yaxis": {"title": {"text": up}}}
    legend = {"legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0}}
    return {
        "data": [*data],
        "layout": {"height": HEIGHT, "margin": FIGURE_MARGIN} | axes | legend,
    }


def _means(along: dict[str, Any], component: int) -> list[dict[str, Any]]:
    """Draw the rolling mean of a component, or its mean per level, over the 99 % band at zero."""
    at, band = along["at"], along["band"]
    mean = {"x": at, "y": [row[component] for row in along["means"]], "name": "mean"}
    if along["rolls"]:
        edges = {"x": at + at[::-1], "y": band + [-b for b in band[::-1]]}
        grey = {"fill": "toself", "fillcolor": BAND, "line": {"width": 0}, "hoverinfo": "skip"}
        drawn = [edges | grey | {"name": LIKELY}, mean | {"line": {"color": PATTERN, "width": 2}}]
        return [trace | {"type": "scatter", "mode": "lines"} for trace in drawn]
    bars = {"array": band, "color": BAND, "thickness": 14, "width": 0}
    none = {"x": at, "y": [0.0] * len(at), "error_y": bars, "marker": {"size": 1, "color": QUIET}}
    dots = mean | {"marker": {"size": 12, "color": PATTERN, "symbol": "diamond"}}
    drawn = [none | {"name": LIKELY}, dots]
    return [trace | {"type": "scatter", "mode": "markers"} for trace in drawn]
