"""Causes that no effect describes, as columns of the sum."""

import findings
import numpy as np
import printers
import pytest
import virtual_blind as vb
import virtual_findings as vf

from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.causes.unknown_laws import DRIFT_LENGTHS, list_unknown_blocks
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.posterior.blocks import DRIFT, EFFECT
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

MODEL = new_model("delta54")


def scene_with_correlated_noise(seed):
    """A robot that lacks nothing; each error of the noise is nine tenths of the one before."""
    day, noise = vf.session(seed, 120, 30), vr.THESIS_NOISE
    quiet = vf.samples(day, [], findings.quiet(0.0), 0)
    rng = np.random.default_rng([seed, 5])
    q, r, w = vb.draw(noise, vb.correlated(len(quiet["q"]), quiet["r"], rng))
    seen = quiet | {"q": quiet["q"] + q, "r": quiet["r"] + r, "R": vr.turn(w) @ quiet["R"]}
    return see(fit(MODEL, findings.dataset(seen, noise), hold_out=0))


@pytest.mark.parametrize("seed", [81000, 81001])
def test_correlated_noise_is_not_taken_for_a_bump_of_the_device(seed):
    """With drift that was known at every third sample only, a bump had 0.99."""
    found = Causes.of(scene_with_correlated_noise(seed), list_effects_to_test(MODEL)).sum.search()
    assert found.probability["drifting noise"] > 0.99
    assert all(p < 0.5 for name, p in found.probability.items() if found.kinds[name] == EFFECT)


def test_drift_of_few_samples_has_the_covariance_of_a_random_walk_that_returns():
    """exp(-|i - k| / length) of the pose's errors, positions and turns as large in sigmas."""
    data, _ = findings.hiding([vf.KINDS["backlash"]], 1.0, seed=3)
    scene = see(fit(MODEL, data.select(np.arange(60)), hold_out=0))
    n = len(scene.model.joints)
    by_pose = scene.measured_jacobian[:, :, n : n + 6].copy()
    for some in (slice(0, 3), slice(3, 6)):
        by_pose[:, :, some] /= np.sqrt(np.mean(np.sum(by_pose[:, :, some] ** 2, axis=1)))
    order = np.argsort(np.argsort(data.time[:60]))
    apart = np.abs(order[:, None] - order) / order.std()
    [block] = list_unknown_blocks(scene, [DRIFT])
    for i, length in enumerate(DRIFT_LENGTHS):
        K = np.einsum("iak,jbk,ij->iajb", by_pose, by_pose, np.exp(-apart / length))
        K = K.reshape(len(scene.residual), -1)
        K = scene.project_off_geometry(scene.project_off_geometry(K).T)
        found = block.columns[i] @ block.columns[i].T
        np.testing.assert_allclose(found, K, atol=1e-4 * np.abs(K).max())


def test_noise_of_touches_is_no_law_of_the_joint_readings_that_hold_it():
    """Each of 45 places was touched twice, with a noise of 1 mm. The error of a height is a smooth
    function of the three readings at it, so that a law of all of them had more than 0.99."""
    rng, kind = np.random.default_rng(9), printers.PRINTERS["as built"]
    model = kind.model()
    line = np.linspace(-0.055, 0.055, 9)
    xy = np.array([(x, y) for x in line for y in line if np.hypot(x, y) < 0.056])
    at = np.column_stack([xy, np.zeros(len(xy))]).repeat(2, axis=0)
    at[:, 2] = 1e-3 * rng.standard_normal(len(at))
    q = Kinematics(model).inverse(at).joints
    data = Dataset.from_arrays(
        model.joints,
        q,
        np.zeros((len(q), 3)),
        measured=np.zeros(6, bool),
        joint_sigma=np.full(3, 1e-6),
        conditions={"reading.probe": np.zeros(len(q))},
        pose_id=np.arange(len(q)) // 2,
    )
    sensor = load_sensor("probe", height=0.0, sigma=None)
    scene = see(fit(model.with_sensors((sensor,)), data, hold_out=0))
    found = Causes.of(scene, []).sum.search()
    assert not [name for name, p in found.probability.items() if p > 0.5]
