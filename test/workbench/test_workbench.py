"""The workbench: a bench without a browser, the guard at the door, and the page in a real one."""

import asyncio
import json
import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from threading import Event

import numpy as np
import pytest
import virtual_findings as vf
from findings import hiding
from workbench_page import LONG, Served, command, opened, until

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.reporting.readable import write_micro
from parallel_cal.session.history import SessionError
from parallel_cal.session.known_columns import remember_columns
from parallel_cal.session.session import Session

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"


@pytest.fixture
def folder(tmp_path):
    Session.new(tmp_path / "s", read_model(MODEL), [BAG], fitting=FitOptions(hold_out=0.5))
    return tmp_path / "s"


# ------------------------------------------------------------------ without a browser


@pytest.mark.wide
def test_a_bench_takes_steps_beside_and_shows_what_came_out(folder):
    from parallel_cal.workbench.bench import Bench

    bench = Bench(folder)  # nothing is kept yet: it looks by itself
    until(lambda: not bench.working, "the first look")
    assert "word" not in bench.view["verdict"]  # nothing is judged
    version = bench.version
    bench.begin("fit")
    bench.begin("fit")  # one step at a time: nothing
    until(lambda: not bench.busy, "fit")
    assert bench.version > version
    verdict = bench.view["verdict"]
    assert (verdict["word"], verdict["label"]) == ("explained", "explained, not yet in the model")
    assert verdict["words"].startswith("Backlash or hysteresis accounts for")
    state = bench.session.state
    assert state.verdict == "explained"
    # The page and the history have the same sentences.
    told = write_micro(state.summary).lower()
    assert all(
        words.rstrip(".").lower() in told for words in (verdict["words"], *verdict["remarks"])
    )
    bench.save()
    until(lambda: not bench.busy, "Save")
    assert (
        "the verdict on this model is explained, not yet in the model: backlash"
        in bench.question.words
    )
    assert not bench.output.exists()
    bench.save(bench.question.key)
    until(lambda: not bench.busy, "Save")
    assert bench.message == f"written: {folder / 'model.yaml'}"
    bench.begin("add", "thermal_expansion")
    until(lambda: not bench.busy, "add")
    assert "does not fall" in bench.question.words  # it may be forced, with a reason
    bench.begin("add", "backlash")
    until(lambda: bench.stage not in ("", "starting"), "its first word")
    bench.cancel()
    until(lambda: not bench.busy, "the end")
    assert bench.message == "cancelled; the session is unchanged"
    assert bench.session.state.step == "save to model.yaml, forced"
    again = Bench(folder)  # what was looked at is kept
    assert not again.working
    assert again.view == bench.view
    again.run_now("undo")
    again.run_now("undo")
    assert again.session.state.step == "begin"
    until(lambda: not again.working, "the kept view")
    bench.follow()
    assert bench.session.state.step == "begin"


class SlowLooks:
    """A worker whose looks last until nobody wants them and they are `released`, and whose steps
    are done at once."""

    def __init__(self):
        self.begun, self.released = [], Event()
        self.released.set()

    def work(self, function, folder, step, *given, tell, wanted):
        from parallel_cal.base.worker import WorkCancelled
        from parallel_cal.workbench.bench import Done

        self.begun.append(step)
        if step == "look":
            tell("reading", 0.5, {"verdict": "preliminary"})
            until(lambda: not wanted() and self.released.is_set(), "the end of the look")
            tell("running the diagnosis", 0.5, {"verdict": "of another state"})
            raise WorkCancelled
        return Done(f"{step} is done")

    def end(self):
        pass


def test_a_step_ends_a_look_and_follows_it(folder):
    from parallel_cal.workbench.bench import Bench

    worker = SlowLooks()
    bench = Bench(folder, worker=worker)
    until(lambda: bench.stage == "reading", "the first look")
    assert bench.working
    assert not bench.busy
    bench.begin("fit")
    until(lambda: bench.message == "fit is done", "the fit")
    assert worker.begun == ["look", "fit"]
    # What the look found when it was no longer wanted is not shown.
    assert bench.view == {"verdict": "preliminary"}
    assert not bench.working


def test_a_step_that_waits_for_the_end_of_a_look_can_be_cancelled(folder):
    from parallel_cal.workbench.bench import Bench

    worker = SlowLooks()
    worker.released.clear()
    bench = Bench(folder, worker=worker)
    until(lambda: bench.stage == "reading", "the first look")
    bench.begin("fit")
    bench.cancel()
    worker.released.set()
    until(lambda: not bench.working, "the end")
    assert bench.message == "cancelled; the session is unchanged"
    assert worker.begun == ["look"]


def test_a_look_at_another_state_begins_anew_and_an_owner_can_cancel_it(folder):
    from parallel_cal.workbench.bench import Bench

    worker = SlowLooks()
    bench = Bench(folder, worker=worker)
    until(lambda: bench.stage == "reading", "the first look")
    bench.run_now("start_branch", "other")
    until(lambda: worker.begun == ["look", "look"] and bench.stage == "reading", "another look")
    assert bench.view == {"verdict": "preliminary"}
    assert bench.message == ""
    bench.cancel()
    until(lambda: not bench.working, "the end")
    assert bench.message == "cancelled; the session is unchanged"
    assert worker.begun == ["look", "look"]


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


def test_where_a_token_is_required_no_one_enters_without_it():
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
    ):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 1
        assert words in capsys.readouterr().err


def test_a_session_that_the_command_starts_shows_its_numbers_without_reading_again(
    tmp_path, monkeypatch
):
    from parallel_cal.cli.workbench import _create_session
    from parallel_cal.workbench import bench

    folder = tmp_path / "s"
    _create_session(folder, Path(MODEL), [Path(BAG)], FitOptions(), None)
    monkeypatch.setattr("parallel_cal.session.session.load_sessions", None)
    bench._work(folder, "look", (), {}, tell=lambda *told: None)
    assert "94 samples" in bench.load_view(Session(folder))["counts"]


def test_a_view_is_parsed_once_and_again_if_its_file_changes(folder):
    from parallel_cal.workbench import bench

    session, file = Session(folder), bench.view_path(Session(folder))
    bench._store_view(file, {"tiles": [1]})
    first = bench.load_view(session)
    assert bench.load_view(session) is first
    os.utime(file, ns=(0, 0))
    bench._store_view(file, {"tiles": [2]})
    assert bench.load_view(session) == {"tiles": [2]}


def test_nicegui_does_not_watch_the_numbers_of_a_figure():
    from nicegui import Client, ui

    from parallel_cal.workbench.widgets import draw_figure, make_chart

    with Client(ui.page("/figure")):
        figure = draw_figure(make_chart({}, "error [µm]"), "a figure")
    assert type(figure.props["options"]["data"][0]["x"]) is list  # no observed list


def test_a_port_in_use_is_refused_before_a_session_is_made(tmp_path, capsys):
    from parallel_cal.cli.main import main

    folder = tmp_path / "s"
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(SystemExit) as ended:
            main(["workbench", MODEL, BAG, "--session", str(folder), "--port", str(port)])
    assert ended.value.code == 1
    words = capsys.readouterr().err
    assert f"--port {port}: the server cannot listen there (Address already in use)" in words
    assert "choose another port by --port" in words
    assert not folder.exists()


@pytest.mark.wide
def test_a_second_server_of_a_session_is_refused_and_a_dead_one_leaves_no_lock(folder, tmp_path):
    first = Served(folder)
    try:
        answer = subprocess.run(
            command(folder, port=first.port + 1), capture_output=True, text=True, timeout=LONG
        )
        assert answer.returncode == 1
        said = f"{folder}: process {first.process.pid} at {first.url} serves this session already"
        assert said in answer.stderr
        assert "Traceback" not in answer.stderr
    finally:
        first.end(signal.SIGKILL)
    log = (tmp_path / "log").open("w")
    again = Served(folder, log=log)
    again.end()
    assert "already" not in (tmp_path / "log").read_text()


def test_a_session_that_cannot_be_written_says_so(folder):
    session = Session(folder)
    (folder / ".lock").unlink(missing_ok=True)
    (folder / ".lock").mkdir()  # as on a read-only disk, where tests by root could write
    with pytest.raises(
        SessionError, match=r"cannot be changed \(Is a directory\); make its folder"
    ):
        session.start_branch("other")


# ------------------------------------------------------------------ in a browser


@pytest.fixture(scope="module")
def chromium():
    with opened() as one:
        yield one


@pytest.fixture
def browser(chromium):
    """The browser of all tests of this file; what a test opened in it is closed."""
    yield chromium
    for context in chromium.contexts:
        context.close()


@pytest.mark.wide
def test_the_whole_loop_on_the_page(browser, tmp_path):
    folder, output = tmp_path / "s", tmp_path / "robot.yaml"
    served, asked_for = Served(MODEL, BAG, "--session", folder, "-o", output), set()
    try:
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1000 * LONG)
        page.on("request", lambda request: asked_for.add(request.url.split("/")[2]))
        said = []
        page.on("console", lambda one: said.append(one.text) if one.type == "error" else None)
        page.goto(served.url)
        page.get_by_text("Where it fails").wait_for()

        page.get_by_role("button", name="Fit", exact=True).click()
        page.locator("#verdict-words").get_by_text("backlash or hysteresis").wait_for()
        fitted = page.locator("header").inner_text()
        assert "606 ± 11 µm" in fitted
        page.get_by_role("cell", name="606 ± 11 µm").wait_for()  # before the fit, in the history

        # Brush half of the map while another window takes a step: as many are marked in the table.
        other = browser.new_page()
        other.set_default_timeout(1000 * LONG)
        other.goto(served.url)
        other.locator("#verdict").get_by_text("explained, not yet in the model").wait_for()
        rms = page.get_by_role("figure", name="rms residual")
        rms.scroll_into_view_if_needed()
        rms.locator(".scatterlayer path.point").first.wait_for()  # a figure is drawn when in sight
        box = rms.locator(".nsewdrag").first.bounding_box()
        page.mouse.move(box["x"] + 2, box["y"] + 2)
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
        other.get_by_role("button", name="Undo", exact=True).click()
        page.locator("#verdict").get_by_text("explained, not yet in the model").wait_for(
            state="detached"
        )
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] - 2, steps=5)
        page.mouse.up()
        page.locator("#marked").get_by_text(re.compile(r"^\d+ samples marked")).wait_for()
        marked = int(page.locator("#marked").inner_text().split()[0])
        assert 10 < marked < 84
        along = page.get_by_role("figure", name="residual of x against")
        faint = along.locator(".scatterlayer path.point[style*='opacity: 0.35']")
        until(lambda: faint.count() == 94 - marked, "the same samples marked in the other view")
        other.get_by_role("button", name="Redo", exact=True).click()
        page.locator("#verdict").get_by_text("explained, not yet in the model").wait_for()

        page.get_by_role("button", name="add backlash", exact=True).click()
        page.locator("#verdict-words").get_by_text("down to the noise").wait_for()
        other.locator("#verdict-words").get_by_text("down to the noise").wait_for()
        assert page.locator("header").inner_text() != fitted
        assert "backlash" in page.locator("#budget").inner_text()
        page.locator("#budget").hover()
        page.locator(".q-tooltip").get_by_text("A part removes").wait_for()
        assert not said
        # What the samples do not tell stays on the page, in the verdict and beside the effect.
        verdict = page.locator("#verdict-words").text_content()
        assert re.search(
            r"Backlash or hysteresis: .* \d+ planned poses would (not yet )?tell", verdict
        )
        assert page.locator(".ambiguous").inner_text() == "or hysteresis: the samples do not tell"
        page.get_by_role("button", name="Save", exact=True).click()
        page.locator("#message").get_by_text("written").wait_for()
        assert "backlash" in [effect.name for effect in read_model(output).effects]

        page.get_by_role("button", name="Undo", exact=True).click()
        page.locator("#verdict").get_by_text("explained, not yet in the model").wait_for()
        page.get_by_label("name of new branch").fill("careful")
        page.get_by_role("button", name="Branch", exact=True).click()
        page.get_by_role("cell", name="careful").wait_for()
        page.get_by_role("region", name="Samples", exact=True).get_by_role("checkbox").nth(
            1
        ).click()
        page.locator("#marked").get_by_text("1 sample marked").wait_for()
        page.get_by_label("reason").fill("bumped")
        page.get_by_role("button", name="Exclude", exact=True).click()
        page.get_by_text("is excluded: bumped").wait_for()
        assert asked_for == {f"127.0.0.1:{served.port}"}  # nothing leaves the machine

        served.end(signal.SIGKILL)
        session = Session(folder)
        assert set(session.record.branches) == {"main", "careful"}
        assert list(session.state.excluded.values()) == ["bumped"]
        served = Served(MODEL, BAG, "--session", folder, "-o", output)
        page.goto(served.url)
        page.get_by_text("is excluded: bumped").wait_for()
        page.get_by_role("button", name="Fit", exact=True).click()
        page.get_by_role("button", name="Cancel", exact=True).click()
        page.locator("#message").get_by_text("cancelled").wait_for()
        last, said = Session(folder).state, page.locator("#message").inner_text()
        # The fit is quicker than a click may be: what is said of it is true.
        assert (last.number == session.state.number) == ("the session is unchanged" in said)
        assert session.state.number in (last.number, last.parent)
    finally:
        served.end()


def camera(page, branch):
    """Where the view of a branch's residuals is seen from, rounded."""
    figure = page.get_by_role("figure", name=f"residuals of {branch}")
    eye = figure.evaluate("figure => figure._fullLayout.scene._scene.getCamera().eye")
    return [round(eye[k], 3) for k in "xyz"]


@pytest.mark.wide
def test_everything_else_on_the_page_and_no_serious_fault_of_access(browser, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    bag = tmp_path / "bag"
    shutil.copytree(BAG, bag)
    folder = tmp_path / "s"
    session = Session.new(folder, read_model(MODEL), [bag], fitting=FitOptions(hold_out=0.5))
    session.fit()
    session.start_branch("beside")
    served = Served(folder)

    def faults(page):
        # NiceGUI shows the loading bar of its framework, which is no part of the page.
        outside = {"exclude": [[".q-loading-bar"]]}
        found = axe.run(page, context=outside).response["violations"]
        return [
            (one["id"], one["nodes"][0]["html"][:200])
            for one in found
            if one["impact"] in ("serious", "critical")
        ]

    try:
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1000 * LONG)
        page.goto(served.url)
        page.locator("#verdict-words").get_by_text("backlash or hysteresis").wait_for()
        assert "AP" in page.locator("#iso").inner_text()
        counts = page.locator("#counts").inner_text()
        assert "rms at 94 samples of 74 held-out poses" in counts
        assert re.search(r"chi2/dof 1\.\d\d, 0\.\d\d to 1\.\d\d for a complete model", counts)
        page.get_by_text("1 warning", exact=True).click()
        page.get_by_text("the residuals are larger than the stated noise").wait_for()
        shown = page.get_by_role("figure", name="backlash: residual of joint1 against")
        for _ in range(5):  # a click may meet a row that is drawn anew
            page.get_by_text("Show pattern").first.click()
            with suppress(playwright.TimeoutError):
                shown.wait_for(timeout=1000 * LONG / 5)
                break
        shown.wait_for(timeout=1000)
        for name, words in (("sides", "from three sides"), ("uncertainty", "1-sigma ellipses")):
            page.get_by_role("tab", name=name).click()
            page.get_by_role("figure", name=words).wait_for()
        assert faults(page) == []

        page.get_by_role("region", name="Samples", exact=True).get_by_role("checkbox").nth(
            1
        ).click()
        page.locator("#marked").get_by_text("1 sample marked").wait_for()
        page.get_by_role("button", name="Open", exact=True).click()
        page.get_by_role("figure", name="readings of sample").wait_for()
        page.get_by_role("button", name="Close", exact=True).click()

        page.get_by_role("spinbutton", name="poses").fill("8")
        page.get_by_role("button", name="Plan", exact=True).click()
        page.get_by_role("figure", name="planned and measured poses").wait_for()
        page.get_by_text("After a calibration at these 8 poses alone").wait_for()
        with page.expect_download() as download:
            page.get_by_role("button", name=f"download {Session(folder).state.number}.csv").click()
        lines = Path(download.value.path()).read_text().splitlines()
        table = [line for line in lines if not line.startswith("#")]
        assert table[0].startswith("x [m],y [m],z [m],qx,qy,qz,qw,joint1 [rad]")
        assert len(table) == 9
        # The poses that the diagnosis plans decide between two effects.
        with page.expect_download() as download:
            page.get_by_role("button", name="download distinguish_effects.csv").click()
        text = Path(download.value.path()).read_text()
        assert re.search(r"# \d+ planned poses .* the robot has backlash or hysteresis", text)
        assert "past.joint1 [rad]" in text
        assert "Drive to the joints past.* first" in text

        number = Session(folder).state.number
        page.get_by_role("button", name="Certificate", exact=True).click()
        page.get_by_label("Limit of position [µm]").fill("fifty")
        page.get_by_label("Serial number of the robot").fill("D-0042")
        page.get_by_role("button", name="Save fields").click()
        page.locator("#certificate-problem").get_by_text("expected a positive number").wait_for()
        page.get_by_label("Limit of position [µm]").fill("50")
        page.get_by_role("button", name="Save fields").click()
        page.get_by_label("Serial number of the robot").wait_for(state="hidden")
        page.get_by_role("button", name="Report", exact=True).click()
        with page.expect_download() as download:
            page.get_by_role("button", name=f"Download report_{number}.html").click()
        assert "<dd>D-0042</dd>" in Path(download.value.path()).read_text()

        before = Session(folder).state
        row = page.get_by_role("row").filter(has_text="chain1.Lb")
        row.get_by_role("checkbox").click()
        page.get_by_role("button", name="Fix marked", exact=True).click()
        page.locator("#consequence").get_by_text("counts as exactly known").wait_for()
        page.get_by_role("radio", name="values that were measured").click()
        page.get_by_label("chain1.Lb [mm]", exact=True).fill("240.25")
        page.get_by_role("button", name="Fix and fit again", exact=True).click()
        until(lambda: Session(folder).state != before, "the parameter held")
        assert "chain1.Lb" in Session(folder).options.fix
        assert Session(folder).state.step == "fix chain1.Lb at measured values"
        assert Session(folder).model.value("chain1.Lb") == pytest.approx(0.24025)
        number = Session(folder).state.number
        until((folder / "views" / f"{number}.json").exists, "a look at what is left")

        page.locator("#stage").wait_for(state="hidden")  # the page is drawn anew until then
        time.sleep(1)
        page.get_by_role("button", name="Compare", exact=True).click()
        page.get_by_text("Compare branches").wait_for()
        page.get_by_role("figure", name="residuals of beside").wait_for()
        page.get_by_role("figure", name="residuals of main").wait_for()
        turn = page.get_by_role("figure", name="residuals of main").locator("canvas").first
        before = camera(page, "beside")

        def are_equal():
            return before != camera(page, "beside") == camera(page, "main")

        def both_turned():
            if not are_equal():  # a view that is still being drawn neither turns nor follows
                box = turn.bounding_box()
                page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
                page.mouse.down()
                page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 3, steps=5)
                page.mouse.up()
                time.sleep(1)
            return are_equal()

        until(
            both_turned,
            "the other view to turn as far",
        )
        page.keyboard.press("Escape")

        narrow = browser.new_page(viewport={"width": 800, "height": 900}, color_scheme="dark")
        narrow.set_default_timeout(1000 * LONG)
        narrow.goto(served.url)
        narrow.get_by_text("Where it fails").wait_for()
        wide = narrow.evaluate("document.documentElement.scrollWidth")
        assert wide <= 800
        assert faults(narrow) == []

        shutil.rmtree(bag)  # what is lost meanwhile is said, and nothing else is
        state = Session(folder).state
        served.end()
        served = Served(folder)
        page.goto(served.url)
        page.get_by_role("button", name="Fit", exact=True).click()
        page.locator("#message").get_by_text("bag").wait_for()
        assert Session(folder).state == state
    finally:
        served.end()


@pytest.mark.wide
def test_a_full_disk_is_reported_and_the_session_is_unchanged(folder):
    from parallel_cal.workbench.bench import Bench

    bench = Bench(folder)
    until(lambda: not bench.working, "the first look")
    state = bench.session.state
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit(most):  # no larger file can be written, here or in the worker
        for process in (0, bench._worker._process.pid):
            resource.prlimit(process, resource.RLIMIT_FSIZE, (most, usual[1]))

    try:
        limit(1000)
        bench.begin("fit")
        until(lambda: not bench.busy, "its end")
        assert "large" in bench.message  # as the system says it
        bench.save()
        until(lambda: not bench.busy, "the question")
        bench.save(bench.question.key)
        until(lambda: not bench.busy, "its end")
    finally:
        limit(usual[0])
    assert bench.failed
    assert "large" in bench.message  # as the system says it
    assert not bench.output.exists()
    assert Session(folder).state == state
    bench.begin("fit")
    until(lambda: not bench.busy, "the fit")
    assert bench.session.state.step == "fit"


def test_views_are_kept_as_plain_data(tmp_path):
    from parallel_cal.workbench.bench import VIEW_VERSION, load_view

    class Kept:
        folder = tmp_path

        class state:
            number = 3

    assert load_view(Kept) is None
    (tmp_path / "views").mkdir()
    whole = {"version": VIEW_VERSION, "view": {"tiles": []}}
    Path(tmp_path / "views" / "3.json").write_text(json.dumps(whole))
    assert load_view(Kept) == {"tiles": []}
    older = whole | {"version": VIEW_VERSION - 1}
    Path(tmp_path / "views" / "3.json").write_text(json.dumps(older))
    assert load_view(Kept) is None
    Path(tmp_path / "views" / "3.json").write_text("{ half")
    assert load_view(Kept) is None


# ------------------------------------------------------------------ over the model in use


@pytest.mark.wide
def test_the_server_writes_over_a_better_model_only_what_the_owner_confirmed(folder, tmp_path):
    from parallel_cal.workbench.bench import Bench

    output = tmp_path / "robot.yaml"
    session = Session(folder)
    session.fit()
    session.add("backlash")
    session.save(output)
    session.undo()
    better = output.read_text()
    bench = Bench(folder, output)

    def save(*confirmed):
        until(lambda: not bench.working, "the look or step before")
        bench.save(*confirmed)
        until(lambda: not bench.busy, "Save")

    save()
    first = bench.question
    assert first.words.startswith("this model is worse by a factor of 1.07")
    in_use, this = bench.table["rows"]
    assert (in_use["model"], in_use["effects"]) == ("model in use", "backlash")
    assert (this["model"], this["effects"]) == ("this model", "none")
    for row, error in ((in_use, 32.5), (this, 37.0)):
        value, sigma = re.match(
            r"([\d.]+) ± ([\d.]+) µm, [\d.]+ ± [\d.]+ arcmin", row["rms error"]
        ).groups()
        assert float(value) == pytest.approx(error, rel=0.01)
        assert 0.5 < float(sigma) < 5
        assert row["judged"] == "at held-out poses"
        assert int(row["samples"]) == 94
    save("yes")  # no page's click, but a request that knows of none
    assert bench.question == first
    assert output.read_text() == better
    bench.decline()
    assert bench.question is None
    assert bench.table is None
    assert "is unchanged" in bench.message
    output.write_text(better + "# written by a campaign meanwhile\n")
    save(first.key)
    assert bench.question.key != first.key
    assert "campaign" in output.read_text()
    save(bench.question.key)
    assert bench.question is None
    assert bench.message.startswith(f"written: {output}; this model is worse")
    assert len(bench.table["rows"]) == 2
    assert not read_model(output).effects
    assert "this model is worse" in read_model(output).history[-1]["forced"]
    assert bench.session.state.step == "save to robot.yaml, forced"
    assert bench.view["verdict"]["word"] == "explained"  # as it was: nothing to look at anew
    assert Bench(folder, output).view == bench.view


@pytest.mark.wide
def test_the_page_asks_before_it_writes_a_worse_model_and_before_it_adds_a_refused_effect(
    browser, folder, tmp_path
):
    """Both histories keep the reasons."""
    output = tmp_path / "robot.yaml"
    session = Session(folder)
    session.fit()
    session.add("backlash")
    session.save(output)
    session.undo()
    better = output.read_text()
    served = Served(folder, "-o", output)
    try:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(1000 * LONG)
        page.goto(served.url)
        page.locator("#verdict-words").get_by_text("backlash or hysteresis").wait_for()
        page.get_by_role("button", name="Save", exact=True).click()
        page.locator("#question").get_by_text("this model is worse by a factor of").wait_for()
        rows = page.locator("#compared tbody tr")
        assert [row.split("\t")[0] for row in rows.all_inner_texts()] == [
            "model in use",
            "this model",
        ]
        page.get_by_role("button", name="Keep the model in use", exact=True).click()
        page.locator("#message").get_by_text("not saved").wait_for()
        assert output.read_text() == better
        page.get_by_role("button", name="Save", exact=True).click()
        page.get_by_role("button", name="Write anyway", exact=True).wait_for()
        assert page.get_by_role("button", name="Write anyway", exact=True).is_disabled()
        page.get_by_label("say why").fill("the camera was moved")
        page.get_by_role("button", name="Write anyway", exact=True).click()
        page.locator("#message").get_by_text("written").wait_for()
        assert not read_model(output).effects
        page.get_by_role("cell", name="save to robot.yaml, forced").wait_for()
        page.get_by_role("cell", name="the camera was moved").wait_for()
        assert read_model(output).history[-1]["reason"] == "the camera was moved"

        page.get_by_text("tested effects less probable").click()
        page.get_by_role("button", name="add gain of the drives").click()
        page.locator("#question").get_by_text("Add gain of the drives anyway?").wait_for()
        assert "--force" not in page.locator("#question").inner_text()
        page.get_by_role("button", name="Keep the model", exact=True).click()
        page.locator("#message").get_by_text("gain of the drives was not added").wait_for()
        assert Session(folder).state.step == "save to robot.yaml, forced"

        page.get_by_role("button", name="add gain of the drives").click()
        page.get_by_label("say why").fill("its data sheet states it")
        page.get_by_role("button", name="Add anyway", exact=True).click()
        page.get_by_role("cell", name="add gain of the drives, forced").wait_for()
        page.get_by_role("cell", name="its data sheet states it").wait_for()
        session = Session(folder)
        assert session.state.reason == "its data sheet states it"
        entry = session.model.history[-1]
        assert (entry["effect"], entry["reason"]) == ("encoder_gain", "its data sheet states it")
        assert entry["forced"]

        page.get_by_role("button", name="remove gain of the drives").click()
        page.get_by_role("cell", name="remove gain of the drives", exact=True).wait_for()
        assert not Session(folder).model.effects
    finally:
        served.end()


# ------------------------------------------------------------------ tables


def write_table(file):
    """Write the samples of the recording as a table of other names and units."""
    data = load_dataset(BAG)
    header = "arm A [deg];arm B [deg];arm C [deg];X;Y;Z"
    rows = np.column_stack([np.degrees(data.q), 1e3 * data.r])
    file.write_text("\n".join([header, *(";".join(map(repr, row)) for row in rows.tolist())]))
    return len(data)


def test_a_table_with_the_documented_names_is_previewed_as_the_command_line_reads_it(folder):
    from parallel_cal.session.table_preview import preview_table

    table = folder / "table.csv"
    names = [f"joint{k} [deg]" for k in (1, 2, 3)] + ["x [mm]", "y [mm]", "z [mm]"]
    names += ["Rx", "Ry", "Rz", "direction.joint1", "direction.joint2", "Temperature [degC]"]
    names += ["temperature.arms [degC]", "reading.probe.gauge [um]", "Shot"]
    table.write_text(",".join(names) + "\n" + ",".join(["1"] * len(names)) + "\n")
    found = preview_table(table, folder)
    assert not found["error"]
    assert found["angles"] == ["Rx", "Ry", "Rz"]
    assert found["conditions"] == {
        "time": None,
        "temperature": "Temperature [degC]",
        "payload": None,
        "direction.joint1": "direction.joint1",
        "direction.joint2": "direction.joint2",
        "temperature.arms": "temperature.arms [degC]",
    }
    assert found["readings"] == {"probe.gauge": "reading.probe.gauge [um]"}
    assert found["name"] == "Shot"
    table.write_text("joint1 [deg],temperature [Pa]\n1,2\n")
    assert "'Pa' is no unit of temperature" in preview_table(table, folder)["error"]


def test_the_poses_of_a_table_are_drawn_on_the_robot_wherever_the_device_stands(folder):
    from parallel_cal.workbench.import_preview import preview_samples

    data, table = load_dataset(BAG), folder / "table.csv"
    columns = {
        "joints": {f"joint{k}": {"column": f"joint{k}", "unit": "rad"} for k in (1, 2, 3)},
        "position": {"columns": ["x", "y", "z"], "unit": "m"},
    }

    def preview(places):
        rows = np.column_stack([data.q, places]).tolist()
        lines = [",".join(map(repr, row)) for row in rows]
        table.write_text("\n".join(["joint1,joint2,joint3,x,y,z", *lines]))
        found = preview_samples(table, folder, columns)
        cloud = next(t for t in found["figure"]["data"] if t.get("name") == "measured")
        difference = float(re.search(r"differ by (\S+) mm rms", found["words"])[1])
        return np.column_stack([cloud[axis] for axis in "xyz"]), difference

    turn = rotation_matrix(np.array([0.4, -1.1, 2.0]))
    there, difference = preview(data.r @ turn.T + [2.0, -1.0, 0.5])
    here, same = preview(data.r)
    np.testing.assert_allclose(there, here, atol=2e-3)
    np.testing.assert_allclose(there, 1e3 * data.r, atol=3.0)  # the model errs by 0.6 mm
    assert difference == same < 0.7
    assert preview(1.1 * data.r)[1] > 3  # a wrong length shows


@pytest.mark.parametrize("family", ["A", "J", "axis "])
def test_usual_names_of_columns_are_understood(folder, family):
    from parallel_cal.session.table_preview import preview_table

    table = folder / "table.csv"
    names = [f"{family}{k} [deg]" for k in (1, 2, 3)] + ["X [mm]", "Y [mm]", "Z"]
    names += [f"direction.{family}1", "load [kg]", "temp [degC]"]
    table.write_text(";".join(names) + "\n" + ";".join(["1"] * len(names)) + "\n")
    found = preview_table(table, folder)
    assert [found["columns"][f"joint{k}"] for k in (1, 2, 3)] == names[:3]
    assert [found["columns"][axis] for axis in "xyz"] == names[3:6]
    assert found["conditions"] == {
        "time": None,
        "temperature": "temp [degC]",
        "payload": "load [kg]",
        "direction.joint1": f"direction.{family}1",
    }
    assert set(names[:5]) <= set(found["with_unit"])
    assert "Z" not in found["with_unit"]  # its unit is to be chosen


@pytest.mark.slow
def test_the_sides_of_a_table_and_its_angles_reach_the_samples(browser, tmp_path):
    data, folder, table = load_dataset(BAG), tmp_path / "s", tmp_path / "sides.csv"
    sides = np.column_stack([data.conditions[f"direction.joint{k}"] for k in (1, 2, 3)])
    names = [f"joint{k} [deg]" for k in (1, 2, 3)] + ["x [mm]", "y [mm]", "z [mm]"]
    names += [f"direction.joint{k}" for k in (1, 2, 3)] + ["A", "B", "C", "Shot", "Remark"]
    rows = np.column_stack([np.degrees(data.q), 1e3 * data.r, sides, np.zeros((len(data), 5))])
    text = [",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())]
    table.write_text("\n".join(text))
    served = Served(MODEL, "--session", folder)
    try:
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(1000 * LONG)
        page.goto(served.url)
        page.get_by_role("button", name="Import a table", exact=True).first.click()
        page.locator("input[type=file]").set_input_files(table)
        unused = page.locator("#unused")
        unused.get_by_text("not used: A, B, C, Remark").wait_for()
        page.get_by_text("10 of 14 columns understood").wait_for()
        page.locator("#import-counts").get_by_text(f"samples: {len(data)} at ").wait_for()
        page.get_by_role("figure", name="poses of the table on the robot").wait_for()
        page.mouse.click(5, 5)  # beside the dialog, which loses nothing
        assert page.get_by_label("column of joint2", exact=True).is_hidden()  # nothing is doubtful
        page.locator("#understood").get_by_text("see and change").click()
        page.get_by_label("column of joint2", exact=True).click()
        page.get_by_role("option", name="joint1 [deg]", exact=True).click()
        page.get_by_role("button", name="Import", exact=True).click()
        answer = page.locator("#import-answer")
        answer.get_by_text("joint1 [deg] is chosen for joint1 and joint2").wait_for()
        page.get_by_label("column of joint2", exact=True).click()
        page.get_by_role("option", name="joint2 [deg]", exact=True).click()
        page.get_by_label("orientation", exact=True).click()
        page.get_by_role("option", name="three angles", exact=True).click()
        unused.get_by_text("not used: Remark", exact=True).wait_for()
        page.get_by_label("unit of the angles", exact=True).click()
        page.get_by_role("option", name="deg", exact=True).click()
        page.get_by_label("position [µm]").fill("20")
        page.get_by_role("button", name="Import", exact=True).click()
        answer.wait_for(state="hidden")
        page.get_by_role("cell", name=f"import {len(data)} samples of sides.csv").wait_for()
        # The next table of this kind needs one look: its columns are read as those of the last.
        page.get_by_role("button", name="Import a table", exact=True).first.click()
        page.locator("input[type=file]").set_input_files(table)
        page.get_by_text("13 of 14 columns understood").wait_for()
        unused.get_by_text("not used: Remark", exact=True).wait_for()
    finally:
        served.end()
    found = Session(folder).samples
    for k in (1, 2, 3):
        np.testing.assert_array_equal(found.conditions[f"direction.joint{k}"], sides[:, k - 1])
    assert not found.sides_from_order
    assert found.names == dict.fromkeys(range(len(data)), "0.0")  # the column Shot
    assert found.measured.all()
    np.testing.assert_allclose(found.pose_cov[0, 0, 0], 20e-6**2)


@pytest.mark.wide
def test_a_table_is_imported_with_its_columns_named_on_the_page(browser, tmp_path):
    table, folder = tmp_path / "tracker.csv", tmp_path / "s"
    count = write_table(table)
    known = {
        "joints": {f"joint{k}": {"column": f"arm {a} [deg]"} for k, a in enumerate("ABC", 1)},
        "position": {"columns": ["X", "Y", "Z"], "unit": "mm"},
        "conditions": {},
        "visits": "unordered",
        "noise": {},
    }
    assert remember_columns(read_model(MODEL).mechanism, Path("yesterday.csv"), known) == ""
    served = Served(MODEL, "--session", folder)
    try:
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(1000 * LONG)
        page.goto(served.url)
        page.locator("#empty").get_by_text("Import a table of measured poses").wait_for()
        page.get_by_role("button", name="Import a table", exact=True).first.click()
        page.locator("input[type=file]").set_input_files(table)
        # As in another session of this user; one click takes the header alone.
        page.get_by_text("6 of 6 columns understood").wait_for()
        page.locator("#remembered").get_by_text("as in yesterday.csv, imported on").wait_for()
        page.get_by_role("button", name="Read the header instead", exact=True).click()
        page.locator("#remembered").wait_for(state="hidden")
        page.get_by_text("3 of 6 columns understood").click()
        page.get_by_text(f"{count} rows; the first ones:").wait_for()
        # Where the columns need more room than there is, a scrollbar is always in view.
        page.set_viewport_size({"width": 420, "height": 900})
        preview = page.locator(".q-dialog .wide-table")
        assert preview.evaluate("e => e.scrollWidth > e.clientWidth")
        bar = "e => getComputedStyle(e, '::-webkit-scrollbar').height"
        assert preview.evaluate(bar) == "12px"
        page.set_viewport_size({"width": 1280, "height": 900})

        def choose(label, words):
            page.get_by_label(label, exact=True).click()
            option = page.get_by_role("option", name=words, exact=True)
            option.click()
            option.wait_for(state="hidden")  # the next list may have the same words

        def press_import():
            page.get_by_role("button", name="Import", exact=True).click()

        press_import()
        answer = page.locator("#import-answer")
        answer.get_by_text("choose a column for joint1, joint2, joint3").wait_for()
        assert "parallel-cal import rrf" in answer.inner_text()  # if they are touches of a bed
        for k, arm in enumerate("ABC"):
            choose(f"column of joint{k + 1}", f"arm {arm} [deg]")
        press_import()  # x, y and z were found by their names, but have no unit
        answer.get_by_text("unit").wait_for()
        assert answer.inner_text() == "the header states no unit: choose unit of x, y, z"
        assert Session(folder).state.step == "begin"
        choose("unit of x, y, z", "mm")
        choose("unit of all joints", "deg")
        second = page.get_by_label("unit of joint2", exact=True).locator("xpath=ancestor::label")
        second.get_by_text("deg", exact=True).wait_for()
        choose("unit of joint2", "as in the header")
        press_import()
        answer.wait_for(state="hidden")
        page.get_by_role("cell", name=f"import {count} samples of tracker.csv").wait_for()
        page.get_by_role("button", name="Fit", exact=True).click()
        page.get_by_role("cell", name="fit", exact=True).wait_for()
    finally:
        served.end()
    session = Session(folder)
    np.testing.assert_allclose(session.samples.q, load_dataset(BAG).q, atol=1e-12)
    assert session.state.position_rms < 60e-6
    [columns] = folder.rglob("*.columns.yaml")
    joints = json.loads(columns.read_text())["joints"]
    assert [one.get("unit") for one in joints.values()] == ["deg", None, "deg"]


# ------------------------------------------------------------------ samples set aside


@pytest.mark.wide
def test_a_sample_that_the_verdict_set_aside_can_be_excluded_on_the_page(browser, tmp_path):
    data, _ = hiding([vf.KINDS["backlash"]], 0.8, seed=40)
    data.r[17] += 2e-3 * np.array([0.7, -0.5, 0.5])
    data.to_json(tmp_path / "samples.json")
    folder = tmp_path / "s"
    session = Session.new(folder, new_model("delta54"), [tmp_path / "samples.json"])
    session.fit()
    served = Served(folder)
    try:
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(1000 * LONG)
        page.goto(served.url)
        page.locator("#verdict-words").get_by_text("sample 17 (", exact=False).first.wait_for()
        assert (
            "--data" not in page.locator("#verdict-words").text_content()
        )  # no option of a command
        assert "does not use sample 17" in page.locator("#included").inner_text()
        strip = page.locator("#strip")
        strip.get_by_text("sample 17 is knocked").wait_for()
        assert strip.get_by_role("button", name="exclude knocked: 17").is_enabled()
        page.get_by_label("reason", exact=True).fill("the reflector was touched")
        page.get_by_role("button", name="Exclude sample 17", exact=True).click()
        page.get_by_text("sample 17 is excluded: the reflector was touched").wait_for()
        until(lambda: set(Session(folder).state.excluded) == {17}, "the exclusion on disk")
        page.locator("#included").wait_for(state="hidden")
    finally:
        served.end()
