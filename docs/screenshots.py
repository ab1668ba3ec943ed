"""Make the screenshots of the documentation: `python docs/screenshots.py [NAME ...] [--to FOLDER]`.

NAME is one or more of workbench, law, live, tolerance and power; all but power by default, because
its 212 sessions take half an hour on two cores. `workbench` makes four pictures; `live` needs
ROS 2. The pictures go to docs/, or to FOLDER. Chromium and the packages of `make venv` must be
installed.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY / "test" / "helpers"))

from workbench_page import Served, opened

MODEL = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
BAG = REPOSITORY / "bags" / "delta_backlash"
LAW_BAG = REPOSITORY / "bags" / "delta_crosstalk"
FIRST_SCREEN = {"width": 1280, "height": 620}
TIMEOUT_MS = 240_000  # for a step on a busy computer
# Live is pictured once 40 or more of the 94 samples are collected; a busy page may skip a number.
ENOUGH_SAMPLES = re.compile(r"^[4-9]\d samples")
# The heading of the candidates appears at this height, below the header that is always in view.
SCROLL_TO_CANDIDATES = """() => {
  const card = document.querySelector('[aria-label="What is missing"]');
  window.scrollBy(0, card.getBoundingClientRect().top - 56);
}"""


def open_page(browser: Any, url: str, height: int, width: int = 1280) -> Any:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(TIMEOUT_MS)
    page.goto(url)
    return page


def wait_until_drawn(page: Any) -> None:
    """Wait until the page has no plot left to draw and no message left to fade."""
    page.wait_for_timeout(3000)
    page.evaluate("() => new Promise(done => requestIdleCallback(() => done()))")


def show_workbench(browser: Any, work: Path, folder: Path) -> None:
    """Take pictures after a fit of a recording with backlash: first_screen.png and
    first_screen_dark.png (of the README), workbench.png and workbench_pattern.png."""
    served = Served(MODEL, BAG, "--session", work / "session")
    try:
        page = open_page(browser, served.url, 1000)
        page.get_by_role("button", name="Fit", exact=True).click()
        page.locator("#verdict-words").get_by_text("backlash").wait_for()
        wait_until_drawn(page)
        page.screenshot(path=folder / "workbench.png")
        page.set_viewport_size(FIRST_SCREEN)
        for scheme, name in (("dark", "first_screen_dark"), ("light", "first_screen")):
            page.emulate_media(color_scheme=scheme)
            wait_until_drawn(page)
            page.screenshot(path=folder / f"{name}.png")
        page.set_viewport_size({"width": 1280, "height": 1000})
        candidates = page.get_by_role("region", name="What is missing")
        candidates.get_by_text("pattern", exact=False).first.click()
        wait_until_drawn(page)
        page.evaluate(SCROLL_TO_CANDIDATES)
        wait_until_drawn(page)
        page.screenshot(path=folder / "workbench_pattern.png")
    finally:
        served.end()


def show_law(browser: Any, work: Path, folder: Path) -> None:
    """Take workbench_law.png: the law of an error that no effect of the catalogue describes."""
    served = Served(MODEL, LAW_BAG, "--session", work / "law")
    try:
        page = open_page(browser, served.url, 1000)
        page.get_by_role("button", name="Fit", exact=True).click()
        page.get_by_role("button", name="Find its law", exact=True).click()
        page.locator("#law").wait_for()
        wait_until_drawn(page)
        page.get_by_role("region", name="Law of the error").screenshot(
            path=folder / "workbench_law.png"
        )
    finally:
        served.end()


def show_live(browser: Any, work: Path, folder: Path) -> None:
    """Take workbench_live.png while the nodes receive a recording at three times real time."""
    from ros_helpers import NodeProcess

    from parallel_cal.nodes.client import use_private_domain

    use_private_domain()
    served = Served("--ros", MODEL, "--session", work / "live", "--namespace", "cell")
    try:
        page = open_page(browser, served.url, 1000)
        page.locator("#served").get_by_text("the model of this state").wait_for()
        replay = NodeProcess("replay_node", work, "/cell", bag=str(BAG), rate=3.0)
        page.locator("#live-error").get_by_text("mean").wait_for()
        page.locator("#collected").get_by_text(ENOUGH_SAMPLES).wait_for()
        page.get_by_role("region", name="Live").screenshot(path=folder / "workbench_live.png")
        replay.ended(TIMEOUT_MS / 1000)
    finally:
        served.end()


def show_study(browser: Any, work: Path, folder: Path, kind: str, height: int) -> None:
    """Take study_KIND.png: the top of the page that `study KIND` writes."""
    plan = work / "plan.csv"
    run("plan", MODEL, "--poses", 40, "--seed", 1, "-o", plan)
    inputs = (MODEL, "--plan", plan) if kind == "tolerance" else (plan, MODEL)
    run("study", kind, *inputs, "-o", work / kind)
    page = open_page(browser, (work / kind / f"{kind}.html").as_uri(), height, width=1100)
    wait_until_drawn(page)
    page.screenshot(path=folder / f"study_{kind}.png")


def run(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "parallel_cal.cli", *map(str, arguments)], check=True)


PICTURES: dict[str, Callable[[Any, Path, Path], None]] = {
    "workbench": show_workbench,
    "law": show_law,
    "live": show_live,
    "tolerance": lambda *places: show_study(*places, kind="tolerance", height=1000),
    "power": lambda *places: show_study(*places, kind="power", height=770),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    names = [name for name in PICTURES if name != "power"]
    parser.add_argument("names", nargs="*", choices=[*PICTURES, []], default=names, metavar="NAME")
    parser.add_argument("--to", type=Path, default=REPOSITORY / "docs", metavar="FOLDER")
    given = parser.parse_args()
    given.to.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work, opened() as browser:
        for name in given.names:
            PICTURES[name](browser, Path(work), given.to)


if __name__ == "__main__":
    main()
