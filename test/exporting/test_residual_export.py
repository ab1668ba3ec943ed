"""Residuals as ROS tools read them: an MCAP file, and layouts that name its topics."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from parallel_cal.cli.main import main
from parallel_cal.recordings.residuals import ROOT, TOPICS, residual_messages

REPOSITORY = Path(__file__).parents[2]
CONFIG = REPOSITORY / "config"
PRESET, BAG = CONFIG / "delta_mockup_nominal.yaml", REPOSITORY / "bags" / "delta_clean"
STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "residuals.mcap"
    main_exits_well(["export-residuals", str(PRESET), str(BAG), "-o", str(path)])
    return path


def main_exits_well(arguments):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert not ended.value.code


@pytest.fixture(scope="module")
def messages(exported):
    """By topic: [(log time in ns, message)], as a reader that knows nothing of ours finds them."""
    found = {}
    with Reader(exported) as reader:
        for connection, time, data in reader.messages():
            message = STORE.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    return found


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """What `compare --json` says of the same recording, by sample."""
    from parallel_cal import compare, load_dataset, read_model

    model = read_model(PRESET)
    rows = compare(model, load_dataset(BAG, joints=model.joints)).document()["rows"]
    return sorted(rows, key=lambda row: row["sample"])


def vectors(messages, topic):
    found = [message.vector for _, message in messages[f"{ROOT}/{topic}"]]
    return np.array([[v.x, v.y, v.z] for v in found])


def test_the_file_holds_every_topic_with_standard_messages(messages):
    assert messages.keys() == {ROOT + topic for topic in TOPICS}
    kinds = {ROOT + t: kind.replace("/msg/", "__msg__") for t, kind in TOPICS.items()}
    for topic, found in messages.items():
        assert found[0][1].__msgtype__.replace("/msg/", "__msg__") == kinds[topic]


def test_positions_orientations_and_joints_are_those_that_compare_shows(messages, document):
    for topic, key in (("position", "position_error"), ("orientation", "orientation_error")):
        expected = np.array([row[key] for row in document], float)
        np.testing.assert_allclose(vectors(messages, topic), expected, atol=1e-15)
    joints = [message.position for _, message in messages[f"{ROOT}/joints"]]
    np.testing.assert_allclose(joints, [row["joint_error"] for row in document], atol=1e-15)
    assert messages[f"{ROOT}/joints"][0][1].name == ["joint1", "joint2", "joint3"]
    sigmas = [message.data for _, message in messages[f"{ROOT}/sigmas"]]
    np.testing.assert_allclose(sigmas, [row["sigmas"] for row in document])


def test_measured_minus_predicted_is_the_residual(messages):
    def points(topic):
        found = [message.pose.position for _, message in messages[f"{ROOT}/{topic}"]]
        return np.array([[p.x, p.y, p.z] for p in found])

    apart = points("measured") - points("predicted")
    np.testing.assert_allclose(apart, vectors(messages, "position"), atol=1e-12)


def test_in_sigmas_a_clean_nominal_robot_is_far_off_and_its_noise_is_not(messages):
    """0.6 mm of geometry before some 10 um of noise."""
    assert np.abs(vectors(messages, "position_sigmas")).max() > 20
    rms = np.sqrt(np.mean(vectors(messages, "position") ** 2))
    in_sigmas = np.sqrt(np.mean(vectors(messages, "position_sigmas") ** 2))
    assert 1e-6 < rms / in_sigmas < 1e-4


def test_times_are_those_of_the_recording(messages):
    with Reader(BAG) as reader:
        begin, end = reader.start_time, reader.end_time
    times = [time for time, _ in messages[f"{ROOT}/position"]]
    assert begin < times[0] < times[-1] < end
    assert times == sorted(times)
    for time, message in messages[f"{ROOT}/position"]:
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time


def test_the_arrows_begin_where_was_measured_and_are_a_hundred_times_as_long(messages):
    [(_, array)] = messages[ROOT]
    assert array.markers[0].action == 3  # what was drawn before goes
    errors = vectors(messages, "position")
    assert len(array.markers) == 1 + len(errors)
    for marker, error in zip(array.markers[1:], errors, strict=True):
        a, b = marker.points
        np.testing.assert_allclose([b.x - a.x, b.y - a.y, b.z - a.z], 100 * error, atol=1e-12)
        assert marker.header.frame_id == "base"


@pytest.mark.wide
def test_a_file_that_stands_is_not_overwritten(exported, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["export-residuals", str(PRESET), str(BAG), "-o", str(exported)])
    assert ended.value.code == 1
    assert "already exists" in capsys.readouterr().err


@pytest.mark.wide
def test_saved_samples_are_exported_too_from_stamp_zero_on(tmp_path, capsys):
    from parallel_cal import load_dataset, read_model

    model = read_model(PRESET)
    dataset = load_dataset(BAG, joints=model.joints)
    dataset.to_json(tmp_path / "samples.json")
    out = tmp_path / "r.mcap"
    arguments = ["export-residuals", str(PRESET), str(tmp_path / "samples.json"), "-o", str(out)]
    main_exits_well([*arguments, "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["samples"] == len(dataset)
    assert set(said["topics"]) == {ROOT + topic for topic in TOPICS}
    with Reader(out) as reader:
        assert reader.start_time == round(1e9 * dataset.time[0])


def test_what_was_not_measured_is_not_reported():
    from parallel_cal import Dataset, Kinematics, compare, new_model

    model = new_model("delta24")
    q = np.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.2], [0.2, 0.2, 0.1]])
    r = Kinematics(model).direct(q).position + [0.001, 0.0, 0.0]
    dataset = Dataset.from_arrays(model.joints, q, r, pose_cov=1e-10 * np.eye(6), joint_sigma=1e-5)
    found = compare(model, dataset).residuals(dataset.numbers, np.arange(3))
    told = [message.topic for message in residual_messages(found, 1.0)]
    assert told.count("/position") == told.count("/measured") == told.count("/predicted") == 3
    assert "/orientation" not in told
    assert "/orientation_sigmas" not in told
    np.testing.assert_allclose(found.vectors["/position"], [[0.001, 0, 0]] * 3, atol=1e-12)


# ------------------------------------------------------------------- layouts


def layout_topics():
    """(layout, topic or field) of every display and curve."""
    rviz = yaml.safe_load((CONFIG / "residuals.rviz").read_text())
    for display in rviz["Visualization Manager"]["Displays"]:
        if "Topic" in display:
            yield "residuals.rviz", display["Topic"]["Value"]
    juggler = ElementTree.parse(CONFIG / "residuals.plotjuggler.xml")
    for curve in juggler.iter("curve"):
        yield "residuals.plotjuggler.xml", curve.get("name")


def numbers(prefix, message):
    """The names under which PlotJuggler plots a message: fields, joints by their name."""
    if message.__msgtype__ == "sensor_msgs/msg/JointState":
        return {f"{prefix}/{name}/position" for name in message.name}
    found = set()
    for field in message.__dataclass_fields__:
        value = getattr(message, field)
        if hasattr(value, "__msgtype__"):
            found |= numbers(f"{prefix}/{field}", value)
        elif isinstance(value, float):
            found.add(f"{prefix}/{field}")
    return found


def test_every_topic_and_number_of_the_layouts_is_in_an_exported_file(messages):
    plotted = {n for topic, [(_, one), *_] in messages.items() for n in numbers(topic, one)}
    named = list(layout_topics())
    assert len(named) > 20
    for layout, name in named:
        assert name in (messages if layout.endswith("rviz") else plotted), name


def test_the_node_publishes_what_the_file_holds():
    """Of the policy it is known that it is what the node publishes."""
    policy = (CONFIG / "sros2_policy.xml").read_text()
    own = policy[policy.index('node="calibration_node"') :]
    published = set(re.findall(r"<topic>~(/residuals[^<]*)</topic>", own))
    assert published == {ROOT.removeprefix("/calibration_node") + topic for topic in TOPICS}
