"""Colours and widgets that all parts of the page use."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any

from nicegui import ui

from parallel_cal.reporting.blocks import DIGITS, Judgement
from parallel_cal.reporting.colours import BAND, QUIET
from parallel_cal.reporting.markup import chip
from parallel_cal.reporting.readable import MISSING

AMBER = "#9a6700"
AXIS = {"gridcolor": BAND, "zerolinecolor": QUIET}
FIGURE_LAYOUT = {
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"color": QUIET},
    "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": QUIET},
    "template": {
        "layout": {
            "xaxis": AXIS,
            "yaxis": AXIS,
            # A translucent line is invisible in space on a light ground.
            "scene": dict.fromkeys(("xaxis", "yaxis", "zaxis"), AXIS | {"gridcolor": QUIET}),
        }
    },
}
# Width [px] from which the page has two columns, and width up to which the header omits numbers
# and figures stand one below the other.
TWO_COLUMNS_PX, NARROW_PX = 1600, 767
STACKED_PX = 839  # width up to which the verdict is below the machine
# The utility classes that the page uses, with Tailwind's names and values. Tailwind itself rewrites
# its style sheet whenever an element appears, and the browser then computes all styles again.
UTILITIES = """
@layer base {
  *, ::before, ::after { box-sizing: border-box }
  html { line-height: 1.5 }
  svg, canvas { display: block; vertical-align: middle }
}
@layer utilities {
  .w-full { width: 100% }
  .w-24 { width: 6rem }
  .w-28 { width: 7rem }
  .w-32 { width: 8rem }
  .w-36 { width: 9rem }
  .w-40 { width: 10rem }
  .w-48 { width: 12rem }
  .w-64 { width: 16rem }
  .max-w-2xl { max-width: 42rem }
  .max-w-4xl { max-width: 56rem }
  .max-w-5xl { max-width: 64rem }
  .min-w-0 { min-width: 0 }
  .mx-auto { margin-inline: auto }
  .gap-0 { gap: 0 }
  .gap-1 { gap: 0.25rem }
  .gap-2 { gap: 0.5rem }
  .gap-3 { gap: 0.75rem }
  .gap-x-2 { column-gap: 0.5rem }
  .gap-x-3 { column-gap: 0.75rem }
  .gap-x-4 { column-gap: 1rem }
  .gap-y-0 { row-gap: 0 }
  .gap-y-1 { row-gap: 0.25rem }
  .justify-between { justify-content: space-between }
  .items-start { align-items: flex-start }
  .items-center { align-items: center }
  .items-end { align-items: flex-end }
  .flex-1 { flex: 1 1 0% }
  .grow { flex-grow: 1 }
  .shrink { flex-shrink: 1 }
  .shrink-0 { flex-shrink: 0 }
  .basis-0 { flex-basis: 0 }
  .basis-64 { flex-basis: 16rem }
  .text-xs { font-size: 0.75rem; line-height: 1rem }
  .text-sm { font-size: 0.875rem; line-height: 1.25rem }
  .text-base { font-size: 1rem; line-height: 1.5rem }
  .text-lg { font-size: 1.125rem; line-height: 1.75rem }
  .leading-tight { line-height: 1.25 }
  .font-bold { font-weight: 700 }
  .break-all { word-break: break-all }
  .whitespace-nowrap { white-space: nowrap }
  .shadow { box-shadow: 0 1px 3px 0 rgb(0 0 0 / 0.1), 0 1px 2px -1px rgb(0 0 0 / 0.1) }
  .truncate { overflow: hidden; text-overflow: ellipsis; white-space: nowrap }
}
"""
# The style of the chip and the tiles, which the report has, too.
BLOCKS = files("parallel_cal.reporting").joinpath("blocks.css").read_text(encoding="utf-8")
CSS = f"""
:root {{ --nicegui-default-gap: 0.75rem }}
.q-header, .q-footer {{ background: #fff; color: #1f2328 }}
.q-header {{ padding: 4px 16px }}
.q-footer {{ padding: 6px 16px; border-top: 1px solid #d0d7de }}
.quiet {{ opacity: 0.75 }}
/* Numbers without room beside the verdict wrap to a second line, which is not shown. */
.judged {{ display: flex; flex-wrap: wrap; column-gap: 12px; height: 28px; overflow: hidden }}
.judged > * {{ height: 28px }}
.judged > .said {{ max-width: 100% }}
.nicegui-content {{ padding: 12px 16px }}
.first {{ display: grid; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); gap: 12px;
  width: 100%; align-items: stretch }}
.machine {{ width: 100%; height: clamp(220px, calc(100vh - 290px), 640px) }}
.falling {{ width: 100%; flex: 1 1 160px; min-height: 160px; position: relative }}
.machine > *, .falling > * {{ height: 100% }}
.falling > * {{ position: absolute }}
.stages {{ padding: 0 8px }}
.strip {{ grid-column: 1 / -1; display: flex; flex-wrap: wrap; gap: 2px 24px }}
.remarks {{ margin: 0; padding-left: 1.5em; list-style: disc }}
.chip .badge {{ font-size: 0.875rem; margin-right: 8px }}
.tiles {{ gap: 8px; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)) }}
.tiles dl {{ padding: 8px 12px }}
.tiles dd {{ font-size: 20px }}
.tiles dd + dd {{ font-size: 16px }}
.steps {{ margin: 0; padding-left: 1.5em; list-style: decimal }}
@media (max-width: {STACKED_PX}px) {{
  .first {{ grid-template-columns: minmax(0, 1fr) }}
  .machine {{ height: clamp(180px, 30vh, 400px) }} }}
.columns {{ display: grid; grid-template-columns: minmax(0, 1fr); gap: 12px; width: 100%;
  align-items: start }}
.columns > .rest {{ display: contents }}
@media (min-width: {TWO_COLUMNS_PX}px) {{
  .columns.paired {{ display: flow-root }}
  .columns.paired > :not(.rest), .columns.paired > .rest > * {{ float: left; clear: left;
    width: calc(50% - 6px); margin-bottom: 12px }}
  .columns.paired > .right, .columns.paired > .rest > :nth-child(even) {{ float: right;
    clear: right }} }}
@media (max-width: {TWO_COLUMNS_PX - 1}px) {{ .headline-about {{ display: none }} }}
@media (max-width: {NARROW_PX}px) {{
  .headline {{ display: none }}
  .side-by-side {{ flex-wrap: wrap }} }}
.candidate {{ display: grid; grid-template-columns: auto minmax(0, 1fr) auto; gap: 0 12px;
  align-items: start; width: 100% }}
.candidate > .wide {{ grid-column: 1 / -1 }}
.one-line-rows td {{ white-space: nowrap }}
.wide-table {{ overflow-x: auto }}
.wide-table .q-table__middle {{ overflow: visible }}
.wide-table::-webkit-scrollbar {{ height: 12px }}
.wide-table::-webkit-scrollbar-thumb {{ background: {QUIET}; border-radius: 6px }}
.q-table--dense :is(th, td) {{ padding: 4px 6px; font-variant-numeric: tabular-nums }}
.q-table th {{ vertical-align: bottom; position: relative }}
.q-table th .q-table__sort-icon--left {{ position: absolute }}
.q-btn {{ text-transform: none }}
.q-btn--dense {{ padding: 2px 8px }}
.q-btn--standard.disabled {{ --q-primary: #6e7781 }}
.amber {{ color: {AMBER} }}
.body--dark .amber {{ color: #d29922 }}
.js-plotly-plot :is([class$=tick], .textpoint, .infolayer, .legend) text {{
  fill: currentColor !important }}
#popup {{ top: 0; bottom: auto; left: 50%; transform: translateX(-50%); margin: 4px;
  padding: 12px 48px; color: #fff; background: #9a3412; white-space: nowrap }}
.skip-link {{ position: absolute; left: -999rem; top: 4px; z-index: 1; padding: 4px 12px;
  background: inherit }}
.skip-link:focus {{ left: 16px }}
:is(a, button, input, [tabindex]):focus-visible {{ box-shadow: 0 0 0 3px #3b7dd8 !important }}
#plan {{ scroll-margin-top: calc(var(--header-height, 40px) + 12px) }}
#plan:focus {{ outline: none; box-shadow: none !important }}
#content {{ max-width: 2200px }}
#content:focus {{ outline: none; box-shadow: none !important }}
.q-header.at-robot {{ z-index: 7000 }}
body:has(.q-header.at-robot) :is(.q-dialog__inner, .q-dialog__backdrop) {{
  top: var(--header-height, 0px) }}
body:has(.q-header.at-robot) .q-dialog__inner > div {{ max-height: 100% }}
.body--dark :is(.q-header, .q-footer) {{ background: #1d1d1d; color: #e6edf3 }}
.body--dark .q-footer {{ border-color: #444c56 }}
.body--dark .q-btn--outline, .body--dark .q-btn--flat, .body--dark .skip-link {{
  --q-primary: #7fc0f0 }}
"""
# At a robot a dialog begins below the header, so that STOP stays within reach.
HEADER_HEIGHT = """<script>
function followHeaderHeight() {
  const header = document.querySelector(".q-header");
  const tell = () => document.documentElement.style.setProperty(
    "--header-height", header.offsetHeight + "px");
  new ResizeObserver(tell).observe(header);
}
</script>"""
# Fetch Plotly while the measurements are read, before there is something to draw.
HEAD = """<script>document.documentElement.lang = "en"</script>
<script type="module">import("nicegui-plotly").catch(() => undefined)</script>"""
CHECKBOX = '<q-checkbox dense v-model="props.selected" :aria-label="{words}" />'
MAX_SHORT_CELL = 18  # letters of a cell that is not broken into lines
HEADING = "role=heading aria-level=2"
FIGURE_MARGIN = {"t": 28, "r": 12, "l": 52, "b": 44}  # the toolbar fits into the top one


def card(title: str) -> Any:
    """Make a region of the page with its heading."""
    made = ui.card().classes("w-full gap-2").props(f'role=region aria-label="{title}"')
    with made:
        ui.label(title).classes("text-base font-bold").props(HEADING)
    return made


class Chip:
    """The word of a verdict on a colour of its own, as in the report; hidden if there is none."""

    def __init__(self) -> None:
        self._place = ui.element().classes("chip shrink-0")

    def show(self, verdict: dict[str, Any]) -> None:
        self._place.clear()
        self._place.set_visibility("word" in verdict)
        if "word" in verdict:
            words = "preliminary: " if verdict.get("is_preliminary") else ""
            with self._place:
                said = Judgement(verdict["word"], words + verdict["label"], verdict["words"])
                ui.html(chip(said), sanitize=False)


# A number without its last zeros sorts; the digits that it was rounded to are shown.
SHOW_DIGITS = f"(value, row) => row[{{field}} + {DIGITS!r}] ?? value ?? {MISSING!r}"


def table(columns: list[tuple[str, str]], rows: list[dict[str, Any]], key: str, **how: Any) -> Any:
    """Make a table of (field, heading) columns, sortable by each, with numbers on the right."""
    shown = [
        {
            "name": field,
            "label": label,
            "field": field,
            "align": "right" if _is_of_numbers(rows, field) else "left",
            "sortable": True,
            # where all cells are short enough for one line, as `10.95 ± 0.30 µm`
            "style": "white-space: nowrap"
            if all(len(str(row.get(field, ""))) <= MAX_SHORT_CELL for row in rows)
            else "",
            ":format": SHOW_DIGITS.format(field=json.dumps(field)),
        }
        for field, label in columns
    ]
    made = ui.table(columns=shown, rows=rows, **({"row_key": key} | how))
    if "selection" in how:
        made.add_slot("header-selection", CHECKBOX.format(words="'mark all'"))
        made.add_slot("body-selection", CHECKBOX.format(words="'mark ' + props.key"))
    return made.classes("w-full").props("dense flat wrap-cells")


def _is_of_numbers(rows: list[dict[str, Any]], field: str) -> bool:
    values = [row[field] for row in rows if row.get(field) is not None]
    return bool(values) and all(isinstance(value, (int, float)) for value in values)


def make_chart(across: dict[str, Any], up: str, **look: Any) -> dict[str, Any]:
    """Make a low figure with one empty trace; its vertical axis begins at zero."""
    return {
        "data": [{"type": "scatter", "x": [], "y": [], **look}],
        "layout": {
            "height": 200,
            "margin": {"t": 8, "r": 12, "l": 52, "b": 36},
            "xaxis": across,
            "yaxis": {"title": {"text": up}, "rangemode": "tozero"},
        },
        "config": {"displaylogo": False, "displayModeBar": False},
    }


def draw_figure(figure: dict[str, Any], words: str, before: Any = None) -> Any:
    """Draw a figure in the page's colours, with a description for screen readers.

    Updating the figure `before` takes a tenth of the time of a new one.
    """
    kept = {"uirevision": words}  # keeps zoom and camera
    config = {"displaylogo": False} | figure.get("config", {})
    layout = figure["layout"] | FIGURE_LAYOUT | kept
    # NiceGUI watches every number of a list for changes, but not those of a tuple.
    figure = figure | {"data": tuple(figure["data"]), "layout": layout, "config": config}
    if before is None:
        before = ui.plotly(figure).classes("w-full")
    else:
        before.update_figure(figure)
    before.props["role"], before.props["aria-label"] = "figure", words
    return before
