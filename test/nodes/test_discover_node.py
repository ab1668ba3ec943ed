"""The action `~/discover` of calibration_node: a law through ROS, with feedback and cancel."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import json
import os
import shutil
from pathlib import Path
from unittest import mock

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from parallel_cal_msgs.action import Diagnose
from parallel_cal_msgs.srv import LoadSamples
from ros_helpers import calibrating
from std_msgs.msg import String

from parallel_cal.nodes.client import use_private_domain
from parallel_cal.recordings.loading import load_dataset

REPOSITORY = Path(__file__).parents[2]
PRESET = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
CANCELED, SUCCEEDED, ABORTED = 5, 4, 6


class Finder:
    """calibration_node with the samples of a recording that no effect explains, and a client."""

    def __init__(self, folder, client):
        self.folder, self.client = folder, client
        self.results = client.subscribe_latest(String, "calibration_node/result")

    def send(self, hear=lambda feedback: None, action="discover", **fields):
        return self.client.send_goal(Diagnose, f"calibration_node/{action}", hear, **fields)

    def wait_for_result(self, handle):
        return self.client.await_result(handle.get_result_async(), "the result", 300)


@pytest.fixture(scope="module")
def finder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("discover")
    shutil.copy(PRESET, folder / "robot.yaml")
    load_dataset(REPOSITORY / "bags" / "delta_crosstalk").to_json(folder / "samples.json")
    with mock.patch.dict(os.environ):
        namespace = use_private_domain()
        files = {"model_file": str(folder / "robot.yaml"), "allowed_folders": str(folder)}
        with calibrating(folder, namespace, journal=False, **files) as client:
            path = str(folder / "samples.json")
            loaded = client.call(LoadSamples, "calibration_node/load_samples", path=path)
            assert loaded.success, loaded.message
            yield Finder(folder, client)


@pytest.mark.wide
def test_the_action_returns_the_law_its_effect_file_and_the_document_of_the_command(finder):
    heard, files = [], sorted(finder.folder.iterdir())
    answer = finder.wait_for_result(finder.send(heard.append))
    result = answer.result
    document = json.loads(result.json, parse_constant=pytest.fail)
    assert (answer.status, result.success) == (SUCCEEDED, True), result.message
    assert result.verdict == document["verdict"] == "described"
    assert result.message == f"described: {document['summary']}"
    (law,) = document["laws"]
    assert (law["place"], law["drivers"]) == ("joints", ["next_joint"])
    assert (
        law["validation"]["after"]["position_rms"]
        < 0.5 * (law["validation"]["before"]["position_rms"])
    )
    (name, text), *more = document["effects"].items()
    assert not more
    assert name.startswith("law_joints_")
    assert "class FoundLaw(Effect)" in text
    fractions = [one.fraction for one in heard]
    assert fractions == sorted(fractions)
    assert {"screening places and drivers", "searching sessions without a law"} <= {
        one.stage for one in heard
    }
    finder.client.wait(lambda: bool(finder.results), "the latched result")
    latest = json.loads(finder.results[0].data)
    assert (latest["kind"], latest["success"]) == ("discover", True)
    assert latest["document"] == document
    assert sorted(finder.folder.iterdir()) == files  # a node writes no code


@pytest.mark.wide
def test_a_search_that_is_cancelled_ends_at_once_and_the_node_can_search_again(finder):
    heard = []
    handle = finder.send(heard.append)
    finder.client.wait(lambda: any("screening" in one.stage for one in heard), "the search", 120)
    assert not finder.send().accepted
    assert not finder.send(action="diagnose").accepted
    finder.client.await_result(handle.cancel_goal_async(), "the cancel")
    answer = finder.wait_for_result(handle)
    assert answer.status == CANCELED
    assert "cancelled" in answer.result.message
    assert not answer.result.verdict
    again = finder.wait_for_result(finder.send(model_file="/no/such.yaml"))
    assert again.status == ABORTED
    assert "/no/such.yaml" in again.result.message
