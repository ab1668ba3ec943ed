"""What a fleet tells, of robots from a workshop that shares nothing with the package."""

import fleets
import numpy as np
import pytest
import virtual_fleet as vf
from datasets import as_dataset

from parallel_cal.base.documents import plain
from parallel_cal.fleet.findings import findings
from parallel_cal.fleet.jobs import Asked, jobs_of
from parallel_cal.fleet.judging import judged
from parallel_cal.fleet.tolerances import next_robot
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.virtual.robot import Delta

ASKED = Asked(FitOptions(hold_out=0.5), effects=("backlash", "encoder_second_harmonic"))
DRAWING = read_model(fleets.NOMINAL)


def rows_of(folder, members, recordings):
    jobs = jobs_of(fleets.written(folder, members, recordings))
    return [judged(job, ASKED, str(k))[0] for k, job in enumerate(jobs)]


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
    told = plain(vars(Evidence.of(result)))
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
