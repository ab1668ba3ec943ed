"""The workbench in Chromium: `python -m bench.speed.workbench [--samples N ...]`.

From the command to a useful page, from a step to its verdict, and every interaction: the longest of
three, from the act of a person to the last change on the page. 94 are the samples of
bags/delta_backlash, any other number is simulated. Without --samples, the recording is timed. On a
busy machine, put `chrt -r 1` before the command: it then has most of a core.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

REPOSITORY = Path(__file__).parents[2]

from workbench_page import Served, opened

from parallel_cal.diagnosis.verdict_words import VERDICT_LABELS
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.simulate import simulate

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
    name: str
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="+", default=[SAMPLES_OF_BAG], metavar="N")
    for count in parser.parse_args().samples:
        with tempfile.TemporaryDirectory() as folder, opened() as browser:
            recordings = write_recordings(count, Path(folder))
            table = Table("what", "time [s]", title=f"workbench, {count} samples")
            for row in time_page(browser, Path(folder) / "session", recordings):
                table.add_row(row.name, f"{row.seconds:.2f}")
        Console().print(table)


def write_recordings(count: int, folder: Path) -> list[Path]:
    """Write the samples of a robot with backlash; simulated ones in parts, to save memory."""
    if count == SAMPLES_OF_BAG:
        return [REPOSITORY / BAG]
    model, parts = read_model(MODEL), math.ceil(count / MAX_SAMPLES_PER_RECORDING)
    files = [folder / f"samples_{k}.json" for k in range(parts)]
    for seed, file in enumerate(files):
        poses = count // parts
        simulate(model, poses, seed, effects=["backlash"]).dataset().to_json(file)
    return files


def time_page(browser: Any, session: Path, recordings: list[Path]) -> Iterator[Row]:
    page = browser.new_page(viewport={"width": 1280, "height": 1000})  # a person's is open already
    page.set_default_timeout(PATIENCE_MS)
    page.add_init_script(NUMBERS)
    begin, began = time.perf_counter(), time.time()
    served = Served(MODEL, *recordings, "--session", session)
    try:
        page.goto(served.url, wait_until="commit")
        page.wait_for_function("() => window.painted")
        painted = page.evaluate("() => window.painted / 1000")
        yield Row("command to the first numbers", painted - began)
        page.get_by_role("figure", name="the machine and its errors").locator("canvas").wait_for()
        yield Row("command to the machine and its errors", time.perf_counter() - begin)
        _rest(page)
        yield from _time_step(page, "Fit", "fit", VERDICT_LABELS["explained"])
        yield from _time_interactions(page)
        yield from _time_step(page, "add backlash", "add backlash", VERDICT_LABELS["at_noise"])
    finally:
        served.end()


def _time_step(page: Any, button: str, name: str, verdict: str) -> Iterator[Row]:
    """Time a step: numbers of a part of many samples, then the verdict, of a part and of all."""
    begin = time.perf_counter()
    page.get_by_role("button", name=button, exact=True).click()
    yield _until(f"{name} to the first numbers", page, f"preliminary {name}|{name}:", begin)
    yield _until(f"{name} to the verdict", page, verdict, begin)
    page.locator("#stage").wait_for(state="hidden")
    yield Row(f"{name} to the verdict of all samples", time.perf_counter() - begin)
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


def _until(name: str, page: Any, words: str, begin: float) -> Row:
    """Seconds until the word or the sentences of the verdict match."""
    matches = """words => [...document.querySelectorAll("#verdict, #verdict-words")]
      .some(part => part.innerText.match(words))"""
    page.wait_for_function(matches, arg=words or ".")
    return Row(name, time.perf_counter() - begin)


def _rest(page: Any) -> None:
    """Wait until the page has nothing left to draw."""
    page.evaluate("() => new Promise(done => requestIdleCallback(() => done()))")


if __name__ == "__main__":
    main()
