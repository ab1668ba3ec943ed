"""The first screen of the page: the machine, the answers, one next step, and words for people."""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from workbench_page import LONG, Served, opened

from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.reporting.contents import describe_parameters
from parallel_cal.reporting.machine import (
    GLOW_COLOUR,
    ErringPart,
    Stage,
    describe_erring_parts,
    draw_machine,
    find_erring_parts,
)
from parallel_cal.reporting.names import TITLES, name_effects, name_step, title_of
from parallel_cal.reporting.summary import describe_left
from parallel_cal.session.session import Session
from parallel_cal.workbench.next_step import WaysOn, find_next_step

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"
HEXAPOD = "config/stewart_general.yaml"


# ------------------------------------------------------------------ names


def test_every_effect_of_the_catalogue_has_a_name_for_people():
    folder = Path(__file__).parents[2] / "parallel_cal" / "effects"
    names = {file.stem for file in folder.glob("[a-z]*.py")}
    assert set(TITLES) == {name for name in names if "_" in name}
    assert not any("_" in title for title in TITLES.values())


def test_names_of_effects_are_replaced_in_sentences_but_not_in_names_of_parameters():
    assert name_effects("add encoder_gain, forced") == "add gain of the drives, forced"
    assert name_effects("thermal_expansion_by_part") == "thermal expansion by part"
    assert name_effects("encoder_gain.joint1.gain, my_encoder_gain") == (
        "encoder_gain.joint1.gain, my_encoder_gain"
    )
    assert title_of("my_law") == "my law"


# ------------------------------------------------------------------ the machine


def field(size, n=30):
    rng = np.random.default_rng(2)
    return size * rng.standard_normal((n, 3))


def draw(sizes, model=HEXAPOD, erring=()):
    places = np.random.default_rng(1).uniform(-0.04, 0.04, (30, 3)) + [0, 0, 0.3]
    stages = [Stage(str(k), field(size)) for k, size in enumerate(sizes)]
    return draw_machine(read_model(model), places, stages, np.arange(30), erring)


def longest(stage, magnification=0):
    at = stage["traces"][magnification][0]
    starts, ends = (np.array([at[a][k::3] for a in "xyz"], float) for k in (0, 1))
    return np.linalg.norm(ends - starts, axis=0).max()


def test_arrows_shrink_along_the_slider_on_one_scale_and_one_ramp():
    drawn = draw([600e-6, 48e-6, 26e-6])
    stages, (usual, enlarged) = drawn["stages"], drawn["scales"]
    assert usual == draw([600e-6])["scales"][0]  # it shows the first stage
    for k, scale in enumerate((usual, enlarged)):
        lengths = [longest(stage, k) for stage in stages]
        assert np.divide(lengths, lengths[0]) == pytest.approx([1, 48 / 600, 26 / 600], rel=1e-3)
        assert lengths[0] / longest(stages[0]) == pytest.approx(scale / usual, rel=1e-3)
    colours = [set(stage["traces"][0][0]["line"]["color"]) for stage in stages]
    assert len(colours[0] & colours[2]) < 10  # large errors have other colours than small ones


def test_enlarged_arrows_of_the_last_stage_are_inside_the_axes_and_longer_ones_have_no_head():
    drawn = draw([600e-6, 37e-6, 32e-6])
    first, _, last = drawn["stages"]
    for axis in "xyz":
        low, high = drawn["layout"]["scene"][f"{axis}axis"]["range"]
        for trace in (*first["traces"][0], *last["traces"][1]):
            values = [v for v in trace[axis] if v is not None]
            assert low < min(values) <= max(values) < high
    kinds = [[trace["type"] for trace in stage["traces"][1]] for stage in (first, last)]
    assert kinds == [["scatter3d"] * 2, ["scatter3d", "mesh3d", "scatter3d"]]


def test_without_errors_that_became_small_there_is_nothing_to_enlarge():
    assert len(draw([128e-6, 120e-6])["scales"]) == 1
    assert draw([])["scales"] == []


def test_a_sample_that_was_not_judged_has_no_arrow():
    model, places = read_model(HEXAPOD), np.zeros((30, 3))
    errors = field(1e-4)
    errors[7] = np.nan
    drawn = draw_machine(model, places, [Stage("now", errors)], np.arange(100, 130))
    words = drawn["stages"][0]["traces"][0][2]["text"]
    assert len(words) == 29
    assert not any(text.startswith("107:") for text in words)


@pytest.mark.parametrize(("model", "owner"), [(HEXAPOD, "leg3"), (MODEL, "joint2")])
def test_the_part_that_errs_glows_with_its_size_and_no_other_part(model, owner):
    from parallel_cal.reporting.drawings import lines

    drawn = draw([1e-4], model, [ErringPart("backlash", owner, 53e-6, "m")])
    [glow] = [t for t in drawn["robot"] if t.get("line", {}).get("color") == GLOW_COLOUR]
    text = f"{owner[:-1]} {owner[-1]}: 53.0 µm"
    assert [one["text"] for one in drawn["layout"]["scene"]["annotations"]] == [text]
    family = {"leg3": "leg3.", "joint2": "chain2."}[owner]
    driven = [part for part in lines(read_model(model)) if part.kind == "driven"]
    own = [part for part in driven if any(name.startswith(family) for name in part.parameters)]
    at = np.array([[v for v in glow[a] if v is not None] for a in "xyz"]).T
    np.testing.assert_allclose(at, 1e3 * np.vstack([part.points for part in own]), atol=1e-2)


def test_arrows_point_the_same_way_wherever_the_device_stands():
    from dataclasses import replace

    from parallel_cal.base.rotation import rotation_matrix
    from parallel_cal.diagnosis.comparison import compare
    from parallel_cal.recordings.simulate import simulate
    from parallel_cal.workbench.views import _make_comparison_view

    model = read_model(HEXAPOD)
    data = simulate(model, 20, 5, effects=["backlash:width=6e-5"]).dataset()
    turn, shift = rotation_matrix(np.array([0.3, -0.5, 1.2])), np.array([0.5, -1.0, 0.4])
    moved = replace(data, r=(data.r - shift) @ turn, R=turn.T @ data.R, frame="tracker")
    here, there = (_make_comparison_view(compare(model, one))["machine"] for one in (data, moved))
    for axis in "xyz":
        shafts = (drawn["stages"][0]["traces"][0][0][axis] for drawn in (here, there))
        np.testing.assert_allclose(*(np.array(one, float) for one in shafts), atol=1e-3)
    [device] = [trace for trace in there["robot"] if trace.get("name") == "device"]
    assert device["text"] == ["device, 1.1 m away"]  # 0.5, -1 and 0.4 m, from the robot's middle


def test_the_robot_is_drawn_to_scale_with_the_device_where_it_was_registered():
    from parallel_cal.sensors.device_frame import DeviceFrame

    model = read_model(HEXAPOD)
    assert not any(trace["name"] == "device" for trace in draw_machine(model)["robot"])
    near, far = (
        model.with_sensors((DeviceFrame(position=at),)) for at in ((0.1, 0.2, 0.3), (0.0, 4.0, 0.1))
    )
    [device] = [t for t in draw_machine(near)["robot"] if t["name"] == "device"]
    assert [device[a] for a in "xyz"] == [[100.0], [200.0], [300.0]]
    drawn = draw_machine(far)
    [device] = [t for t in drawn["robot"] if t["name"] == "device"]
    assert device["text"] == ["device, 4 m away"]
    low, high = drawn["layout"]["scene"]["yaxis"]["range"]
    assert low < device["y"][0] < high < 1000  # at the edge: the robot stays large
    assert drawn["layout"]["scene"]["aspectmode"] == "data"
    assert drawn["layout"]["scene"]["xaxis"]["title"]["text"] == "x of base [mm]"


def test_only_parts_whose_size_stands_out_are_named_and_several_share_a_sentence():
    from parallel_cal.identification.fit import summarise_parameters

    model = read_model(HEXAPOD).with_effect("backlash")
    values, sigma = model.values.copy(), np.full(len(model.values), 5e-6)
    own = model.table.matching(["backlash.*"])
    values[own] = [53e-6, 24e-6, 1e-6, 40e-6, 40e-6, 40e-6]
    model = model.with_values(values)
    estimates = summarise_parameters(model, sigma, np.zeros(len(values), bool))
    parts = find_erring_parts(["backlash"], describe_parameters(model, estimates))
    assert [part.owner for part in parts] == ["leg1", "leg2", "leg4", "leg5", "leg6"]
    words = describe_erring_parts(parts, model.joints)
    assert words == "Backlash in leg 1, leg 2, leg 4, leg 5 and leg 6: 24.0 to 53.0 µm."
    whole = [ErringPart("backlash", joint, 3e-5, "m") for joint in model.joints]
    assert describe_erring_parts(whole, model.joints) == "Backlash in all 6 legs: 30.0 µm."


# ------------------------------------------------------------------ one next step


class State:
    def __init__(self, errors=True):
        self.errors = {"position_rms": 1e-4} if errors else {}


class FakeBench:
    """A bench in a state; its steps are told by name."""

    live = law_view = None

    def __init__(self, view, state=None, is_saved=False, planned=None):
        self.is_saved, self.planned = is_saved, planned
        self.view, self.session = view, type("S", (), {"state": state or State()})
        self.has_samples = view is not None and "verdict" in view

    def begin(self, *step):
        return step

    def save(self):
        return ("save",)

    def find_law(self):
        return ("find_law",)


WAYS = WaysOn(lambda: ("import",), lambda: ("show poses",))


def judged(offered=None, left="no", find_law=False, needs_poses=False, deciding_poses=0):
    return {
        "needs_poses": needs_poses,
        "deciding_poses": deciding_poses,
        "verdict": {},
        "answers": {"is_left": left},
        "offered": offered,
        "find_law": find_law,
    }


OFFERED = {"effects": ["encoder_gain", "backlash"], "text": "encoder_gain+backlash"}


@pytest.mark.parametrize(
    ("view", "state", "words", "step"),
    [
        ({"robot": "delta54"}, State(errors=False), "Import a table", ("import",)),
        ({"verdict": {}}, State(errors=False), "Fit", ("fit",)),
        (
            judged(OFFERED, "yes", True),
            State(),
            "Add gain of the drives and backlash",
            ("add", "encoder_gain+backlash"),
        ),
        (judged(left="yes", find_law=True), State(), "Find its law", ("find_law",)),
        (judged(), State(), "Save", ("save",)),
        (judged(deciding_poses=12), State(), "Save", ("save",)),
        (judged(OFFERED, "unknown", needs_poses=True), State(), "Plan 20 poses", ("plan", 20)),
    ],
)
def test_the_next_step_follows_the_state(view, state, words, step):
    found = find_next_step(FakeBench(view, state), WAYS)
    assert found.words == words
    assert found.begin() == step


@pytest.mark.parametrize(
    ("bench", "words"),
    [
        (FakeBench(judged(needs_poses=True), planned="1.csv"), "See the planned poses"),
        (FakeBench(judged(deciding_poses=12), is_saved=True), "See 12 poses that help to decide"),
    ],
)
def test_poses_that_are_planned_are_the_next_step_where_more_must_be_measured(bench, words):
    found = find_next_step(bench, WAYS)
    assert found.words == words
    assert found.begin() == ("show poses",)


@pytest.mark.parametrize(
    ("view", "is_saved"),
    [
        (None, False),  # the samples are being read
        ({"verdict": {}}, False),  # fitted, and not diagnosed yet
        (judged(), True),
    ],
)
def test_there_is_no_next_step_while_nothing_is_judged_and_after_a_save(view, is_saved):
    assert find_next_step(FakeBench(view, is_saved=is_saved), WAYS) is None


# ------------------------------------------------------------------ in the views


def test_a_sentence_that_begins_with_an_effect_has_its_name_for_people():
    from parallel_cal.diagnosis.verdict import Verdict
    from parallel_cal.workbench.views import _verdict

    verdict = Verdict("explained", "own_weight_sag accounts for it", remarks=("encoder_gain fits",))
    diagnosis = SimpleNamespace(verdict=verdict, model=SimpleNamespace(effects=()))
    said = _verdict(diagnosis)
    assert said["words"] == "Sag by its own weight accounts for it."
    assert said["remarks"] == ["Gain of the drives fits."]


@pytest.mark.wide
def test_all_that_is_shown_has_one_frame_one_set_of_samples_and_one_noise(tmp_path):
    from parallel_cal.workbench import views

    session = Session.new(
        tmp_path / "s", read_model(MODEL), [BAG], fitting=FitOptions(hold_out=0.5)
    )
    session.fit()
    view = views.view(session, lambda *told: None)
    tiles = {tile["name"]: tile["values"][0][0] for tile in view["tiles"]}
    assert [stage["name"] for stage in view["machine"]["stages"]] == [
        "nominal",
        "fitted",
        "+ backlash",
    ]
    for stage, tile in zip(view["machine"]["stages"], list(tiles.values())[:3], strict=True):
        # The arrows are the errors of the tile: rms of their lengths over the magnification.
        at = stage["traces"][0][0]
        starts, ends = (np.array([at[a][k::3] for a in "xyz"], float) for k in (0, 1))
        lengths = np.linalg.norm(ends - starts, axis=0) / view["machine"]["scales"][0] * 1e3  # µm
        rms = np.sqrt(np.mean(lengths**2))
        assert rms == pytest.approx(float(tile.split(" ")[0]), rel=0.02)
    assert view["answers"]["missing"].startswith("Backlash: 7")
    assert view["answers"]["left"] == "Nothing else is left: the rest is noise."
    assert "add in squares" in view["budget"]["title"]


# ------------------------------------------------------------------ in a browser


@pytest.mark.wide
def test_a_stranger_is_led_from_an_empty_page_to_a_saved_model(tmp_path):
    with opened() as browser:
        served = Served(HEXAPOD, "--session", tmp_path / "s", "-o", tmp_path / "robot.yaml")
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.set_default_timeout(1000 * LONG)
            page.goto(served.url)
            page.locator("#robot").get_by_text("(stewart42), 6 joints").wait_for()
            page.locator("#machine-words").get_by_text("to scale").wait_for()
            page.get_by_role("button", name="Try it with simulated poses").click()
            page.get_by_role("button", name="next step: Fit").click()
            page.locator("#missing").get_by_text("Backlash").wait_for()

            said = page.locator("#machine-words")
            said.get_by_text("in the frame of the base, fitted: ").wait_for()
            times = re.search(r"every step magnified \d+ times", said.inner_text())[0]
            slider = page.get_by_role("slider", name="errors of which model")
            slider.locator("[tabindex]").press("ArrowRight")
            said.get_by_text("+ backlash: ").wait_for()
            assert times in said.inner_text()
            page.get_by_role("checkbox", name="enlarge").click()
            page.wait_for_function(f"!document.body.innerText.includes('{times}')")

            page.locator(".machine canvas").first.hover()
            page.mouse.wheel(0, 200)
            page.wait_for_function("scrollY > 0")
            page.evaluate("scrollTo(0, 0)")

            page.get_by_role("button", name="Why?").click()
            page.get_by_role("figure", name="proof: backlash: residual of leg1 against").wait_for()
            page.get_by_role("button", name="Close", exact=True).click()
            page.get_by_role("button", name="next step: Add backlash").click()
            page.get_by_role("button", name="next step: Save").click()
            page.locator("#message").get_by_text("written").wait_for()
            page.locator("#saved").get_by_text("saved in robot.yaml").wait_for()
            page.get_by_role("button", name=re.compile("next step: See .* to decide")).click()
            page.wait_for_function("document.activeElement.id === 'plan'")
            assert page.locator("#plan").bounding_box()["y"] < 100  # below the header
            assert read_model(tmp_path / "robot.yaml").effects

            served.end()
            lost = page.locator("#popup")
            lost.get_by_text("Connection lost").wait_for()
            page.wait_for_function(
                "getComputedStyle(document.querySelector('#popup')).visibility === 'visible'"
            )
            assert lost.bounding_box()["y"] < 20
        finally:
            if served.process.poll() is None:
                served.end()


def test_a_step_is_named_without_the_settings_with_which_its_effect_began():
    assert name_step("add hysteresis:*.width=0.0003") == "add hysteresis"
    assert name_step("add backlash and encoder_gain") == "add backlash and gain of the drives"
    assert name_step("import 3 samples of C:table.csv") == "import 3 samples of C:table.csv"


@pytest.mark.parametrize(
    ("left", "is_assumed", "words"),
    [
        ("no", False, "Nothing is left: the rest is noise."),
        ("no", True, "Nothing shows in the errors. How large the noise is was not stated."),
        ("unknown", True, "Whether anything is left is not known."),
    ],
)
def test_only_a_stated_noise_lets_the_rest_be_called_noise(left, is_assumed, words):
    fitted = SimpleNamespace(observations=SimpleNamespace(noise_assumed=is_assumed))
    diagnosis = SimpleNamespace(left=left, missing=[], best=SimpleNamespace(fitted=fitted))
    assert describe_left(diagnosis) == words
