"""A diagnosis on the independent robot: the right name, the right verdict, and honest doubts."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import virtual_day as vd
import virtual_effects_hidden as hidden
import virtual_effects_more as more
import virtual_findings as vf
from datasets import JOINTS, measured
from findings import clean, dataset, hiding
from marks import keep

import parallel_cal.diagnosis.diagnose as diagnosing
import parallel_cal.diagnosis.next_measurement as next_measurement
import parallel_cal.identification.fit as fitting
import parallel_cal.identification.given_model as given_model
from parallel_cal.base.errors import FitError
from parallel_cal.base.progress import ignore_progress
from parallel_cal.diagnosis.decision import DECIDED, Undecided, plan_decision
from parallel_cal.diagnosis.diagnose import diagnose, diagnose_fitted, refit_with_equal_weights
from parallel_cal.diagnosis.search import Chosen, Search
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Noise, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.results import describe
from parallel_cal.reporting.text import show
from parallel_cal.session.steps import add
from parallel_cal.virtual import robot as vr

MODEL = new_model("delta54")


@pytest.fixture(scope="module")
def play():
    """A diagnosis of hidden play, and the data."""
    data = measured(0, effects=[vr.Backlash((3e-4, 2.5e-4, 2e-4))], n_poses=110)
    return diagnose(MODEL, data), data


def test_a_diagnosis_of_a_known_fit_does_not_repeat_it_and_says_the_same(play, monkeypatch):
    whole, data = play
    result, fitted = fit(MODEL, data), list[str]()

    def refit(model, *given, **how):
        fitted.append("+".join(effect.name for effect in model.effects))
        return fitting.fit_unjudged(model, *given, **how)

    monkeypatch.setattr("parallel_cal.diagnosis.diagnose.fit_unjudged", refit)
    found = diagnose_fitted(MODEL, data, result)
    assert found.base.fitted is result
    assert fitted
    assert "" not in fitted
    said, again = whole.document(), found.document()
    assert {key for key in said if said[key] != again[key]} <= {"warnings", "dataset"}


def entry(document, name):
    return next(c for c in document["candidates"] if c["effect"] == name)


def test_a_single_step_shows_what_a_whole_fit_of_one_effect_would_find(play):
    _, data = play
    given = given_model.GivenModel.of(MODEL, data, None, False)
    search = Search(MODEL, refit_with_equal_weights(MODEL, given, FitOptions()), ignore_progress)
    one = Chosen("backlash")
    step = search.fit(one, once=True)
    whole = search.fit(one)
    assert step.fitted.estimate.iterations == 1 < whole.fitted.estimate.iterations
    assert step.fitted.estimate.chi2 == pytest.approx(whole.fitted.estimate.chi2, rel=1e-3)
    errors = [t.fitted.held_out.summary.position_rms for t in (search.fit(), step, whole)]
    assert errors[1] == pytest.approx(errors[2], rel=0.004)
    assert errors[2] < 0.9 * errors[0]
    widths = [t.fitted.parameters()["backlash.joint1.width"] for t in (step, whole)]
    assert widths[0].value == pytest.approx(widths[1].value, abs=0.05 * widths[1].sigma)
    assert search.fit(one, once=True).fitted is whole.fitted  # the better one, once it is known


# ------------------------------------------------------------------------- what it says


@cache
def nothing_found(seed):
    """The diagnosis of a robot without errors beside its geometry."""
    return diagnose(MODEL, clean(seed))


@cache
def one_kind_found(name):
    """The diagnosis of a robot that hides one kind of physics: 0.6 sigma of the residual, 150
    samples."""
    return diagnose(MODEL, hiding([vf.KINDS[name]], 0.6, seed=1)[0])


@pytest.mark.wide
@pytest.mark.parametrize("seed", keep(range(3), 0))
def test_where_nothing_is_hidden_it_says_stop_looking_and_proposes_nothing(seed):
    found = nothing_found(seed)
    assert found.verdict.word == "at_noise"
    assert found.effects == ()
    assert "no further effect is needed" in found.verdict.text


@pytest.mark.parametrize(("there", "refits"), [(True, 2), (False, 1)])
def test_refits_look_for_no_frame_again_and_judge_no_start(monkeypatch, there, refits):
    """Where the device stands is settled before the first of them, and nobody reads the rest; what
    is chance is not refitted."""
    data = hiding([vf.KINDS["backlash"]], 1.0, 0)[0] if there else clean(0)
    asked = {"register_observed": 0, "errors": 0}

    def counted(function):
        def call(*arguments):
            asked[function.__name__] += 1
            return function(*arguments)

        return call

    for module, name in ((given_model, "register_observed"), (fitting, "errors")):
        monkeypatch.setattr(module, name, counted(getattr(module, name)))
    found = diagnose(MODEL, data, effects=["backlash"])
    folds = len(found.dataset.folds(0.25, 0))
    assert asked == {"register_observed": 1, "errors": refits * (folds + 1)}
    assert (found.entries[0].alone is not None) is there


def test_hidden_backlash_is_found_and_its_width_is_estimated(play):
    found, _ = play
    assert found.verdict.word == "explained"
    assert found.effects == ("backlash",)
    best = entry(found.document(), "backlash")
    assert best["rank"] == 1
    assert best["p_value"] < 1e-9
    assert best["probability"] > 0.95
    assert best["remaining_after_geometry"] > 0.8
    widths = [best["parameters"][f"{joint}.width"] for joint in JOINTS]
    for width, truth in zip(widths, (3e-4, 2.5e-4, 2e-4), strict=True):
        assert abs(width["value"] - truth) < 4 * width["sigma"]


def test_the_document_of_a_diagnosis_has_the_keys_of_its_contract(play):
    document = play[0].document()
    assert {"verdict", "summary", "baseline", "noise", "candidates", "structure"} <= set(document)
    wanted = {
        "effect",
        "rank",
        "p_value",
        "holdout_before",
        "holdout_after",
        "share_explained",
        "remaining_after_geometry",
        "confused_with",
        "missing_conditions",
        "parameters",
    }
    for row in document["candidates"]:
        assert wanted <= set(row)
    ranks = [row["rank"] for row in document["candidates"]]
    assert ranks == sorted(ranks)
    best = document["candidates"][0]
    assert best["holdout_after"]["position_rms"] < best["holdout_before"]["position_rms"]


def test_the_table_of_effects_agrees_with_what_is_missing(play):
    """The probability of each effect in both, the most probable first."""
    found, _ = play
    stated = {name: p for cause in found.missing for name, p in cause["each"].items()}
    rows = found.document()["candidates"]
    assert {r["effect"]: r["probability"] for r in rows if r["effect"] in stated} == stated
    tested = [row["probability"] for row in rows if row["probability"] is not None]
    assert tested == sorted(tested, reverse=True)
    shown = show(found)
    [row] = [line.split() for line in shown.splitlines() if line.startswith("backlash ")]
    assert row[:3] == ["backlash", ">", "99"]


def test_of_many_samples_an_evenly_spread_part_is_diagnosed_which_a_warning_says(monkeypatch):
    whole = hiding([vf.KINDS["backlash"]], 1.0, 0)[0]
    monkeypatch.setattr(diagnosing, "MAX_DIAGNOSED_SAMPLES", 70)
    found = diagnose(MODEL, whole, effects=["backlash"])
    numbers = found.dataset.numbers
    assert 60 < len(numbers) < 80 < len(whole)  # about 70: with all visits of their poses
    assert numbers[-1] > 0.9 * len(whole)
    assert np.array_equal(found.dataset.q, whole.q[numbers])
    said = f"{len(numbers)} of {len(whole)} samples are used, evenly spread over the recording"
    assert said in found.document()["warnings"]
    assert found.effects == ("backlash",)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: clean(0), "at_noise"),
        (lambda: hiding([vf.KINDS["backlash"]], 1.0, 0)[0], "explained"),
        (lambda: hiding([vf.KINDS["joint compliance"]], 1.0, 0)[0], "unexplained"),
        (lambda: measured(3, n_poses=7, n_replicates=0), "cannot_know"),
    ],
    ids=["clean", "found", "not in the catalogue", "few"],
)
def test_a_verdict_is_two_short_sentences_and_a_list(make, word):
    found = diagnose(MODEL, make(), effects=["backlash"])
    assert found.verdict.word == word
    sentences = found.verdict.summary.split(". ")
    assert len(sentences) <= 2
    assert all(len(one.split()) <= 25 for one in sentences)
    document = found.document()
    assert document["summary"] == found.verdict.summary
    details = [*document["against"], *document["remarks"]]
    lines = show(found).splitlines()
    assert lines[0] == f"{word}: {found.verdict.summary}"
    assert lines[1 : 1 + min(len(details), 3)] == [f"- {one}" for one in details[:3]]


def test_add_accepts_the_effect_that_the_diagnosis_proposes(play):
    _, data = play
    step = add(MODEL, "backlash", data)
    held = step.document()["held_out"]["after"]
    assert held["position_rms"] < step.document()["held_out_without_effect"]["position_rms"]
    assert step.model.history[-1]["effect"] == "backlash"


@pytest.mark.wide
@pytest.mark.parametrize(
    "name", keep(vf.KINDS, "gear ripple", "joint compliance", "thermal growth")
)
def test_each_kind_of_physics_is_called_by_its_name(name):
    """bench/truth/find_effects.py draws hundreds."""
    found = one_kind_found(name)
    called = {n for e in found.effects for n in (e, *found.swaps.get(e, []))}
    assert called & set(vf.KINDS[name].names)
    assert found.verdict.word == "explained"
    after, floor = found.best.fitted.held_out.summary, found.best.fitted.noise_floor
    # A complete model of 42 numbers does as well on poses it has not seen: 5 % over the noise.
    assert after.position_rms < 1.12 * floor.position_rms


@pytest.mark.wide
def test_two_at_once_are_both_found():
    kinds = [vf.KINDS["backlash"], vf.KINDS["base drift"]]
    found = diagnose(MODEL, hiding(kinds, 0.6, seed=2)[0])
    assert [set(cause["effects"]) for cause in found.missing] in (
        [{"backlash", "hysteresis"}, {"base_drift"}],
        [{"backlash"}, {"base_drift"}],
    )
    assert all(cause["probability"] > 0.95 for cause in found.missing)
    assert found.verdict.word == "explained"
    assert found.left == "no"


@pytest.mark.wide
@pytest.mark.parametrize("name", keep(vf.OUTSIDE, "cross-talk", "a dented field"))
def test_an_effect_outside_the_catalogue_is_never_explained_by_known_effects(name):
    kind = vf.Kind((), vf.OUTSIDE[name], 0.5e-3)
    found = diagnose(MODEL, hiding([kind], 1.5, seed=3)[0])
    assert found.verdict.word == "unexplained"
    assert not found.effects
    assert found.explanation.laws


@pytest.mark.wide
def test_a_dissipative_effect_of_the_wrong_sign_teaches_the_robot_nothing():
    """Directions recorded with the wrong sign: other effects would only imitate the backlash."""
    found = diagnose(MODEL, measured(0, effects=[vr.Backlash((-3e-3, -2e-3, -2.5e-3))]))
    assert found.verdict.word == "unexplained"
    assert not found.effects
    assert "width would have to be -0.00" in found.verdict.text
    assert "check the recorded direction and travel of the joints" in found.verdict.text


def test_an_effect_that_held_out_poses_do_not_prove_has_no_probability(monkeypatch):
    """The table gave 99 % to what `add` refused, and the verdict called the error unexplained."""

    def refuse(*given, **options):
        raise FitError("the validation error does not fall")

    monkeypatch.setattr(diagnosing, "find_addition", refuse)
    data = measured(0, effects=[vr.Backlash((3e-4, 2.5e-4, 2e-4))], n_poses=110)
    found = diagnose(MODEL, data, effects=["backlash"])
    row = entry(found.document(), "backlash")
    assert (found.suspected, found.missing) == (("backlash",), [])
    assert (row["probability"], row["reason"]) == (None, "the validation error does not fall")


@pytest.mark.wide
def test_an_unknown_gear_ratio_is_found_and_add_finds_it_too():
    ripple = hidden.GearRipple((4e-4, 3e-4, 3.5e-4), (0.3, 1.2, 2.0), 37.3)
    data = measured(4, effects=[ripple], n_poses=110)
    found = diagnose(MODEL, data, effects=["gear_transmission_error", "backlash"])
    best = entry(found.document(), "gear_transmission_error")
    # The second harmonic of half the ratio is the same wave.
    assert any(best["settings"]["ratio"] == pytest.approx(r, abs=0.3) for r in (37.3, 18.65))
    assert best["tried"] > 50
    step = add(MODEL, "gear_transmission_error", data)
    ratio = step.document()["parameters"]["gear_transmission_error.ratio"]["value"]
    assert ratio == pytest.approx(best["settings"]["ratio"], rel=1e-6)
    shown = re.search(r"gear_transmission_error: ratio ([\d.]+) \+- ", show(found))
    assert float(shown[1]) == pytest.approx(ratio, abs=0.1)
    [cause] = found.missing
    assert found.additions == (f"gear_transmission_error:ratio={best['settings']['ratio']!r}",)
    likeliest = cause["settings"]["gear_transmission_error"][0]
    assert likeliest["values"]["ratio"] == pytest.approx(ratio, rel=1e-3)
    assert best["settings_sigma"] == likeliest["sigma"]


@pytest.mark.wide
def test_of_an_effect_and_its_special_case_the_simpler_one_is_named_alone_unless_it_explains_less():
    def reason(found):
        return entry(found.document(), "strain_wave_compliance")["reason"]

    quiet = nothing_found(1)
    assert reason(quiet) == "not tested: joint_compliance, a special case of it, explains nothing"
    line = one_kind_found("joint compliance")
    assert reason(line) == "explains no more than joint_compliance, a special case of it"
    assert "strain_wave_compliance" not in (n for swaps in line.swaps.values() for n in swaps)
    k1 = np.array([800.0, 1000.0, 700.0])
    curved = more.StiffeningGears(tuple(k1), tuple(k1**3 / 0.25**2))
    kind = vf.Kind((), lambda s, rng: curved, 1.0, vf.FINE)
    found = diagnose(MODEL, hiding([kind], 1, seed=1)[0])
    assert found.effects == ("strain_wave_compliance",)


@pytest.mark.wide
def test_the_same_poses_at_another_size_of_noise_give_the_same_name():
    """F tests do not care how large the stated noise is; the verdict does."""
    data, _ = hiding([vf.KINDS["backlash"]], 0.6, seed=5)
    loose = replace(data, pose_cov=9 * data.pose_cov, joint_sigma=3 * data.joint_sigma)
    found = diagnose(MODEL, loose)
    assert found.effects == ("backlash",)


# ----------------------------------------------------------------------- what it doubts


def test_a_bump_is_not_looked_for_where_all_samples_have_one_time():
    data = measured(1)
    at_once = replace(data, conditions=data.conditions | {"time": np.zeros(len(data))})
    row = entry(diagnose(MODEL, at_once, effects=["device_bump"]).document(), "device_bump")
    assert row["reason"] == "cannot be tested: time never changed"


def test_an_effect_whose_condition_was_not_recorded_is_listed_with_the_reason():
    document = diagnose(MODEL, measured(1), effects=["thermal_expansion", "backlash"]).document()
    row = entry(document, "thermal_expansion")
    assert row["p_value"] is None
    assert row["missing_conditions"] == ["temperature"]
    assert row["reason"] == "cannot be tested: no temperature recorded"
    assert document["measure_next"]["record"] == {"thermal_expansion": ["temperature"]}


def test_an_effect_that_makes_no_sense_here_is_listed_with_the_reason():
    document = diagnose(MODEL, measured(1), effects=["spool_buildup", "backlash"]).document()
    assert "does not apply" in entry(document, "spool_buildup")["reason"]


def test_an_effect_that_the_geometry_absorbs_is_reported_as_not_visible():
    document = diagnose(MODEL, measured(1), effects=["target_offset", "backlash"]).document()
    row = entry(document, "target_offset")
    assert row["remaining_after_geometry"] < 0.01
    assert "cannot be seen" in row["reason"]


@cache
def all_of_steel_warming_up():
    """The diagnosis of a robot of steel in a hall that gets warmer evenly."""
    growth = hidden.ThermalGrowth(11.7e-6, 11.7e-6, 11.7e-6)
    day = vd.plan(110, 20, 0, dwell=10.0, air=lambda t: 18 + 0.003 * np.asarray(t))
    return diagnose(MODEL, dataset(vf.samples(day, [growth], vf.FINE, 0), vf.FINE))


@pytest.mark.wide
def test_temperature_that_rises_evenly_shows_growth_rather_than_drift():
    """Growth at its usual size explains it; a drift would have to be unusual."""
    found = all_of_steel_warming_up()
    assert found.effects == ("thermal_expansion",)
    [cause] = found.missing
    assert cause["probability"] > 0.95
    assert found.document()["missing"] == [cause]


@pytest.mark.wide
def test_poses_planned_to_distinguish_two_explanations_do_so():
    found = all_of_steel_warming_up()
    sets = {name: Chosen(name) for name in ("thermal_expansion", "base_drift")}
    doubt = Undecided.between(found.best, sets)
    seen = found.dataset.conditions
    plan = plan_decision(doubt, seen, 20, 20, lambda joints: np.ones(len(joints), bool))
    assert doubt.entropy == pytest.approx(np.log(2))
    assert plan.after <= DECIDED
    # Recorded was that it is the warmer, the later: the poses are not.
    line = np.polyfit(seen["time"], seen["temperature"], 1)
    time, warm = (plan.a[:, doubt.model.conditions.index(c)] for c in ("time", "temperature"))
    assert np.abs(np.polyval(line, time) - warm).max() > 4.0  # K


def test_poses_are_planned_once_and_only_for_a_caller_who_asks(monkeypatch):
    """A plan takes as long as several fits."""
    planned = []

    def counted(*arguments, **options):
        planned.append(arguments)
        return plan_decision(*arguments, **options)

    plan_decision = next_measurement.plan_decision
    monkeypatch.setattr(next_measurement, "plan_decision", counted)
    data = hiding([vf.KINDS["backlash"]], 1.0, 0)[0]
    found = diagnose(MODEL, data, effects=["backlash", "hysteresis"])
    assert found.swaps == {"backlash": ["hysteresis"]}
    assert not found.measure_next.record
    assert not planned
    plan = found.document()["measure_next"]["plan"]
    assert plan["between"] == ["backlash", "hysteresis"]
    assert plan["certainty"]["now"] < plan["certainty"]["then"]
    assert found.measure_next.advice
    assert len(planned) == 1


@pytest.mark.wide
def test_without_any_noise_figure_the_best_is_named_and_what_is_left_is_unknown():
    data = measured(2, effects=[vr.Backlash((6e-4, 6e-4, 6e-4))], n_replicates=0)
    guessed = Dataset.from_arrays(
        JOINTS,
        data.q,
        data.r,
        data.R,
        measured=data.measured,
        conditions=data.conditions,
        pose_id=np.arange(len(data)),
        source="a camera nobody calibrated",
    )
    model = replace(MODEL, noise=Noise(1e-4, 1e-5, 1e-4, assumed=True))
    found = diagnose(model, guessed)
    assert (found.verdict.word, found.left) == ("partly_explained", "unknown")
    assert found.effects == ("backlash",)
    [cause] = found.missing
    assert cause["probability"] > 0.95
    assert found.document()["noise"]["variance"] is None


def test_too_few_poses_cannot_know():
    found = diagnose(MODEL, measured(3, n_poses=7, n_replicates=0))
    assert found.verdict.word == "cannot_know"
    assert found.verdict.text.startswith("6 degrees of freedom are too few for a verdict")


def test_orientation_that_the_model_holds_still_is_not_at_noise():
    data = measured(4)
    found = diagnose(new_model("delta24"), data, effects=["backlash"])
    assert found.verdict.word == "unexplained"
    assert "larger model" in found.verdict.text


@pytest.mark.wide
def test_the_larger_model_is_a_candidate_like_any_other():
    data = measured(4)
    found = diagnose(new_model("delta24"), data)
    assert found.effects == ("parallelogram_errors",)
    assert found.verdict.word == "explained"
    assert found.best.fitted.model.mechanism.name == "delta54"


# --------------------------------------------------------------------------- what it takes


@pytest.mark.wide
def test_a_users_own_effect_takes_part(tmp_path, monkeypatch):
    (tmp_path / "my_lab").mkdir()
    (tmp_path / "my_lab" / "__init__.py").write_text("")
    (tmp_path / "my_lab" / "cross_talk.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    talk = hidden.CrossTalk((5e-4, 4e-4, 6e-4), 7.0)
    data = measured(5, effects=[talk], n_poses=110)
    assert diagnose(MODEL, data, effects=["backlash"]).verdict.word == "unexplained"
    found = diagnose(MODEL, data, effects=["backlash"], also=["my_lab.cross_talk"])
    assert found.effects == ("my_lab.cross_talk",)
    assert found.verdict.word == "explained"


OWN = '''
"""Each joint's signal ripples with the angle of the next."""
import casadi as ca

from parallel_cal.model.effect import Effect
from parallel_cal.model.parameters import Parameter


class CrossTalk(Effect):
    physics = "wires side by side"
    source = "our lab"

    def parameters(self, mechanism):
        return [Parameter(f"{j}.size", "rad", 0.0, 3e-4) for j in mechanism.joints]

    def ideal(self, seen, e, at, mechanism):
        names, n = mechanism.joints, len(mechanism.joints)
        q = [seen.q[i] + e[j].size * ca.sin(7 * seen.q[(i + 1) % n]) for i, j in enumerate(names)]
        return seen.with_q(ca.vertcat(*q))
'''


def test_excluded_samples_keep_the_numbers_of_the_others():
    data = measured(6)
    data.r[[12, 40]] += [1e-3, 0, 0]
    found = diagnose(MODEL, data.excluding([12]), effects=["backlash"])
    assert [row["sample"] for row in found.document()["odd_samples"] if row["outlier"]] == [40]
    assert any("excluded on request: sample 12" in w for w in found.document()["warnings"])


def test_a_baseline_that_cannot_be_identified_is_a_clear_error():
    with pytest.raises(FitError, match="different poses give"):
        diagnose(MODEL, measured(0, n_poses=5, n_replicates=0))


def test_it_reports_progress_and_can_be_cancelled():
    class Stop(Exception):
        pass

    stages = []

    def report(stage, fraction):
        stages.append(stage)
        if len(stages) == 6:
            raise Stop

    with pytest.raises(Stop):
        diagnose(MODEL, measured(0), progress=report)
    assert any("testing" in stage or "identifying" in stage for stage in stages)


@pytest.mark.wide
def test_gross_outliers_are_set_aside_and_named_before_a_robust_diagnosis():
    data, _ = hiding([vf.KINDS["backlash"]], 0.6, seed=6)
    data.r[[20, 60, 100]] += [[2e-3, 0, 0], [0, -3e-3, 0], [0, 0, 5e-3]]
    data.r[[30, 70]] -= [[2e-3, 0, 0], [0, -3e-3, 0]]
    found = diagnose(MODEL, data, effects=["backlash", "base_drift", "device_axes"])
    assert {one.sample for one in found.knocked} == {20, 30, 60, 70, 100}
    assert (found.verdict.word, found.effects) == ("explained", ("backlash",))
    more = replace(data, r=data.r.copy())
    more.r[[25, 65, 105]] += [[3e-3, 0, 0], [0, -2e-3, 0], [0, 0, 5e-3]]
    spoilt = diagnose(MODEL, more, effects=["backlash", "base_drift", "device_axes"])
    assert {one.sample for one in spoilt.odd_samples if one.outlier} >= {60, 70, 100, 105}
    assert not spoilt.knocked  # so many are heavy tails of the noise
    assert spoilt.verdict.word != "explained"
    found = diagnose(MODEL, data, effects=["backlash", "base_drift", "device_axes"], loss="cauchy")
    assert found.effects == ("backlash",)
    assert found.verdict.word == "explained"
    assert any(
        "excluded by --loss cauchy: sample 20, 30, 60, 70, 100" in w
        for w in found.document()["warnings"]
    )


@pytest.mark.wide
@pytest.mark.parametrize("size", [0.3e-3, 2e-3])
def test_one_knocked_sample_is_named_with_the_verdict_of_the_others(size):
    data, _ = hiding([vf.KINDS["backlash"]], 0.8, seed=40)
    data.r[17] += size * np.array([0.7, -0.5, 0.5])
    found = diagnose(MODEL, data, effects=["backlash", "base_drift", "device_axes"])
    assert found.effects == ("backlash",)
    assert found.verdict.word == "explained"
    assert [one.sample for one in found.knocked] == [17]
    assert "backlash" in found.verdict.summary
    assert found.verdict.remarks[-1].startswith("Not used: sample 17 (")
    shown = [one for one in describe(found) if isinstance(one, str)]
    assert not any(": sample 17 at" in one for one in shown)  # it is listed once
    check, command = found.document()["next_steps"]
    assert check == "check sample 17: the commands below exclude it"
    assert command.split(" -o ")[0].endswith("add MODEL backlash RECORDING --data exclude=17")


@pytest.mark.wide
def test_two_samples_of_unknown_sides_do_not_make_a_second_effect():
    """Neither is far enough from the others to be excluded alone; together they spoil chi2."""
    data, _ = hiding([vf.KINDS["backlash"]], 2.5, seed=40)
    data = data.select(np.arange(60))
    for joint in data.joint_names:
        data.conditions[f"direction.{joint}"][:2] = 0.0
    found = diagnose(MODEL, data, effects=["backlash", "gear_transmission_error"])
    assert found.verdict.word == "explained"
    assert found.effects == ("backlash",)


@pytest.mark.wide
def test_without_the_sides_an_effect_is_not_told_from_a_backlash_that_scatters_the_visits():
    """A joint is mostly reached from below where it reads much: unknown sides look like a gain."""
    data, _ = hiding([vf.KINDS["gear ripple"]], 1.0, seed=40)
    data = replace(data, pose_cov=data.pose_cov / 9, joint_sigma=data.joint_sigma / 3)
    seen = diagnose(MODEL, data, effects=["gear_transmission_error", "base_drift"])
    assert (seen.verdict.word, seen.effects) == ("explained", ("gear_transmission_error",))
    assert seen.noise.misstated == pytest.approx(3.0, rel=0.2)
    sides = ("direction.", "travel.")
    others = {k: v for k, v in data.conditions.items() if not k.startswith(sides)}
    blind = diagnose(
        MODEL, replace(data, conditions=others), effects=["gear_transmission_error", "base_drift"]
    )
    assert (blind.verdict.word, blind.effects) == ("cannot_know", ("gear_transmission_error",))
    assert "the sides from which the joints came are not known" in blind.verdict.text
    assert [step.split(":")[0] for step in blind.next_steps] == [
        "state the sides from which the joints came, and diagnose again"
    ]


@pytest.mark.wide
def test_a_sample_counts_as_knocked_that_only_shows_once_a_large_effect_is_known():
    data, _ = hiding([vf.KINDS["backlash"]], 3.0, seed=40)
    data.r[17] += 0.25e-3 * np.array([0.7, -0.5, 0.5])
    found = diagnose(MODEL, data, effects=["backlash", "base_drift", "device_axes"])
    assert found.effects == ("backlash",)
    assert [one.sample for one in found.knocked] == [17]
    assert found.noise.misstated is None
    assert add(MODEL, "backlash", data).knocked == (17,)


@pytest.mark.wide
def test_the_first_row_of_a_table_is_excluded_for_its_unknown_sides_and_nobody_is_blamed():
    """Its joints count as in the middle of a backlash, which they never are."""
    data, _ = hiding([vf.KINDS["backlash"]], 10.0, seed=40)
    for joint in data.joint_names:
        data.conditions[f"direction.{joint}"][0] = 0.0
    found = diagnose(MODEL, data, effects=["backlash", "base_drift", "device_axes"])
    assert found.effects == ("backlash",)
    assert [one.sample for one in found.knocked] == [0]
    assert "knocked" not in found.verdict.text
    assert found.verdict.text.endswith(
        "from which sides its joints came is not known, so exclude it"
    )
    [command] = found.next_steps
    assert command.startswith(
        "add what was found: parallel-cal add MODEL backlash RECORDING --data"
    )
    step = add(MODEL, "backlash", data)
    assert step.knocked == (0,)
    assert "sample 0 (a sample of which the sides from which" in show(step)


@pytest.mark.wide
def test_add_excludes_the_knocked_sample_that_the_verdict_excluded_and_says_so():
    data, _ = hiding([vf.KINDS["backlash"]], 0.8, seed=40)
    data.r[17] += 2e-3 * np.array([0.7, -0.5, 0.5])
    step = add(MODEL, "backlash", data)
    others = add(MODEL, "backlash", data.excluding([17]))
    assert step.knocked == (17,)
    assert step.result.samples == step.rival.samples == 149
    assert step.model.values == pytest.approx(others.model.values, rel=1e-12)
    assert step.model.history[-1]["knocked"] == step.document()["knocked"] == [17]
    assert "knocked" not in others.model.history[-1]
    assert "excluded from both fits: sample 17 (far from all others, as if somebody" in show(step)
    assert any("excluded because it is far from all others" in w for w in step.warnings)
    with pytest.raises(FitError, match=r"with 'base_drift'.*\(judged without sample 17\)"):
        add(MODEL, "base_drift", data)
    # With all samples, as a verdict that excludes none uses them.
    assert add(MODEL, "backlash", data, force=True, knocked=()).result.samples == 150


@pytest.mark.wide
@pytest.mark.parametrize("size", keep([3.0, 4.0], 4.0))
def test_good_poses_that_a_robust_loss_mistrusted_count_again_once_the_effect_is_known(size):
    data, _ = hiding([vf.KINDS["backlash"]], size, seed=6)
    data.r[[20, 60]] += [[2e-2, 0, 0], [0, -3e-2, 0]]
    how = {"effects": ["backlash", "base_drift"], "loss": "cauchy"}
    aside = fit(MODEL, data, loss="cauchy", hold_out=0).down_weighted
    found = diagnose(MODEL, data, **how)
    assert found.effects == ("backlash",)
    left_out = set(data.numbers) - set(found.dataset.numbers)
    assert left_out == {20, 60}
    assert len(aside) > 100  # of 150, before
