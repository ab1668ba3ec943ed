"""The workbench: a bench without a browser, the guard at the door, and the page in a real one."""

import asyncio
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.session.session import Session

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
LONG = 240.0  # s that anything may take on a busy machine


@pytest.fixture
def folder(tmp_path):
    Session.new(tmp_path / "s", read_model(MODEL), [BAG], fitting=FitOptions(hold_out=0.5))
    return tmp_path / "s"


def until(condition, what):
    end = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.05)


# ------------------------------------------------------------------ without a browser


@pytest.mark.wide
def test_a_bench_takes_steps_beside_and_shows_what_came_out(folder):
    from parallel_cal.workbench.bench import Bench

    bench = Bench(folder)  # nothing is kept yet: it looks by itself
    until(lambda: not bench.busy, "the first look")
    assert bench.view["verdict"]["colour"] == "grey"
    version = bench.version
    bench.begin("fit")
    bench.begin("fit")  # one step at a time: nothing
    until(lambda: not bench.busy, "fit")
    assert bench.version > version
    assert bench.view["verdict"]["words"].startswith("one effect missing: backlash")
    assert bench.view["verdict"]["colour"] == "amber"
    assert bench.session.state.verdict.startswith("explained")
    bench.save()
    assert bench.message == f"written: {folder / 'model.yaml'}"
    bench.begin("add", "thermal_expansion")
    until(lambda: not bench.busy, "add")
    assert bench.failed
    assert "does not fall" in bench.message
    bench.begin("add", "backlash")
    until(lambda: bench.stage not in ("", "starting"), "its first word")
    bench.cancel()
    until(lambda: not bench.busy, "the end")
    assert bench.message == "cancelled; the session is as it was"
    assert bench.session.state.step == "fit"
    again = Bench(folder)  # what was looked at is kept
    assert not again.busy
    assert again.view == bench.view
    again.at_once("undo")
    assert again.session.state.step == "begin"
    until(lambda: not again.busy, "the kept view")
    bench.follow()
    assert bench.session.state.step == "begin"


def asked(headers, token="", query=b"", kind="http"):
    """The status that a guard answers, 200 where it lets in."""
    from parallel_cal.workbench.server import LOOPBACK, Guard

    sent = []

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        sent.append(message)

    raw = [(k.encode(), v.encode()) for k, v in headers.items()]
    scope = {"type": kind, "headers": raw, "query_string": query}
    asyncio.run(Guard(app, LOOPBACK, token)(scope, None, send))
    return sent[0]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"host": "127.0.0.1:8080"}, 200),
        ({"host": "localhost:8080", "origin": "http://localhost:8080"}, 200),
        ({"host": "evil.example"}, 403),
        ({"host": "127.0.0.1:8080", "origin": "http://evil.example"}, 403),
        ({"host": "127.0.0.1:8080", "origin": "null"}, 403),
        ({}, 403),
    ],
)
def test_a_foreign_host_or_origin_is_refused(headers, status):
    assert asked(headers)["status"] == status
    if status == 403:
        assert asked(headers, kind="websocket")["type"] == "websocket.close"


def test_where_a_token_is_asked_for_nobody_comes_in_without():
    here = {"host": "127.0.0.1"}
    assert asked(here, token="secret")["status"] == 403
    assert asked(here, token="secret", query=b"token=wrong")["status"] == 403
    first = asked(here, token="secret", query=b"token=secret")
    assert first["status"] == 200
    cookie = dict(first["headers"])[b"set-cookie"].decode().split(";")[0]
    assert asked(here | {"cookie": cookie}, token="secret")["status"] == 200


def test_the_command_says_what_it_lacks(tmp_path, capsys):
    from parallel_cal.cli.main import main

    for arguments, words in (
        (["workbench", str(tmp_path)], "no session in this folder"),
        (["workbench", MODEL, BAG, "--host", "0.0.0.0"], "give a --token"),
        (["workbench", MODEL, "--session", str(tmp_path / "n")], "at least one recording"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 1
        assert words in capsys.readouterr().err


# ------------------------------------------------------------------ in a browser


class Served:
    """`parallel-cal workbench` as a person starts it."""

    def __init__(self, folder, output):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"
        code = "import sys; from parallel_cal.cli.main import main; main(sys.argv[1:])"
        given = [MODEL, BAG, "--session", folder, "-o", output, "--port", self.port, "--no-open"]
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, "workbench", *map(str, given)],
            stderr=subprocess.DEVNULL,
            env={k: v for k, v in os.environ.items() if k != "PYTEST_CURRENT_TEST"},
        )
        until(self._answers, "the server's first answer")

    def _answers(self):
        assert self.process.poll() is None
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", self.port)) == 0

    def end(self, how=signal.SIGTERM):
        self.process.send_signal(how)
        self.process.wait(60)


@pytest.fixture
def browser():
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
        one = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield one
        one.close()


@pytest.mark.wide
def test_the_whole_loop_on_the_page(browser, tmp_path):
    folder, output = tmp_path / "s", tmp_path / "robot.yaml"
    served, asked_for = Served(folder, output), set()
    try:
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1000 * LONG)
        page.on("request", lambda request: asked_for.add(request.url.split("/")[2]))
        page.goto(served.url)
        page.get_by_text("Where it fails").wait_for()

        page.get_by_role("button", name="Fit", exact=True).click()
        page.locator("#verdict").get_by_text("one effect missing: backlash").wait_for()
        fitted = page.locator("header").inner_text()
        assert "606 µm" in fitted

        # Brush half of the map: as many samples are marked in the table.
        plot = page.get_by_role("img", name="rms residual").locator(".nsewdrag").first
        plot.scroll_into_view_if_needed()
        box = plot.bounding_box()
        page.mouse.move(box["x"] + 2, box["y"] + 2)
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] - 2, steps=5)
        page.mouse.up()
        page.locator("#marked").get_by_text(re.compile(r"^\d+ samples marked")).wait_for()
        marked = int(page.locator("#marked").inner_text().split()[0])
        assert 10 < marked < 84
        along = page.get_by_role("img", name="residual of x against")
        faint = along.locator(".scatterlayer path.point[style*='opacity: 0.35']")
        until(lambda: faint.count() == 94 - marked, "the same samples marked in the other view")

        other = browser.new_page()
        other.set_default_timeout(1000 * LONG)
        other.goto(served.url)
        other.locator("#verdict").get_by_text("one effect missing").wait_for()

        page.get_by_role("button", name="add backlash").click()
        page.locator("#verdict").get_by_text("down to their noise").wait_for()
        other.locator("#verdict").get_by_text("down to their noise").wait_for()
        assert page.locator("header").inner_text() != fitted
        assert "backlash" in page.locator("#budget").inner_text()
        page.get_by_role("button", name="Save", exact=True).click()
        page.locator("#message").get_by_text("written").wait_for()
        assert "backlash" in [effect.name for effect in read_model(output).effects]

        page.get_by_role("button", name="Undo", exact=True).click()
        page.locator("#verdict").get_by_text("one effect missing").wait_for()
        page.get_by_label("new branch from here").fill("careful")
        page.get_by_role("button", name="Branch", exact=True).click()
        page.get_by_role("cell", name="careful").wait_for()
        page.get_by_role("checkbox").nth(1).click()
        page.locator("#marked").get_by_text("1 samples marked").wait_for()
        page.get_by_label("reason").fill("bumped")
        page.get_by_role("button", name="Exclude", exact=True).click()
        page.get_by_text("is left out: bumped").wait_for()
        assert asked_for == {f"127.0.0.1:{served.port}"}  # nothing leaves the machine

        served.end(signal.SIGKILL)
        session = Session(folder)
        assert set(session.record.branches) == {"main", "careful"}
        assert list(session.state.excluded.values()) == ["bumped"]
        served = Served(folder, output)
        page.goto(served.url)
        page.get_by_text("is left out: bumped").wait_for()
        page.get_by_role("button", name="Fit", exact=True).click()
        page.get_by_role("button", name="Cancel", exact=True).click()
        page.locator("#message").get_by_text("cancelled").wait_for()
        assert Session(folder).state == session.state
    finally:
        served.end()


def test_views_are_kept_as_plain_data(tmp_path):
    from parallel_cal.workbench.bench import VERSION, kept

    class Kept:
        folder = tmp_path

        class state:
            number = 3

    assert kept(Kept) is None
    (tmp_path / "views").mkdir()
    whole = {"version": VERSION, "view": {"tiles": []}}
    Path(tmp_path / "views" / "3.json").write_text(json.dumps(whole))
    assert kept(Kept) == {"tiles": []}
    older = whole | {"version": VERSION - 1}
    Path(tmp_path / "views" / "3.json").write_text(json.dumps(older))
    assert kept(Kept) is None
    Path(tmp_path / "views" / "3.json").write_text("{ half")
    assert kept(Kept) is None
