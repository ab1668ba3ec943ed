"""Joint states at rest become recordings of a watch, without ROS."""

from dataclasses import replace

import numpy as np
import pytest
import test_extra_legs as hexapod
from test_watch import LEGS, NAMES, START, calibrated

from parallel_cal.model.model import Noise
from parallel_cal.nodes.live_watch import LiveWatch, Rests

DAY = 86400.0


def states(day, jump=0.0, rests=24, leg=2):
    """(time, readings by name) of joint states: the robot rests for a second at each place."""
    base, platform, zero = hexapod.built(LEGS, 0)
    rng = np.random.default_rng([day, 5])
    q = hexapod.distances(base, platform, *hexapod.poses(300 + day, rests)) - zero
    q[:, leg] -= jump
    for k, row in enumerate(q):
        for step in range(6):
            noise = rng.normal(0, 6**0.5 * hexapod.SIGMA, LEGS)
            yield (
                START + DAY * day + 1.5 * k + 0.2 * step,
                dict(zip(NAMES, row + noise, strict=True)),
            )


def live(path, **given):
    options = {"interval": 29.0, "samples": 20, "threshold": 5e-4, "false_alarm_days": 30.0}
    model = replace(calibrated(), noise=Noise(joint=hexapod.SIGMA))
    return LiveWatch(model, path, **options | given)


def test_a_rest_is_the_mean_of_its_readings_and_counts_once():
    rests = Rests(1e-3)
    moves = [0.0, 0.1, 0.2, *[0.3] * 4, 0.4, 0.5, *[0.3] * 5, 0.6, *[0.9, 0.9002] * 3, 1.0]
    found = [rests.add(0.2 * k, np.array([q])) for k, q in enumerate(moves)]
    # The second rest is at the place of the first: its errors are the same.
    assert [float(f[1][0]) for f in found if f is not None] == pytest.approx([0.3, 0.9001])


def test_a_clock_that_jumps_back_ends_a_rest():
    rests = Rests(1e-3)
    for time in (0.0, 0.5, 1.0):
        assert rests.add(time, np.zeros(1)) is None
    assert rests.add(-50.0, np.zeros(1)) is not None


def test_joint_states_show_a_jump(tmp_path):
    watched, path = live(tmp_path / "state.json"), tmp_path / "state.json"
    for day in range(6):
        for time, readings in states(day, 200e-6 * (day >= 5)):
            dataset = watched.collect(time, readings, {"temperature": 20.0})
            if dataset is not None:
                watched.add(dataset)
        if day == 2:
            watched = live(path)  # as after a new start of the node
    assert len(watched.watch.trend) == 6
    assert watched.watch.alarm.time >= START + 5 * DAY
    assert next(iter(watched.watch.parts)) == "leg3"


def test_a_joint_state_without_all_joints_is_ignored(tmp_path):
    watched = live(tmp_path / "state.json")
    assert watched.collect(0.0, {"leg1": 0.1}, {}) is None
    assert len(watched) == 0
