"""The part of the page for a robot: topics of the nodes, arriving samples, model in use."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Any

from nicegui import run, ui

from parallel_cal.reporting.colours import MEASURED, QUIET
from parallel_cal.workbench.bench import Bench, Live
from parallel_cal.workbench.campaign_card import CampaignCard
from parallel_cal.workbench.widgets import AMBER, card, draw_figure, make_chart, table

POLL_INTERVAL_S = 1.0  # s between two polls of the nodes
ERROR_WINDOW_S = 60  # s of errors that are shown
MARKS = {"ok": "✓", "warn": "!", "error": "✗", "stale": "?"}  # readable without colours
COLUMNS = {
    "level": "state",
    "node": "node",
    "what": "stream",
    "rate": "rate [Hz]",
    "received": "received",
    "lost": "lost",
    "late": "delay, p99 [ms]",
    "said": "message",
}


class LiveCard:
    """The card Live; drawn once and then updated in place."""

    def __init__(self, bench: Bench, live: Live, follow: Callable[[dict[str, Any]], None]):
        """Call `follow` with the status of the campaign whenever the nodes are polled."""
        self.bench, self.live, self._follow = bench, live, follow
        self.campaign = CampaignCard(live)
        with card("Live"):
            self.trouble = ui.label().props("id=trouble role=alert").style(f"color: {AMBER}")
            self.model = ui.label().props("id=served")
            with ui.row().classes("items-center"):
                self.samples = ui.label().props("id=collected aria-live=polite")
                self.take = ui.button("Take samples", on_click=self._take).props("dense outline")
                with self.take:
                    ui.tooltip("add the samples that calibration_node has collected to the session")
            self.warnings = ui.label().classes("text-sm").style(f"color: {AMBER}")
            self.streams = table([*COLUMNS.items()], [], "name").props("aria-label=streams")
            figure = make_chart(
                {"title": {"text": "time [s]"}, "range": [-ERROR_WINDOW_S, 0]},
                "error [µm]",
                mode="markers",
                marker={"color": MEASURED, "size": 4},
            )
            self.error = ui.label().classes("text-sm").props("id=live-error")
            self.chart = draw_figure(figure, "error of the measured poses over time")
            self.dropped = ui.expansion("no dropped messages").classes("w-full")
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
        self._follow(told["campaign"])

    def _describe_served_model(self, model: dict[str, Any]) -> str:
        if not model.get("hash"):
            return f"no model in use: {model.get('reason') or 'no status received yet'}"
        same = model["hash"] == self.bench.hash
        when = datetime.fromtimestamp(model["since"]).strftime("%H:%M:%S")
        effects = f" ({', '.join(model['effects'])})" if model["effects"] else ""
        is_this = "the model of this state" if same else "another model than that of this state"
        failed = "" if model["ok"] else f"; the last attempt failed: {model['reason']}"
        return f"the robot uses {model['hash'][:12]}{effects} since {when}: {is_this}{failed}"

    def _draw_errors(self, errors: list[tuple[float, float]]) -> None:
        shown = [(t, 1e6 * e) for t, e in errors if t > -ERROR_WINDOW_S]
        trace = self.chart.figure["data"][0]
        trace["x"], trace["y"] = [round(t, 2) for t, _ in shown], [round(e, 1) for _, e in shown]
        if not shown:
            self.error.set_text("no error: no pose was both measured and predicted")
        else:
            mean = sum(e for _, e in shown) / len(shown)
            self.error.set_text(f"position error in the last minute: mean {mean:.0f} µm")
        self.chart.set_visibility(bool(shown))
        if shown:
            self.chart.update()

    def _list_dropped(self, dropped: list[Any]) -> None:
        if dropped == self._said:
            return
        self._said = dropped
        count = sum(one["count"] for one in dropped)
        self.dropped.set_text(f"{count} dropped message{'' if count == 1 else 's'}")
        self.dropped.clear()
        with self.dropped:
            for one in dropped[-50:]:
                ui.label(f"{one['time']:.1f} s: {one['reason']} {one['detail']}").style(
                    f"color: {QUIET}"
                ).classes("text-sm")

    async def _take(self) -> None:
        await run.io_bound(self.bench.take)
