"""The errors that the page shows while a robot moves: measured beside predicted poses."""

import numpy as np
import pytest

from parallel_cal.nodes.live_errors import LiveErrors

SPEED = 1.0  # m/s along x
OFFSET = np.array([0.0, 3e-4, 4e-4])  # m, of each measured position: 0.5 mm


def position(t):
    return np.array([SPEED * t, 0.0, 0.0])


def times(rate, begin=0.0, end=20.0):
    return np.arange(begin, end, 1 / rate)


def errors_of(predictions, measurements):
    """The errors when all predictions arrive before all measurements, and the reverse."""
    early, late = LiveErrors(), LiveErrors()
    for t in predictions:
        early.add_predicted(t, position(t))
    found = [e for t in measurements for e in early.add_measured(t, position(t) + OFFSET)]
    for t in measurements:
        late.add_measured(t, position(t) + OFFSET)
    other = [e for t in predictions for e in late.add_predicted(t, position(t))]
    assert found == pytest.approx(other)
    return found


def test_either_stream_may_arrive_20_seconds_after_the_other():
    measurements = times(20, 0.013, 19.9)
    found = errors_of(times(100), measurements)
    assert len(found) == len(measurements)
    assert found == pytest.approx([5e-4] * len(found))


def test_a_measured_pose_between_lost_predictions_is_not_compared():
    kept = [t for t in times(100) if not 5.0 < t < 5.5]  # 50 predictions are lost

    def turning(t):  # the robot comes back meanwhile
        return np.array([0.1 * np.sin(2 * np.pi * t), 0.0, 0.0])

    compare, found = LiveErrors(), []
    for t in kept:
        compare.add_predicted(t, turning(t))
    for t in times(20, 0.013, 19.9):
        found += compare.add_measured(t, turning(t) + OFFSET)
    assert len(found) == len(times(20, 0.013, 19.9)) - 10
    assert found == pytest.approx([5e-4] * len(found), rel=0.05)


def test_a_slow_stream_is_compared_at_its_own_rate():
    assert len(errors_of(times(5), times(20, 0.3, 19.0))) == len(times(20, 0.3, 19.0))


def test_measured_poses_before_the_first_prediction_are_not_compared():
    assert errors_of(times(100, 10.0), times(20, 0.003, 9.9)) == []
