"""Numbers that joints have of their own: gears, screws and encoders of one robot that differ."""

import re
from dataclasses import replace

import numpy as np
import pytest
from marks import as_slow
from scipy.optimize import minimize
from typer.testing import CliRunner

import parallel_cal as pc
from parallel_cal.base.errors import ModelError
from parallel_cal.causes.settings import Scan
from parallel_cal.cli.main import application
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.posterior.evidence import Choice
from parallel_cal.reporting.contents import parameters
from parallel_cal.reporting.summary import describe_effect, describe_missing, summarize
from parallel_cal.session.steps import add


def with_ripples(ratios, seed, poses=120, size=0.6e-3):
    """Samples of a Delta whose gears have these ratios, as its own readings would show them."""
    model, rng = new_model("delta24"), np.random.default_rng(seed)
    data = pc.simulate(model, poses, seed).dataset()
    true = data.q
    phases = rng.uniform(0, 2 * np.pi, 3)
    read = true.copy()
    for _ in range(50):  # true = read + size sin(ratio read + phase)
        read = true - size * np.sin(np.array(ratios) * read + phases)
    return model, replace(data, q=read)


@pytest.mark.wide
@pytest.mark.parametrize("ratios", [(9.0, 15.0, 15.0), (7.3, 21.0, 33.0)])
def test_gears_that_differ_have_their_own_ratios(ratios):
    """A ratio of 7.5 was named for gears of 9 and 15, and nothing for three ratios."""
    model, data = with_ripples(ratios, 2)
    found = pc.diagnose(model, data, joint_sigma=1.2e-4)
    assert found.effects == ("gear_transmission_error",)
    [named] = found.best.chosen
    setting = named.settings
    each = [setting.get(f"joint{k}.ratio", setting["ratio"]) for k in (1, 2, 3)]
    assert each == pytest.approx(ratios, abs=0.3)
    assert len(setting) == len(set(ratios))  # equal gears share a number
    [weighed] = [one["settings"]["gear_transmission_error"] for one in found.missing]
    assert weighed[0]["probability"] > 0.9
    assert set(weighed[0]["sigma"]) == set(setting)
    before, after = (one.fitted.held_out.summary.position_rms for one in (found.base, found.best))
    assert after < 0.5 * before
    assert found.left == "no"


@pytest.mark.wide
def test_equal_gears_have_one_ratio():
    model, data = with_ripples((12.4, 12.4, 12.4), 3)
    found = pc.diagnose(model, data, joint_sigma=1.2e-4)
    [named] = found.best.chosen
    assert named.settings == pytest.approx({"ratio": 12.4}, abs=0.3)


LEADS = {"joint1": 5.1e-3, "joint2": 5.1e-3, "joint3": 8.2e-3}  # m


def with_screws(leads):
    """Samples of a linear delta whose screws have these leads."""
    waves = ",".join(f"{joint}.sin={60e-6!r},{joint}.lead={v!r}" for joint, v in leads.items())
    noise = Noise(joint=2e-6, position=1e-5, orientation=1e-4)
    model = replace(new_model("linear_delta"), noise=noise)
    data = pc.simulate(model, 120, 4, effects=[f"screw_pitch_error:lead=5.1e-3,{waves}"]).dataset()
    return model, data


@pytest.mark.wide
def test_screws_of_one_robot_may_have_different_leads():
    """Two axes with a lead of 5 mm, and one with 8 mm."""
    model, data = with_screws(LEADS)
    found = pc.diagnose(model, data)
    [named] = found.best.chosen
    assert named.name == "screw_pitch_error"
    each = [named.settings.get(f"{joint}.lead", named.settings["lead"]) for joint in LEADS]
    assert each == pytest.approx([*LEADS.values()], rel=0.02)


def test_files_of_earlier_releases_have_one_number_for_all():
    model = new_model("delta24").with_effect("gear_transmission_error", {"ratio": 80.0})
    text = dump_model(model)
    lines = [line for line in text.splitlines() if ".ratio" not in line]
    assert len(lines) == len(text.splitlines()) - 3
    read = parse_model("\n".join(lines), "robot.yaml")
    assert read.table.names == model.table.names
    np.testing.assert_array_equal(read.values, model.values)
    np.testing.assert_array_equal(read.fixed, model.fixed)


def test_an_own_number_takes_the_place_of_the_common_one():
    settings = {"ratio": 9.0, "joint2.ratio": 15.0}
    model = new_model("delta24").with_effect("gear_transmission_error", settings)
    sizes = {f"gear_transmission_error.joint{k}.sin1": 1e-3 for k in (1, 2)}
    values = np.array([sizes.get(n, v) for n, v in model.table.mapping(model.values).items()])
    plain, q = pc.Kinematics(new_model("delta24")), np.array([0.3, 0.2, 0.1])
    rippled = pc.Kinematics(model.with_values(values))
    ideal = q + 1e-3 * np.array([np.sin(9 * 0.3), np.sin(15 * 0.2), 0.0])
    r, expected = (one.position for one in (rippled.direct(q), plain.direct(ideal)))
    np.testing.assert_allclose(r, expected, atol=1e-9)


def test_each_joint_that_differs_is_named_with_its_number():
    model = new_model("delta24").with_effect(
        "gear_transmission_error", {"ratio": 9.0, "joint2.ratio": 15.0}
    )
    sigmas = {"ratio": 0.2, "joint2.ratio": 0.11}
    words = describe_effect(model, "gear_transmission_error", sigmas)
    assert words.endswith("ratio of the others 9.00 +- 0.20; ratio of joint2 15.00 +- 0.11)")
    each = {"ratio": 9.0, **{f"joint{k}.ratio": 10.0 + k for k in (1, 2, 3)}}
    words = describe_effect(
        new_model("delta24").with_effect("gear_transmission_error", each),
        "gear_transmission_error",
    )
    assert words.endswith("; ratio of joint1 11; ratio of joint2 12; ratio of joint3 13)")


@pytest.mark.wide
def test_an_addition_without_numbers_searches_for_those_of_each_joint():
    """It took one ratio for all, and left no way on: the effect was in the model then."""
    model, data = with_ripples((9.0, 15.0, 15.0), 2)
    step = add(model, "gear_transmission_error", data, joint_sigma=1.2e-4)
    found = step.model.table.mapping(step.model.values)
    own = [found[f"gear_transmission_error.joint{k}.ratio"] for k in (1, 2, 3)]
    each = [one or found["gear_transmission_error.ratio"] for one in own]
    assert each == pytest.approx((9.0, 15.0, 15.0), abs=0.3)


def test_a_number_of_one_joint_needs_that_of_the_others():
    with pytest.raises(ModelError, match=r"joint1\.ratio is stated without ratio"):
        new_model("delta24").with_effect("gear_transmission_error", {"joint1.ratio": 11.0})


@pytest.fixture(scope="module")
def ripples():
    """The ripples of three gears, beside encoders that may be eccentric, near their ratios."""
    model, data = with_ripples((9.0, 15.0, 15.0), 2)
    causes = Causes.of(
        see(pc.fit(model, data, hold_out=0, joint_sigma=1.2e-4)),
        ["gear_transmission_error", "encoder_eccentricity"],
        kinds=(),
    )
    blocks = {one.name: one for one in causes.blocks}
    beside = causes.sum.evidence((Choice(blocks["encoder_eccentricity"], 0, 1),), causes.nu)
    block = blocks["gear_transmission_error"]
    return Scan(causes.scene, beside, beside.rank_one(block).best)


def test_a_cause_beside_others_is_weighed_as_if_these_were_taken_out(ripples):
    """r' S^-1 r and |S| of all causes are those of the one, of what S^-1/2 of the others leaves."""
    setting = ripples.block.settings[ripples.best.setting]
    others = ripples.beside.log_p - ripples.beside.outside.log_p
    beside = ripples.beside.weigh(ripples.at(setting).alone).max()
    assert ripples.weigh(setting) + others == pytest.approx(beside, abs=1e-3)


def test_numbers_are_sought_to_the_peak_that_a_search_without_derivatives_finds(ripples):
    setting = dict(ripples.block.settings[ripples.best.setting])
    keys = [*setting]
    assert len(keys) == 2
    start = np.array([setting[key] for key in keys])

    def weigh(numbers):
        return ripples.weigh({**setting, **dict(zip(keys, numbers, strict=True))})

    simplex = [start, start + [0.3, 0], start + [0, 0.3]]
    how = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-5}
    best = minimize(lambda numbers: -weigh(numbers), start, method="Nelder-Mead", options=how)
    reached, found = ripples.find_peak(setting, keys)
    assert reached == pytest.approx(-best.fun, abs=2e-3)
    assert reached > weigh(start) + 1
    sigma = ripples.compute_sigma(found)
    away = [(found[key] - value) / sigma[key] for key, value in zip(keys, best.x, strict=True)]
    assert away == pytest.approx([0, 0], abs=0.05)


@pytest.mark.wide
def test_the_tables_of_a_report_list_the_numbers_that_joints_have():
    """They listed `gear ratio of its own, or 0 of joint 1`, with the value 0."""
    name = "gear_transmission_error"
    model, data = with_ripples((9.0, 15.0, 9.0), 2)

    def list_shown(settings):
        result = pc.fit(model.with_effect(name, settings), data, joint_sigma=1.2e-4, hold_out=0)
        shown = {n: one for n, one in parameters(result).items() if n.endswith("ratio")}
        return {n.removeprefix(f"{name}."): (one.value, one.words) for n, one in shown.items()}

    assert list_shown({"ratio": 9.0}) == {"ratio": (9.0, f"gear ratio of {name.replace('_', ' ')}")}
    found = list_shown({"ratio": 9.0, "joint2.ratio": 15.0})
    assert set(found) == {"ratio", "joint2.ratio"}
    assert found["joint2.ratio"] == (15.0, "own gear ratio of joint 2 of gear transmission error")
    every = {f"joint{k}.ratio": ratio for k, ratio in ((1, 9.0), (2, 15.0), (3, 9.5))}
    assert set(list_shown({"ratio": 9.0, **every})) == set(every)


GEARS = "gear_transmission_error"


@pytest.mark.wide
@pytest.mark.parametrize(
    ("ratios", "other"),
    [((9.0, 15.0, 9.0), {"joint2.ratio": 15.0}), ((12.4, 12.4, 12.4), {})],
)
def test_a_joint_whose_number_differs_is_found_in_a_model_that_has_the_effect(
    tmp_path, monkeypatch, ratios, other
):
    """Laws and other effects were named for it, since the model had the effect already."""
    model, data = with_ripples(ratios, 2)
    common = f"{GEARS}:ratio={ratios[0]}"
    has = add(model, common, data, force=True, joint_sigma=1.2e-4).model
    found = pc.diagnose(has, data, joint_sigma=1.2e-4)
    assert found.effects == ((GEARS,) if other else ())
    assert found.left == "no"
    if not other:
        return
    [named] = found.best.chosen
    assert named.settings == pytest.approx(other, abs=0.6)
    lines = {line.label: line.text for line in summarize(found)}
    assert lines["missing:"] == f"{GEARS} with another ratio of joint2 > 99 %"
    assert found.verdict.summary.startswith(f"{GEARS} with another ratio of joint2 accounts for")
    assert describe_missing(found) == "Ripple of the gears with another ratio of joint2: > 99 %."
    # The proposed command works, and the model then lacks nothing.
    monkeypatch.chdir(tmp_path)
    pc.write_model(has, "robot.yaml")
    data.to_json("today.json")
    words = ["add", "robot.yaml", *found.additions, "today.json", "--joint-sigma", "1.2e-4"]
    done = CliRunner().invoke(application(words), [*words, "-o", "better.yaml"])
    assert done.exit_code == 0
    better = pc.read_model("better.yaml")
    assert better.value(f"{GEARS}.joint2.ratio") == named.settings["joint2.ratio"]
    assert better.value(f"{GEARS}.ratio") == 9.0
    assert [effect.name for effect in better.effects] == [GEARS]
    assert pc.diagnose(better, data, joint_sigma=1.2e-4).effects == ()


@pytest.mark.slow
def test_a_screw_that_differs_is_found_in_a_model_that_has_the_effect():
    model, data = with_screws(LEADS)
    has = add(model, "screw_pitch_error:lead=5.1e-3", data, force=True).model
    [named] = pc.diagnose(has, data).best.chosen
    assert named.settings == pytest.approx({"joint3.lead": 8.2e-3}, rel=0.02)


@pytest.mark.wide
def test_another_effect_is_not_taken_for_a_number_of_one_joint():
    model, data = with_ripples((12.4, 12.4, 12.4), 6)
    data = replace(data, q=data.q + 3e-3 * np.sin(2 * data.q + 0.3) * np.array([0, 1, 0]))
    has = add(model, f"{GEARS}:ratio=12.4", data, force=True, joint_sigma=1.2e-4).model
    found = pc.diagnose(has, data, joint_sigma=1.2e-4)
    assert found.effects
    assert GEARS not in found.effects


def test_an_effect_that_the_model_has_takes_only_the_number_of_a_joint():
    has = new_model("delta24").with_effect(GEARS, {"ratio": 9.0})
    assert has.with_effect(GEARS, {"joint2.ratio": 15.0}).value(f"{GEARS}.joint2.ratio") == 15.0
    for wrong in ({}, {"ratio": 8.0}, {"ratio": 8.0, "joint2.ratio": 15.0}):
        with pytest.raises(ModelError, match=r"already has .*: gear_.*:JOINT\.ratio=\.\.\."):
            has.with_effect(GEARS, wrong)


@pytest.mark.wide
@pytest.mark.parametrize(
    "numbers", [as_slow({"ratio": 23.0}), {"ratio": 23.0, "joint2.ratio": 34.0}]
)
def test_several_joints_whose_numbers_differ_in_a_model_are_found_one_after_the_other(numbers):
    """It failed where two joints were likely; a stated number of a joint that is wrong was not
    doubted."""
    ratios = (23.0, 37.3, 51.9)
    model, data = with_ripples(ratios, 2)
    for _ in range(2):
        has = model.with_effect(GEARS, numbers)
        found = pc.diagnose(has, data, joint_sigma=1.2e-4)
        assert GEARS in found.effects
        [named] = [one for one in found.best.chosen if one.name == GEARS]
        numbers = {**numbers, **named.settings}
    each = [numbers[f"joint{k}.ratio"] for k in (2, 3)]
    assert each == pytest.approx(ratios[1:], abs=1.0)
    # Beside both, nothing is left.
    assert pc.diagnose(model.with_effect(GEARS, numbers), data, joint_sigma=1.2e-4).left == "no"


def test_a_width_of_a_slide_among_joints_that_turn_has_its_own_unit():
    """It was listed as an angle: 0.0001 m as 0.0057 deg."""
    words = describe_effect(new_model("scara16").with_effect("hysteresis"), "hysteresis")
    assert re.fullmatch(r"hysteresis \(width [\d.]+ deg; width of joint3 [\d.]+ mm\)", words)
