"""Joint states on one clock, poses on another: the motion that both show tells how far apart."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.clocks import DRIVER, clock_offset
from parallel_cal.recordings.loading import dataset_from_recording
from parallel_cal.recordings.options import SampleOptions

BAGS = Path(__file__).parents[1] / "bags"
ALL = sorted(p.name for p in BAGS.iterdir() if (p / "metadata.yaml").exists())


@cache
def recording(name):
    return read_bag(BAGS / name)


def late(name, delay):
    """The recording with the device's stamps `delay` seconds later, or drawn anew by a function."""
    pose = recording(name).pose
    return dataclasses.replace(
        recording(name), pose=dataclasses.replace(pose, time=pose.time + delay)
    )


@pytest.mark.parametrize("delay", [0.12, -0.4, 3.0, -1000.0])
def test_dwells_come_out_as_if_there_were_one_clock(delay):
    plain = dataset_from_recording(recording("delta_crosstalk"))
    found = dataset_from_recording(late("delta_crosstalk", delay))
    assert len(found) == len(plain)
    assert np.abs(found.r - plain.r).max() < 5e-6
    assert np.abs(found.q - plain.q).max() == 0
    assert not any("two clocks" in w for w in plain.warnings)
    [said] = [w for w in found.warnings if "two clocks" in w]
    assert f"s {'later' if delay > 0 else 'earlier'} than" in said
    assert float(said.split(" was stamped ")[1].split()[0]) == pytest.approx(abs(delay), abs=1e-3)


def test_motion_is_paired_as_if_there_were_one_clock():
    options = SampleOptions(mode="continuous")
    plain = dataset_from_recording(recording("delta_latency"), options)
    found = dataset_from_recording(late("delta_latency", 0.25), options)
    shown = {r.tobytes(): q for r, q in zip(plain.r, plain.q, strict=True)}
    apart = [q - shown[r.tobytes()] for r, q in zip(found.r, found.q, strict=True)]
    assert len(found) > 0.98 * len(plain)
    fastest = max(np.abs(plain.conditions[f"velocity.{j}"]).max() for j in plain.joint_names)
    assert np.abs(apart).max() < 3e-3 * fastest  # 3 ms of motion
    assert sum("two clocks" in w for w in found.warnings) == 1


@pytest.mark.parametrize("name", ["delta_crosstalk", "argos_gear_ripple"])
def test_the_uncertainty_is_that_of_the_delay(name):
    """Positions tell it, and orientations alone do."""
    own = [clock_offset(late(name, d).joints, late(name, d).pose) for d in (0.2, -0.7, 5.03)]
    errors = [o.delay - d for o, d in zip(own, (0.2, -0.7, 5.03), strict=True)]
    assert all(o.sigma < 1e-3 for o in own)
    assert np.abs(errors).max() < 5 * own[0].sigma
    assert np.ptp(errors) < own[0].sigma


def test_what_a_driver_may_be_late_by_stays_an_effect():
    for delay in (-0.8 * DRIVER, 0.8 * DRIVER):
        there = late("delta_crosstalk", delay)
        assert clock_offset(there.joints, there.pose) is None


def test_a_device_that_shows_noise_alone_tells_nothing():
    there = recording("delta_crosstalk")
    noise = 1e-5 * np.random.default_rng(0).standard_normal(there.pose.position.shape)
    assert clock_offset(there.joints, dataclasses.replace(there.pose, position=noise)) is None


@pytest.mark.wide
@pytest.mark.parametrize("name", ALL)
def test_recordings_on_one_clock_are_left_alone(name):
    there = recording(name)
    assert clock_offset(there.joints, there.pose) is None
