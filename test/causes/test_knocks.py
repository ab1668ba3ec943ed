"""Samples that were disturbed alone, as causes of the sum."""

from dataclasses import replace

import numpy as np
import pytest
import virtual_findings as vf
from findings import dataset, hiding
from virtual_findings import KINDS

from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.causes.knocks import are_few, compute_falls, find_sideless_samples
from parallel_cal.diagnosis import causes
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.causes import Causes, find_knocked_samples
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.posterior.evidence import SIZES
from parallel_cal.session.steps import add
from parallel_cal.virtual import robot as vr

MODEL = new_model("delta54")


def scene_of(data):
    return see(fit(MODEL, data, hold_out=0))


def find_knocked(data):
    return find_knocked_samples(scene_of(data), list_effects_to_test(MODEL))


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


@pytest.fixture
def many():
    """660 samples of 600 poses with a large backlash: many, if parts have about 220 samples."""
    day = vf.session(6, 600, 60)
    effects = [vr.Backlash((3e-3, 2.4e-3, 2.1e-3))]
    return dataset(vf.samples(day, effects, vr.THESIS_NOISE, 6), vr.THESIS_NOISE)


def test_the_parts_of_many_samples_share_them_with_all_visits_of_a_pose(many):
    scene = scene_of(many)
    parts = list(scene.divide(220))
    assert [len(part.dataset) for part in parts] == pytest.approx([220] * 3, abs=25)
    numbers = np.concatenate([part.dataset.numbers for part in parts])
    assert sorted(numbers) == list(range(660))
    poses = [set(part.dataset.pose_id.tolist()) for part in parts]
    assert sum(map(len, poses)) == len(set.union(*poses)) == 600
    for part, own in zip(parts, poses, strict=True):
        assert np.array_equal(part.dataset.r, many.r[part.dataset.numbers])
        # Poses that repeat every third of them, as in a raster, are in each part.
        assert {pose % 3 for pose in own} == {0, 1, 2}
        assert np.abs(part.basis.T @ part.residual).max() < 1e-6
    assert next(scene.divide(660)) is scene
    assert len(list(scene.divide(10))) == 6  # of 100 poses each


@pytest.mark.wide
def test_add_finds_knocked_samples_in_every_part_of_many_that_a_large_effect_hides(
    many, monkeypatch
):
    """What is missing is searched for in one part, so that time and memory do not grow with the
    samples; the others are searched for such samples beside it."""
    searched, make = [], Causes.of.__func__

    def noted(cls, scene, names, *more, **known):
        searched.extend([len(scene.dataset)] if len(names) > 20 else [])
        return make(cls, scene, names, *more, **known)

    monkeypatch.setattr(causes, "MAX_SEARCHED_SAMPLES", 220)
    monkeypatch.setattr(Causes, "of", classmethod(noted))
    knocked = [int(part.dataset.numbers[100]) for part in scene_of(many).divide(220)]
    for number, by in zip(knocked, ((7, -5, 5), (-7, 5, 5), (5, 7, -5)), strict=True):
        many.r[number] += 0.02e-3 * np.array(by)
    falls = compute_falls(scene_of(many))
    assert not set(np.argsort(-falls)[:30].tolist()) & {*knocked}
    step = add(MODEL, "backlash", many)
    assert list(step.knocked) == sorted(knocked)
    assert step.result.samples == 657
    # Once with these samples, and once without them.
    assert searched == pytest.approx([220] * 2, abs=25)


def test_a_motion_is_not_searched_for_samples_that_were_disturbed_alone(many, monkeypatch):
    monkeypatch.setattr(Causes, "of", None)
    assert find_knocked(replace(many, mode="continuous")) == ()
