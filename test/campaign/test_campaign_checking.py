"""What a sample may differ by from the model's prediction before a campaign stops."""

from dataclasses import replace

import numpy as np
import pytest

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.campaign.cell import CellError
from parallel_cal.campaign.checking import Checker
from parallel_cal.model.model import Noise, new_model
from parallel_cal.recordings.simulate import simulate


def visited(name, poses=12, seed=0):
    """The model as drawn, and samples of a robot off its drawing by its tolerances."""
    drawn = replace(new_model(name), noise=Noise(1e-5, 2e-5, 1e-4))
    rng, table = np.random.default_rng(seed), drawn.table
    off = table.nominal + table.tolerance * rng.standard_normal(len(table))
    built = drawn.with_values(np.where(drawn.fixed, table.nominal, off))
    return drawn, simulate(built, poses=poses, seed=seed).dataset()


def check_all(model, data):
    checker = Checker(model, {})
    for i in range(1, len(data.q)):
        checker.check(data.select([i]), data.q[i], data.select([i - 1]))


@pytest.mark.parametrize("name", ["delta24", "stewart42", "argos9", "argos27", "linear_delta"])
@pytest.mark.parametrize("seed", range(3))
def test_a_robot_within_its_tolerances_is_never_stopped(name, seed):
    check_all(*visited(name, seed=seed))


@pytest.mark.parametrize("name", ["stewart42", "argos9"])
def test_a_target_beside_the_middle_of_a_platform_that_turns_is_no_fault(name):
    """A registration determines where it is, once there are samples enough."""
    model, data = visited(name)
    beside = data.R @ np.array([0.08, -0.05, 0.12])
    check_all(model, replace(data, r=data.r + beside))


def test_a_platform_that_does_not_turn_in_the_model_may_tilt_a_little_in_reality():
    model, data = visited("delta24")
    tilts = np.random.default_rng(1).normal(0, 2e-3, (len(data.q), 3))
    tilted = np.array([rotation_matrix(w) @ R for w, R in zip(tilts, data.R, strict=True)])
    check_all(model, replace(data, R=tilted))


@pytest.mark.parametrize(("name", "where"), [("delta24", "moved"), ("stewart42", "turned")])
def test_another_target_is_noticed(name, where):
    model, data = visited(name)
    swapped = replace(
        data,
        r=data.r + (np.arange(len(data.q)) == 6)[:, None] * np.array([0.0, 0.0, 0.08]),
        R=np.array([rotation_matrix([0, 0, 0.3 * (i == 6)]) @ R for i, R in enumerate(data.R)]),
    )
    with pytest.raises(CellError, match=where):
        check_all(model, swapped)
