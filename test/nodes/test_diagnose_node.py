"""What is missing, found through the running nodes, and gone from kinematics_node's answers."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import dataclasses
import json
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import yaml
from bag_catalogue import DELTA

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from both_nodes import BothNodes, select_held_out
from parallel_cal_msgs.action import Diagnose, Identify
from parallel_cal_msgs.msg import CollectionStatus
from parallel_cal_msgs.srv import AddEffect, Compare, ListSamples, LoadSamples
from rcl_interfaces.srv import GetParameters
from ros_helpers import calibrating
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from parallel_cal.model.file.modelfile import model_hash, read_model
from parallel_cal.model.shelf import load_effect
from parallel_cal.nodes.client import use_private_domain
from parallel_cal.recordings.bag import list_topics
from parallel_cal.recordings.loading import load_dataset

REPOSITORY = Path(__file__).parents[2]
BAGS = REPOSITORY / "bags"
BACKLASH, PRESET = BAGS / "delta_backlash", REPOSITORY / "config" / "delta_mockup_nominal.yaml"
CANCELED, SUCCEEDED, ABORTED = 5, 4, 6
MANY = 8  # times the samples of the recording: a diagnosis then lasts until it is cancelled
REPLAYED = ("delta_backlash",)  # `test_demo.py` replays it, too
WITH_CONDITIONS = ("delta_compliance", "delta_thermal")  # payload and temperature as topics


def quiet(stage, fraction):
    """Nobody looks on."""


def truth(name):
    return yaml.safe_load((BAGS / "truth" / f"{name}.yaml").read_text())


RECORDINGS = sorted({path.stem for path in (BAGS / "truth").glob("*.yaml")} - {*REPLAYED})


@pytest.fixture
def environment():
    with mock.patch.dict(os.environ):
        yield


def started(name, folder):
    """Both nodes on a copy of the model that a user of this recording starts from."""
    model_file = Path(shutil.copy(REPOSITORY / truth(name)["baseline"], folder / "robot.yaml"))
    return BothNodes(model_file, REPOSITORY / "bags"), model_file


def found(effects, expected):
    """Whether each effect found is one of those that cannot be told from a hidden one."""
    return len(effects) == len(expected) and all(
        any(effect in alike for effect in effects) for alike in expected
    )


def error(answers, effects):
    """Mean error of the answers: of the measured kind, against the measurement; where the device
    was at fault it is no standard, and the virtual robot itself is."""
    if any(load_effect(name).of_device for name in effects):
        r, _ = DELTA.robot.forward(np.array([sample.joints for sample in answers.samples]))
        return np.linalg.norm(answers.r - r, axis=1).mean()
    measured = answers.samples[0].pose.covariance[0] < 1e3
    return answers.norms()["position" if measured else "orientation"].mean()


def diagnosed(session, name):
    """The effects found; the verdict is the truth's."""
    result = session.diagnose(0.25, quiet)
    document = json.loads(result.json, parse_constant=pytest.fail)
    assert result.verdict == document["verdict"] == truth(name)["verdict"], result.message
    assert found(document["effects"], truth(name)["found"]), result.message
    return document["effects"]


def improved_by(session, effects, before, ask):
    """Add the effects one by one, each written and served; the error falls every time."""
    for effect in effects:
        session.wait_until_served(session.add_effect(effect).hash)
        after = ask()
        assert after < before, effect
        before = after


def added_to(model_file):
    """Names in the file's history; a larger mechanism is one of them, and no effect of its own."""
    return [step["effect"] for step in read_model(model_file).history if "effect" in step]


def learn(session, name):
    """Diagnose all samples; then, by those left, add what is missing, judged by those apart."""
    effects = diagnosed(session, name)
    if not effects:
        return effects
    samples, joints = session.samples()
    apart = select_held_out(samples)
    session.remove(apart)
    session.wait_until_served(session.identify(0.25, quiet).hash)

    def ask():
        return error(session.answers(apart, joints), effects)

    improved_by(session, effects, ask(), ask)
    return effects


# Below, the node is asked for each step once; test_recordings_diagnosed.py has the verdicts.
@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_the_samples_of_a_recording_get_the_right_verdict_and_the_better_model(
    name, tmp_path, environment
):
    session, model_file = started(name, tmp_path)
    load_dataset(BAGS / name, mode=truth(name)["mode"]).to_json(tmp_path / "samples.json")
    with session:
        session.load(tmp_path / "samples.json")
        effects = learn(session, name)
    assert added_to(model_file) == effects


@pytest.mark.slow
@pytest.mark.parametrize("name", [*REPLAYED, *WITH_CONDITIONS])
def test_a_replayed_recording_gets_the_right_verdict_and_the_better_model(
    name, tmp_path, environment
):
    session, model_file = started(name, tmp_path)
    topics = {topic.name.strip("/"): topic.count for topic in list_topics(BAGS / name)[0]}
    messages = topics["joint_states"] + topics["measured_pose"]
    with session:
        session.collect(BAGS / name, messages, 50.0, quiet)
        effects = learn(session, name)
    assert added_to(model_file) == effects


# ------------------------------------------------------------------ one node, asked in every way


class Bench:
    """calibration_node with the samples of the backlash recording, and a client."""

    def __init__(self, folder, client):
        self.folder, self.client = folder, client
        self.model_file = folder / "robot.yaml"
        self.status = client.subscribe_latest(
            CollectionStatus, "calibration_node/collection_status"
        )
        self.diagnosis = client.subscribe_latest(String, "calibration_node/diagnosis")
        self.arrows = client.subscribe_latest(MarkerArray, "calibration_node/residuals")

    def call(self, type, name, **fields):
        return self.client.call(type, f"calibration_node/{name}", **fields)

    def goal(self, type=Diagnose, hear=lambda feedback: None, **fields):
        return self.client.send_goal(
            type, f"calibration_node/{type.__name__.lower()}", hear, **fields
        )

    def outcome(self, handle):
        return self.client.await_result(handle.get_result_async(), "the result", 120)

    def load(self, samples):
        assert self.call(LoadSamples, "load_samples", path=str(self.folder / samples)).success

    def waits_for_event(self, words):
        self.client.wait(
            lambda: bool(self.status) and words in self.status[0].last_event, f"'{words}'"
        )


@contextmanager
def running(folder, namespace, samples=""):
    shutil.copy(PRESET, folder / "robot.yaml")
    files = {"model_file": str(folder / "robot.yaml"), "allowed_folders": f"{folder}:{samples}"}
    with calibrating(folder, namespace, **files) as client:
        yield Bench(folder, client)


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """A folder with the recording's samples, and with so many that all work takes long."""
    folder = tmp_path_factory.mktemp("samples")
    dataset = load_dataset(BACKLASH)
    dataset.to_json(folder / "s.json")
    many = dataset.select(np.tile(np.arange(len(dataset)), MANY))
    dataclasses.replace(many, pose_id=np.arange(len(many))).to_json(folder / "many.json")
    return folder


@pytest.fixture(scope="module")
def bench(samples):
    with mock.patch.dict(os.environ), running(samples, use_private_domain()) as bench:
        yield bench


@pytest.fixture
def loaded(bench):
    bench.load("s.json")
    return bench


def test_a_diagnosis_reports_its_stages_its_verdict_and_the_rest_of_the_error(loaded):
    heard, before = [], loaded.model_file.read_bytes()
    answer = loaded.outcome(loaded.goal(Diagnose, heard.append))
    result, document = answer.result, json.loads(answer.result.json, parse_constant=pytest.fail)
    assert answer.status == SUCCEEDED
    assert result.success
    assert result.message == f"{result.verdict}: {document['summary']}"
    assert 30e-6 < document["baseline"]["position_mean"] < 38e-6  # left out, as the node does
    assert [f.fraction for f in heard] == sorted(f.fraction for f in heard)
    assert any("backlash" in f.stage for f in heard)
    loaded.client.wait(lambda: bool(loaded.diagnosis), "the latched diagnosis")
    assert json.loads(loaded.diagnosis[0].data) == document
    loaded.client.wait(lambda: bool(loaded.arrows), "the arrows")
    assert len(loaded.arrows[0].markers) == 1 + 94
    longest = max(np.ptp([m.points[0].x, m.points[1].x]) for m in loaded.arrows[0].markers[1:])
    assert longest < 100 * 200e-6  # of the best model, not of the node's, which is off by 600 um
    assert loaded.model_file.read_bytes() == before


@pytest.mark.wide
def test_odd_samples_are_named_as_the_node_names_them(loaded):
    listed = {sample.id for sample in loaded.call(ListSamples, "list_samples").samples}
    compared = json.loads(loaded.call(Compare, "compare").json, parse_constant=pytest.fail)
    assert {row["id"] for row in compared["rows"]} == listed
    assert set(compared["where"]) >= {"along", "regions", "structure", "replicates"}
    diagnosed = json.loads(loaded.outcome(loaded.goal()).result.json)
    for row in compared["where"]["odd_samples"] + diagnosed["odd_samples"]:
        assert row["id"] == min(listed) + row["sample"]


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ({"model_file": "/no/such.yaml"}, "/no/such.yaml"),
        ({"hold_out": 7.0}, "at most 0.5"),
        ({"hold_out": float("nan")}, "hold_out"),
    ],
)
def test_an_odd_goal_is_a_message(loaded, goal, said):
    answer = loaded.outcome(loaded.goal(**goal))
    assert answer.status == ABORTED
    assert said in answer.result.message
    assert "internal error" not in answer.result.message
    assert not answer.result.verdict


@pytest.mark.wide
def test_a_cancelled_diagnosis_ends_and_meanwhile_the_node_answers_but_does_no_other_work(loaded):
    heard, before = [], loaded.model_file.read_bytes()
    latest = list(loaded.diagnosis)
    loaded.load("many.json")
    handle = loaded.goal(Diagnose, heard.append)
    loaded.client.wait(lambda: len(heard) > 1, "feedback")
    for type in (Diagnose, Identify):
        assert not loaded.goal(type).accepted
    loaded.waits_for_event("goal rejected: a diagnosis is running")
    assert (
        "a diagnosis is running" in loaded.call(AddEffect, "add_effect", effect="backlash").message
    )
    assert len(loaded.call(ListSamples, "list_samples").samples) == MANY * 94
    loaded.client.await_result(handle.cancel_goal_async(), "the cancel")
    answer = loaded.outcome(handle)
    assert answer.status == CANCELED
    assert "cancelled" in answer.result.message
    assert heard[-1].fraction < 1
    assert loaded.diagnosis == latest
    assert loaded.model_file.read_bytes() == before
    loaded.load("s.json")
    assert loaded.outcome(loaded.goal()).result.success


def adding(bench, effect):
    """The answer to come of add_effect; the node has begun."""
    answer = bench.client.ask(AddEffect, "calibration_node/add_effect", effect=effect)
    bench.waits_for_event(f"adding {effect}")
    return answer


def test_while_an_effect_is_added_the_node_answers_but_takes_no_goal(loaded):
    loaded.load("many.json")
    coming = adding(loaded, "backlash")
    assert not loaded.goal().accepted
    loaded.waits_for_event("goal rejected: an effect is being added")
    assert len(loaded.call(ListSamples, "list_samples").samples) == MANY * 94
    assert loaded.call(GetParameters, "get_parameters", names=["hold_out"]).values
    assert not coming.done()
    answer = loaded.client.await_result(coming, "the effect", 120)
    assert answer.success, answer.message
    assert answer.hash == model_hash(loaded.model_file.read_bytes())
    shutil.copy(PRESET, loaded.model_file)


def test_an_effect_can_be_named_with_what_is_known_of_it(loaded):
    output = loaded.folder / "ripple.yaml"
    answer = loaded.call(
        AddEffect,
        "add_effect",
        effect="gear_transmission_error:ratio=17",
        output_file=str(output),
        force=True,
    )
    assert answer.success, answer.message
    written = read_model(output)
    assert written.values[written.table.index_of("gear_transmission_error.ratio")] == 17
    bad = loaded.call(AddEffect, "add_effect", effect="gear_transmission_error:ratio=many")
    assert not bad.success
    assert "ratio" in bad.message


@pytest.mark.parametrize("work", ["diagnosis", pytest.param("effect", marks=pytest.mark.wide)])
def test_a_node_stopped_in_the_middle_of_its_work_ends_cleanly_and_writes_nothing(
    work, samples, tmp_path, environment
):
    heard, namespace = [], f"{use_private_domain()}_stopped_{work}"
    with running(tmp_path, namespace, samples) as bench:
        before = bench.model_file.read_bytes()
        path = str(samples / "many.json")
        assert bench.call(LoadSamples, "load_samples", path=path).success
        if work == "diagnosis":
            bench.goal(Diagnose, heard.append)
            bench.client.wait(lambda: len(heard) > 1, "feedback")
        else:
            adding(bench, "backlash")
    assert bench.model_file.read_bytes() == before


def test_all_visits_of_a_pose_are_kept_apart_together():
    samples = [SimpleNamespace(id=i, replicate_of=-1) for i in range(1, 21)]
    samples += [SimpleNamespace(id=i + 20, replicate_of=i) for i in range(1, 21)]
    apart = {s.id for s in select_held_out(samples)}
    assert len(apart) == 4
    assert {i + 20 for i in apart if i <= 20} == {i for i in apart if i > 20}
