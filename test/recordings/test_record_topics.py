"""The topics to record are those that the commands read, under the names that they are given."""

import json
import shlex

import pytest
from typer.testing import CliRunner

from parallel_cal.cli.main import application

USUAL = ["joint_states", "measured_pose", "measured_position", "temperature", "payload"]
USUAL += ["constraint", "distance"]


def run(*words):
    done = CliRunner().invoke(application(["record-topics"]), ["record-topics", *words])
    assert done.exit_code == 0, done.output
    return done.stdout.split("\n")[:-1]


def test_the_usual_topics_are_listed_one_a_line():
    assert run() == [f"/{name}" for name in USUAL]


def test_names_without_a_slash_are_in_the_namespace():
    listed = run("--namespace", "/cell/arm/", "--data", "temperature=/hall/air")
    assert "/cell/arm/joint_states" in listed
    assert "/hall/air" in listed
    assert not any(name.endswith("/temperature") for name in listed)


def test_a_topic_of_poses_that_is_named_replaces_both_usual_ones():
    listed = run("--data", "measured_pose=/tracker/pose")
    assert "/tracker/pose" in listed
    assert not {"/measured_pose", "/measured_position"} & set(listed)


def test_a_topic_that_is_switched_off_is_not_listed():
    assert run("--data", "payload=") == [f"/{name}" for name in USUAL if name != "payload"]


def test_sensors_of_parts_and_images_are_listed_where_they_are_named():
    given = ("temperature.arms=arm/air", "images=left,/right")
    listed = run(*(word for one in given for word in ("--data", one)))
    assert {"/arm/air", "/left", "/right", "/temperature"} <= set(listed)


def test_a_body_on_tf_needs_the_static_frames_too():
    listed = run("--data", "measured_pose=/tf:base->tool")
    assert {"/tf", "/tf_static"} <= set(listed)


def test_the_command_line_of_ros2_bag_record_is_printed():
    [line] = run("--command", "-o", "first day")
    recorded = [f"/{name}" for name in USUAL]
    assert shlex.split(line) == [
        "ros2",
        "bag",
        "record",
        "-s",
        "mcap",
        "-o",
        "first day",
        *recorded,
    ]


def test_json_has_the_topics_and_the_command():
    [line] = run("--json")
    document = json.loads(line)
    assert document["topics"] == [f"/{name}" for name in USUAL]
    assert document["command"][-len(USUAL) :] == document["topics"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_recording_of_these_topics_has_all_that_is_read(tmp_path, storage):
    """What simulate writes is among the topics, so that nothing of it would be missed."""
    from parallel_cal.model.model import new_model
    from parallel_cal.recordings.bag import list_topics
    from parallel_cal.recordings.simulate import simulate
    from parallel_cal.recordings.writer import write_bag

    write_bag(simulate(new_model("slider_crank"), 4, 0), tmp_path / "bag", storage)
    written = {f"/{topic.name.lstrip('/')}" for topic in list_topics(tmp_path / "bag")[0]}
    assert written <= {*run(), "/joint_trajectory"}
