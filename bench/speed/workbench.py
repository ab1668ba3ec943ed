"""The workbench in Chromium: `python -m bench.speed.workbench [--samples N ...]`.

From the command to a useful page, from a step to its verdict, and every interaction: the longest of
three, from the act of a person to the last change on the page. The other columns are the processor
time of the server with its worker, that of the browser, and what the browser received, all since
the command or the click. 94 are the samples of bags/delta_backlash, any other number is
simulated. Without --samples, the recording is timed. On a busy machine, put `chrt -r 1` before the
command: it then has most of a core. With --recordings FOLDER, the simulated samples are kept there,
and used again.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).parents[2]

from workbench_page import Served, opened

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.diagnosis.verdict_words import VERDICT_LABELS
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.simulate import simulate, stated_noise
from parallel_cal.workbench.kept_pictures import EARLIER

MODEL, BAG = REPOSITORY / "config" / "delta_mockup_nominal.yaml", "bags/delta_backlash"
SAMPLES_OF_BAG, MAX_SAMPLES_PER_RECORDING = 94, 10_000
PATIENCE_MS, REPEATS = 1_800_000, 3
TABS = ("joints, round", "sides", "uncertainty", "joints")
# Notes when a person acts, and when the page last changed what it shows.
WATCH = """() => {
  const shown = ".js-plotly-plot, table, #marked, #verdict-words, #headline";
  for (const kind of ["mouseup", "click"])
    addEventListener(kind, () => { window.acted = performance.now() }, { capture: true });
  new MutationObserver(changes => {
    const parts = changes.map(({ target }) => target.closest ? target : target.parentElement);
    if (parts.some(part => part?.closest(shown)))
      requestAnimationFrame(() => setTimeout(() => { window.changed = performance.now() }));
  }).observe(document.body,
             { subtree: true, childList: true, attributes: true, characterData: true });
}"""
# Notes when the numbers of the verdict are first painted, in ms: while figures are drawn, which
# comes next, the page answers nobody.
NUMBERS = """new MutationObserver((changes, observer) => {
  if (!document.querySelector('[aria-label="Errors"] dd')?.innerText) return;
  observer.disconnect();
  requestAnimationFrame(() => setTimeout(() => { window.painted = Date.now() }));
}).observe(document, { subtree: true, childList: true, characterData: true })"""
SETTLED = "() => acted && changed > acted && performance.now() - changed > 1500"


@dataclass(frozen=True)
class Row:
    """Seconds that a person waits, processor seconds of the server and its worker, and of the
    browser, and the MB that the browser received, all since the same act."""

    name: str
    seconds: float
    serving: float = math.nan
    drawing: float = math.nan
    received: float = math.nan


class Meter:
    """What the server's processes and the browser used since the last `reset` (from /proc)."""

    def __init__(self, page: Any) -> None:
        self.server, self.received, self.peak = 0, 0.0, 0.0
        network = page.context.new_cdp_session(page)
        network.send("Network.enable")
        network.on("Network.dataReceived", lambda e: self._add(e["encodedDataLength"]))
        network.on(
            "Network.webSocketFrameReceived", lambda e: self._add(len(e["response"]["payloadData"]))
        )
        self.reset()

    def _add(self, size: int) -> None:
        self.received += size * 1e-6

    def reset(self) -> None:
        self.began, self.received = time.perf_counter(), 0.0
        self._before = self._processor_times()

    def row(self, name: str, seconds: float | None = None) -> Row:
        """The row of what was used; `seconds` of waiting, by default since `reset`."""
        serving, drawing = self._processor_times()
        waited = time.perf_counter() - self.began if seconds is None else seconds
        return Row(
            name, waited, serving - self._before[0], drawing - self._before[1], self.received
        )

    def _processor_times(self) -> tuple[float, float]:
        served = _descendants(self.server) if self.server else []
        self.peak = max([self.peak, sum(map(_peak_memory, served))])
        others = set(_descendants(os.getpid())) - {os.getpid(), *served}
        return sum(map(_processor_time, served)), sum(map(_processor_time, others))


def _descendants(process: int) -> list[int]:
    found = [process]
    for one in found:
        for tasks in Path(f"/proc/{one}/task").glob("*/children"):
            found += map(int, tasks.read_text().split())
    return found


def _processor_time(process: int) -> float:
    """Processor seconds of a process and of its children that have ended."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _peak_memory(process: int) -> float:
    """The largest memory (MB) that a process had."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(one.split()[1]) / 1024 for one in lines if one.startswith("VmHWM"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="+", default=[SAMPLES_OF_BAG], metavar="N")
    parser.add_argument("--recordings", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    for count in given.samples:
        with tempfile.TemporaryDirectory() as folder, opened() as browser:
            kept = given.recordings or Path(folder)
            recordings = write_recordings(count, kept / str(count))
            heads = ("time [s]", "server [s]", "browser [s]", "received [MB]")
            print(f"\n{f'workbench, {count} samples':48}", *(f"{name:>14}" for name in heads))
            for row in time_page(browser, Path(folder) / "session", recordings):
                used = (row.seconds, row.serving, row.drawing, row.received)
                shown = (f"{'' if math.isnan(x) else f'{x:.2f}':>14}" for x in used)
                print(f"{row.name:48}", *shown, flush=True)


def write_recordings(count: int, folder: Path) -> list[Path]:
    """Write the samples of a robot with backlash; simulated ones in recordings of the same poses,
    each with noise of its own."""
    if count == SAMPLES_OF_BAG:
        return [REPOSITORY / BAG]
    model, parts = read_model(MODEL), math.ceil(count / MAX_SAMPLES_PER_RECORDING)
    files = [folder / f"samples_{k}.json" for k in range(parts)]
    if all(file.exists() for file in files):
        return files
    folder.mkdir(parents=True, exist_ok=True)
    # To simulate the streams of a recording takes longer than to diagnose it.
    true = simulate(model, count // parts, effects=["backlash"], quiet=True).dataset()
    noise, rng = stated_noise(model), np.random.default_rng(0)
    joint = replace(model, noise=noise).joint_noise
    for k, file in enumerate(files):
        turns = rotation_matrix(noise.orientation * rng.standard_normal(true.r.shape))
        noisy = replace(
            true,
            q=true.q + joint * rng.standard_normal(true.q.shape),
            r=true.r + noise.position * rng.standard_normal(true.r.shape),
            R=turns @ true.R,
            sha256=f"{k:064x}",
        )
        noisy.to_json(file)
    return files


def time_page(browser: Any, session: Path, recordings: list[Path]) -> Iterator[Row]:
    page = browser.new_page(viewport={"width": 1280, "height": 1000})  # a person's is open already
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(NUMBERS)
    meter, began = Meter(page), time.time()
    served = Served(MODEL, *recordings, "--session", session)
    meter.server = served.process.pid
    try:
        page.goto(served.url, wait_until="commit")
        page.wait_for_function("() => window.painted")
        painted = page.evaluate("() => window.painted / 1000")
        yield meter.row("command to the first numbers", painted - began)
        page.get_by_role("figure", name="the machine and its errors").locator("canvas").wait_for()
        yield meter.row("command to the machine and its errors")
        page.locator("#stage").wait_for(state="hidden")
        _rest(page)
        yield meter.row("command to all samples")
        yield from _time_step(page, meter, "Fit", "fit", VERDICT_LABELS["explained"])
        yield from _time_interactions(page)
        yield from _time_step(
            page, meter, "add backlash", "add backlash", VERDICT_LABELS["at_noise"]
        )
        yield Row(f"peak memory of the server and its worker: {meter.peak:.0f} MB", math.nan)
    finally:
        served.end()


def _time_step(page: Any, meter: Meter, button: str, name: str, verdict: str) -> Iterator[Row]:
    """Time a step: numbers of a part of many samples, a picture, then the verdict, of a part and of
    all."""
    meter.reset()
    page.get_by_role("button", name=button, exact=True).click()
    _wait_for(page, f"preliminary {name}|{name}:")
    yield meter.row(f"{name} to the first numbers")
    _rest(page)
    page.get_by_text(EARLIER).wait_for(state="hidden")
    _rest(page)
    yield meter.row(f"{name} to its first pictures")
    _wait_for(page, verdict)
    yield meter.row(f"{name} to the verdict")
    page.locator("#stage").wait_for(state="hidden")
    yield meter.row(f"{name} to the verdict of all samples")
    _rest(page)


def _time_interactions(page: Any) -> Iterator[Row]:
    page.evaluate(WATCH)
    # Figures out of sight are drawn when somebody scrolls to them.
    page.get_by_role("region", name="Where it fails").scroll_into_view_if_needed()
    page.get_by_role("figure", name="rms residual").locator(".point").first.wait_for()

    def longest(name: str, *acts: Callable[[], object]) -> Row:
        return Row(name, max(_time(page, act) for act in acts))

    press = {name: page.get_by_role("button", name=name, exact=True) for name in ("Undo", "Redo")}
    rows = page.get_by_role("region", name="Samples").get_by_role("checkbox")
    heading = page.get_by_role("region", name="Samples").locator("th.sortable").first
    tabs = [page.get_by_role("tab", name=name, exact=True).click for name in TABS]
    yield longest("brush in a view", *[lambda k=k: _brush(page, k) for k in range(REPEATS)])
    yield longest("mark a row of the table, unmark it", *[rows.nth(1).click] * 2 * REPEATS)
    yield longest("sort the table", *[heading.click] * REPEATS)
    yield longest("change the tab", *tabs)
    yield longest("choose in the menu against", *[lambda k=k: _choose(page, k) for k in (2, 1, 0)])
    yield longest("undo, redo", *[press["Undo"].click, press["Redo"].click] * REPEATS)


def _brush(page: Any, part: int) -> None:
    """Drag a box over a part of the map of residuals, beside the boxes of the other parts."""
    plot = page.get_by_role("figure", name="rms residual").locator(".nsewdrag").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    width = box["width"] / REPEATS
    left, low = box["x"] + width * part, box["y"] + box["height"] - 5
    page.mouse.move(left + 5, box["y"] + 5)
    page.mouse.down()
    page.mouse.move(left + width - 5, low, steps=5)
    page.mouse.up()


def _choose(page: Any, option: int) -> None:
    page.get_by_label("against", exact=True).click()
    page.get_by_role("option").nth(option).click()


def _time(page: Any, act: Callable[[], object]) -> float:
    """Seconds from a person's act to the last change that it makes on the page."""
    _rest(page)
    page.evaluate("() => { window.acted = window.changed = 0 }")
    act()
    page.wait_for_function(SETTLED, polling=300)
    return float(page.evaluate("() => changed - acted")) * 1e-3


def _wait_for(page: Any, words: str) -> None:
    """Wait until the word or the sentences of the verdict match."""
    matches = """words => [...document.querySelectorAll("#verdict, #verdict-words")]
      .some(part => part.innerText.match(words))"""
    page.wait_for_function(matches, arg=words or ".")


def _rest(page: Any) -> None:
    """Wait until the page has nothing left to draw."""
    page.evaluate("() => new Promise(done => requestIdleCallback(() => done()))")


if __name__ == "__main__":
    main()
