"""Marked samples: a sample that is marked in one view is marked in all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from parallel_cal.reporting.colours import PATTERN
from parallel_cal.workbench.widgets import draw_figure

# Marks samples in every view as Plotly marks its own selection. Its 'restyle' redraws each view,
# which takes twenty times as long. To draw all views takes seconds: the numbers are painted first,
# then one view after the other, those in space last, and a view out of sight when it comes into
# sight.
# The wheel scrolls the page, and zooms a figure with Ctrl; Plotly would keep it to itself in space.
SCRIPT = """<script>
addEventListener("wheel", event => {
  if (!event.ctrlKey && event.target.closest?.(".js-plotly-plot")) event.stopPropagation();
}, { capture: true, passive: true });
let marked = new Set();
function markSamples(numbers) {
  marked = new Set(numbers);
  for (const view of document.querySelectorAll(".js-plotly-plot")) markView(view);
}
function markView(view) {
  for (const points of view.calcdata ?? []) {
    const trace = points[0].trace, told = trace.customdata;
    if (!told || !points[0].node3) continue;
    const which = [...told.keys()].filter(i => marked.has(told[i]));
    trace.selectedpoints = trace._input.selectedpoints = marked.size ? which : undefined;
    for (const point of points) point.selected = marked.has(told[point.i]) ? 1 : 0;
    trace._module.styleOnSelect(view, points, points[0].node3);
  }
}
</script>
<script type="module">
const { Plotly } = await import("nicegui-plotly");
const { react, newPlot } = Plotly, waiting = new WeakMap(), margin = 200;  // px
const coming = new IntersectionObserver(views => {  // called after the page is painted
  for (const { isIntersecting, target } of views.sort((a, b) => isSpatial(a) - isSpatial(b))) {
    if (!isIntersecting) continue;
    coming.unobserve(target);
    turn = turn.then(() => draw(target)).then(() => new Promise(painted));
  }
}, { rootMargin: `${margin}px` });
let turn = Promise.resolve();
function isSpatial({ target }) {
  return waiting.get(target)?.[0].layout.scene ? 1 : 0;
}
function painted(done) {
  requestAnimationFrame(() => setTimeout(done));
}
function draw(view) {
  const figure = waiting.get(view);
  waiting.delete(view);
  if (!figure) return;
  const [{ layout, ...rest }, ...more] = figure;
  const coloured = { ...rest, layout: { ...layout, font: { ...layout.font, ...ink(view) } } };
  const mark = () => marked.size && markView(view);
  return react(view, coloured, ...more).then(mark, console.error);
}
// A style sheet does not reach the text of figures in space.
function ink(view) {
  return { color: getComputedStyle(view).color };
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => setTimeout(() => {
  for (const view of document.querySelectorAll(".js-plotly-plot"))
    if (view.layout?.scene) Plotly.relayout(view, { font: { ...view.layout.font, ...ink(view) } });
}, 500));  // after the page has its new colours
function postpone(view, ...figure) {
  waiting.set(view, figure);
  coming.unobserve(view);
  coming.observe(view);
  return Promise.resolve(view);
}
Plotly.react = postpone;
Plotly.newPlot = (view, figure, config) => {  // an empty figure keeps the place
  const { height, paper_bgcolor, plot_bgcolor } = figure.layout, none = { visible: false };
  const empty = { height, paper_bgcolor, plot_bgcolor, xaxis: none, yaxis: none };
  newPlot(view, [], empty, config);
  return postpone(view, figure, config);
};
</script>"""
SELECTION_HANDLER = "event => emit((event?.points ?? []).map(point => point.customdata))"
MARKED_STYLE = {
    "selected": {"marker": {"color": PATTERN, "size": 11}},
    "unselected": {"marker": {"opacity": 0.35}},
}


class Marking:
    """The numbers of the samples that are marked in this window."""

    def __init__(self, told: Callable[[set[int]], None]):
        """Call `told` with the marked samples whenever they change."""
        self.numbers, self.told, self._views = set[int](), told, list[Any]()

    def mark(self, numbers: set[int]) -> None:
        self.numbers = numbers
        self._views = [view for view in self._views if not view.is_deleted]
        for view in self._views:
            self._put(view.figure)  # a redraw then shows the marks, too
        ui.run_javascript(f"markSamples({sorted(numbers)})")
        self.told(numbers)

    def markable(self, figure: dict[str, Any]) -> dict[str, Any]:
        """Make the points of a figure markable if they carry sample numbers."""
        figure = {
            "data": [t | MARKED_STYLE if "customdata" in t else t for t in figure["data"]],
            "layout": figure["layout"] | {"dragmode": "select"},
            "config": {"displaylogo": False},
        }
        self._put(figure)
        return figure

    def follow(self, view: Any) -> None:
        """Synchronise the selection in a view with the marked samples."""
        view.on("plotly_selected", lambda e: self._brush(e.args), js_handler=SELECTION_HANDLER)
        view.on("plotly_deselect", self._forget)
        self._views.append(view)

    def _put(self, figure: dict[str, Any]) -> None:
        for trace in figure["data"]:
            if "customdata" in trace:
                numbers = enumerate(trace["customdata"])
                chosen = [i for i, n in numbers if n in self.numbers] if self.numbers else None
                trace["selectedpoints"] = chosen

    def _brush(self, chosen: list[int | None]) -> None:
        numbers = {int(n) for n in chosen if n is not None}
        if numbers and numbers != self.numbers:  # a redraw sends its selection, too
            self.mark(numbers)

    def _forget(self) -> None:
        if self.numbers:
            self.mark(set())


class FigureSlot:
    """A place for one figure at a time; hidden if there is none."""

    def __init__(self, marking: Marking | None = None):
        """`marking` belongs to flat views, whose samples can be marked."""
        self._marking, self._view = marking, None
        with ui.column().classes("flex-1 min-w-0 w-full gap-0") as self._column:
            self._title = ui.label().classes("text-sm")

    def show(self, figure: dict[str, Any] | None, words: str = "", title: str = "") -> None:
        """Show a figure with `words` for screen readers, and a `title` above it."""
        self._title.set_text(title)
        self._title.set_visibility(bool(title))
        self._column.set_visibility(figure is not None)
        if figure is None:
            return
        before = self._view
        with self._column:
            figure = self._marking.markable(figure) if self._marking else figure
            self._view = draw_figure(figure, words, before)
        if self._marking and before is None:
            self._marking.follow(self._view)

    def clear(self) -> None:
        """Forget the figure, so that the next one keeps nothing of its axes."""
        if self._view is not None:
            self._view.delete()
            self._view = None
