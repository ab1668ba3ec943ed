"""Between the sets that a diagnosis leaves possible: predictions as refits give, and poses."""

from pathlib import Path

import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.diagnosis.decision import DECIDED, Undecided, plan_decision
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.planning.posepool import make_pool
from parallel_cal.posterior.decision import choose_deciding_poses

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def found():
    """Of a Delta with backlash, in samples that leave hysteresis possible."""
    model = pc.read_model(ROOT / "config" / "delta_mockup_nominal.yaml")
    return diagnose(model, pc.load_dataset(ROOT / "bags" / "delta_backlash"))


@pytest.mark.wide
def test_the_sets_are_those_of_the_diagnosis_and_each_is_refitted(found):
    doubt = Undecided.of(found.explanation.doubt)
    assert [str(one) for one in doubt.sets] == ["backlash", "hysteresis"]
    assert found.swaps == {"backlash": ["hysteresis"]}
    of_sets = dict(found.explanation.described.sets)
    assert [one.p for one in doubt.sets] == [of_sets[one.names] for one in doubt.sets]
    # The closed form is near what a refit finds, which does not know that the gears are alike:
    # both effects are nearly linear.
    own, refit = doubt.sets[0], found.best.fitted
    names = [n for n, f in zip(doubt.model.table.names, doubt.free, strict=True) if f]
    values = doubt.model.values[doubt.free] + own.estimate * doubt.model.table.tolerance[doubt.free]
    for name, value, row in zip(names, values, own.factor, strict=True):
        if name.startswith("backlash."):
            sigma = np.linalg.norm(row) * doubt.model.table[name].tolerance
            assert abs(value - refit.model.value(name)) < 1.5 * sigma
            assert value > 4 * sigma


@pytest.mark.wide
def test_poses_are_allowed_and_lower_the_entropy_by_what_random_ones_do_not(found):
    doubt, guard = Undecided.of(found.explanation.doubt), Guard.of(found.best.fitted.model)
    plan = plan_decision(doubt, found.dataset.conditions, 20, 40, guard.is_measurable)
    assert plan.at_last < plan.after < 0.7 * doubt.entropy
    assert plan.at_last > DECIDED  # 40 such poses are not expected to decide
    assert guard.is_measurable(plan.pool.poses.joints).all()
    # Poses of usual sessions: the same number of random ones.
    rng = np.random.default_rng(1)
    pool = make_pool(doubt.model, 20, rng, symmetric=False)
    random = choose_deciding_poses(doubt.predict(pool, pool.a), 20, 0.0)[1][-1]
    assert random > 1.2 * plan.after
    nowhere = plan_decision(
        doubt, found.dataset.conditions, 20, 40, lambda joints: np.zeros(len(joints), bool)
    )
    assert nowhere is None
