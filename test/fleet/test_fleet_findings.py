"""What a fleet tells, of robots from a workshop that shares nothing with the package."""

import fleets
import numpy as np
import pytest
import virtual_fleet as vf
from datasets import as_dataset

from parallel_cal.base.documents import to_json_value
from parallel_cal.fleet.findings import findings
from parallel_cal.fleet.jobs import FleetOptions, jobs_of
from parallel_cal.fleet.judging import judge_recording
from parallel_cal.fleet.tolerances import next_robot
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.reporting.fleets import change_in_words, effect_in_words
from parallel_cal.virtual.robot import Delta

ASKED = FleetOptions(FitOptions(hold_out=0.5), effects=("backlash", "encoder_second_harmonic"))
DRAWING = read_model(fleets.NOMINAL)


# ----------------------------------------------------------------------------- rows made by hand

NUMBERS = ("chain1.Lb", "chain2.Lb")
PLAYS = tuple(f"backlash.joint{i}.width" for i in (1, 2, 3))


def document(names, estimate, sigma):
    A = np.eye(len(names)) / sigma**2
    told = Evidence(names, np.asarray(estimate, float), A, np.zeros(len(names)))
    return to_json_value(vars(told))


def row(robot, recording="0", lengths=(0.24, 0.24), play=None, plays=(0.0,) * 3, when=None):
    """A recording that tells two rods to 10 um and three plays to 0.1 mrad."""
    found = {
        "robot": robot,
        "recording": recording,
        "reason": "",
        "mechanism": "delta54",
        "time": when,
        "effects": [play] if play else [],
        "evidence": document(NUMBERS, lengths, 1e-5),
        "effects_evidence": {"backlash": document(PLAYS, plays, 1e-4)},
    }
    if play:
        found["evidence"] = document(
            (*NUMBERS, *PLAYS), (*lengths, *plays), np.array([1e-5] * 2 + [1e-4] * 3)
        )
    return found


def workshop(n, **changed):
    """Rods 0.3 mm too long with a spread of 0.1 mm; `changed` robots are given otherwise."""
    rng = np.random.default_rng(4)
    rods = 0.2403 + 1e-4 * rng.standard_normal((n, 2))
    plays = 1e-4 * rng.standard_normal((n, 3))
    return [
        row(f"r{k}", **{"lengths": rods[k], "plays": plays[k]} | changed.get(f"r{k}", {}))
        for k in range(n)
    ]


def test_the_next_robots_file_has_the_fleets_means_and_spreads():
    found = findings(workshop(30), DRAWING)
    rod = found.parameters[0]
    assert (rod.name, rod.unit, rod.nominal, rod.tolerance) == ("chain1.Lb", "m", 0.24, 0.0005)
    assert rod.mean == pytest.approx(0.2403, abs=3 * rod.sigma)
    assert rod.low < 1e-4 < rod.high
    learned = next_robot(DRAWING, found)
    assert learned.table["chain1.Lb"].nominal == learned.value("chain1.Lb") == rod.mean
    assert learned.table["chain1.Lb"].tolerance == pytest.approx(np.hypot(rod.spread, rod.sigma))
    assert learned.table["chain3.Lb"] == DRAWING.table["chain3.Lb"]
    assert (found.effects, found.outlying, found.drifts) == ((), (), ())
    assert findings(workshop(3), DRAWING) is None


def test_an_effect_of_most_robots_is_the_designs_and_in_the_next_robots_model():
    rng = np.random.default_rng(5)
    changed = {
        f"r{k}": {"play": "backlash", "plays": 1e-3 * (1 + 0.2 * rng.standard_normal(3))}
        for k in range(14)
    }
    found = findings(workshop(15, **changed), DRAWING)
    (effect,) = found.effects
    assert (effect.name, effect.kind, len(effect.robots), effect.of) == (
        "backlash",
        "design",
        14,
        15,
    )
    assert {d.robot for d in effect.deviations} == {"r14"}
    learned = next_robot(DRAWING, found)
    play = learned.table["backlash.joint1.width"]
    assert learned.value(play.name) == pytest.approx(1e-3, rel=0.2)
    assert play.tolerance > learned.value(play.name)


def test_an_effect_of_one_robot_is_its_fault_where_its_numbers_stand_apart():
    odd = {"play": "backlash", "plays": (0.0, 4e-3, 0.0)}
    usual = {"play": "backlash", "plays": (1e-4, 0.0, 0.0)}
    found = findings(workshop(15, r4=odd, r5=usual), DRAWING)
    (effect,) = found.effects
    assert (effect.kind, effect.robots) == ("fault", ("r4", "r5"))
    assert [(d.robot, d.name) for d in effect.deviations] == [("r4", "backlash.joint2.width")]
    assert "backlash: only in r4: a fault of this robot" in effect_in_words(effect)
    (doubted,) = findings(workshop(15, r5=usual), DRAWING).effects
    assert doubted.kind == "doubtful"
    assert next_robot(DRAWING, found).effects == ()


def test_robots_of_another_kind_and_failed_recordings_have_no_say():
    rows = workshop(10)
    other = row("x", lengths=(9.0, 9.0)) | {"mechanism": "stewart42"}
    failed = {"robot": "y", "recording": "0", "reason": "cut short", "inputs": ""}
    found = findings([*rows, other, failed], DRAWING)
    assert found.others == ("x",)
    assert found.parameters == findings(rows, DRAWING).parameters


def test_a_robot_drifts_by_its_recordings_times():
    rng = np.random.default_rng(6)
    times = np.arange(4) * vf.DAY
    rows = [
        row(f"r{k}", str(i), rng.normal(0.24, 1e-5, 2) + [0.0, (k == 2) * 1e-4 * i], when=1e9 + t)
        for k in range(6)
        for i, t in enumerate(times)
    ]
    (drift,) = findings(rows, DRAWING).drifts
    assert (drift.robot, drift.name) == ("r2", "chain2.Lb")
    assert drift.rate == pytest.approx(1e-4 / vf.DAY, abs=3 * drift.sigma)
    assert findings(rows, DRAWING).changed == ()


@pytest.mark.parametrize("when", [(None, None, None), (3e9, 1e9, 2e9)])
def test_of_a_robot_whose_recordings_contradict_each_other_the_last_counts(when):
    """One rod was changed for a longer one between the second and the last; 20 other robots' agree
    but for noise, and none of them is named."""
    rng = np.random.default_rng(8)
    rods = 0.24 + 1e-4 * rng.standard_normal((20, 1, 2)) + 1e-5 * rng.standard_normal((20, 3, 2))
    last = int(np.argmax(when)) if when[0] else 2
    rods[7, last, 1] += 1e-3
    rows = [row(f"r{k}", f"{i}", rods[k, i], when=when[i]) for k in range(20) for i in range(3)]
    found = findings(rows, DRAWING)
    (one,) = found.changed
    assert (one.robot, one.name, one.after) == ("r7", "chain2.Lb", str(last))
    assert one.size == pytest.approx(1e-3, abs=4 * one.sigma)
    (apart,) = found.outlying
    assert (apart.robot, apart.name) == ("r7", "chain2.Lb")
    assert apart.size == pytest.approx(1e-3, abs=4 * apart.sigma)
    assert found.drifts == ()
    assert "only the last recording is used" in change_in_words(one, "1 mm")


def test_recordings_in_which_other_effects_were_found_are_no_contradiction():
    """Lengths of another model differ by what that says instead."""
    rows = [row(f"r{k}", f"{i}", (0.24, 0.24)) for k in range(8) for i in range(3)]
    rows[4] |= row("r1", "1", (0.24, 0.2405)) | {"effects": ["encoder_gain"]}
    assert findings(rows, DRAWING).changed == ()
    rows[5] |= {"effects": ["encoder_gain"]}
    (one,) = findings(rows, DRAWING).changed
    assert (one.robot, one.before, one.after) == ("r1", "1", "2")


def test_recordings_that_tell_nothing_contradict_none():
    nothing = to_json_value(vars(Evidence.uninformative(NUMBERS)))
    rows = [row(f"r{k}", f"{i}") for k in range(6) for i in range(2)]
    rows[1] |= {"evidence": nothing}
    rows[2] |= {"evidence": nothing}
    rows[3] |= {"evidence": nothing}
    assert findings(rows, DRAWING).changed == ()


def test_noise_that_all_recordings_understate_is_no_contradiction():
    rng = np.random.default_rng(9)
    rods = 0.24 + 5e-5 * rng.standard_normal((20, 3, 2))  # five times what they say
    rows = [row(f"r{k}", f"{i}", rods[k, i]) for k in range(20) for i in range(3)]
    assert findings(rows, DRAWING).changed == ()


def test_an_effect_of_many_but_not_most_is_perhaps_a_batchs():
    changed = {f"r{k}": {"play": "backlash", "plays": (1e-3, 1e-3, 1e-3)} for k in range(0, 12, 2)}
    (effect,) = findings(workshop(15, **changed), DRAWING).effects
    assert effect.kind == "doubtful"
    assert "6 of 15 robots" in effect_in_words(effect)
    assert "check what these robots share" in effect_in_words(effect)


def test_a_spread_that_the_data_do_not_show_is_zero():
    rows = [row(f"r{k}", lengths=(0.2403, 0.2403)) for k in range(8)]
    assert [one.spread for one in findings(rows, DRAWING).parameters] == [0.0, 0.0]


# ----------------------------------------------------------------------------- virtual robots


def rows_of(folder, members, recordings):
    jobs = jobs_of(fleets.written(folder, members, recordings, n_poses=24))
    return [judge_recording(job, ASKED, str(k))[0] for k, job in enumerate(jobs)]


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Fourteen robots, three recordings each; robots 1, 2 and 3 have what vf.drawn gives them."""
    return findings(rows_of(tmp_path_factory.mktemp("fleet"), vf.drawn(14), 3), DRAWING)


@pytest.mark.wide
def test_what_all_robots_have_is_the_designs_and_the_fault_of_one_is_its_own(found):
    kinds = {effect.name: (effect.kind, effect.robots) for effect in found.effects}
    assert kinds["backlash"] == ("design", found.robots)
    assert kinds["encoder_second_harmonic"] == ("fault", ("robot002",))
    play = next(effect for effect in found.effects if effect.name == "backlash")
    for number in play.numbers:
        assert number.mean == pytest.approx(vf.PLAY, abs=4 * number.sigma)
        assert number.low < 0.2 * vf.PLAY < number.high


@pytest.mark.wide
def test_the_robot_with_another_arm_is_named_with_its_arm(found):
    (odd,) = found.outlying
    assert (odd.robot, odd.name) == ("robot001", "chain1.La_x")
    assert odd.size == pytest.approx(vf.LONG["chain1.La_x"], abs=3 * odd.sigma)


@pytest.mark.wide
def test_the_robot_whose_motor_sinks_drifts(found):
    (drift,) = found.drifts
    assert (drift.robot, drift.name) == ("robot003", "chain3.D_z")
    assert drift.rate == pytest.approx(vf.CREEP["chain3.D_z"], abs=3 * drift.sigma)


@pytest.mark.wide
def test_means_and_spreads_are_the_workshops(found):
    true = {
        one.name: (vf.TABLE_5_12[one.name] + vf.JIG.get(one.name, 0.0), spread)
        for one in found.parameters
        if (spread := vf.SPREAD.get(one.name.split(".")[1]))
    }
    held = [one.low < true[one.name][1] < one.high for one in found.parameters]
    near = [abs(one.mean - true[one.name][0]) < 2.5 * one.sigma for one in found.parameters]
    assert len(held) == 42
    assert np.mean(held) > 0.85
    assert np.mean(near) > 0.9
    jig = next(one for one in found.parameters if one.name == "chain2.Lb")
    assert jig.mean - jig.nominal > 4 * jig.sigma


def error_of(model, robot, reading):
    """Rms position error (m) of a model where it was never measured."""
    return np.sqrt(
        np.mean(np.sum((Kinematics(model).direct(reading).position - robot) ** 2, axis=1))
    )


def fitted_row(member):
    """What a fleet has of a robot that lacks nothing, without its diagnosis."""
    result = fit(DRAWING, as_dataset(member.measured(0, 0.0)), hold_out=0)
    told = to_json_value(vars(Evidence.of(result)))
    row = {"robot": member.name, "recording": "0", "mechanism": "delta54", "reason": ""}
    return row | {"effects": [], "time": None, "evidence": told, "effects_evidence": {}}


@pytest.mark.slow
def test_the_next_robot_needs_fewer_poses_with_what_the_fleet_taught(tmp_path):
    """Twenty robots teach; the error (rms over eight others) at poses never measured, by how many
    each was identified from: half the poses are then worth more than all with the drawing's."""
    workshop = {"play": 0.0, "faults": False, "spread": vf.FINE}
    rows = [fitted_row(member) for member in vf.drawn(20, **workshop)]
    write_model(next_robot(DRAWING, findings(rows, DRAWING)), tmp_path / "next.yaml")
    models = {"drawing": DRAWING, "fleet": read_model(tmp_path / "next.yaml")}
    errors = {}
    for k, member in enumerate(vf.drawn(8, seed=5, **workshop)):
        robot = Delta(member.dimensions)
        unseen = vf.dwell_samples(robot, 60, 0, pose_seed=99)
        for n in (6, 8, 12, 16, 24):
            data = as_dataset(vf.dwell_samples(robot, n, 0, seed=100 * k + n, pose_seed=7))
            for name, model in models.items():
                found = fit(model, data, hold_out=0, prior=True).model
                own = error_of(found, unseen["true_r"], unseen["reading"])
                errors.setdefault((name, n), []).append(own)
    rms = {key: np.sqrt(np.mean(np.square(values))) for key, values in errors.items()}
    print({f"{name} {n}": f"{1e6 * value:.1f} um" for (name, n), value in rms.items()})
    assert rms["fleet", 6] < rms["drawing", 12]
    assert rms["fleet", 12] < rms["drawing", 24]
    assert all(rms["fleet", n] < rms["drawing", n] for _, n in rms)
