"""The fleet's page: what it says is what the rows say, and robots lead to their reports."""

import re
import shutil
from html import unescape

import fleets
import pytest
import virtual_fleet as vf

from parallel_cal.fleet.findings import findings
from parallel_cal.fleet.fleet import Fleet
from parallel_cal.fleet.jobs import FleetOptions, jobs_of
from parallel_cal.fleet.judging import judge_recording
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.reporting.fleet_page import LIBRARY, robot_page, write_fleet_page
from parallel_cal.reporting.fleets import format_fleet

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRAWS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
NAMES = ("a <b>", "c/d", "e", "f")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four robots, one of them twice; a fifth whose recording failed; the first has a report."""
    path = tmp_path_factory.mktemp("page")
    asked = FleetOptions(effects=("backlash",))
    jobs = jobs_of(fleets.written(path, vf.drawn(1), 2, n_poses=24, n_replicates=4))
    first, shown = judge_recording(jobs[0], asked, "0", robot_page)
    later = judge_recording(jobs[1], asked, "1")[0] | {"robot": "e"}
    rows = [first | {"robot": name} for name in NAMES] + [later]
    rows.append({"robot": "z", "recording": "y", "inputs": "2", "reason": "cut <short>"})
    (path / "reports").mkdir()
    (path / "reports" / "a%20%3Cb%3E.html").write_text(shown)
    drawing = read_model(fleets.NOMINAL)
    fleet = Fleet(tuple(rows), findings(rows, drawing))
    write_fleet_page(fleet, path)
    return path, fleet


def part(text, name):
    return re.search(rf'<section id="{name}">.*?</section>', text, flags=re.DOTALL).group()


@pytest.mark.wide
def test_the_page_has_every_robot_and_why_a_recording_failed(folder):
    path, fleet = folder
    text = (path / "fleet.html").read_text()
    assert "5 robots, 6 recordings" in text
    assert "_" not in part(text, "verdicts")  # words, not the keys of a document
    robots = part(text, "robots-by-error")
    rows = [unescape(cell) for cell in re.findall(r'data-label="robot"[^>]*>(.*?)</td>', robots)]
    assert sorted(re.sub("<a.*?>|</a>", "", row) for row in rows) == sorted(NAMES)
    assert 'href="reports/a%2520%253Cb%253E.html"' in robots
    assert robots.count("href=") == 1
    assert "cut &lt;short&gt;" in part(text, "failed")
    assert "backlash: in 4 of 4 robots" in part(text, "findings")
    assert "failed: z y: cut <short>" in format_fleet(fleet)


@pytest.mark.wide
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_robots_link_opens_its_report_with_its_pictures(folder):
    playwright = pytest.importorskip("playwright.sync_api")
    path, _ = folder
    assert (path / "reports" / LIBRARY).stat().st_size > 1e6
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=DRAWS)
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        wrong = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(f"file://{path}/fleet.html")
        page.locator(".plot .plotly").first.wait_for()
        page.get_by_role("link", name="a <b>").click()
        page.locator(".plot .plotly").first.wait_for()
        assert "delta54 on" in page.title()
        assert not wrong
        browser.close()
