"""The way to a target: its time by hand-worked numbers, its workspace and its singularities."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelFileError, SolveError
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.nodes.path_check import Bounds, check_path

NOMINAL = Path(__file__).parents[1] / "config" / "delta_mockup_nominal.yaml"
BOUNDS = Bounds(crossing=1.0, singularity=0.02)


def with_rates(*rates):
    """The Delta whose three joints have these velocities and accelerations."""
    text = NOMINAL.read_text()
    for k, (velocity, acceleration) in enumerate(rates, 1):
        old = next(line for line in text.splitlines() if line.startswith(f"  joint{k}:"))
        new = old.replace("}", f", velocity: {velocity}, acceleration: {acceleration}}}")
        text = text.replace(old, new)
    return parse_model(text)


def way(model, start, goal, bounds=BOUNDS):
    kinematics = Kinematics(model)
    target = kinematics.direct(np.array(goal))
    return check_path(kinematics, np.array(start), target, None, bounds)


def test_the_slowest_joint_sets_the_time_by_velocity_or_by_acceleration():
    """0.2 rad at 1.5 rad/s: 1.5 * 0.2 / 1.5 = 0.2 s; 0.15 rad at 10 rad/s^2: sqrt(0.09) = 0.3 s."""
    model = with_rates((1.5, 1e9), (1e9, 10.0), (1e9, 1e9))
    found = way(model, [0.5, 0.5, 0.5], [0.7, 0.5, 0.5])
    assert found.seconds == pytest.approx(0.2, rel=1e-9)
    assert "joint1" in found.why
    assert "velocity 1.5" in found.why
    found = way(model, [0.5, 0.5, 0.5], [0.5, 0.65, 0.5])
    assert found.seconds == pytest.approx(0.3, rel=1e-9)
    assert "joint2" in found.why


def test_a_joint_without_a_velocity_crosses_its_range_in_the_time_given():
    model = parse_model(NOMINAL.read_text())
    low, high = model.mechanism.joint_limits[0]
    found = way(model, [0.5] * 3, [0.6, 0.5, 0.5], Bounds(2.0, 0.02))
    assert found.seconds == pytest.approx(1.5 * 0.1 * 2.0 / (high - low), rel=1e-9)


def test_a_way_that_leaves_the_workspace_is_refused_and_one_back_in_is_not():
    model = parse_model(NOMINAL.read_text())
    inside, outside = [0.5] * 3, [1.2] * 3
    low, high = model.mechanism.workspace.low, model.mechanism.workspace.high
    z = Kinematics(model).direct(np.array(outside)).position[2]
    assert not low[2] <= z <= high[2]
    with pytest.raises(SolveError, match="leaves the model file's workspace"):
        way(model, inside, outside)
    assert way(model, outside, inside).seconds > 0


def test_no_way_leads_near_a_singularity():
    """The usual way keeps 0.1 and more; where more is asked for it is refused."""
    model = parse_model(NOMINAL.read_text())
    usual = way(model, [0.5] * 3, [0.6] * 3).singularity
    assert usual > 0.1
    with pytest.raises(SolveError, match="too near a singularity"):
        way(model, [0.5] * 3, [0.6] * 3, Bounds(1.0, 10.0))


def test_limits_survive_the_file_and_must_be_positive():
    model = with_rates((1.5, 20.0), (2.0, 10.0), (3.0, 5.0))
    again = parse_model(dump_model(model))
    assert again.mechanism.joint_rates == ((1.5, 20.0), (2.0, 10.0), (3.0, 5.0))
    assert new_model("delta24").mechanism.joint_rates == ()
    assert not any(map(math.isfinite, sum(with_some().mechanism.joint_rates, ())[1:]))
    with pytest.raises(ModelFileError, match="velocity"):
        with_rates((-1.0, 1.0))
    assert replace(model).mechanism.joint_rates == model.mechanism.joint_rates


def with_some():
    text = NOMINAL.read_text()
    old = next(line for line in text.splitlines() if line.startswith("  joint1:"))
    return parse_model(text.replace(old, old.replace("}", ", velocity: 2.0}")))
