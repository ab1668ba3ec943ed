"""Samples that were disturbed alone, as causes of the sum."""

import numpy as np
import pytest
from findings import hiding
from virtual_findings import KINDS

from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.causes.knocks import are_few, compute_falls, find_sideless_samples
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.posterior.evidence import SIZES

MODEL = new_model("delta54")


def scene_of(data):
    return see(fit(MODEL, data, hold_out=0))


def find_knocked(data):
    return Causes.of(scene_of(data), list_effects_to_test(MODEL)).find_knocked_samples()


def test_the_fall_without_a_sample_is_that_of_a_regression_without_its_rows():
    data, _ = hiding([KINDS["backlash"]], 1.0, seed=3)
    scene = scene_of(data.select(np.arange(60)))
    rows = np.arange(len(scene.residual)).reshape(-1, scene.rows)
    falls = compute_falls(scene)
    for sample in (0, 17, 59):
        kept = np.delete(rows, sample, axis=0).ravel()
        Q, r = scene.basis[kept], scene.residual[kept]
        left = r - Q @ np.linalg.lstsq(Q, r, rcond=None)[0]
        assert falls[sample] == pytest.approx(
            scene.residual @ scene.residual - left @ left, rel=1e-6
        )


def test_beside_a_chosen_cause_the_fall_is_that_of_a_regression_with_its_prior():
    data, _ = hiding([KINDS["backlash"]], 1.0, seed=3)
    scene = scene_of(data.select(np.arange(60)))
    causes = Causes.of(scene, ["backlash"])
    chosen = causes.sum.choose([one for one in causes.blocks if one.name == "backlash"])
    scaled = SIZES[chosen[0].size] * chosen[0].block.at(chosen[0].setting)
    S = np.eye(len(scene.residual)) + scaled @ scaled.T
    rows = np.arange(len(scene.residual)).reshape(-1, scene.rows)
    falls = compute_falls(scene, chosen)

    def squares(kept):
        L = np.linalg.cholesky(S[np.ix_(kept, kept)])
        r, Q = (np.linalg.solve(L, part[kept]) for part in (scene.residual, scene.basis))
        left = r - Q @ np.linalg.lstsq(Q, r, rcond=None)[0]
        return left @ left

    for sample in (5, 40):
        fall = squares(rows.ravel()) - squares(np.delete(rows, sample, axis=0).ravel())
        assert falls[sample] == pytest.approx(fall, rel=1e-5)


def test_samples_that_hide_one_another_behind_a_large_effect_are_found_together():
    data, _ = hiding([KINDS["backlash"]], 3.0, seed=40)
    data.r[17] += 0.4e-3 * np.array([0.7, -0.5, 0.5])
    data.r[60] += 2e-3 * np.array([-0.7, 0.5, 0.5])
    assert find_knocked(data) == (17, 60)


@pytest.mark.parametrize("seed", range(4))
def test_in_clean_samples_none_is_disturbed(seed):
    data, _ = hiding([KINDS["backlash"]], 2.0, seed=seed)
    assert find_knocked(data) == ()


def test_many_samples_under_a_load_of_their_own_are_explained_by_it():
    """Four of them lie far from all others, and a sag explains them with one parameter."""
    data, _ = hiding([KINDS["backlash"]], 0.0, seed=8)
    data.conditions["payload"][:] = 0.0
    data.conditions["payload"][[10, 50, 90, 120]] = 2.0
    data.r[[10, 50, 90, 120], 2] -= 0.4e-3
    assert find_knocked(data) == ()


def test_what_counts_as_few_and_as_without_sides():
    data, _ = hiding([KINDS["backlash"]], 1.0, seed=3)
    assert are_few(range(7), data)
    assert not are_few(range(8), data)
    for joint in data.joint_names:
        data.conditions[f"direction.{joint}"][4] = 0.0
    assert find_sideless_samples(data) == {4}
