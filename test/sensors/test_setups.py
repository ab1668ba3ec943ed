"""Set-ups without a pose device from end to end: recording, samples, command line."""

import json
from dataclasses import replace

import bag_writing as bw
import numpy as np
import pytest
import tied_session as ts
import virtual_setups as vs

from parallel_cal.base.errors import BagError, DatasetError, FitError
from parallel_cal.cli import main as cli
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import Summary, held_out_ratio
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.bag import list_topics, read_bag
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.recordings.loading import dataset_from_recording, load_dataset
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.topics import choose_topics
from parallel_cal.sensors.probe import Probe

STOPS = [[0.1, 0.2, 0.3], [0.4, 0.1, 0.2], [0.2, 0.5, 0.1], [0.3, 0.3, 0.5]]
PLANE, SPHERE = "reading.plane", "reading.sphere1"


@pytest.fixture(scope="module")
def robot():
    return vs.random_delta(3)


@pytest.fixture(scope="module")
def plate_bag(robot, tmp_path_factory):
    """120 poses of a virtual Delta tied to a plate and two holes."""
    return bw.write_bag(tmp_path_factory.mktemp("plate") / "bag", ts.messages(robot))


@pytest.fixture
def run(capsys):
    """run(*arguments) -> the JSON document, or the one line of an error."""

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            cli.main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        if ended.value.code == 0:
            return json.loads(out)
        assert ended.value.code == 1, err
        assert out == ""
        lines = [line for line in err.splitlines() if not line.startswith("warning: ")]
        assert len(lines) == 1
        return lines[0].removeprefix("error: ")

    return call


@pytest.fixture
def plate_model(run, tmp_path):
    """A new model file of model 24 and the plate, as a person makes it."""
    run("new", "delta24", "--sensor", ts.SENSOR, "-o", tmp_path / "robot.yaml", "--json")
    return tmp_path / "robot.yaml"


def moves():
    return ts.session(STOPS)


def bag_of(folder, *parts):
    return bw.write_bag(folder / "bag", [message for part in parts for message in part])


def column(dataset, name):
    """A column as a list, None for NaN."""
    return [None if np.isnan(v) else v for v in dataset.conditions[name].tolist()]


# ------------------------------------------------------------------------------ recordings


def test_what_holds_the_tip_is_a_zero_reading_of_its_channel(tmp_path):
    held = ts.ties_of(moves(), ["plane", "plane", "sphere1", "plane"])
    dataset = load_dataset(bag_of(tmp_path, bw.joint_states(moves()), held))
    assert column(dataset, PLANE) == [0.0, 0.0, None, 0.0]
    assert column(dataset, SPHERE) == [None, None, 0.0, None]
    assert not dataset.measured.any()
    assert dataset.count_pose.tolist() == [0] * 4
    np.testing.assert_allclose(dataset.q, STOPS, atol=1e-5)
    assert dataset.dropped == ()


def test_a_dwell_in_which_the_constraint_changes_is_dropped_with_the_reason(tmp_path):
    held = [bw.tie(-0.1, "plane"), bw.tie(1.3, "sphere1"), bw.tie(1.75, "sphere1")]
    dataset = load_dataset(bag_of(tmp_path, bw.joint_states(moves()), held))
    assert column(dataset, PLANE) == [0.0, None, None]
    [dropped] = dataset.dropped
    assert dropped.reason == "constraint changed"
    assert "'plane', then 'sphere1'" in dropped.detail
    assert dropped.time == pytest.approx(1.3, abs=0.1)


def test_a_dwell_that_nothing_holds_is_dropped_with_the_reason(tmp_path):
    held = [bw.tie(0.8, "plane"), bw.tie(2.8, "")]
    dataset = load_dataset(bag_of(tmp_path, bw.joint_states(moves()), held))
    assert column(dataset, PLANE) == [0.0, 0.0]
    assert [d.reason for d in dataset.dropped] == ["nothing measured"] * 2


def test_without_any_hold_there_is_no_dataset(tmp_path):
    path = bag_of(tmp_path, bw.joint_states(moves()), [bw.tie(0.0, "")])
    with pytest.raises(DatasetError, match=r"no usable dwell.*nothing measured"):
        load_dataset(path)


def test_distances_are_averaged_over_the_dwell_for_each_gauge(tmp_path):
    read = [bw.distance(1.2 + 0.1 * k, 0.25 + 1e-6 * k, "ball_bar") for k in range(3)]
    read += [bw.distance(1.2, 0.125, "probe"), bw.distance(2.2, 0.5, "", topic="distance")]
    read += [bw.distance(1.9, 9.0, "probe"), bw.distance(2.3, np.inf, "probe")]
    dataset = load_dataset(bag_of(tmp_path, bw.joint_states(moves()), read))
    assert column(dataset, "reading.ball_bar") == [pytest.approx(0.250001, abs=3e-8), None]
    assert column(dataset, "reading.probe") == [0.125, None]
    assert column(dataset, "reading.distance") == [None, 0.5]
    assert "value is not finite" in [d.reason for d in dataset.dropped]


def test_poses_and_a_constraint_are_used_together(tmp_path):
    def late(message):
        return message[2] > bw.ns(1.9)

    seen = [m for m in bw.poses(moves()) if late(m)]
    held = [bw.tie(-0.1, "plane"), bw.tie(2.8, "")]
    dataset = load_dataset(bag_of(tmp_path, bw.joint_states(moves()), seen, held))
    assert column(dataset, PLANE) == [0.0, 0.0, 0.0, None]
    assert dataset.measured.any(axis=1).tolist() == [False, False, True, True]
    np.testing.assert_allclose(dataset.r[2:], np.array(STOPS)[2:], atol=1e-5)


def test_joints_stamped_by_another_clock_than_the_recorders_keep_their_constraint(tmp_path):
    """A String has no header: it holds from the joint state that was logged before it."""
    slow = 3600 * 10**9
    stamped = [
        bw.joint_state(t, moves().names, q, stamp=bw.ns(t) - slow)
        for t, q in zip(moves().time.tolist(), moves().q, strict=True)
    ]
    held = ts.ties_of(moves(), ["plane", "sphere1", "plane", "plane"])
    dataset = load_dataset(bag_of(tmp_path, stamped, held))
    assert column(dataset, SPHERE) == [None, 0.0, None, None]


def test_the_topics_can_be_named_and_are_never_guessed(tmp_path):
    held = [bw.text(0.0, "plane", "/plate/tie")]
    path = bag_of(tmp_path, bw.joint_states(moves()), held)
    named = load_dataset(path, topics={"constraint": "plate/tie"})
    assert column(named, PLANE) == [0.0] * 4
    with pytest.raises(BagError, match=r"measured_pose.*without a pose device.*'constraint'"):
        load_dataset(path)
    with pytest.raises(BagError, match=r"no messages on topic '/tie' \(constraint\)"):
        load_dataset(path, topics={"constraint": "/tie"})


def test_an_unnamed_pose_topic_is_not_used_beside_a_constraint(tmp_path):
    """A driver's own pose is the model's opinion; it must not pass for a measurement."""
    own = bw.poses(moves(), topic="driver/tool_pose")
    held = [bw.tie(-0.1, "plane")]
    path = bag_of(tmp_path, bw.joint_states(moves()), own, held)
    assert not load_dataset(path).measured.any()
    named = load_dataset(path, topics={"measured_pose": "driver/tool_pose"})
    assert named.measured.all()


def test_a_silent_pose_device_is_no_hindrance(tmp_path):
    held = ts.ties_of(moves(), ["plane"] * 4)
    silent = [bw.pose(0.1, (0, 0, 0))]
    path = bag_of(tmp_path, bw.joint_states(moves()), held, silent)
    topics = [replace(t, count=0) if t.name == "measured_pose" else t for t in list_topics(path)[0]]
    assert set(choose_topics(topics, {}, [])) == {"joint_states", "constraint"}


def test_a_constraint_belongs_to_dwells(tmp_path):
    path = bag_of(tmp_path, bw.joint_states(moves()), [bw.tie(0.0, "plane")])
    with pytest.raises(DatasetError, match=r"use mode='dwell', or disable their topics"):
        dataset_from_recording(read_bag(path), SampleOptions(mode="continuous"))


def test_readings_survive_saving_and_joining(tmp_path):
    held = ts.ties_of(moves(), ["plane", "plane", "sphere1", "plane"])
    dataset = load_dataset(bag_of(tmp_path, bw.joint_states(moves()), held))
    dataset.to_json(tmp_path / "samples.json")
    again = Dataset.from_json(tmp_path / "samples.json")
    assert column(again, PLANE) == column(dataset, PLANE)
    only_plane = dataset.select(dataset.conditions[SPHERE] != 0.0)
    del (only_plane.conditions)[SPHERE]
    both = join_datasets([only_plane, replace(again, source="again", sha256="another")])
    assert column(both, SPHERE) == [None] * 3 + [None, None, 0.0, None]
    assert not any("not used" in warning for warning in both.warnings)


def test_look_counts_what_every_channel_read(plate_bag, run):
    document = run("look", plate_bag, "--json")
    assert document["readings"] == {"plane": 40, "sphere1": 40, "sphere2": 40}
    assert document["channels"]["constraint"] == "constraint"
    assert document["channels"]["pose"] is None
    assert document["measured"] == []
    assert not any(name.startswith("reading.") for name in document["conditions"])


# ------------------------------------------------------------------------------ command line


def workspace_error(path, robot):
    """Mean position error (m) all over the workspace, not on the plate only."""
    joints, where = vs.workspace(robot)
    found = Kinematics(read_model(path)).direct(joints).position
    return np.linalg.norm(found - where, axis=1).mean()


def test_a_recorded_plate_session_calibrates_the_whole_workspace(
    plate_bag, plate_model, robot, run, tmp_path
):
    better = tmp_path / "better.yaml"
    options = ("--prior", "--joint-sigma", ts.SIGMA, "--json")
    document = run("fit", plate_model, plate_bag, "-o", better, *options)
    assert workspace_error(plate_model, robot) > 1e-3
    assert workspace_error(better, robot) < 60e-6
    held = document["held_out"]
    assert document["before"]["position_mean"] is None
    assert held["before"]["reading_mean"] > 0.3e-3
    assert held["after"]["reading_mean"] < 1.4 * document["noise_floor"]["reading_mean"]
    assert document["improvement"]["reading"] > 5
    assert 0.6 < document["chi2_per_dof"] < 1.5
    step = read_model(better).history[-1]
    assert step["held_out"]["after"]["reading_rms"] == held["after"]["reading_rms"]
    assert read_model(better).sensors == read_model(plate_model).sensors


def test_comparing_shows_the_readings_worst_first(plate_bag, plate_model, run, run_cli):
    document = run("compare", plate_model, plate_bag, "--joint-sigma", ts.SIGMA, "--json")
    norms = [row["reading_norm"] for row in document["rows"]]
    assert norms == sorted(norms, reverse=True)
    assert document["channels"] == ["plane", "sphere1", "sphere2"]
    assert [v is None for v in document["rows"][0]["reading_error"]].count(False) == 1
    assert document["rows"][0]["position"] == [None] * 3
    shown = run_cli("compare", plate_model, plate_bag, "--joint-sigma", ts.SIGMA)
    assert "reading error, mean" in shown
    assert "sphere2 [um]" in shown


def test_steps_are_judged_by_readings_only_where_no_pose_was_measured():
    def table(**known):
        return Summary(**{f"{kind}_rms": value for kind, value in known.items()})

    before, after = table(reading=4e-5, joint=1e-4), table(reading=1e-5, joint=3e-4)
    assert held_out_ratio(before, after) == pytest.approx(0.25)
    before, after = table(position=1e-4, reading=4e-5), table(position=5e-5, reading=4e-4)
    assert held_out_ratio(before, after) == pytest.approx(0.5)
    assert held_out_ratio(table(), table()) is None


def test_adding_an_effect_compares_readings_with_and_without_it(
    plate_bag, plate_model, run, tmp_path
):
    options = ("--prior", "--joint-sigma", ts.SIGMA, "--force", "--json")
    added = tmp_path / "added.yaml"
    document = run("add", plate_model, "backlash", plate_bag, "-o", added, *options)
    without, held = document["held_out_without_effect"], document["held_out"]["after"]
    assert 10e-6 < without["reading_rms"] < 100e-6
    assert 10e-6 < held["reading_rms"] < 100e-6
    assert read_model(added).sensors == read_model(plate_model).sensors


def test_a_plane_that_was_not_recorded_is_named(robot, plate_model, run, tmp_path):
    readings, ties = ts.PLATE.session(robot, 10, 0)
    kept = ties != "plane"
    session = ts.session(readings[kept])
    path = bag_of(tmp_path, bw.joint_states(session), ts.ties_of(session, ties[kept]))
    said = run("fit", plate_model, path, "--json")
    assert "no measurement with plane, which the model's sensors expect" in said
    assert "recorded: sphere1, sphere2" in said
    assert said.rstrip().endswith("remove plane_spheres from the list `sensors` in the model file")


def test_a_table_of_poses_for_a_model_with_a_probe_says_that_it_needs_no_probe():
    model = new_model("linear_delta", sensors=(Probe(height=0.0, sigma=1e-5),))
    data = Dataset.from_arrays(model.joints, np.full((3, 3), 0.33), np.zeros((3, 3)))
    words = "remove probe from the list `sensors` .*: the measured poses need no sensor"
    with pytest.raises(FitError, match=words):
        observe(model, data)


def test_an_unknown_constraint_names_the_channels_of_the_model(plate_model, run, tmp_path):
    held = ts.ties_of(moves(), ["plane", "sphere1", "sphere2", "sfere1"])
    path = bag_of(tmp_path, bw.joint_states(moves()), held)
    said = run("fit", plate_model, path, "--json")
    assert "readings of sfere1, but the model's sensors have plane, sphere1, sphere2" in said


def test_a_model_with_sensors_refuses_only_poses(plate_model, run, tmp_path):
    path = bag_of(tmp_path, bw.joint_states(moves()), bw.poses(moves()))
    said = run("fit", plate_model, path, "--json")
    assert "no measurement with plane, sphere1, sphere2" in said
    assert "(recorded: no reading)" in said


def test_readings_without_a_sensor_in_the_model_are_refused(plate_bag, run, tmp_path):
    run("new", "delta24", "-o", tmp_path / "bare.yaml", "--json")
    said = run("fit", tmp_path / "bare.yaml", plate_bag, "--json")
    assert "readings of plane, sphere1, sphere2, but the model's sensors have no channel" in said


def test_fewer_ties_than_freedoms_is_a_clear_error(robot, plate_model, run, tmp_path):
    path = bw.write_bag(tmp_path / "few", ts.messages(robot, n=4))
    said = run("fit", plate_model, path, "--joint-sigma", ts.SIGMA, "--json")
    assert said.startswith("12 different poses give 12 equations, but 24 parameters are free")


def test_a_probe_calibrates_what_it_can_see_from_a_recording(robot, run, tmp_path):
    """Heights above a plate that is 0.4 mm higher than drawn, joints with 5 urad of noise."""
    joints, where = vs.workspace(robot, 40)
    moves = ts.session(joints + np.random.default_rng(2).normal(0, 5e-6, joints.shape))
    read = [
        bw.distance(k + 0.2 + 0.1 * i, height, "probe")
        for k, height in enumerate(where[:, 2] - 0.3004)
        for i in range(3)
    ]
    path = bag_of(tmp_path, bw.joint_states(moves), read)
    model = tmp_path / "probe.yaml"
    run("new", "delta24", "--sensor", "probe: {height: 0.3}", "-o", model, "--json")
    document = run("fit", model, path, "--prior", "--joint-sigma", "5e-6", "--json")
    assert document["before"]["reading_mean"] > 0.2e-3
    assert document["after"]["reading_mean"] < 2e-6
    assert document["held_out"]["after"]["reading_mean"] < 20e-6
    # Tolerances hold a part of what 40 heights determine.
    assert 40 - document["rank"] <= document["dof"] < 40 - 0.8 * document["rank"]


def test_a_plan_for_the_device_says_that_it_does_not_count_the_probe(run, tmp_path):
    model = tmp_path / "probe.yaml"
    run("new", "delta24", "--sensor", "probe: {height: 0.3}", "-o", model, "--json")
    known = "noise: {joint: 2.0e-05, position: 1.0e-05, orientation: null}"
    text = model.read_text()
    unknown = next(line for line in text.splitlines() if line.startswith("noise: "))
    model.write_text(text.replace(unknown, known))
    options = ("--poses", "20", "--pool", "60", "--fix", "probe.*", "--json")
    document = run("plan", model, *options)
    assert document["warnings"] == [
        "planned for the pose device only: readings of probe are ignored"
    ]


def test_a_sensor_option_wins_over_the_configuration_and_leaves_its_other_numbers(run, tmp_path):
    """RepRapFirmware's config.g states the bed's slopes and where the probe's tip is."""
    (tmp_path / "config.g").write_text("M665 L250 R125 H300\nM666 A1 B-2\nG31 X10 Y5 Z2\n")
    sensor = "probe: {height: 0.3, tip: [0.02, 0.005, -0.002]}"
    out = tmp_path / "printer.yaml"
    run("new", "--from", tmp_path / "config.g", "--sensor", sensor, "-o", out, "--json")
    model = read_model(out)
    [probe] = model.sensors
    assert (probe.height, probe.tip, probe.sigma) == (0.3, (0.02, 0.005, -0.002), None)
    values = {name: model.value(f"probe.{name}") for name in ("plate.z", "tip.x", "tip.z")}
    assert values == {"plate.z": 0.3, "tip.x": 0.02, "tip.z": -0.002}
    assert model.value("probe.plate.ry") == pytest.approx(-0.01)  # 1 % along x
    assert model.value("probe.plate.rx") == pytest.approx(-0.02)


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ("probe: {heigth: 0.3}", "--sensor:1: probe.heigth: unknown option; did you mean 'height'"),
        ("probe", "--sensor:1: probe.height: this key is missing"),
        ("probing: {height: 0.3}", "no sensor 'probing': expected one of ball_bar"),
        ("[probe]", "expected 'NAME' or 'NAME: {KEY: VALUE, ...}'"),
    ],
)
def test_a_sensor_given_wrongly_makes_no_model_file(sensor, words, run, tmp_path):
    assert words in run("new", "delta24", "--sensor", sensor, "-o", tmp_path / "m.yaml")
    assert not (tmp_path / "m.yaml").exists()


def test_every_sensor_is_listed_with_its_options(run):
    listed = {row["name"]: row["options"] for row in run("sensors", "--json")["sensors"]}
    assert listed["probe"][0] == "height"
    assert {"ball_bar", "device_frame", "plane_spheres", "probe"} <= listed.keys()


def test_poses_in_contact_are_planned_where_no_device_measures_them(plate_model, run):
    found = run("plan", plate_model, "--poses", "24", "--json")
    assert len(found["poses"]) == 24
    assert found["expected"]["position_rms"] < found["random"]["expected"]["position_rms"]
