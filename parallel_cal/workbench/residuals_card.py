"""Where the model fails: residuals in space, by joint, and against what they may go with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nicegui import ui

from parallel_cal.reporting.colours import BAND, PATTERN, QUIET
from parallel_cal.workbench.marking import FigureSlot, Marking
from parallel_cal.workbench.widgets import FIGURE_MARGIN, card

HINT = (
    "Drag a box in a flat view (box or lasso tool): the same samples are marked in all flat views. "
    "Arrows have the colour of their direction."
)
LIKELY = "99 % of means if nothing depends on it"
RMS = "rms residual [sigmas] over the workspace"


class ResidualsCard:
    """A card that is drawn once: the next view is put into what is there, as it was looked at."""

    def __init__(self, marking: Marking):
        self.view: dict[str, Any] = {}
        with card("Where it fails"):
            ui.label(HINT).classes("text-sm").style("opacity: 0.75")
            with ui.row().classes("w-full no-wrap max-lg:flex-wrap"):
                with ui.column().classes("flex-1 min-w-0 gap-0") as self.space:
                    self.scale = ui.label().classes("text-sm")
                    self.arrows = FigureSlot()
                self.map = FigureSlot(marking)
            self.tabs = ui.tabs(on_change=self._turn)
            self.words = ui.label().classes("text-sm")
            self.picture = FigureSlot(marking)
            with ui.row().classes("items-center") as self.asked:
                self.component = ui.select([], label="residual of", on_change=self._draw_profile)
                self.along = ui.select([], label="against", on_change=self._draw_profile)
                self.component.classes("w-32")
                self.along.classes("w-48")
            self.course = FigureSlot(marking)

    def show(self, view: dict[str, Any]) -> None:
        self.view = view
        arrows, residuals = view["arrows"], view["residuals"]
        self.space.set_visibility(arrows is not None)
        if arrows is not None:
            self.scale.set_text(f"Residuals, drawn {arrows['scale']:g} times as long as they are")
            self.arrows.show(arrows["figure"], "residual arrows in space")
        self._map(residuals)
        self._pictures()
        _offer(self.component, residuals["components"])
        _offer(self.along, list(residuals["along"]))
        self._draw_profile()

    def _map(self, residuals: dict[str, Any]) -> None:
        sizes = [sample["sigmas"] or 0 for sample in self.view["samples"]]
        marker = {"color": sizes, "colorscale": "Cividis", "showscale": True, "size": 9}
        x, y = ([p[k] for p in residuals["place"]] for k in (0, 1))
        across, up = (residuals["where"].format(axis) for axis in "xy")
        self.map.show(_make_flat_figure([self._samples(x, y, marker)], across, up, RMS), RMS)

    def _pictures(self) -> None:
        """One at a time; the one that was looked at stays."""
        names = [one["name"] for one in self.view["pictures"]]
        looked_at = self.tabs.value if self.tabs.value in names else next(iter(names), None)
        if names != [tab.props["name"] for tab in self.tabs]:
            self.tabs.clear()
            with self.tabs:
                for name in names:
                    ui.tab(name)
        self.tabs.set_value(looked_at)
        self._turn()

    def _turn(self) -> None:
        chosen = [one for one in self.view["pictures"] if one["name"] == self.tabs.value]
        self.words.set_text(chosen[0]["words"] if chosen else "")
        self.picture.show(*((chosen[0]["figure"], chosen[0]["words"]) if chosen else (None,)))

    def _draw_profile(self) -> None:
        """The chosen component of the residuals against what it may go with."""
        residuals, name = self.view["residuals"], self.component.value
        along = residuals["along"].get(self.along.value)
        told = along is not None and name in residuals["components"]
        self.asked.set_visibility(told)
        if not told:
            return self.course.show(None)
        k = residuals["components"].index(name)
        marker = {"color": residuals["colours"][k], "size": 7, "opacity": 0.6}
        samples = self._samples(along["values"], [row[k] for row in residuals["sigmas"]], marker)
        across = f"{self.along.value} [{along['unit']}]" if along["unit"] else self.along.value
        title = f"residual of {name} against {self.along.value}"
        figure = _make_flat_figure([samples, *_means(along, k)], across, f"{name} [sigmas]", title)
        self.course.show(figure, title)

    def _samples(self, x: Any, y: Any, marker: dict[str, Any]) -> dict[str, Any]:
        """A point of every sample, in the samples' order."""
        numbers = [s["sample"] for s in self.view["samples"]]
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


def _offer(select: Any, names: list[str]) -> None:
    """What can be chosen now; what was chosen stays where it can."""
    chosen = select.value if select.value in names else next(iter(names), None)
    select.set_options(names, value=chosen)


def _make_flat_figure(
    data: Sequence[dict[str, Any]], across: str, up: str, title: str
) -> dict[str, Any]:
    axes = {"xaxis": {"title": {"text": across}}, "yaxis": {"title": {"text": up}}}
    words = {"text": title, "font": {"size": 13}}
    return {
        "data": [*data],
        "layout": {"height": 360, "margin": FIGURE_MARGIN, "title": words, **axes},
    }


def _means(along: dict[str, Any], component: int) -> list[dict[str, Any]]:
    """The rolling mean of a component, or one a level, over the band of 99 % about none."""
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
