"""Simulated recordings: they load, they repeat, and hold the effect that was asked for."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import BagError, ModelError, SolveError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.cli import main as cli
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import parse_effect
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.mechanism import Workspace
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.simulate import simulate, stated_noise, with_effects
from parallel_cal.recordings.writer import write_bag

ROOT = Path(__file__).parents[2]
IDENTIFIED = ROOT / "config" / "delta_mockup_identified.yaml"


@pytest.fixture(scope="module")
def robot():
    return read_model(IDENTIFIED)


def recorded(session, tmp_path, model, name="bag", storage="mcap"):
    write_bag(session, tmp_path / name, storage)
    return load_dataset(tmp_path / name, joints=model.joints)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_loads_to_as_many_samples_as_poses(robot, tmp_path, storage):
    data = recorded(simulate(robot, 12, seed=1), tmp_path, robot, storage=storage)
    assert len(data) == 12
    assert len(set(data.pose_id)) == 12
    assert not data.dropped


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(4))
def test_poses_visited_again_are_seen_as_replicates(robot, tmp_path, seed):
    data = recorded(simulate(robot, 10, seed, replicates=10), tmp_path, robot)
    assert len(data) == 20
    assert sorted(np.bincount(data.pose_id)) == [2] * 10


def test_a_robot_that_only_turns_is_seen_to_come_again_though_its_place_is_noise(tmp_path):
    argos = read_model(IDENTIFIED.parent / "argos_mockup_nominal.yaml")
    data = recorded(simulate(argos, 6, seed=1, replicates=6), tmp_path, argos)
    assert sorted(np.bincount(data.pose_id)) == [2] * 6


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(robot, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_bag(simulate(robot, 4, seed), tmp_path / name / "bag")
    a, b, c = ((tmp_path / name / "bag" / "bag.mcap").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_quiet_instruments_show_the_robot_itself(robot, tmp_path):
    data = recorded(simulate(robot, 8, quiet=True), tmp_path, robot)
    pose = Kinematics(robot).direct(data.q)
    assert np.abs(pose.position - data.r).max() < 1e-9
    assert np.abs(pose.rotation - data.R).max() < 1e-9
    assert np.sqrt(data.pose_cov[0, 0, 0]) == pytest.approx(1e-5)


@pytest.mark.wide
def test_noise_is_one_draw_a_dwell_of_the_stated_size(robot, tmp_path):
    data = recorded(simulate(robot, 150, seed=3), tmp_path, robot)
    error = data.r - Kinematics(robot).direct(data.q).position
    # Joint noise reaches the position too, so it scatters more than the device alone.
    assert 1e-5 < error.std() < 4e-5
    assert np.median(data.scatter_pose[:, :3]) == pytest.approx(2e-6, rel=0.3)
    assert np.median(data.scatter_q) == pytest.approx(0.2 * robot.noise.joint, rel=0.2)


def test_noise_that_the_model_does_not_state_is_that_of_typical_instruments():
    assert stated_noise(new_model("delta24")).position == 1e-5
    own = replace(new_model("delta24"), noise=Noise(0.0, None, 1e-3))
    assert stated_noise(own) == Noise(0.0, 1e-5, 1e-3)


def test_the_hidden_effect_is_in_the_recording(robot, tmp_path):
    hidden = with_effects(robot, [parse_effect("backlash:width=0.001")])
    data = recorded(simulate(hidden, 10, quiet=True), tmp_path, robot)
    at = {k: v for k, v in data.conditions.items() if k in hidden.conditions}
    with_it, without = Kinematics(hidden).direct(data.q, at), Kinematics(robot).direct(data.q)
    assert np.abs(with_it.position - data.r).max() < 1e-9
    assert np.abs(without.position - data.r).max() > 2e-5


def test_conditions_are_recorded_and_vary(robot, tmp_path):
    data = recorded(simulate(robot, 12), tmp_path, robot)
    assert set(data.conditions["payload"]) == {0.0, 0.5}
    assert np.ptp(data.conditions["temperature"]) > 0.5
    for joint in robot.joints:
        assert set(data.conditions[f"direction.{joint}"]) == {-1.0, 1.0}


def test_all_poses_are_in_the_workspace_and_joint_limits(robot, tmp_path):
    data = recorded(simulate(robot, 30, quiet=True), tmp_path, robot)
    box = robot.mechanism.workspace
    assert (data.r >= np.array(box.low) - 1e-6).all()
    assert (data.r <= np.array(box.high) + 1e-6).all()
    low, high = np.array(robot.mechanism.joint_limits).T
    assert ((data.q >= low) & (data.q <= high)).all()


@pytest.mark.parametrize("name", ["delta24", "argos9", "scara16", "slider_crank"])
def test_other_mechanisms_can_be_recorded_too(name, tmp_path):
    model = new_model(name)
    data = recorded(simulate(model, 6, quiet=True), tmp_path, model)
    pose = Kinematics(model).direct(data.q)
    assert len(data) == 6
    assert np.abs(pose.position - data.r).max() < 1e-8
    assert np.abs(rotation_vector(data.R @ pose.rotation.transpose(0, 2, 1))).max() < 1e-8


@pytest.mark.wide
def test_a_workspace_out_of_reach_is_a_clear_error():
    mechanism = load_mechanism("delta24")
    mechanism.workspace = Workspace((1.0, 1.0, 1.0), (2.0, 2.0, 2.0))
    with pytest.raises(SolveError, match="make the workspace in the model file smaller"):
        simulate(new_model(mechanism), 3)


# ------------------------------------------------------------------- how effects are written


def test_an_effect_is_written_as_name_and_numbers():
    assert parse_effect("backlash") == ("backlash", {})
    assert parse_effect("a.b:width=3e-4, joint1.x=-1") == ("a.b", {"width": 3e-4, "joint1.x": -1.0})
    for bad in ("backlash:width", "backlash:=1"):
        with pytest.raises(ModelError, match="expected NAME:key=value"):
            parse_effect(bad)
    for bad in ("backlash:width=much", "backlash:width=nan"):
        with pytest.raises(ModelError, match=r"width is '(much|nan)', expected a number"):
            parse_effect(bad)


def test_numbers_that_are_not_given_are_one_tolerance(robot):
    model = with_effects(robot, [("backlash", {"joint1.width": 1e-4})])
    assert model.value("backlash.joint1.width") == 1e-4
    assert model.value("backlash.joint2.width") == model.table["backlash.joint2.width"].tolerance


def test_a_number_may_be_for_one_joint_for_all_or_for_a_pattern(robot):
    model = with_effects(robot, [("backlash", {"width": 2e-4, "joint3.width": 5e-4})])
    assert model.values[-3:] == pytest.approx([2e-4, 2e-4, 5e-4])
    model = with_effects(robot, [("backlash", {"joint[12].width": 7e-4})])
    assert model.values[-3:] == pytest.approx([7e-4, 7e-4, 3e-4])


def test_an_unknown_effect_or_number_is_a_clear_error(robot):
    with pytest.raises(ModelError, match="no effect 'wobble'"):
        with_effects(robot, [("wobble", {})])
    with pytest.raises(ModelError, match=r"no parameter matches 'backlash\.depth'"):
        with_effects(robot, [("backlash", {"depth": 1.0})])


# ------------------------------------------------------------------- on the command line


def test_the_command_says_what_it_recorded_and_never_overwrites(tmp_path, capsys):
    bag = tmp_path / "bag"
    command = [
        "simulate",
        str(IDENTIFIED),
        "--effect",
        "backlash:width=0.0004",
        "--poses",
        "9",
        "--seed",
        "3",
        "--replicates",
        "2",
        "-o",
        str(bag),
        "--json",
    ]
    with pytest.raises(SystemExit) as ended:
        cli.main(command)
    made = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    assert made["effect_parameters"]["backlash.joint2.width"] == 0.0004
    assert len(load_dataset(bag)) == 11
    with pytest.raises(SystemExit) as ended:
        cli.main(command)
    assert ended.value.code == 1
    assert "already exists" in capsys.readouterr().err


def test_an_unknown_storage_is_a_clear_error(robot, tmp_path):
    with pytest.raises(BagError, match="expected mcap or sqlite3"):
        write_bag(simulate(robot, 1), tmp_path / "bag", "floppy")
    assert not list(tmp_path.iterdir())


def test_poses_that_are_near_each_other_do_not_follow_each_other(tmp_path):
    model = new_model("slider_crank")
    data = recorded(simulate(model, 40, seed=1), tmp_path, model)
    assert len(data) == 40
