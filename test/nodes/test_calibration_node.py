"""The calibration node as others see it: a process, topics, services and an action."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import bag_writing as bw
import numpy as np
import pytest
import tied_session as ts
import virtual_setups as vs
from marks import keep

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    InertiaStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    Vector3Stamped,
)
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from parallel_cal_msgs.action import Identify
from parallel_cal_msgs.msg import CollectionStatus, ModelStatus
from parallel_cal_msgs.srv import (
    AddEffect,
    Compare,
    ListSamples,
    LoadSamples,
    RemoveSample,
    SaveSamples,
)
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameterTypes, SetParameters
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from ros_helpers import LONG, NodeProcess
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import model_hash, read_model, write_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.nodes import client as node_client
from parallel_cal.nodes.client import Client, Process, use_private_domain
from parallel_cal.nodes.jobs import WorkSlot
from parallel_cal.nodes.recorder import Recorder
from parallel_cal.recordings.bag import list_topics, read_bag
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.simulate import simulate
from parallel_cal.recordings.writer import write_bag

REPOSITORY = Path(__file__).parents[2]
PRESET = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
CLEAN, ECCENTRIC = (REPOSITORY / "bags" / b for b in ("delta_clean", "delta_eccentricity"))
CANCELED, SUCCEEDED, ABORTED = 5, 4, 6


def counts(bag):
    """How many joint readings and poses a bag holds."""
    found = {topic.name.strip("/"): topic.count for topic in list_topics(bag)[0]}
    return found["joint_states"], found["measured_pose"]


def received(status):
    return status.joint_states_received + status.poses_received


class Robot:
    """Both nodes on a copy of the preset, and a client of theirs."""

    def __init__(self, folder):
        self.folder, self.namespace = folder, use_private_domain()
        self.model_file = folder / "robot.yaml"
        self.processes = []
        shutil.copy(PRESET, self.model_file)
        for node in ("kinematics_node", "calibration_node"):
            files = {"model_file": str(self.model_file), "allowed_folders": f"{folder}:/no"}
            self.start(node, **files)
        self.client = Client("tester", self.namespace, self.processes)
        self.latched = {
            "status": self.client.subscribe_latest(
                CollectionStatus, "calibration_node/collection_status"
            ),
            "dropped": self.client.subscribe_latest(String, "calibration_node/dropped"),
            "result": self.client.subscribe_latest(String, "calibration_node/result"),
            "residuals": self.client.subscribe_latest(MarkerArray, "calibration_node/residuals"),
            "model": self.client.subscribe_latest(ModelStatus, "kinematics_node/model_status"),
        }

    def start(self, node, **parameters):
        self.processes.append(Process(node, self.folder, self.namespace, **parameters))
        return self.processes[-1]

    def call(self, type, name, **fields):
        return self.client.call(type, f"calibration_node/{name}", **fields)

    @property
    def status(self):
        self.client.wait(lambda: bool(self.latched["status"]), "a status")
        return self.latched["status"][0]

    def result(self):
        return json.loads(self.latched["result"][0].data)

    def play(self, bag):
        """Replay a bag and wait until all of it has been looked at."""
        already, expected = received(self.status), sum(counts(bag))
        listeners = self.client.count_subscribers(topic.name for topic in list_topics(bag)[0])
        player = self.start("replay_node", bag=str(bag), rate=20.0, wait_for_subscribers=listeners)
        self.client.wait(lambda: received(self.status) >= already + expected, "the bag", 120)
        self.client.wait(lambda: player.status is not None, "the end of the replay")
        self.processes.remove(player)

    def identify(self, hear=lambda feedback: None, **goal):
        handle = self.client.send_goal(Identify, "calibration_node/identify", hear, **goal)
        assert handle.accepted
        return handle

    def outcome(self, handle):
        return self.client.await_result(handle.get_result_async(), "the result", 120)

    def identified(self, **goal):
        answer = self.outcome(self.identify(**goal))
        assert answer.status == (SUCCEEDED if answer.result.success else ABORTED)
        return answer.result

    def fresh_model(self, name):
        return str(shutil.copy(PRESET, self.folder / name))


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    with mock.patch.dict(os.environ):
        robot = Robot(tmp_path_factory.mktemp("robot"))
        yield robot
        robot.client.close()
        assert [process.end() for process in robot.processes] == [0, 0]


@pytest.fixture(scope="module")
def collected(robot):
    """The robot after a replay of the clean recording; its samples are in samples.json."""
    robot.play(CLEAN)
    assert robot.call(SaveSamples, "save_samples", path=str(robot.folder / "s.json")).success
    return robot


@pytest.fixture
def full(collected):
    """All 94 samples, whatever a test before did to them."""
    answer = collected.call(LoadSamples, "load_samples", path=str(collected.folder / "s.json"))
    assert answer.samples == 94
    return collected


def test_before_anything_arrives_every_service_answers_with_a_reason(robot):
    assert robot.status.samples == 0
    for answer in (
        robot.call(Trigger, "take_sample"),
        robot.call(SaveSamples, "save_samples", path="/tmp/never.json"),
        robot.call(LoadSamples, "load_samples", path="/no/such/file.json"),
        robot.call(RemoveSample, "remove_sample", id=1),
        robot.call(Compare, "compare"),
        robot.call(AddEffect, "add_effect", effect="backlash"),
        robot.call(AddEffect, "add_effect"),
        robot.identified(),
    ):
        assert not answer.success
        assert answer.message
        assert "internal error" not in answer.message
    assert robot.call(ListSamples, "list_samples").samples == []


def test_at_twenty_times_real_time_nothing_is_lost(collected):
    status = collected.status
    assert status.joint_states_received == 15277
    assert status.poses_received == 3056
    assert status.paired + status.dropped == 3056
    assert status.dropped <= 1
    assert status.samples == 94
    assert json.loads(collected.latched["dropped"][0].data) == []


def test_samples_carry_what_was_measured_and_how(collected):
    answer = collected.call(ListSamples, "list_samples")
    assert len(answer.samples) == 94
    assert answer.joint_names == ["joint1", "joint2", "joint3"]
    assert answer.status.samples == 94
    sample = answer.samples[0]
    assert len(sample.joints) == 3
    assert sample.pose.covariance[0] == pytest.approx(1e-10, rel=0.1)
    conditions = {c.name: c.value for c in sample.conditions}
    assert conditions["payload"] == 0.2
    assert "direction.joint1" in conditions
    assert sample.stamp.sec >= 1767225600
    assert sum(s.replicate_of >= 0 for s in answer.samples) == 20


def test_samples_are_removed_saved_loaded_and_cleared(full):
    first = full.call(ListSamples, "list_samples").samples[0].id
    assert full.call(RemoveSample, "remove_sample", id=first).success
    assert full.status.samples == 93
    assert not full.call(RemoveSample, "remove_sample", id=first).success
    path = str(full.folder / "93.json")
    assert full.call(SaveSamples, "save_samples", path=path).samples == 93
    assert full.call(Trigger, "clear_samples").success
    assert full.call(ListSamples, "list_samples").samples == []
    assert full.call(LoadSamples, "load_samples", path=path).samples == 93
    bad = full.call(LoadSamples, "load_samples", path=str(full.model_file))
    assert not bad.success
    assert full.status.samples == 93


def test_comparing_shows_every_sample_and_the_residuals_as_arrows(full):
    answer = full.call(Compare, "compare")
    document = json.loads(answer.json)
    assert answer.success
    assert document["position_mean"] == pytest.approx(605e-6, rel=0.02)
    assert len(document["rows"]) == 94
    listed = {s.id for s in full.call(ListSamples, "list_samples").samples}
    assert {row["id"] for row in document["rows"]} == listed
    full.client.wait(lambda: bool(full.latched["residuals"]), "arrows")
    arrows = full.latched["residuals"][0].markers
    assert len(arrows) == 1 + 94
    assert arrows[1].header.frame_id == "base"
    assert {marker.id for marker in arrows[1:]} == listed


def test_a_comparison_returns_every_residual_as_plain_numbers(full):
    vectors, joints, node = [], [], full.client._node
    listening = [
        node.create_subscription(type, f"calibration_node/residuals/{name}", kept.append, 200)
        for type, name, kept in (
            (Vector3Stamped, "position", vectors),
            (JointState, "joints", joints),
        )
    ]
    full.client.wait(lambda: all(s.get_publisher_count() for s in listening), "the node")
    rows = json.loads(full.call(Compare, "compare").json)["rows"]
    full.client.wait(lambda: len(vectors) == len(joints) == 94, "the residuals")
    samples = {s.id: s for s in full.call(ListSamples, "list_samples").samples}
    told = {(m.header.stamp.sec, m.header.stamp.nanosec): m.vector for m in vectors}
    for row in rows:
        stamp = samples[row["id"]].stamp
        vector = told[stamp.sec, stamp.nanosec]
        assert [vector.x, vector.y, vector.z] == pytest.approx(row["position_error"], abs=1e-12)
    assert list(joints[0].name) == ["joint1", "joint2", "joint3"]


def test_too_few_samples_are_refused_and_nothing_is_written(full):
    model = full.fresh_model("few.yaml")
    before = Path(model).read_bytes()
    for sample in full.call(ListSamples, "list_samples").samples[4:]:
        full.call(RemoveSample, "remove_sample", id=sample.id)
    result = full.identified(model_file=model, hold_out=0.25)
    assert not result.success
    assert "different poses" in result.message
    assert Path(model).read_bytes() == before


def test_a_bad_model_file_is_a_message(full):
    path = full.folder / "bad.yaml"
    path.write_text("parallel_cal: 1\nmechanism: delta54\nodd: 1\n")
    result = full.identified(model_file=str(path), hold_out=0.25)
    assert not result.success
    assert "bad.yaml" in result.message
    missing = full.identified(model_file="/no/such.yaml")
    assert "/no/such.yaml" in missing.message
    assert not full.call(Compare, "compare", model_file=str(path)).success


def test_no_request_overwrites_what_is_not_of_its_kind_or_lies_elsewhere(full):
    before = full.model_file.read_bytes()
    for path, reason in (
        (str(full.model_file), "not a samples file"),
        ("/dev/null", "allowed_folders"),
        (str(full.folder / ".." / "x.json"), "allowed_folders"),
    ):
        answer = full.call(SaveSamples, "save_samples", path=path)
        assert not answer.success
        assert reason in answer.message
    hidden = full.folder / ".bash_profile"
    answer = full.call(SaveSamples, "save_samples", path=str(hidden))
    assert f"{hidden}: a samples file's name must end in .json" in answer.message
    assert not answer.success
    assert not hidden.exists()
    result = full.identified(output_file=str(full.folder / "s.json"), force=True)
    assert "not a model file" in result.message
    assert full.model_file.read_bytes() == before
    refused = full.call(AddEffect, "add_effect", effect="antigravity.effect")
    assert "allow_foreign_modules" in refused.message


def test_odd_goals_are_messages(full):
    model = full.fresh_model("odd.yaml")
    goals = [
        {"method": "magic"},
        {"fix": ["nothing.*"]},
        {"hold_out": 7.0},
        {"joint_sigma": -1.0},
        {"joint_sigma": float("nan")},
        {"joint_sigma": float("inf")},
        {"output_file": "/no/such/folder/robot.yaml"},
    ]
    for goal in goals:
        result = full.identified(model_file=model, **goal)
        assert not result.success, goal
        assert "internal error" not in result.message


def test_an_identified_model_is_written_and_served_under_the_same_hash(full):
    heard = []
    answer = full.outcome(full.identify(heard.append, hold_out=0.25))
    result = answer.result
    assert answer.status == SUCCEEDED
    assert result.success, result.message
    assert result.position_before == pytest.approx(605e-6, rel=0.02)
    assert result.held_out_after < 35e-6
    assert result.hash == model_hash(full.model_file.read_bytes())
    assert read_model(full.model_file).history[-1]["step"] == "fit"
    assert [f.fraction for f in heard] == sorted(f.fraction for f in heard)
    assert heard[-1].stage
    assert heard[-1].position_error < 35e-6
    full.client.wait(
        lambda: bool(full.latched["model"]) and full.latched["model"][0].hash == result.hash,
        "kinematics_node to take the file over",
    )
    full.client.wait(lambda: full.result()["hash"] == result.hash, "the latched result")
    assert full.result()["document"] == json.loads(result.json)


def test_a_hold_out_of_zero_is_the_parameter_and_below_it_only_force_writes(full):
    model = full.fresh_model("held.yaml")
    before = Path(model).read_bytes()
    none = full.identified(model_file=model, hold_out=-1.0)
    assert not none.success
    assert "nothing was written" in none.message
    assert Path(model).read_bytes() == before
    usual = full.identified(model_file=model)
    assert usual.success, usual.message
    assert usual.held_out_after < 35e-6
    full.identified(model_file=full.fresh_model("other.yaml"))
    after = Path(full.folder / "other.yaml").read_bytes()
    undone = full.call(Trigger, "undo")
    assert undone.success, undone.message
    assert Path(full.folder / "other.yaml").read_bytes() == PRESET.read_bytes()
    assert Path(full.folder / "other.yaml.previous").read_bytes() == after


def test_a_tracker_s_frame_is_registered_and_reported_as_on_the_command_line(full):
    """The tracker shows everything 1, 2, 3 m further on."""
    clean = load_dataset(CLEAN)
    away = dataclasses.replace(clean, r=clean.r + [1.0, 2.0, 3.0], frame="tracker")
    away.to_json(full.folder / "away.json")
    assert full.call(LoadSamples, "load_samples", path=str(full.folder / "away.json")).success
    result = full.identified(model_file=full.fresh_model("away.yaml"), hold_out=0.25)
    assert result.success, result.message
    assert result.held_out_after < 35e-6
    assert "the transform between them is estimated from the samples" in " ".join(
        full.status.warnings
    )
    full.client.wait(
        lambda: any("'tracker' was registered to 'base'" in w for w in full.status.warnings),
        "the registration",
    )
    assert full.call(LoadSamples, "load_samples", path=str(full.folder / "s.json")).success
    assert full.call(Compare, "compare").success
    full.client.wait(
        lambda: not any("was registered" in w for w in full.status.warnings), "its end"
    )


def test_undo_concerns_the_model_file_that_replaced_another(robot, tmp_path):
    """Also of a run before, and where the file that results go to was never written."""
    model = Path(shutil.copy(PRESET, tmp_path / "m.yaml"))
    before = model.read_bytes()
    older = b"# old\n" + before
    (tmp_path / "m.yaml.previous").write_bytes(older)
    namespace = use_private_domain() + "_undo"
    files = {"model_file": str(model), "output_file": str(tmp_path / "never.yaml")}
    node = Process("calibration_node", tmp_path, namespace, journal=False, **files)
    client = Client("tester", namespace, [node])
    answer = client.call(Trigger, "calibration_node/undo")
    assert answer.success, answer.message
    assert model.read_bytes() == older
    assert (tmp_path / "m.yaml.previous").read_bytes() == before
    client.close()
    assert node.end() == 0


ENDLESS = """
import time
from pathlib import Path


def estimate(model, observations, free, prior=False):
    Path(__file__).with_name("begun").touch()
    while True:
        time.sleep(3600)
"""


def test_a_user_s_own_method_that_never_returns_ends_when_its_goal_is_cancelled(
    collected, tmp_path, monkeypatch
):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "endless.py").write_text(ENDLESS)
    begun = tmp_path / "mine" / "begun"
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    shutil.copy(PRESET, tmp_path / "m.yaml")
    namespace = use_private_domain() + "_endless"
    node = Process(
        "calibration_node",
        tmp_path,
        namespace,
        journal=False,
        allow_foreign_modules=True,
        model_file=str(tmp_path / "m.yaml"),
        allowed_folders=f"{tmp_path}:{collected.folder}",
    )
    client, heard = Client("tester", namespace, [node]), []
    samples = str(collected.folder / "s.json")
    assert client.call(LoadSamples, "calibration_node/load_samples", path=samples).success
    identify = "calibration_node/identify"
    handle = client.send_goal(Identify, identify, heard.append, method="mine.endless")
    client.wait(begun.exists, "its beginning")
    client.await_result(handle.cancel_goal_async(), "the cancel")
    assert client.await_result(handle.get_result_async(), "the end").status == CANCELED
    again = client.send_goal(Identify, identify, heard.append)
    assert client.await_result(again.get_result_async(), "the result").result.success
    begun.unlink()
    client.send_goal(Identify, identify, heard.append, method="mine.endless")
    client.wait(begun.exists, "its beginning")
    client.close()
    assert node.end() == 0


def test_a_node_that_is_deactivated_refuses_collects_nothing_and_goes_on_when_active(full):
    def change(to):
        request = {"transition": Transition(id=to)}
        assert full.client.call(ChangeState, "calibration_node/change_state", **request).success

    state = full.client.call(GetState, "calibration_node/get_state").current_state
    assert state.label == "active"
    heard = []
    running = full.identify(heard.append, model_file=full.fresh_model("off.yaml"), hold_out=0.01)
    change(Transition.TRANSITION_DEACTIVATE)
    assert "cancelled" in full.outcome(running).result.message

    def refused():  # and said; the end of the goal that was cancelled is said as well, at any time
        assert not full.client.send_goal(Identify, "calibration_node/identify", print).accepted
        return "inactive: activate it first" in full.status.last_event

    full.client.wait(refused, "a word on why")
    for type, name in ((Trigger, "clear_samples"), (AddEffect, "add_effect"), (Compare, "compare")):
        answer = full.call(type, name)
        assert not answer.success
        assert "the node is inactive: activate it first" in answer.message
    publisher = full.client._node.create_publisher(JointState, "joint_states", 10)
    full.client.wait(lambda: publisher.get_subscription_count() > 0, "the node")
    before = full.call(ListSamples, "list_samples").status.joint_states_received
    for _ in range(20):
        publisher.publish(JointState(name=["joint1"], position=[0.0]))
    assert publisher.wait_for_all_acked()
    assert full.call(ListSamples, "list_samples").status.joint_states_received == before
    change(Transition.TRANSITION_ACTIVATE)
    full.client._node.destroy_publisher(publisher)
    assert len(full.call(ListSamples, "list_samples").samples) == 94


def test_a_model_that_is_as_good_already_is_refused_unless_forced(full):
    model = full.fresh_model("twice.yaml")
    assert full.identified(model_file=model, hold_out=0.25).success
    before = Path(model).read_bytes()
    again = full.identified(model_file=model, hold_out=0.25)
    assert not again.success
    assert "does not fall" in again.message
    assert json.loads(again.json)["samples"] == 94
    assert Path(model).read_bytes() == before
    forced = full.identified(model_file=model, hold_out=0.25, force=True)
    assert forced.success
    assert len(read_model(model).history) == 3


def test_parameters_can_be_freed_and_fixed(full):
    model = full.fresh_model("masks.yaml")
    more = json.loads(full.identified(model_file=model, free=["chain1.b_z"]).json)
    assert more["free"] == 43
    fewer = json.loads(full.identified(model_file=model, fix=["chain1.*"], force=True).json)
    assert fewer["free"] < 42


@pytest.fixture(scope="module")
def many(collected):
    """A file with so many samples and poses that leaving each out takes a minute or more."""
    dataset = load_dataset(collected.folder / "s.json").select(np.tile(np.arange(94), 8))
    dataset = dataclasses.replace(dataset, pose_id=np.arange(len(dataset)))
    dataset.to_json(collected.folder / "many.json")
    return str(collected.folder / "many.json")


def test_a_cancelled_goal_ends_at_once_and_writes_nothing(full, many):
    model, heard = full.fresh_model("cancelled.yaml"), []
    before = Path(model).read_bytes()
    assert full.call(LoadSamples, "load_samples", path=many).success
    handle = full.identify(heard.append, model_file=model, hold_out=0.001)
    full.client.wait(lambda: len(heard) > 3, "feedback")
    other = full.client.send_goal(Identify, "calibration_node/identify", heard.append)
    assert not other.accepted
    full.client.wait(lambda: "goal rejected" in full.status.last_event, "the reason")
    assert "running" in full.call(AddEffect, "add_effect", effect="backlash").message
    full.client.await_result(handle.cancel_goal_async(), "the cancel")
    answer = full.outcome(handle)
    assert answer.status == CANCELED
    assert not answer.result.success
    assert "cancelled" in answer.result.message
    assert Path(model).read_bytes() == before


def test_after_a_cancelled_goal_the_next_one_is_served(full):
    assert full.identified(model_file=full.fresh_model("next.yaml"), hold_out=0.25).success


@mock.patch.dict(os.environ)
def test_a_node_stopped_in_the_middle_of_an_identification_ends_cleanly(full, many, tmp_path):
    namespace, model, heard = (
        use_private_domain() + "_stopped",
        full.fresh_model("stopped.yaml"),
        [],
    )
    before = Path(model).read_bytes()
    node = Process("calibration_node", tmp_path, namespace, model_file=model)
    client = Client("tester", namespace, [node])
    assert client.call(LoadSamples, "calibration_node/load_samples", path=many).success
    client.send_goal(Identify, "calibration_node/identify", heard.append, hold_out=0.001)
    client.wait(lambda: len(heard) > 3, "feedback")
    client.close()
    assert node.end() == 0
    assert "Traceback" not in node.log.read_text()
    assert Path(model).read_bytes() == before


def test_a_goal_that_rclpy_dropped_does_not_keep_the_next_one_out():
    one = WorkSlot(None)
    one.begin("the first", promised=True)
    one.begin("the second", promised=True)
    one.confirm()
    with pytest.raises(ParallelCalError, match="the second"):
        one.begin("the third")


def test_a_node_that_does_not_know_a_client_yet_is_asked_again(full, monkeypatch):
    create, lost = full.client._node.create_client, []

    def create_unknown(type, name):
        """Create a client of which the node drops the first two answers."""
        client = create(type, name)
        if type is not GetParameterTypes:
            return client

        def call(request):
            if len(lost) == 2:
                return client.call_async(request)
            lost.append(Future())
            return lost[-1]

        return SimpleNamespace(service_is_ready=client.service_is_ready, call_async=call)

    monkeypatch.setattr(node_client, "ASK_AGAIN_S", 0.05)
    monkeypatch.setattr(full.client._node, "create_client", create_unknown)
    monkeypatch.setattr(full.client, "_clients", {})
    assert full.call(Trigger, "clear_samples").success
    assert len(lost) == 2


@pytest.mark.wide
def test_an_effect_is_added_where_it_helps_and_refused_where_not(full):
    output = str(full.folder / "effect.yaml")
    refused = full.call(AddEffect, "add_effect", effect="backlash", output_file=output)
    assert not refused.success
    assert "does not fall" in refused.message
    assert not Path(output).exists()
    assert not full.call(AddEffect, "add_effect", effect="wishful_thinking").success
    samples = full.folder / "eccentric.json"
    load_dataset(ECCENTRIC).to_json(samples)
    assert full.call(LoadSamples, "load_samples", path=str(samples)).success
    added = full.call(AddEffect, "add_effect", effect="encoder_eccentricity", output_file=output)
    assert added.success, added.message
    assert added.hash == model_hash(Path(output).read_bytes())
    assert [e.name for e in read_model(output).effects] == ["encoder_eccentricity"]


def test_diagnostics_tell_of_the_samples_and_of_every_stream(full):
    told = {}

    def hear(message):
        told.update({s.name.split(": ")[1]: s for s in message.status})

    full.client._node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
    full.client.wait(lambda: {"samples", "joint_states"} <= told.keys(), "diagnostics")
    counts = {v.key: v.value for v in told["joint_states"].values}
    assert int(counts["Events since startup"]) >= 15277
    assert counts["Lost since startup"] == "0"
    assert {v.key: v.value for v in told["samples"].values}["samples"] == "94"


@pytest.fixture(scope="module")
def short_bag(tmp_path_factory):
    """A recording of 12 poses, for what does not depend on their number."""
    bag = tmp_path_factory.mktemp("short") / "bag"
    write_bag(simulate(read_model(PRESET), 12, 1), bag)
    return bag


def played(tmp_path, bag, by):
    """A node that a bag was played to, then ended by a signal; its journals are in `j`."""
    namespace, processes = use_private_domain() + "_journal", []
    node = Process("calibration_node", tmp_path, namespace, journal_folder=str(tmp_path / "j"))
    processes.append(node)
    client = Client("tester", namespace, processes)
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client.wait(lambda: bool(status), "a status")
    listeners = client.count_subscribers(topic.name for topic in list_topics(bag)[0])
    replay = {"bag": str(bag), "rate": 50.0, "wait_for_subscribers": listeners}
    processes.append(Process("replay_node", tmp_path, namespace, **replay))
    client.wait(lambda: received(status[0]) >= sum(counts(bag)), "the bag", 120)
    client.wait(lambda: status[0].samples == 12, "the samples", LONG)
    assert str(tmp_path / "j") in status[0].journal
    client.close()
    node._process.send_signal(by)
    node._process.wait(20)
    processes[1].end()
    return namespace


@pytest.mark.wide
@pytest.mark.parametrize("by", keep([signal.SIGKILL, signal.SIGTERM], signal.SIGKILL))
@mock.patch.dict(os.environ)
def test_samples_outlive_their_node_however_it_ends_until_they_are_saved(tmp_path, short_bag, by):
    """After a crash they are there again; after an end in order, the file is named."""
    namespace = played(tmp_path, short_bag, by)
    folder = str(tmp_path / "j")
    for expected in (12, 0):  # the second time they were saved
        files = {"journal_folder": folder, "allowed_folders": str(tmp_path)}
        node = Process("calibration_node", tmp_path, namespace, **files)
        client = Client("tester", namespace, [node])
        status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
        client.wait(lambda s=status: bool(s), "a status")
        if expected and by == signal.SIGTERM:
            assert status[0].samples == 0
            (journal,) = (tmp_path / "j").glob("*.journal")
            assert f"its samples are in {journal}" in status[0].last_event
            loaded = client.call(LoadSamples, "calibration_node/load_samples", path=str(journal))
            assert loaded.samples == expected, loaded.message
        else:
            assert status[0].samples == expected
        if expected:
            if by == signal.SIGKILL:
                assert "12 samples of the previous run were read" in status[0].last_event
            path = str(tmp_path / "s.json")
            saved = client.call(SaveSamples, "calibration_node/save_samples", path=path)
            assert saved.samples == 12
            np.testing.assert_array_equal(load_dataset(path).q, load_dataset(short_bag).q)
        client.close()
        assert node.end() == 0


def test_a_raw_recording_is_a_bag_of_the_messages_as_they_came(tmp_path):
    state = JointState(name=["a", "b"], position=[0.25, 0.5])
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id, pose.pose.pose.position.x = "base", 0.125
    recorder = Recorder(tmp_path / "folder")
    for i in range(3):
        state.header.stamp.sec = pose.header.stamp.sec = i + 1
        recorder.write("joint_states", "sensor_msgs/msg/JointState", state, i)
        kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
        recorder.write("measured_pose", kind, pose, i)
    recorder.close()
    recording = read_bag(recorder.path)
    assert recording.joints.position.tolist() == [[0.25, 0.5]] * 3
    assert recording.pose.position[:, 0].tolist() == [0.125] * 3
    assert recording.joints.time.tolist() == [0.0, 1.0, 2.0]


@mock.patch.dict(os.environ)
def test_a_node_that_is_stopped_while_it_records_ends_as_well_as_any(tmp_path):
    namespace, folder = use_private_domain() + "_recording", str(tmp_path / "j")
    parameters = {"journal_folder": folder, "record": True}
    node = NodeProcess("calibration_node", tmp_path, namespace, **parameters)
    client = Client("tester", namespace, [node])
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client.wait(lambda: bool(status) and "recording to" in status[0].last_event, "a recording")
    client.close()
    assert node.end(signal.SIGTERM) == 0
    (recording,) = Path(folder).glob("raw-*")
    assert (recording / "metadata.yaml").exists()


@pytest.mark.wide
@mock.patch.dict(os.environ)
def test_without_auto_collect_samples_are_taken_by_hand(tmp_path, short_bag):
    namespace, processes = use_private_domain() + "_manual", []
    processes.append(Process("calibration_node", tmp_path, namespace, auto_collect=False))
    client = Client("tester", namespace, processes)
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client.wait(lambda: bool(status), "a status")
    listeners = client.count_subscribers(topic.name for topic in list_topics(short_bag)[0])
    replay = {"bag": str(short_bag), "rate": 50.0, "wait_for_subscribers": listeners}
    processes.append(Process("replay_node", tmp_path, namespace, **replay))
    client.wait(lambda: received(status[0]) >= sum(counts(short_bag)), "the bag", 120)
    taken = client.call(Trigger, "calibration_node/take_sample")
    listed = client.call(ListSamples, "calibration_node/list_samples")
    client.close()
    assert processes[0].end() == 0
    processes[1].end()  # may be interrupted while it makes sure of what we know already
    assert taken.success, taken.message
    assert len(listed.samples) == 1


@mock.patch.dict(os.environ)
def test_a_parameter_that_is_not_allowed_is_one_clear_line(tmp_path):
    """What is allowed for each parameter: test_parameters.py"""
    node = NodeProcess("calibration_node", tmp_path, use_private_domain() + "_bad", mode="walk")
    assert node.ended() == 1
    assert node.said.startswith("error: parameter mode: expected auto or dwell or continuous: ")
    assert node.said.count("\n") == 1


def test_parameters_set_to_what_cannot_be_are_refused_with_the_reason(robot):
    for name, value, reason in (
        ("mode", "walk", "auto or dwell or continuous"),
        ("model_file", "/no/such.yaml", "/no/such.yaml: cannot be read"),
        ("pose_type", "PoseStamped", "read-only"),
    ):
        text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
        change = Parameter(name=name, value=text)
        answer = robot.call(SetParameters, "set_parameters", parameters=[change]).results[0]
        assert not answer.successful
        assert reason in answer.reason


@mock.patch.dict(os.environ)
def test_with_a_stopped_clock_a_topic_of_another_type_is_reported_and_paths_may_use_home(
    tmp_path,
):
    os.environ["HOME"] = str(tmp_path)
    shutil.copy(PRESET, tmp_path / "robot.yaml")
    namespace = use_private_domain() + "_still"
    allowed = f"~:{REPOSITORY}"
    parameters = {"model_file": "~/robot.yaml", "use_sim_time": True, "allowed_folders": allowed}
    node = Process("calibration_node", tmp_path, namespace, **parameters)
    client = Client("tester", namespace, [node])
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client._node.create_publisher(PoseStamped, "measured_pose", 10)
    told = "measured_pose is published as geometry_msgs/msg/PoseStamped, expected"
    client.wait(lambda: bool(status) and told in status[0].last_event, "the other type")
    service = "calibration_node/load_samples"
    assert client.call(LoadSamples, service, path=str(CLEAN)).success
    service = "calibration_node/save_samples"
    assert client.call(SaveSamples, service, path="~/samples.json").samples == 94
    assert client.call(Compare, "calibration_node/compare").success
    assert (tmp_path / "samples.json").exists()
    client.close()
    assert node.end() == 0


@pytest.mark.wide
@mock.patch.dict(os.environ)
def test_a_constraint_session_gives_the_samples_of_its_bag_and_calibrates_the_robot(tmp_path):
    """A virtual Delta on a plate with two holes: joint states and a constraint, no pose."""
    robot = vs.random_delta(3)
    bag = bw.write_bag(tmp_path / "bag", ts.messages(robot, n=20))
    sensor = load_sensor(
        "plane_spheres",
        height=ts.PLATE.height,
        holes=ts.PLATE.holes,
        bars=(ts.PLATE.bar,) * 2,
    )
    model_file, saved = tmp_path / "plate.yaml", tmp_path / "samples.json"
    model = new_model("delta24", sensors=[sensor])
    write_model(dataclasses.replace(model, noise=Noise(joint=ts.PLATE.joint)), model_file)
    namespace, processes = use_private_domain() + "_tied", []
    processes.append(Process("calibration_node", tmp_path, namespace, model_file=str(model_file)))
    client = Client("tester", namespace, processes)
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client.wait(lambda: bool(status), "a status")
    listeners = client.count_subscribers(topic.name for topic in list_topics(bag)[0])
    processes.append(
        Process(
            "replay_node",
            tmp_path,
            namespace,
            bag=str(bag),
            rate=20.0,
            wait_for_subscribers=listeners,
        )
    )
    joints = next(t.count for t in list_topics(bag)[0] if t.name.endswith("joint_states"))
    client.wait(lambda: status[0].joint_states_received >= joints, "the bag", LONG)
    client.wait(lambda: processes[1].status is not None, "the end of the replay")
    assert client.call(SaveSamples, "calibration_node/save_samples", path=str(saved)).samples == 60
    goal = {"hold_out": 0.25, "method": "implicit"}
    handle = client.send_goal(Identify, "calibration_node/identify", lambda feedback: None, **goal)
    result = client.await_result(handle.get_result_async(), "the result").result
    client.close()
    assert processes[0].end() == 0
    live, offline = load_dataset(saved), load_dataset(bag)
    np.testing.assert_array_equal(live.q, offline.q)
    readings = [name for name in offline.conditions if name.startswith("reading.")]
    assert len(readings) == 3
    for name in readings:
        np.testing.assert_array_equal(live.conditions[name], offline.conditions[name])
    assert result.success, result.message
    assert "um" in result.message
    joints, where = vs.workspace(robot)
    found = Kinematics(read_model(model_file)).direct(joints).position
    assert np.linalg.norm(found - where, axis=1).mean() < 100e-6


@mock.patch.dict(os.environ)
def test_best_effort_streams_are_received_and_said_to_be_so(tmp_path):
    """Of a device with sensor data QoS, 0 of 360 poses arrived; of a thermometer, 0 of 80."""
    namespace = use_private_domain() + "_best_effort"
    node = Process("calibration_node", tmp_path, namespace, journal=False)
    client = Client("tester", namespace, [node])
    status = client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    client.wait(lambda: bool(status), "a status")
    received = []
    client._node.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    messages = {
        "joint_states": JointState(name=["a"], position=[0.1]),
        "measured_pose": PoseWithCovarianceStamped(),
        "temperature": Temperature(temperature=21.0),
        "payload": InertiaStamped(),
    }
    messages["measured_pose"].pose.pose.orientation.w = 1.0
    publishers = {
        topic: client._node.create_publisher(type(message), topic, qos_profile_sensor_data)
        for topic, message in messages.items()
    }
    sent = 0

    def arrived():
        nonlocal sent
        sent += 1
        for topic, message in messages.items():
            message.header.stamp.sec = 100 + sent // 50
            message.header.stamp.nanosec = sent % 50 * 20_000_000
            publishers[topic].publish(message)
        shown = {s.name.split(": ")[-1] for array in received for s in array.status}
        enough = status[0].joint_states_received > 20 and status[0].poses_received > 20
        return enough and shown >= messages.keys()

    client.wait(arrived, "messages that were published best effort", 120)
    client.close()
    assert node.end() == 0
    said = node.log.read_text()
    for topic in messages:
        assert f"{namespace}/{topic} is published best effort by {namespace}/tester" in said


@mock.patch.dict(os.environ)
def test_a_node_with_a_model_file_that_is_none_does_not_collect(tmp_path):
    use_private_domain()
    path = tmp_path / "passwd"
    path.write_text("root:x:0:0:root:/root:/bin/bash\n")
    node = NodeProcess("calibration_node", tmp_path, "/wrong_model", model_file=str(path))
    assert node.ended() == 1
    assert f"error: {path}" in node.said
    assert "collecting" not in node.said


# The end of a node whose making was interrupted, and the threads that the interpreter leaves.
INTERRUPTED = """
import atexit, sys, threading
from unittest import mock
import rclpy
from parallel_cal.nodes import calibration_node
def interrupt(node):
    rclpy.shutdown()
    raise RuntimeError("the context is gone")
def tell():
    print([t.name for t in threading.enumerate() if t.name == "joint_states"])
atexit.register(tell)
with mock.patch.object(calibration_node.CalibrationNode, "start", interrupt):
    sys.exit(calibration_node.main())
"""


@mock.patch.dict(os.environ)
def test_a_node_that_is_interrupted_while_it_starts_ends_its_threads(tmp_path):
    """A thread that waits in the middleware aborts the process when the interpreter ends."""
    use_private_domain()
    arguments = ["--ros-args", "-p", f"journal_folder:={tmp_path}"]
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, *arguments], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr
