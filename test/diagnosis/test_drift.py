"""Noise that drifts is told from effects that change slowly by their likelihoods."""

import numpy as np
import pytest
import virtual_blind as vb
import virtual_findings as vf
from findings import dataset, sized
from marks import keep

from bench.truth import new_effects as ne
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.model.model import new_model


def wandering(seed, size=7e-6, effects=()):
    """150 samples of a device that walks at random, next to effects of the robot."""
    day = vf.session(seed)
    seen = vf.samples(day, [vb.Wander(size, seed), *effects], vf.FINE, seed)
    return dataset(seen, vf.FINE)


@pytest.mark.wide
@pytest.mark.parametrize("seed", keep(range(20, 23), 22))
def test_a_device_that_walks_at_random_is_not_learned(seed):
    found = diagnose(new_model("delta54"), wandering(seed))
    assert not found.effects
    assert "the noise is correlated over" in found.verdict.text
    drift = next(e for e in found.entries if e.name == "base_drift")
    assert "indistinguishable from drift" in drift.reason


@pytest.mark.wide
def test_backlash_is_named_beside_a_device_that_walks_at_random():
    play = vf.KINDS["backlash"].make(0.3e-3, np.random.default_rng(4))
    found = diagnose(new_model("delta54"), wandering(24, effects=[play]))
    assert found.effects == ("backlash",)


@pytest.mark.wide
@pytest.mark.parametrize("kind", ["base drift", "thermal growth"])
def test_a_true_drift_is_named_in_white_noise(kind):
    day, one = vf.session(25), vf.KINDS[kind]
    hidden = sized(one.make, one.size, 0.4, day, one.noise, 25)
    found = diagnose(
        new_model("delta54"), dataset(vf.samples(day, [hidden], one.noise, 25), one.noise)
    )
    assert set(found.effects) <= set(one.names)
    assert found.effects


@pytest.mark.wide
def test_lines_that_creep_are_told_from_noise_that_drifts():
    """Lines that creep by one sigma, in a session of five hours without a pose again at its end."""
    robot, creep = ne.ROBOTS["four lines"], ne.sized(ne.ROBOTS["four lines"], ne.KINDS["creep"], 6)
    found = diagnose(robot.model(), robot.measured([creep], 6))
    assert found.effects == ("line_creep",)
    [cause] = found.missing
    assert cause["each"]["line_creep"] > 0.95
