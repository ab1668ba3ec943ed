"""A robot must not learn its device's errors: what either may have made is said to be doubtful."""

import numpy as np
import pytest
import virtual_blind as vb
import virtual_findings as vf
from findings import clean, dataset, hiding, sized

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.device import cost
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.session.steps import added


@pytest.fixture(scope="module")
def refracted():
    """A robot without hidden effects before a device whose light bends with height."""
    day = vf.session(0)
    bent = sized(vb.DEVICE["refraction"], 2e-5, 1.5, day, vf.FINE, 3)
    return dataset(vf.samples(day, [bent], vf.FINE, 0), vf.FINE)


@pytest.mark.wide
def test_what_the_device_may_have_made_is_not_called_explained(refracted):
    found = diagnose(new_model("delta54"), refracted)
    robots = [name for name in found.effects if name not in ("device_field", "device_axes")]
    assert found.verdict.word != "explained"
    assert list(found.robot_or_device) == robots
    assert all(f"{name} may be the measuring device's" in found.verdict.summary for name in robots)


def test_and_it_is_not_added_unless_somebody_insists(refracted):
    with pytest.raises(FitError, match="may be the measuring device's"):
        added(new_model("delta54"), "encoder_eccentricity", refracted)
    step = added(new_model("delta54"), "encoder_eccentricity", refracted, force=True)
    assert "may be the measuring device's" in step.model.history[-1]["forced"]


@pytest.mark.wide
@pytest.mark.parametrize("kind", ["eccentricity", "joint compliance"])
def test_what_no_usual_error_of_the_device_makes_stays_the_robots(kind):
    data, _ = hiding([vf.KINDS[kind]], 0.4, 1)
    found = diagnose(new_model("delta54"), data)
    assert found.verdict.word == "explained"
    assert not found.robot_or_device


def test_the_cost_of_a_number_is_its_misfit_and_its_square_in_tolerances():
    data = clean(0)
    result = fit(new_model("delta54"), data, hold_out=0)
    scene = Scene.of(result.model, result.dataset, result.observations, result.free)
    B = scene.off_geometry(np.random.default_rng(0).standard_normal((len(scene.residual), 2)))
    e = np.linalg.solve(np.eye(2) + B.T @ B, B.T @ scene.residual)
    by_hand = np.sum((scene.residual - B @ e) ** 2) + np.sum(e**2)
    assert cost(scene, B) == pytest.approx(by_hand)
