"""The nodes at the robot: their streams, the samples as they come, the model that they serve."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from nicegui import run, ui

from parallel_cal.reporting.colours import MEASURED, QUIET
from parallel_cal.workbench.bench import Bench, Live
from parallel_cal.workbench.campaign_card import CampaignBar, CampaignCard
from parallel_cal.workbench.widgets import COLOURS, card, draw_figure, make_chart, table

POLL_INTERVAL_S = 1.0  # s between two looks at the nodes
ERROR_WINDOW_S = 60  # s of errors that are shown
MARKS = {"ok": "✓", "warn": "!", "error": "✗", "stale": "?"}  # colour alone tells nothing
COLUMNS = {
    "level": "",
    "node": "node",
    "what": "what",
    "rate": "rate [Hz]",
    "received": "received",
    "lost": "lost",
    "late": "p99 [ms]",
    "said": "says",
}


class LiveCard:
    """Looked at again and again, drawn once: what is new is put into what is there."""

    def __init__(self, bench: Bench, live: Live, bar: CampaignBar | None):
        """`bar` is the campaign's part of the header."""
        self.bench, self.live, self.bar = bench, live, bar
        with card("Live"):
            self.trouble = (
                ui.label().props("id=trouble role=alert").style(f"color: {COLOURS['amber']}")
            )
            self.model = ui.label().props("id=served")
            with ui.row().classes("items-center"):
                self.samples = ui.label().props("id=collected aria-live=polite")
                self.take = ui.button("Take samples", on_click=self._take).props("dense")
                with self.take:
                    ui.tooltip("use what calibration_node has collected in this session")
            self.warnings = ui.label().classes("text-sm").style(f"color: {COLOURS['amber']}")
            self.streams = table([*COLUMNS.items()], [], "name").props("aria-label=streams")
            figure = make_chart(
                {"title": {"text": "s ago"}, "range": [-ERROR_WINDOW_S, 0]},
                "error [µm]",
                mode="markers",
                marker={"color": MEASURED, "size": 4},
            )
            self.error = ui.label().classes("text-sm").props("id=live-error")
            self.chart = draw_figure(figure, "error of the poses measured, over time")
            self.dropped = ui.expansion("nothing was dropped").classes("w-full")
        self.campaign = CampaignCard(live)
        self._said: list[Any] = []
        ui.timer(POLL_INTERVAL_S, self._update)
        self._update()

    def _update(self) -> None:
        told = self.live.snapshot()
        self.trouble.set_text(" ".join(told["trouble"]))
        self.trouble.set_visibility(bool(told["trouble"]))
        self.model.set_text(self._describe_served_model(told["model"]))
        samples = told["samples"]
        count = samples.get("samples", 0)
        said = f"{count} samples"
        last = samples.get("last_event", "")
        self.samples.set_text(said if last in ("", said) else f"{said}; {last}")
        self.take.set_enabled(bool(count) and not self.bench.busy)
        self.warnings.set_text("; ".join(samples.get("warnings", [])))
        self.streams.rows = [
            {
                **{k: s.get(k, "") for k in COLUMNS},
                "name": f"{s['node']} {s['what']}",
                "level": f"{MARKS[s['level']]} {s['level']}",
            }
            for s in told["streams"]
        ]
        self.streams.update()
        self._draw_errors(told["errors"])
        self._list_dropped(told["dropped"])
        self.campaign.show(told["campaign"])
        if self.bar is not None:
            self.bar.show(told["campaign"])

    def _describe_served_model(self, model: dict[str, Any]) -> str:
        if not model.get("hash"):
            return f"no model is served: {model.get('reason') or 'nobody has said so yet'}"
        same = model["hash"] == self.bench.hash
        when = datetime.fromtimestamp(model["since"]).strftime("%H:%M:%S")
        effects = f" ({', '.join(model['effects'])})" if model["effects"] else ""
        is_this = "the model of this state" if same else "another model than this state's"
        failed = "" if model["ok"] else f"; the last attempt failed: {model['reason']}"
        return f"the robot uses {model['hash'][:12]}{effects} since {when}: {is_this}{failed}"

    def _draw_errors(self, errors: list[tuple[float, float]]) -> None:
        shown = [(t, 1e6 * e) for t, e in errors if t > -ERROR_WINDOW_S]
        trace = self.chart.figure["data"][0]
        trace["x"], trace["y"] = [round(t, 2) for t, _ in shown], [round(e, 1) for _, e in shown]
        if not shown:
            self.error.set_text("no pose is measured and predicted at once")
        else:
            mean = sum(e for _, e in shown) / len(shown)
            self.error.set_text(f"measured minus predicted, in the last minute: mean {mean:.0f} µm")
        self.chart.set_visibility(bool(shown))
        if shown:
            self.chart.update()

    def _list_dropped(self, dropped: list[Any]) -> None:
        if dropped == self._said:
            return
        self._said = dropped
        self.dropped.set_text(f"{sum(one['count'] for one in dropped)} dropped")
        self.dropped.clear()
        with self.dropped:
            for one in dropped[-50:]:
                ui.label(f"{one['time']:.1f} s: {one['reason']} {one['detail']}").style(
                    f"color: {QUIET}"
                ).classes("text-sm")

    async def _take(self) -> None:
        await run.io_bound(self.bench.take)
