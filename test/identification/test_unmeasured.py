"""Coordinates that were not measured are projected out in one way, whatever looks at the rest."""

import numpy as np
import pytest
import virtual_findings as vf
from datasets import measured
from findings import hiding

from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.identification.fit import fit
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import observe
from parallel_cal.model.model import new_model
from parallel_cal.posterior.scene import Scene

POSE = "x y z rx ry rz"
SOME = ["x y z", "rx ry rz", "z", "x y", "x ry", "x y z rz", "y z rx ry rz"]


def only(coordinates, data):
    """The same samples from a device that shows these coordinates alone."""
    seen = np.array([name in coordinates.split() for name in POSE.split()])
    return data.select(np.arange(len(data))).__class__.from_arrays(
        data.joint_names,
        data.q,
        data.r,
        data.R,
        measured=np.tile(seen, (len(data), 1)),
        pose_cov=data.pose_cov,
        joint_sigma=data.joint_sigma,
        conditions=data.conditions,
        pose_id=data.pose_id,
    )


@pytest.mark.parametrize("coordinates", SOME)
def test_whitened_columns_are_the_whitener_times_the_columns(coordinates):
    model = new_model("delta54")
    observations = observe(model, only(coordinates, measured(0)))
    linearise = Linearisation(model, observations, ~model.fixed, True)
    x = linearise.start()
    phi, C, J = linearise.blocks(model.values, x)
    filled = np.full_like(C, np.nan)
    system, T = linearise(model.values, x, by_measured=filled), linearise.whiten(C)
    assert np.array_equal(filled, C)
    assert np.abs(T @ J - system.jacobian).max() < 1e-7 * np.abs(system.jacobian).max()
    carried = phi + (C @ linearise.compute_adjustments(x)[:, :, None])[:, :, 0]
    assert np.allclose((T @ carried[:, :, None])[:, :, 0], system.residual, atol=1e-6)
    unseen = [3 + POSE.split().index(c) for c in POSE.split() if c not in coordinates.split()]
    assert np.abs(T @ C[:, :, unseen]).max() < 1e-6 * np.abs(T @ C).max()


@pytest.mark.parametrize("coordinates", SOME)
def test_as_many_rows_are_left_as_coordinates_were_measured(coordinates):
    model = new_model("delta54")
    observations = observe(model, only(coordinates, measured(0)))
    linearise = Linearisation(model, observations, ~model.fixed, True)
    system = linearise(model.values, linearise.start())
    assert (system.informative == len(coordinates.split())).all()


@pytest.mark.wide
@pytest.mark.parametrize(
    ("kind", "effect"), [("backlash", "backlash"), ("gear ripple", "gear_transmission_error")]
)
def test_an_effect_is_as_plain_to_a_position_device_as_to_its_score(kind, effect):
    """The score of one refit promises what the refit then brings: chi2 falls by q F-ish parts."""
    data, _ = hiding([vf.KINDS[kind]], 1.5, 0)
    seen = only("x y z", data)
    result = fit(new_model("delta24"), seen, hold_out=0)
    here = Scene.of(result.model, seen, result.observations, result.free)
    one = candidate(here, effect)
    after = fit(result.model.with_effect(effect, one.settings), seen, hold_out=0)
    promised = float(np.sum((one.score.U.T @ here.residual) ** 2))
    fell = result.estimate.chi2 - after.estimate.chi2
    assert one.log_p < np.log(1e-20)
    assert fell == pytest.approx(promised, rel=0.05)
