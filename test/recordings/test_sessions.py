"""The way since a joint turned back, and several recordings taken together."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import virtual_day as vd
from datasets import JOINTS, measured

from parallel_cal.base.errors import DatasetError, FitError
from parallel_cal.cli.main import main
from parallel_cal.identification.fit import fit
from parallel_cal.model.effect import parse_effect
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.recordings.loading import load_dataset, load_sessions
from parallel_cal.recordings.simulate import simulate, with_effects
from parallel_cal.recordings.travel import travel
from parallel_cal.recordings.writer import write_bag
from parallel_cal.virtual import robot as vr

# --------------------------------------------------------------------------- way since a reversal

CALM = 1e-3


def ramp(*stops, per=400):
    """A joint that goes straight from stop to stop."""
    parts = [np.linspace(a, b, per, endpoint=False) for a, b in pairwise(stops)]
    return np.concatenate([*parts, [stops[-1]]])


def way(q, direction):
    """The way of one joint after all its readings (n,)."""
    level = np.array([[q[-1]]])
    return travel(q[:, None], [len(q)], level, np.array([[direction]]), np.array([CALM]))[0, 0]


def test_the_way_counts_from_the_last_reversal():
    assert way(ramp(0.0, 0.5, 0.2, 0.6), +1) == pytest.approx(0.4, abs=1e-12)
    assert way(ramp(0.0, 0.5, 0.2), -1) == pytest.approx(-0.3, abs=1e-12)


def test_a_joint_that_never_turned_back_came_all_the_way():
    assert way(ramp(0.1, 0.3, 0.3, 0.7), +1) == pytest.approx(0.6, abs=1e-12)


def test_shaking_within_the_tolerance_is_no_reversal():
    rng = np.random.default_rng(0)
    q = ramp(0.0, 0.4, 0.1, 0.3)
    q[:-1] += rng.uniform(-CALM / 4, CALM / 4, len(q) - 1)
    assert way(q, +1) == pytest.approx(0.2, abs=CALM)


def test_a_rest_on_the_way_changes_nothing():
    assert way(ramp(0.5, 0.1, 0.2, 0.2, 0.2, 0.2, 0.3), +1) == pytest.approx(0.2, abs=1e-12)


def test_a_joint_that_never_moved_has_no_way():
    assert way(np.full(50, 0.3), 0) == 0.0


def test_a_recordings_dwells_know_their_way_as_the_virtual_robot_drove_it(tmp_path):
    model = new_model("delta54")
    write_bag(simulate(model, 12, 3, quiet=True), tmp_path / "bag", "mcap")
    data = load_dataset(tmp_path / "bag")
    stops = np.vstack([model.mechanism.home.joints, data.q])
    for j, joint in enumerate(model.joints):
        steps, expected = np.diff(stops[:, j]), []
        for k, step in enumerate(steps):
            on = k and np.sign(step) == np.sign(steps[k - 1])
            expected.append(step + (expected[-1] if on else 0.0))
        np.testing.assert_allclose(data.conditions[f"travel.{joint}"], expected, atol=2e-3)


def test_a_simulated_drive_that_winds_up_is_identified_from_its_recording(tmp_path):
    hidden = [parse_effect("hysteresis:lag=0.002")]
    write_bag(simulate(with_effects(new_model("delta24"), hidden), 40, 2), tmp_path / "bag", "mcap")
    data = load_dataset(tmp_path / "bag")
    model = new_model("delta24").with_effect("hysteresis")
    width = with_effects(new_model("delta24"), hidden).value("hysteresis.joint1.width")
    model = model.with_values(np.where(model.table.matching(["*.width"]), width, model.values))
    found = fit(model, data, joint_sigma=1.2e-4, hold_out=0)
    for joint in JOINTS:
        assert found.model.value(f"hysteresis.{joint}.lag") == pytest.approx(2e-3, abs=2e-4)


# --------------------------------------------------------------------------- several recordings


@pytest.fixture(scope="module")
def two():
    first, second = measured(1, n_poses=30, n_replicates=5), measured(2, n_poses=30, n_replicates=5)
    return first, replace(second, source="the second", q=second.q - [1e-3, 0, 0])


def test_samples_know_their_session_and_time_goes_on(two):
    both = join_datasets(two)
    assert len(both) == 70
    np.testing.assert_array_equal(both.conditions["session"], np.repeat([0.0, 1.0], 35))
    assert (np.diff(both.time) > 0).all()
    np.testing.assert_array_equal(both.time, both.conditions["time"])
    np.testing.assert_allclose(np.diff(both.time[35:]), np.diff(two[1].time))
    np.testing.assert_array_equal(both.q[35:], two[1].q)
    np.testing.assert_array_equal(
        both.conditions["direction.joint2"][:35], two[0].conditions["direction.joint2"]
    )


def test_replicates_stay_within_their_session(two):
    ids = join_datasets(two).pose_id
    assert not set(ids[:35]) & set(ids[35:])
    for part, own in ((ids[:35], two[0].pose_id), (ids[35:], two[1].pose_id)):
        np.testing.assert_array_equal(part[:, None] == part, own[:, None] == own)


def test_a_condition_that_only_one_recording_has_is_dropped_with_a_warning(two):
    warm = replace(two[0], conditions={**two[0].conditions, "temperature": np.full(35, 21.0)})
    both = join_datasets((warm, two[1]))
    assert "temperature" not in both.conditions
    assert any("temperature of virtual robot is not used" in w for w in both.warnings)


def test_the_hash_of_several_is_theirs_in_order(two):
    one, other = (replace(d, sha256=s) for d, s in zip(two, ("a", "b"), strict=True))
    assert join_datasets((one, other)).sha256 != join_datasets((other, one)).sha256
    assert join_datasets((one, other)).source == "virtual robot, the second"


def test_recordings_of_another_robot_or_set_up_do_not_go_together(two):
    with pytest.raises(DatasetError, match=r"the second: joint_names is .*'a'.*only recordings of"):
        join_datasets((two[0], replace(two[1], joint_names=("a", "b", "c"))))
    with pytest.raises(DatasetError, match="the second: mode is continuous, but"):
        join_datasets((two[0], replace(two[1], mode="continuous")))
    assert join_datasets((two[0], replace(two[1], frame="tracker"))).frame == two[0].frame


def test_the_same_recording_does_not_count_twice(two):
    twice = replace(two[0], sha256="a"), replace(two[1], sha256="a")
    with pytest.raises(DatasetError, match="the second: the same recording as virtual robot;"):
        join_datasets(twice)


def test_parts_of_one_collection_keep_the_time_between_them(two):
    """Samples of a file first: nobody knows when they were taken; 100 s lie between the others."""
    parts = [*two, replace(two[0], sha256="")]
    all_three = join_datasets(parts, [0, 10**12, 10**12 + 100 * 10**9])
    end = two[0].time.max()
    began = all_three.time[::35] - [d.time[0] for d in parts]
    np.testing.assert_allclose(began, [0, end, end + 100])
    assert "session" not in all_three.conditions
    again = all_three.pose_id[70:]
    np.testing.assert_array_equal(again, all_three.pose_id[:35])
    assert len(all_three.sha256) == 64


def test_parts_that_know_no_time_have_none_together():
    parts = [Dataset.from_arrays(["a"], [[0.1 * k]], [[0.0, 0.0, 0.2 * k]]) for k in (1, 2)]
    assert "time" not in join_datasets(parts, [0, 0]).conditions
    timed = [replace(one, conditions={"time": np.zeros(1)}) for one in parts]
    assert join_datasets(timed, [10**9, 3 * 10**9]).conditions["time"].tolist() == [0.0, 2.0]


def test_homing_anew_between_two_recordings_is_found(two, tmp_path):
    for k, data in enumerate(two):
        data.to_json(tmp_path / f"{k}.json")
    both = load_sessions([tmp_path / "0.json", tmp_path / "1.json"])
    model = new_model("delta54").with_effect("zero_shift")
    found = fit(model, both, hold_out=0)
    assert not found.estimate.spectrum.unidentifiable
    sigma = dict(zip(found.model.table.names, found.estimate.sigma, strict=True))
    for joint, shift in zip(JOINTS, (1e-3, 0.0, 0.0), strict=True):
        full = f"zero_shift.{joint}.since1"
        assert abs(found.model.value(full) - shift) < 4 * sigma[full]
    with pytest.raises(FitError, match="session was not recorded, but the model's effects"):
        fit(model, load_sessions([tmp_path / "0.json"]), hold_out=0)


def test_the_command_line_takes_several_recordings(two, tmp_path, capsys):
    def answer(*words):
        with pytest.raises(SystemExit) as done:
            main([*words, "--json"])
        assert done.value.code == 0
        return json.loads(capsys.readouterr().out)

    files = [str(tmp_path / f"{k}.json") for k in range(2)]
    for data, file in zip(two, files, strict=True):
        data.to_json(file)
    model = str(tmp_path / "model.yaml")
    answer("new", "delta54", "-o", model)
    assert answer("compare", model, *files)["samples"] == 70
    added = answer("add", model, "zero_shift", *files, "-o", model)
    assert added["dataset"]["source"] == "virtual robot, the second"
    assert added["parameters"]["zero_shift.joint1.since1"]["value"] == pytest.approx(1e-3, abs=2e-4)
    without = added["held_out_without_effect"]["position_rms"]
    assert added["held_out"]["after"]["position_rms"] < 0.8 * without


def test_a_single_recording_is_loaded_without_the_condition_session(two, tmp_path):
    two[0].to_json(tmp_path / "0.json")
    alone = load_sessions([tmp_path / "0.json"])
    assert isinstance(alone, Dataset)
    assert "session" not in alone.conditions
    assert len(alone) == len(two[0])


def test_saved_samples_of_several_sessions_are_read_back(two, tmp_path):
    join_datasets(two).to_json(tmp_path / "both.json")
    both = load_dataset(tmp_path / "both.json")
    np.testing.assert_array_equal(both.conditions["session"], np.repeat([0.0, 1.0], 35))


def test_the_virtual_robot_agrees_on_the_way(two):
    """The clean recording's session, driven by the virtual robot and not by our simulation."""
    session = vd.plan(seed=1)
    ways, run = session.ways, np.zeros(3)
    expected = []
    for k, step in enumerate(ways):
        run = np.where((k > 0) & (np.sign(step) == np.sign(ways[k - 1])), run, 0) + step
        expected.append(run)
    stream = vd.record(seed=1, pose_seed=1, noise=vr.Noise(0, 0, 0))
    at = np.searchsorted(stream["joint_time"], session.arrive)
    level, direction = session.reading, np.sign(ways).astype(int)
    found = travel(stream["q"], list(at), level, direction, np.full(3, 1e-6))
    np.testing.assert_allclose(found, expected, atol=1e-5)
