"""The error budget sums and names what was hidden; ISO 9283's figures against hand-worked ones."""

import json

import numpy as np
import pytest
import virtual_setups as vs

from parallel_cal.identification.budget import iso_9283
from parallel_cal.identification.fit import fit
from parallel_cal.identification.prediction_errors import Errors
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

SIGMA, ARCSEC, PLAY = 15e-6, vr.ARCSEC, 1e-3


@pytest.fixture(scope="module")
def result():
    """A virtual Delta with play of 1 mrad, its identification with backlash."""
    rng = np.random.default_rng(5)
    robot, n = vs.random_delta(4), 90
    r = rng.uniform((-0.05, -0.05, 0.16), (0.05, 0.05, 0.24), (n, 3))
    direction = rng.choice([-1.0, 1.0], (n, 3))
    stood, R = robot.inverse(r)
    q = stood + direction * PLAY / 2 + rng.normal(0, 25 * ARCSEC, (n, 3))
    turn = rng.normal(0, 20 * ARCSEC, (n, 3))
    model = new_model("delta54", effects=["backlash"])
    data = Dataset.from_arrays(
        model.joints,
        q,
        r + rng.normal(0, SIGMA, (n, 3)),
        np.array([vr.turn(w) for w in turn]) @ R,
        pose_cov=np.diag([SIGMA**2] * 3 + [(20 * ARCSEC) ** 2] * 3),
        joint_sigma=np.full(3, 25 * ARCSEC),
        conditions={
            f"direction.{name}": d for name, d in zip(model.joints, direction.T, strict=True)
        },
    )
    return fit(model, data), robot, stood, r, direction


def test_a_budget_sums_to_the_error_of_the_drawing(result):
    found, *_ = result
    position, orientation = found.budgets
    assert [b.kind for b in found.budgets] == ["position", "orientation"]
    for budget in (position, orientation):
        assert sum(part.contribution for part in budget.parts) == pytest.approx(budget.total)
        assert [p.name for p in budget.parts] == ["geometry", "backlash", "noise", "rest"]
    assert abs(position.parts[-1].contribution) < 0.1 * position.total


def test_an_effects_own_part_is_what_the_virtual_robot_moves_by_it(result):
    found, robot, stood, r, direction = result
    backlash = next(p for p in found.budgets[0].parts if p.name == "backlash")
    h = 1e-6
    slopes = np.stack([robot.inverse(r + h * axis)[0] - stood for axis in np.eye(3)], axis=2) / h
    moved = np.linalg.solve(slopes, PLAY / 2 * direction[:, :, None])[:, :, 0]
    expected = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    assert backlash.alone == pytest.approx(expected, rel=0.15)


def test_iso_9283_of_a_pose_visited_thrice_and_one_visited_once():
    e = np.array([[3e-5, 0, 0], [1e-5, 0, 0], [2e-5, 0, 0], [0, 4e-5, 0]])
    none = np.full((4, 3), np.nan)

    class Seen:
        group = np.array([0, 0, 0, 1])

    [found] = iso_9283(Errors(e, none, none, none, none), Seen)
    assert found.accuracy_mean == pytest.approx(3e-5)  # 20 and 40 um
    assert found.accuracy_max == pytest.approx(4e-5)
    l = np.sqrt(3 / 2) * np.array([1e-5, 1e-5, 0])  # about the barycentre, unbiased
    assert found.repeatability == pytest.approx(l.mean() + 3 * l.std())
    assert (found.poses, found.visits) == (1, 3)


@pytest.mark.wide
def test_the_command_prints_both(run_cli, tmp_path):
    asked = ("fit", "config/delta_mockup_nominal.yaml", "bags/delta_clean")
    shown = run_cli(*asked, "--hold-out", "0")
    assert "position error of " in shown
    assert "by itself" in shown
    assert "ISO 9283 position: accuracy AP" in shown
    document = json.loads(run_cli(*asked, "--hold-out", "0", "--json"))
    assert document["budget"][0]["parts"][0]["name"] == "geometry"
    assert document["iso_9283"][0]["poses"] == 20
