"""The workbench in Chromium: from the command to a useful page, a step, brushing."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

from playwright.sync_api import sync_playwright
from timing import Row, seconds_each, show

from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.simulate import simulate
from parallel_cal.session.session import Session

FOUND, REPEATS = "missing: backlash", 3
MODEL, POSES = Path(__file__).parents[1] / "config" / "delta_mockup_nominal.yaml", 150
PATIENCE = 120_000  # ms
DRAWN = """() => document.querySelector('[aria-label^="rms residual"]')?._fullLayout"""
WATCH = """() => {
  const views = [...document.querySelectorAll('.js-plotly-plot')].filter(view => view._fullLayout);
  const drawn = view => new Promise(done => view.once("plotly_afterplot", done));
  window.drawnAnew = Promise.all(views.map(drawn)).then(() => undefined);
}"""
MARK = """count => {
  const drawn = document.querySelector('[aria-label^="rms residual"]');
  const points = [...Array(count).keys()].map(i => ({pointIndex: i, customdata: i}));
  const views = [...document.querySelectorAll('.js-plotly-plot')]
    .filter(view => view._fullLayout && view.data.some(trace => trace.customdata));
  // By what is seen: every other point has faded.
  const seen = view => view.calcdata.filter(one => one[0].trace.customdata).every(one =>
    [...one[0].node3.node().querySelectorAll("path.point")]
      .filter(point => point.style.opacity < 0.5).length == one.length - count);
  const begin = performance.now();
  drawn.emit("plotly_selected", {points: points});
  return new Promise(done => {
    const look = () => views.every(seen) ? done(performance.now() - begin)
                                         : requestAnimationFrame(look);
    look();
  });
}"""


def main() -> None:
    model = read_model(MODEL)
    folder = Path(tempfile.mkdtemp())
    try:
        made = simulate(model, POSES, effects=["backlash"], seed=1)
        made.dataset().to_json(folder / "samples.json")
        dataset = load_dataset(folder / "samples.json", joints=model.joints)
        whole = Row("fit() of 150 poses", seconds_each(lambda: fit(model, dataset), least=1))
        session = Session.new(
            folder / "s", model, [folder / "samples.json"], fitting=FitOptions(hold_out=0.25)
        )
        session.fit()
        show("workbench, 150 poses", [whole, *_on_the_page(folder / "s")])
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _on_the_page(folder: Path) -> list[Row]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "parallel_cal.cli", "workbench", folder, "--no-open"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium") or shutil.which("chromium-browser"),
            args=["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"],
        )
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(PATIENCE)
        begin = time.perf_counter()
        served = subprocess.Popen([*map(str, command), "--port", str(port)])
        try:
            _until_answered(port)
            page.goto(f"http://127.0.0.1:{port}/", wait_until="commit")
            page.locator("#verdict").wait_for()
            rows = [Row("from the command to the first paint", time.perf_counter() - begin)]
            page.wait_for_function(DRAWN)
            rows.append(Row("... to where the model fails", time.perf_counter() - begin))
            page.locator("#verdict").get_by_text(FOUND).wait_for()
            rows.append(Row("... to what is missing", time.perf_counter() - begin))
            _rest(page)
            brushed = median(page.evaluate(MARK, k) for k in range(10, 60, 10))
            rows.append(Row("brushing: the marks in every view", brushed * 1e-3))
            again = []
            for _ in range(REPEATS):
                _step(page, "Undo", "not identified yet")
                again.append(_step(page, "Fit", "running the diagnosis"))
                page.locator("#verdict").get_by_text(FOUND).wait_for()
                _rest(page)
            rows.append(Row("re-fit, and every view drawn anew", median(again)))
            return rows
        finally:
            served.terminate()
            served.wait()


def _step(page: Any, button: str, words: str) -> float:
    """Seconds from the click until the header says so and every view has been drawn anew."""
    page.evaluate(WATCH)
    begin = time.perf_counter()
    page.get_by_role("button", name=button, exact=True).click()
    page.locator("#verdict").get_by_text(words).wait_for()
    page.evaluate("() => window.drawnAnew")
    took = time.perf_counter() - begin
    _rest(page)
    return took


def _rest(page: Any) -> None:
    """Until the page has nothing left to draw."""
    page.evaluate("() => new Promise(done => requestIdleCallback(() => done()))")


def _until_answered(port: int) -> None:
    while True:
        with socket.socket() as one, suppress(OSError):
            one.connect(("127.0.0.1", port))
            return
        time.sleep(0.01)


if __name__ == "__main__":
    main()
