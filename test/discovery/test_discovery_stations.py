"""Two stations of the device tell an error of the device from an error of the robot."""

from dataclasses import dataclass

import findings
import numpy as np
import pytest
import virtual_blind as vb
import virtual_findings as vf

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.discovery.discovery import discover
from parallel_cal.discovery.effect_file import load_text
from parallel_cal.model.model import new_model
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.session.steps import UnprovenStepError, add
from parallel_cal.virtual import robot as vr

SIZE = 4e-5  # m at 60 mm from the middle


@dataclass(frozen=True)
class Bent(vr.Effect):
    """A rail along x that is bent to y and z: of the robot's stand, or of the device."""

    size: float = SIZE

    def device(self, r, R, at):
        return r + self.size * (r[:, :1] / 0.06) ** 2 * np.array([0.0, 1.0, 0.4]), R


@dataclass(frozen=True)
class Turned(vr.Effect):
    """A device that was turned between two recordings."""

    def device(self, r, R, at):
        turn = rotation_matrix(np.array([0.1, 0.0, -np.pi / 2]))
        return r @ turn.T, turn @ R


def record(first, second):
    """Two recordings, the second one from another station."""
    days = [vf.samples(vf.session(k), own, vf.FINE, k) for k, own in ((2, first), (3, second))]
    return join_datasets([findings.dataset(day, vf.FINE) for day in days])


def discover_on_delta(data):
    return discover(new_model("delta54"), data)


@pytest.mark.wide
def test_an_error_that_stays_in_the_base_is_the_robots():
    found = discover_on_delta(record([Bent()], [Bent(), Turned()]))
    (law,) = found.laws
    assert (law.name, law.of_device) == ("pose.xyz, each its own by x", False)
    values = {c.name: (c.value, c.sigma) for c in law.parameters}
    for axis, share in (("x", 0.0), ("y", 1.0), ("z", 0.4)):
        value, sigma = values[f"{axis}_quadratic"]
        assert abs(value - share * SIZE / 0.06**2) < 4 * sigma


@pytest.mark.slow
def test_an_error_that_goes_with_the_device_is_the_devices():
    found = discover_on_delta(record([Bent()], [Turned(), Bent()]))
    (law,) = found.laws
    assert law.of_device
    assert law.drivers == ("device.x",)
    assert found.verdict == "described"


@pytest.mark.wide
def test_from_one_station_the_robot_or_the_device_may_err_and_a_second_one_is_advised():
    data = findings.dataset(vf.samples(vf.session(2), [Bent()], vf.FINE, 2), vf.FINE)
    found = discover_on_delta(data)
    assert found.verdict == "robot_or_device"
    assert not found.laws
    assert found.measure_next[-1].startswith("a second station: measure the same poses with")


@pytest.mark.slow
def test_the_robot_does_not_learn_what_stays_the_same_as_the_device_turns():
    """A lean away from the z axis looks the same from a device turned about this axis."""
    stand = vb.YieldingStand(SIZE)
    found = discover_on_delta(record([stand], [Turned(), stand]))
    assert found.verdict == "described"
    assert {law.of_device for law in found.laws} == {True}, found.summary


BENT_STAND = """
import casadi as ca

from parallel_cal import Effect, Parameter


class BentStand(Effect):
    found_in_data = True

    def parameters(self, mechanism):
        return [Parameter(axis, "1/m", 0.0, 5e-3) for axis in "yz"]

    def ideal(self, seen, e, at, mechanism):
        return seen.with_pose(seen.r - seen.r[0] ** 2 * ca.vertcat(0, e.y, e.z), seen.R)
"""


@pytest.mark.wide
def test_add_judges_the_device_in_the_frame_of_each_recording():
    """A bend as small as that of usual devices: from one station it may be the device's, from two
    it is the robot's if it stays in {B}, and the device's if it goes with the device."""
    law, small = load_text(BENT_STAND), Bent(1.5e-5)
    robots = record([small], [small, Turned()])
    step = add(new_model("delta54"), law, robots)
    for axis, share in (("y", 1.0), ("z", 0.4)):
        p = step.result.parameters()[f"{law}.{axis}"]
        assert abs(p.value - share * small.size / 0.06**2) < 4 * p.sigma
    alone = robots.select(np.flatnonzero(robots.conditions["session"] == 0))
    for data in (alone, record([small], [Turned(), small])):
        with pytest.raises(UnprovenStepError, match="the measuring device may cause") as refused:
            add(new_model("delta54"), law, data)
        assert law in str(refused.value)
