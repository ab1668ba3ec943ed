"""Both nodes take the encoder of a passive joint from the joint states, as recordings do."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

pytestmark = [pytest.mark.ros, pytest.mark.wide]
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from bag_writing import POINT, Session, joint_states, poses, write_bag
from both_nodes import BothNodes
from test_passive_encoder import NOISE, ZERO, off_the_drawing, with_encoder

import parallel_cal as pc


def test_a_live_calibration_finds_the_zero_of_an_elbow_encoder(tmp_path):
    """joint_states hold both motors and the elbow; without it, nothing shows its zero."""
    model = with_encoder(sigma=1e-5)
    true = off_the_drawing(model)
    stops = pc.simulate(true, 12, seed=1, quiet=True).dataset()
    elbow = stops.conditions["reading.left_elbow"]
    names = ("right", "left_elbow", "left")
    moves = Session(np.column_stack([stops.q[:, 1], elbow, stops.q[:, 0]]), r=stops.r, names=names)
    messages = joint_states(moves) + poses(moves, type=POINT, topic="measured_position")
    bag = write_bag(tmp_path / "bag", messages)
    pc.write_model(replace(model, noise=NOISE), tmp_path / "robot.yaml")
    with mock.patch.dict(os.environ), BothNodes(tmp_path / "robot.yaml", tmp_path) as nodes:
        nodes.collect(bag, len(messages), 20.0, lambda *_: None)
        samples, joints = nodes.samples()
        predicted = nodes.answers(samples, joints)
        nodes.identify(0.0, lambda *_: None)
    assert joints == ["left", "right"]
    assert len(samples) == len(stops.q)
    assert np.abs(predicted.r[:, 2]).max() < 1e-12
    found = pc.read_model(tmp_path / "robot.yaml")
    assert abs(true.value(ZERO)) > 1e-3
    assert found.value(ZERO) == pytest.approx(true.value(ZERO), abs=3e-4)
