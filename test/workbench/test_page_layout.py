"""The layout of the workbench's page, by the boxes of its parts in a real browser."""

import re
import time
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from datasets import measured
from marks import keep
from workbench_page import LONG, Served, beside_a_played_robot, opened, until

from parallel_cal.diagnosis.patterns import compute_mean_profile
from parallel_cal.diagnosis.verdict_words import VERDICT_LABELS
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.reporting.axes import log_axis
from parallel_cal.reporting.error_steps import FallingError, Step, describe_steps, draw_steps
from parallel_cal.reporting.page import PageBuilder
from parallel_cal.session.history import Record, State, format_first_error
from parallel_cal.session.session import Session
from parallel_cal.workbench.error_steps import find_steps

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"
# A window of 1280 x 800 at a zoom of 150 % has 853 x 533 pixels of CSS.
SIZES = {"800": (800, 900), "1280": (1280, 800), "1920": (1920, 1080), "150 %": (853, 533)}


# ------------------------------------------------------------------ the falling error


def history(*states, branches, branch="main"):
    """A session's history, of which only the record is needed."""
    from parallel_cal.session.history import History

    found = History.__new__(History)
    found.record = Record(recordings=[], states=states, branches=branches, branch=branch)
    return found


def state(number, parent, step, error=None, **more):
    errors = {"position_rms": error} if error else {}
    return State(number=number, parent=parent, step=step, model="", errors=errors, **more)


def test_the_falling_error_begins_before_the_calibration_and_shows_every_branch():
    before, noise = {"position_rms": 606e-6}, {"position_rms": 30e-6}
    found = find_steps(
        history(
            state(0, None, "begin"),
            state(1, 0, "fit", 37e-6, before=before, noise=noise),
            state(2, 1, "save to model.yaml", 37e-6),
            state(3, 2, "add backlash", 32e-6),
            state(4, 1, "add hysteresis", 33e-6),
            branches={"main": 3, "other": 4},
        )
    )
    assert [(s.name, s.before, found.branches[s.branch]) for s in found.steps] == [
        ("before calibration", None, "main"),
        ("fit", 0, "main"),
        ("add backlash", 1, "main"),
        ("add hysteresis", 1, "other"),
    ]
    assert found.now == 2
    words = describe_steps(found)
    assert "before calibration 606 µm, fit 37.0 µm, add backlash 32.0 µm" in words
    assert words.endswith("noise floor 30.0 µm")
    figure = draw_steps(found)
    assert figure["layout"]["title"]["text"].endswith("[µm]; grey: noise floor 30.0")
    assert "<b>other</b>" in str(figure["data"])


def test_the_labels_of_many_steps_are_whole_words_that_plotly_may_not_omit():
    long = "add thermal_expansion, gear_transmission_error"
    for count in (2, 11):
        steps = [Step("before calibration", 1e-4), *(Step(long, 1e-5) for _ in range(count))]
        axis = draw_steps(FallingError("position", steps))["layout"]["xaxis"]
        words = axis["ticktext"][-1].replace("<br>", " ").replace(" …", "").split()
        assert set(words) <= set(long.replace(",", "").split()) | {"thermal_expansion,"}
        # A slanted last label extends beyond the axis, where Plotly omits it.
        assert axis["autotickangles"] == [0, 90]
        assert axis["ticklabeloverflow"] == "allow"


def test_no_line_crosses_the_label_of_a_step_and_the_title_is_above_the_axis():
    errors = [3.0, 1.03, 1.07, 0.4, 0.9]
    steps = [Step(str(k), 3e-4 * v, k - 1 if k else None) for k, v in enumerate(errors)]
    figure = draw_steps(FallingError("orientation", steps, words="orientation, rms"))
    [points] = [t for t in figure["data"] if t.get("mode") == "markers+text"]
    assert points["textposition"] == [
        "top center",
        "top right",  # the curve comes from above, and goes on almost level
        "top center",
        "bottom center",
        "top center",
    ]
    # An upright title is longer than a low axis, and would be cut off.
    assert figure["layout"]["title"]["text"] == "orientation, rms [arcmin]; noise floor not known"
    assert not figure["layout"]["yaxis"]["title"]["text"]


def test_bars_stand_on_zero_unless_the_errors_differ_too_much_for_it():
    for last, kind in ((23e-6, "linear"), (2e-6, "log")):
        steps = [Step("before", 55e-6), Step("fit", last, 0)]
        figure = draw_steps(FallingError("position", steps, noise=1e-6))
        axis, [band] = figure["layout"]["yaxis"], [t for t in figure["data"] if t.get("fill")]
        low, high = axis["range"]
        assert axis["type"] == kind
        assert min(band["y"]) == pytest.approx(0.0 if kind == "linear" else 10**low)
        assert high > 55 if kind == "linear" else 10**high > 55


def test_without_an_error_the_axis_shows_the_noise():
    assert draw_steps(FallingError("position", [], noise=1e-6))["layout"]["yaxis"]["range"][1] > 1
    assert draw_steps(FallingError("position", []))["data"] == []


def test_a_step_on_other_samples_is_joined_by_a_dotted_line():
    found = find_steps(
        history(
            state(0, None, "begin"),
            state(1, 0, "fit", 37e-6),
            state(2, 1, "exclude sample 3", 35e-6, excluded={3: "bumped"}),
            branches={"main": 2},
        )
    )
    assert [s.is_comparable for s in found.steps] == [True, False]
    lines = [t for t in draw_steps(found)["data"] if t.get("mode") == "lines"]
    assert [line["line"]["dash"] for line in lines] == ["dot"]
    assert found.steps[1].details == "1 excluded sample"


def test_without_a_fit_there_is_no_falling_error():
    assert find_steps(history(state(0, None, "begin"), branches={"main": 0})) is None


def test_a_large_error_is_written_without_an_exponent():
    assert format_first_error({"position_rms": 1.8193e-3}) == "1819 um"
    assert format_first_error({"position_rms": 32.456e-6}) == "32.5 um"


def test_a_logarithmic_axis_holds_its_values_and_has_round_ticks():
    axis = log_axis([606.0, 37.0, None, 30.0], "error")
    assert axis["ticktext"] == ["20", "50", "100", "200", "500"]
    low, high = axis["range"]
    assert 10**low < 30 < 606 < 10**high


# ------------------------------------------------------------------ branches


@pytest.mark.wide
def test_the_difference_of_two_predictions_is_that_of_their_positions_over_the_workspace():
    from parallel_cal.reporting.prediction_difference import draw_difference

    model = read_model(MODEL)
    same = {"words": "low and high predict the same positions"}
    assert draw_difference(model, model, "low", "high") == same
    higher = model.values + 1e-4 * np.array([name.endswith("D_y") for name in model.table.names])
    shown = draw_difference(model, model.with_values(higher), "low", "high")
    assert "predictions of high minus those of low" in shown["words"]
    assert "100 µm rms over the workspace, at most 100 µm" in shown["words"]
    assert shown["words"].endswith("1 sigma of low unknown, 1 sigma of high unknown")
    plan, front = (trace for trace in shown["figure"]["data"][:4:2])
    starts, ends = (np.array(front["y"][k::3], dtype=float) for k in (0, 1))
    assert np.allclose(ends - starts, (ends - starts)[0])  # all arrows point up alike
    assert (ends - starts)[0] > 0
    assert np.allclose(plan["x"][0::3], plan["x"][1::3], atol=1e-2)
    assert all("customdata" not in trace for trace in shown["figure"]["data"])


# ------------------------------------------------------------------ many samples


@pytest.mark.wide
def test_a_page_shows_a_limited_number_of_many_samples_with_the_worst_and_says_so(monkeypatch):
    from parallel_cal.diagnosis.comparison import compare
    from parallel_cal.recordings.loading import load_sessions
    from parallel_cal.reporting import contents
    from parallel_cal.workbench import views

    model = read_model(MODEL)
    found = compare(model, load_sessions([BAG]))
    whole = views._make_comparison_view(found)
    assert whole["shown"] == ""
    assert len(whole["samples"]["rows"]) == 94

    monkeypatch.setattr(views, "MAX_SHOWN_SAMPLES", 40)
    monkeypatch.setattr(views, "MAX_WORST_SAMPLES", 10)
    listed, judged = [], contents.JudgedSample
    monkeypatch.setattr(
        contents, "JudgedSample", lambda **given: listed.append(given) or judged(**given)
    )
    part = views._make_comparison_view(found)
    assert len(listed) == 40  # not one object for each of 10^5 samples
    numbers = [row["sample"] for row in part["samples"]["rows"]]
    worst = {one.sample for one in contents.compared_samples(found)[:10]}
    assert worst < set(numbers)
    assert part["shown"].startswith("The views and the table show 40 of 94 samples: the 10 worst")
    assert min(numbers) < 10 < 84 < max(numbers)  # of the whole recording
    for values in (part["residuals"]["sigmas"], part["residuals"]["place"]):
        assert len(values) == 40
    assert part["field"]["numbers"] == numbers
    assert part["machine"]["share"] == "40 of 94 samples"
    assert "share" not in whole["machine"]
    joints = next(one for one in part["pictures"] if one["name"] == "joints")["figure"]["data"]
    points = [one for one in joints if one["name"] == "measured (40 of 94)"]
    assert [one["customdata"] for one in points] == [numbers] * 3  # only these can be marked
    by_number = {row["sample"]: row for row in whole["samples"]["rows"]}
    assert [by_number[row["sample"]] for row in part["samples"]["rows"]] == (
        part["samples"]["rows"]
    )


@pytest.mark.wide
def test_the_numbers_of_a_fit_of_many_samples_are_shown_before_its_residuals(folder, monkeypatch):
    from parallel_cal.workbench import views

    whole = views.glance(Session(folder))
    assert "residuals" in whole
    monkeypatch.setattr(views, "MAX_SHOWN_SAMPLES", 40)
    monkeypatch.setattr(views, "compare", None)  # takes as long as the fit
    part = views.glance(Session(folder))
    assert "residuals" not in part
    assert part["tiles"] == whole["tiles"]


def test_while_a_step_runs_the_pictures_before_it_stay_but_not_what_was_judged():
    from parallel_cal.workbench.kept_pictures import EARLIER, keep_pictures

    before = {"residuals": 1, "machine": 2, "shown": "", "answers": 3, "tiles": [4], "budget": 5}
    numbers = {"tiles": [6], "verdict": 7}
    assert keep_pictures(numbers, before) == numbers | {
        "residuals": 1,
        "machine": 2,
        "shown": EARLIER,
    }
    assert keep_pictures(numbers, None) == numbers
    whole = numbers | {"residuals": 8}
    assert keep_pictures(whole, before) is whole


def test_a_value_of_a_figure_that_is_not_a_number_is_a_gap():
    """NumPy's values, too; 100,000 points take what their digits take."""
    builder = PageBuilder()
    y = np.arange(100_000) / 8.0
    y[[1, 3]] = np.nan, np.inf
    trace = {"type": "scatter", "y": y, "x": [np.float64(1), np.nan], "visible": np.bool_(True)}
    builder.plot({"data": [trace], "layout": {"height": np.int64(200)}})
    text = builder.page("t", "", "")
    assert '"y":[0.0,null,0.25,null,0.5,' in text
    assert '"x":[1.0,null],"visible":true' in text
    assert "NaN" not in text[text.index('"y":[') : text.index('"x":[')]


def test_a_mean_along_many_samples_is_given_at_few_points_and_shows_a_small_course():
    rng = np.random.default_rng(1)
    values = rng.uniform(0, 1, 100_000)
    z = rng.normal(size=(100_000, 1)) + 0.2 * np.sin(2 * np.pi * values)[:, None]
    found = compute_mean_profile("x", values, z)
    assert len(found.at) == len(found.mean) == len(found.band) == 500
    assert np.abs(found.mean[:, 0] - 0.2 * np.sin(2 * np.pi * found.at)).max() < 0.2
    assert found.p_value < 1e-6
    few = compute_mean_profile("x", values[:200], z[:200])
    assert len(few.at) == 186  # every position of a window of 15 samples


def test_a_part_of_many_samples_has_all_visits_of_its_poses_and_their_numbers():
    whole = measured(n_poses=90, n_replicates=30)
    whole = whole.excluding([2])
    part = whole.thinned(40)
    assert 30 <= len(part) <= 50
    assert whole.thinned(500) is whole
    for most in range(20, 110, 5):  # who thins a part again gets the same part
        part_of_most = whole.thinned(most)
        assert part_of_most.thinned(most) is part_of_most
    for number, pose in zip(part.numbers, part.pose_id, strict=True):
        np.testing.assert_array_equal(
            part.q[part.numbers == number], whole.q[whole.numbers == number]
        )
        assert (part.pose_id == pose).sum() == (whole.pose_id == pose).sum()
    assert part.numbers.min() < 15
    assert part.numbers.max() > 105


@pytest.mark.wide
def test_a_page_shows_a_part_of_many_samples_first_and_says_so(folder, monkeypatch):
    from parallel_cal.workbench import views

    session = Session(folder)
    assert views.view_some_samples(session) is None
    assert not list(views.fit_some_samples(session))
    monkeypatch.setattr(views, "MAX_PRELIMINARY_SAMPLES", 60)
    numbers, pictures, verdict, judged = views.fit_some_samples(session)
    assert "residuals" not in numbers
    # The pictures of the fit wait for no diagnosis, and stay while one is made.
    assert numbers == {key: pictures[key] for key in numbers}
    drawn = ("machine", "field", "residuals", "pictures", "samples", "measured")
    assert [verdict[key] for key in drawn] == [pictures[key] for key in drawn]
    assert pictures["residuals"] == judged["residuals"]
    answers = ("answers", "verdict", "tiles", "effects", "offered", "needs_poses", "find_law")
    assert [verdict[key] for key in answers] == [judged[key] for key in answers]
    assert verdict["tiles"][1]["values"] == numbers["tiles"][1]["values"]  # of one fit
    count = len(session.dataset.thinned(60))
    part = f"{count} of 94 samples, evenly spread over the recording"
    assert numbers["verdict"]["words"] == f"preliminary fit of {part}; fitting all samples"
    assert [tile["name"] for tile in numbers["tiles"]] == list(views.FIT_TILES)
    assert judged["verdict"]["words"].startswith(f"preliminary, from {part}: ")
    assert judged["answers"]["missing"].startswith("Backlash")
    assert len(judged["samples"]["rows"]) == count
    seen = views.view_some_samples(session)
    assert seen["verdict"]["words"].startswith(f"preliminary, from {part}: ")
    assert "backlash" in seen["verdict"]["words"].lower()
    assert len(seen["samples"]["rows"]) == count
    assert Session(folder).state.verdict == session.state.verdict  # only the whole is recorded


@pytest.mark.wide
def test_of_many_samples_a_part_is_diagnosed_and_the_numbers_are_those_of_all(folder, monkeypatch):
    from parallel_cal.workbench import views

    def look():
        return views.view(Session(folder), lambda *told: None)

    whole = look()
    monkeypatch.setattr(views, "MAX_DIAGNOSED_SAMPLES", 80)
    part = look()
    count = len(Session(folder).dataset.thinned(80))
    assert count < 94
    assert part["verdict"]["words"].endswith(
        f"(diagnosis of {count} of 94 samples, evenly spread over the recording)"
    )
    assert "backlash" in part["verdict"]["words"].lower()
    assert len(part["samples"]["rows"]) == count
    by_name = {tile["name"]: tile["values"] for tile in whole["tiles"]}
    assert [tile["values"] for tile in part["tiles"] if tile["name"] == "now"] == [by_name["now"]]
    assert part["counts"] == "all errors: rms at 94 samples; ± 1 sigma"
    estimates = [[row[key] for key in ("name", "value", "sigma")] for row in _rows(part)]
    fitted = [[row[key] for key in ("name", "value", "sigma")] for row in _rows(whole)]
    assert estimates == fitted[: len(estimates)]
    assert (part["budget"], part["chi2"]) == (None, "")


def _rows(view):
    return view["parameters"]["rows"]


def test_every_class_of_the_page_has_a_style():
    nicegui = Path(pytest.importorskip("nicegui").__file__).parent
    from parallel_cal.workbench import widgets

    rules = widgets.UTILITIES + widgets.CSS
    for file in ("quasar.unimportant.prod.css", "quasar.important.prod.css", "nicegui.css"):
        rules += (nicegui / "static" / file).read_text()
    used = {
        name
        for file in Path(widgets.__file__).parent.glob("*.py")
        for given in re.findall(r'\.classes\(\s*"([^"]+)"', file.read_text())
        for name in given.split()
    }
    assert {"w-full", "candidate", "items-center"} <= used
    unknown = {name for name in used if not re.search(rf"\.{re.escape(name)}[\s,.:>{{]", rules)}
    assert unknown <= {"ambiguous"}  # by which tests find it


# ------------------------------------------------------------------ in a browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "s"
    session = Session.new(folder, read_model(MODEL), [BAG], fitting=FitOptions(hold_out=0.5))
    session.fit()
    session.start_branch("with backlash")
    session.add("backlash")
    session.switch("main")
    return folder


@pytest.fixture(scope="module")
def browser():
    with opened() as one:
        yield one


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """The file of what the played robot is told."""
    return tmp_path_factory.mktemp("told") / "words"


@pytest.fixture(scope="module")
def page(browser, folder, told):
    """A page on a fitted session beside a played robot that runs a campaign."""
    served = Served(folder, told, command=beside_a_played_robot)
    page = open_page(browser, served.url)
    page.locator("#verdict").get_by_text("explained, not yet in the model").wait_for()
    page.get_by_role("figure", name="residual of x against").wait_for()
    page.locator("#campaign").get_by_text("moving: pose 27").wait_for()
    yield page
    served.end()


def open_page(browser, url):
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.set_default_timeout(1000 * LONG)
    page.goto(url)
    return page


@pytest.mark.wide
@pytest.mark.parametrize(("width", "is_shown"), [(780, False), (1280, True)])
def test_the_numbers_of_the_header_are_beside_the_verdict_or_not_shown(page, width, is_shown):
    page.set_viewport_size({"width": width, "height": 800})
    page.wait_for_timeout(500)  # the page is laid out anew
    place = page.locator(".judged").bounding_box()
    chip, numbers = page.locator("#verdict .badge"), page.locator("#headline")
    said, errors = chip.bounding_box(), numbers.bounding_box()
    assert numbers.inner_text().count("±") == 3
    assert said["x"] + said["width"] <= place["x"] + place["width"]
    if is_shown:
        assert said["x"] + said["width"] < errors["x"]
        assert errors["y"] + errors["height"] <= place["y"] + place["height"]
    else:
        assert errors["y"] >= place["y"] + place["height"]  # on a line that is cut off


@pytest.mark.wide
@pytest.mark.parametrize("size", SIZES)
def test_the_first_screen_is_the_machine_the_verdict_and_one_step(page, size):
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_timeout(500)  # the page is laid out anew
    assert page.locator("header").bounding_box()["height"] <= 0.15 * height
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    machine, verdict, errors, missing, fails = (
        page.get_by_role("region", name=name, exact=True).bounding_box()
        for name in ("Machine", "Verdict", "Errors", "What is missing", "Where it fails")
    )
    figure = page.get_by_role("figure", name="the machine and its errors").bounding_box()
    step = page.get_by_role("button", name="next step: Add backlash").bounding_box()
    assert figure["height"] >= 150
    for part in (figure, step, page.locator("#missing").bounding_box()):
        assert part["y"] + part["height"] <= height
    if width >= 840:
        assert machine["width"] == pytest.approx(1.5 * verdict["width"], rel=0.02)
    filled = (
        page.locator("main button, .q-page button")
        .filter(visible=True)
        .evaluate_all(
            "all => all.filter(one => one.matches('.q-btn--standard')).map(one => one.innerText)"
        )
    )
    assert filled == ["Add backlash"]
    # The header has the word of the verdict, the card its sentences.
    places = page.locator("header"), page.get_by_role("region", name="Verdict", exact=True)
    word, sentence = (
        [place.get_by_text(words).count() for place in places]
        for words in (VERDICT_LABELS["explained"], "accounts for 100 %")
    )
    assert (word, sentence) == ([1, 0], [0, 1])
    assert max(one["y"] + one["height"] for one in (machine, verdict)) <= errors["y"]
    assert errors["y"] + errors["height"] <= missing["y"]
    if width < 1600:
        assert missing["y"] + missing["height"] <= fails["y"]
        assert fails["x"] == missing["x"]
    else:
        assert missing["x"] + missing["width"] <= fails["x"]
        assert fails["y"] == errors["y"]
        live, samples, parameters = (
            page.get_by_role("region", name=name, exact=True).bounding_box()
            for name in ("Live", "Samples", "Parameters")
        )
        assert 0 < samples["y"] - (live["y"] + live["height"]) < 20  # no gap below a short column
        assert samples["x"] == missing["x"]
        assert parameters["x"] == fails["x"]
        assert fails["x"] + fails["width"] > 0.95 * width  # no third of the window is empty
    for name in ("STOP", "Pause", "Fit", "Save"):
        button = page.get_by_role("button", name=name, exact=True).bounding_box()
        assert button["x"] + button["width"] <= width
        assert button["y"] + button["height"] <= 0.15 * height


@pytest.mark.wide
def test_a_change_of_the_page_leaves_its_style_sheets_alone(page):
    # After a change of a style sheet, a browser computes the styles of all elements again.
    page.evaluate(
        """() => {
          window.styleChanges = 0;
          const count = changes => { window.styleChanges += changes.length };
          const all = { childList: true, subtree: true, characterData: true };
          new MutationObserver(count).observe(document.head, all);
        }"""
    )
    page.get_by_role("tab", name="sides", exact=True).click()
    page.get_by_role("figure", name="residuals from three sides").wait_for()
    page.get_by_role("tab", name="joints", exact=True).click()
    page.get_by_role("figure", name="encoder reading minus").wait_for()
    page.wait_for_timeout(500)  # a style sheet would be written after the figure
    assert page.evaluate("window.styleChanges") == 0


@pytest.mark.wide
@pytest.mark.parametrize("size", SIZES)
def test_toolbars_legends_and_titles_of_figures_do_not_cover_each_other(page, size):
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    drawn = page.locator(".js-plotly-plot:visible")
    for one in drawn.all():
        one.scroll_into_view_if_needed()  # a figure out of sight is not drawn for the new width
        page.wait_for_timeout(200)
    covered = page.evaluate(
        """() => [...document.querySelectorAll(".js-plotly-plot")].flatMap(figure => {
          const parts = ".modebar-group, .legend, .g-gtitle text, .g-xtitle text, " +
            ".g-ytitle text, .annotation text";
          const boxes = [...figure.querySelectorAll(parts)]
            .map(part => [part.getAttribute("class"), part.textContent.slice(0, 30),
                          part.getBoundingClientRect()])
            .filter(([, , box]) => box.width * box.height > 0);
          return boxes.flatMap(([kind, text, a], i) => boxes.slice(i + 1)
            .filter(([other, , b]) => kind !== "modebar-group" || other !== "modebar-group")
            .filter(([, , b]) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 &&
                                 Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1)
            .map(([other, words]) => [figure.ariaLabel, kind, text, other, words]));
        })"""
    )
    assert covered == []
    assert drawn.count() > 4


@pytest.mark.wide
def test_effects_that_are_not_significant_are_folded(page):
    missing = page.get_by_role("region", name="What is missing", exact=True)
    shown = missing.get_by_role("button", name="add ")
    assert [one.get_attribute("aria-label") for one in shown.all()] == [
        "add backlash",
        "add hysteresis",
    ]
    missing.get_by_text("tested effects less probable").click()
    missing.get_by_role("button", name="add gain of the drives").wait_for()


@pytest.mark.wide
def test_the_falling_error_is_the_picture_of_the_page(page):
    page.set_viewport_size({"width": 1280, "height": 800})
    page.wait_for_timeout(500)  # the page is laid out anew
    verdict = page.get_by_role("region", name="Verdict", exact=True)
    picture = verdict.get_by_role("figure", name="validation error over the steps")
    words = picture.get_attribute("aria-label")
    assert "before calibration 606 µm" in words
    assert "add backlash 32" in words
    assert "noise floor 30" in words
    shown = picture.bounding_box()
    assert shown["y"] + shown["height"] < 800  # in the first screen
    assert (
        "606 ± 11 µm → 37.0 ± 2.5 µm · noise 30.0 ± 1.2 µm" in page.locator("header").inner_text()
    )


@pytest.mark.wide
def test_the_curve_of_a_campaign_begins_at_the_initial_model_and_names_what_was_added(page):
    region = page.get_by_role("region", name="Automatic calibration", exact=True)
    picture = region.get_by_role("figure", name="error at the validation poses over the steps")
    assert picture.get_attribute("aria-label").endswith(
        "initial model 934 µm, 16 poses: parameters 118 µm, 24 poses: backlash added 37.0 µm; "
        "noise floor 30.0 µm"
    )


@pytest.mark.wide
@pytest.mark.parametrize(
    ("size", "theme"),
    # The least room, and the colours of both themes.
    keep([*product(SIZES, ("light", "dark"))], ("800", "light"), ("1280", "dark")),
)
def test_the_page_has_no_fault_of_access(page, theme, size):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    page.emulate_media(color_scheme=theme)
    page.locator(f"body.body--{theme}").wait_for()
    page.wait_for_timeout(1000)  # the colours change slowly
    page.wait_for_function(
        "document.getAnimations().every(one => one.playState !== 'running')", polling=100
    )
    found = axe.run(page).response["violations"]
    assert [(one["id"], one["nodes"][0]["html"][:200]) for one in found] == []


@pytest.mark.wide
@pytest.mark.parametrize("name", ["Import a table", "Certificate"])
def test_a_dialog_has_no_fault_of_access(page, name):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page.get_by_role("button", name=name, exact=True).last.click()
    dialog = page.get_by_role("dialog", name=name, exact=True)
    dialog.get_by_role("heading", name=name).wait_for()
    bars = "[...document.querySelectorAll('.q-loading-bar')]"  # of Quasar, while files are loaded
    page.wait_for_function(f"{bars}.every(one => getComputedStyle(one).opacity === '0')")
    # axe takes the backdrop for the ground of a dialog, whose colours are those of the page.
    rules = {"rules": {"color-contrast": {"enabled": False}}}
    found = axe.run(page, options=rules).response["violations"]
    dialog.get_by_role("button", name="Close", exact=True).click()
    dialog.wait_for(state="hidden")
    assert [(one["id"], one["nodes"][0]["html"][:200]) for one in found] == []


@pytest.mark.wide
def test_the_text_of_figures_in_space_has_the_colour_of_the_page(page):
    """A style sheet does not reach it."""
    colours = """() => [...document.querySelectorAll(".js-plotly-plot")]
        .filter(view => view._fullLayout?.scene)
        .map(view => [view._fullLayout.font.color, getComputedStyle(view).color])"""
    seen = set()
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        page.evaluate("window.scrollTo(0, 0)")
        page.get_by_role("figure", name="the machine and its errors").scroll_into_view_if_needed()
        alike = f"(found => found.length && found.every(([a, b]) => a === b))(({colours})())"
        page.wait_for_function(alike)
        seen |= {page_colour for _, page_colour in page.evaluate(colours)}
    assert len(seen) == 2


@pytest.mark.wide
def test_the_keyboard_reaches_the_next_step_in_ten_stops_and_shows_where_it_is(page):
    page.reload()
    page.get_by_role("button", name="add backlash", exact=True).wait_for()
    page.locator("#campaign").get_by_text("moving: pose 27").wait_for()
    stops = []
    while not stops or stops[-1][0] != "next step: Add backlash":
        assert len(stops) < 10, stops
        page.keyboard.press("Tab")
        stops.append(
            page.evaluate(
                """() => {
                  const at = document.activeElement, box = at.getBoundingClientRect();
                  return [at.ariaLabel || at.innerText, getComputedStyle(at).boxShadow,
                          box.left >= 0 && box.top >= 0];
                }"""
            )
        )
    assert stops[0][0] == "Skip to the content"
    for name, focus, is_visible in stops:
        assert "rgb(59, 125, 216)" in focus, name
        assert is_visible, name
    assert page.get_by_role("heading", level=1).count() == 1
    page.get_by_text("Skip to the content").focus()
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"


@pytest.mark.wide
def test_compare_shows_how_far_the_predictions_of_the_branches_differ(page):
    failed = []
    page.on("console", lambda m: failed.append(m.text) if "NaN" in m.text else None)
    page.get_by_role("button", name="Compare", exact=True).click()
    words = page.get_by_text("predictions of with backlash minus those of main")
    words.wait_for()
    number = r"[\d.]+ µm"
    assert re.search(
        rf"{number} rms over the workspace, at most {number}; "
        rf"1 sigma of main {number}, 1 sigma of with backlash {number}; "
        "each place with the direction of a sample drawn at random",
        words.inner_text(),
    )
    page.get_by_role("figure", name="difference of the predictions of with backlash").wait_for()
    # The last state of the other branch was not diagnosed: it has no residuals.
    page.get_by_role("figure", name="residuals of main").wait_for()
    page.get_by_text("with backlash: no residuals to show").wait_for()
    page.locator("[aria-label='residuals of main'] canvas").first.wait_for()
    assert not failed
    page.keyboard.press("Escape")
    page.get_by_text("predictions of with backlash minus").wait_for(state="hidden")


@pytest.mark.wide
def test_the_numbers_of_a_step_are_painted_before_its_figures_are_drawn(page):
    page.set_viewport_size({"width": 1280, "height": 3000})  # nothing is out of sight
    page.get_by_role("button", name="Undo", exact=True).click()
    page.locator("#verdict-words").get_by_text("compared with the measurements").wait_for()
    page.locator("#verdict").get_by_text("not judged yet").wait_for()
    assert page.get_by_role("heading", name="Verdict").count() == 0
    page.get_by_role("figure", name="rms residual").locator(".point").first.wait_for()
    page.evaluate("""() => {
      const told = window.told = [], watch = (place, act) => new MutationObserver(act).observe(
        document.querySelector(place), { subtree: true, childList: true, characterData: true });
      watch("#headline", () => requestAnimationFrame(() => told.push("frame with the numbers")));
      watch(".js-plotly-plot[aria-label^='rms residual']", () => told.push("figure"));
    }""")
    page.get_by_role("button", name="Redo", exact=True).click()
    page.wait_for_function("() => told.includes('figure') && told.length > 1")
    assert page.evaluate("told[0]") == "frame with the numbers"


@pytest.mark.wide
def test_buttons_for_marked_rows_wait_for_marks_and_excluding_for_a_reason(page):
    def button(name):
        return page.get_by_role("button", name=name, exact=True)

    page.locator("#marked").get_by_text("mark samples in a view or in the table").wait_for()
    page.locator("#marked-parameters").get_by_text("no parameter marked").wait_for()
    for name in ("Exclude", "Open", "Fix marked", "Free marked"):
        assert button(name).is_disabled(), name
    parameters = page.get_by_role("region", name="Parameters", exact=True)
    parameters.get_by_role("checkbox").nth(1).click()
    page.locator("#marked-parameters").get_by_text("1 parameter marked").wait_for()
    assert button("Fix marked").is_enabled()
    samples = page.get_by_role("region", name="Samples", exact=True)
    for row in (1, 2):
        samples.get_by_role("checkbox").nth(row).click()
        page.locator("#marked").get_by_text(f"{row} sample").wait_for()
    assert button("Open").is_enabled()
    assert button("Exclude").is_disabled()
    page.get_by_label("reason").fill("bumped")
    button("Exclude").click()
    page.get_by_text("2 samples are excluded").wait_for()
    # Both come back in one step, which one Undo reverses.
    button("Include all").click()
    page.get_by_text("2 samples are excluded").wait_for(state="hidden")
    page.get_by_role("cell", name=re.compile(r"^include \d+, \d+$")).first.wait_for()


def inside_viewport(page, name):
    """Whether a button lies inside the window and nothing covers it."""
    box, window = (
        page.get_by_role("button", name=name, exact=True).bounding_box(),
        page.viewport_size,
    )
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    on_top = page.evaluate(
        "([x, y]) => document.elementFromPoint(x, y)?.closest('button')?.innerText ?? ''", middle
    )
    return (
        box["x"] >= 0
        and box["y"] >= 0
        and box["x"] + box["width"] <= window["width"]
        and box["y"] + box["height"] <= window["height"]
        and on_top.lower() == name.lower()
    )


@pytest.mark.wide
def test_stop_and_pause_are_in_view_at_every_size_and_act(page, told):
    """The last test of this robot, which stops."""
    page.reload()
    page.locator("#verdict").get_by_text("explained, not yet in the model").wait_for()
    page.locator("#campaign").get_by_text("moving: pose 27").wait_for()
    for width, height in ((800, 600), (1280, 800), (1920, 1080), (853, 480), (640, 400)):
        page.set_viewport_size({"width": width, "height": height})
        for end in ("0", "document.body.scrollHeight"):
            page.evaluate(f"window.scrollTo(0, {end})")
            time.sleep(0.3)  # the header is laid out anew
            for name in ("STOP", "Pause"):
                assert inside_viewport(page, name), (name, width, height, end)
        assert page.evaluate("window.scrollY") > 0
        assert page.locator("header").bounding_box()["height"] < 0.75 * height
        assert page.evaluate("document.documentElement.scrollWidth") <= width

    page.get_by_role("button", name="Pause", exact=True).click()
    page.locator("#campaign").get_by_text("paused: ").wait_for()
    assert told.read_text().split() == ["pause"]
    page.get_by_role("button", name="Resume", exact=True).click()
    page.locator("#campaign").get_by_text("moving: ").wait_for()

    page.set_viewport_size({"width": 1280, "height": 800})
    page.get_by_role("region", name="Samples", exact=True).get_by_role("checkbox").nth(1).click()
    page.get_by_role("button", name="Open", exact=True).click()
    page.get_by_role("button", name="Close", exact=True).wait_for()
    assert inside_viewport(page, "STOP")  # nor does a dialog cover it
    page.get_by_role("button", name="STOP", exact=True).click()
    until(lambda: told.read_text().split() == ["pause", "resume", "stop"], "STOP to be told")
    page.locator("#campaign").get_by_text("stopped: ").wait_for()


@pytest.mark.wide
def test_while_a_campaign_runs_nobody_is_asked_to_move_the_robot(browser, tmp_path):
    Session.new(tmp_path / "s", read_model(MODEL), [])
    served = Served(tmp_path / "s", tmp_path / "told", command=beside_a_played_robot)
    try:
        page = open_page(browser, served.url)
        page.locator("#campaign").get_by_text("moving: pose 27").wait_for()
        page.locator("#verdict").get_by_text("The campaign is measuring").wait_for()
        page.locator("#empty").get_by_text("the campaign is measuring").wait_for()
        assert "Move the robot" not in page.locator("body").inner_text()
        page.get_by_role("button", name="STOP", exact=True).click()
        page.locator("#empty").get_by_text("Move the robot from pose to pose").wait_for()
    finally:
        served.end()
