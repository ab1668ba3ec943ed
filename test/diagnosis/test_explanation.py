"""The sum made again about a fit, and the fits that prove what it names."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import virtual_findings as vf
from datasets import measured
from findings import hiding
from virtual_setups import random_delta

from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.causes.unknown_laws import LOG_PRIOR
from parallel_cal.diagnosis import causes as linear
from parallel_cal.diagnosis import explanation
from parallel_cal.diagnosis.addition import find_addition, with_given_model_of
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.search import Chosen, Search
from parallel_cal.identification.fit import fit, fit_unjudged
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import new_model
from parallel_cal.posterior.blocks import EFFECT, LAW, Block
from parallel_cal.posterior.evidence import STATED
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.summary import summarize
from parallel_cal.session.steps import add
from parallel_cal.virtual import robot as vr

PLAY = Chosen("backlash")


@pytest.fixture(scope="module")
def search():
    """The refits of a Delta whose play of 11 mm bends any geometry without it."""
    data = measured(0, effects=[vr.Backlash((11e-3, 9e-3, 7e-3))], n_poses=60, n_replicates=0)
    return Search(
        new_model("delta54"),
        lambda model, insist, *_: fit_unjudged(model, data, FitOptions(insist=True)),
        lambda *_: None,
    )


@pytest.fixture(scope="module")
def base(search):
    return search.fit(insist=True, judged=False)


def test_a_sum_about_a_fit_leaves_what_the_fit_leaves(search, base):
    best = search.fit(PLAY, insist=True, judged=False)
    wrong = []
    for scene in (base.scene, explanation._scene_about(base, best, within=None)):
        causes = Causes.of(scene, ["backlash"], kinds=())
        _, described, _ = causes.explain()
        predicted = causes._predict_chi2(described, [PLAY])
        wrong.append(abs(predicted - best.fitted.estimate.chi2 / causes.variance))
    assert wrong[0] > 10
    assert wrong[1] < 0.1


@pytest.mark.parametrize("allowed", [linear.MAX_LINEAR_ERROR, np.inf])
def test_what_imitates_the_curvature_of_a_large_effect_is_not_named(
    search, base, allowed, monkeypatch
):
    """Also where the linear problem agrees with the fit of both effects, as it may by chance."""
    monkeypatch.setattr(linear, "MAX_LINEAR_ERROR", allowed)
    names = list_effects_to_test(base.fitted.model)
    causes = Causes.of(base.scene, names)
    _, described, chosen = causes.explain()
    assert len(chosen) == 2  # the second one is not there
    tried = search.fit_as_shown(*chosen, judged=False)
    nearer = causes.find_nearer(search, (), tried, described)
    assert nearer.names == (("backlash",) if allowed == np.inf else tried.names)
    again = Causes.of(explanation._scene_about(base, nearer, within=None), names)
    _, described, chosen = again.explain()
    assert [one.name for one in chosen] == ["backlash"]
    assert again.find_nearer(search, (), search.fit_as_shown(PLAY, judged=False), described) is None


def test_a_sum_made_again_begins_with_the_numbers_that_were_found():
    """Of the same problem, it finds the same, without a search between the scanned numbers."""
    data = hiding([vf.KINDS["gear ripple"]], 1.0, 0)[0]
    names = ["gear_transmission_error", "backlash"]
    base = fit(new_model("delta54"), data, hold_out=0)
    scene = Scene.of(base.model, base.dataset, base.observations, base.free)
    causes = Causes.of(scene, names, kinds=())
    posterior, described, [gear] = causes.explain()
    [again] = causes._resume(causes.sum, described.chosen)
    settings = dict(gear.settings)
    assert again.block.settings[again.setting] == settings
    assert settings not in [*again.block.scanned.settings]  # between those that were scanned
    assert causes._resume(replace(causes.sum, left_out={gear.name}), described.chosen) == ()
    assert causes.explain((), posterior.chosen, described.chosen)[2] == (gear,)


def test_a_law_gives_way_to_three_effects_that_are_likelier_without_it(monkeypatch):
    """No two of the three explain more than the law, which follows all of them."""
    rng = np.random.default_rng(8)
    own = rng.standard_normal((3, 120, 3))
    residual = np.einsum("knj,kj->n", own, 5.0 * rng.standard_normal((3, 3)))
    residual += rng.standard_normal(120)
    scene = SimpleNamespace(
        residual=residual, dof=120, project_off_geometry=lambda columns: columns, dataset=None
    )
    names = ("encoder_gain", "spool_buildup", "joint_compliance")
    effects = [
        Block.of(scene, name, EFFECT, np.log(1 / 30), [columns], [{}])
        for name, columns in zip(names, own, strict=True)
    ]
    follows = np.hstack([*own, rng.standard_normal((120, 12))])
    law = Block.of(scene, "law", LAW, LOG_PRIOR, [follows], [{}])
    monkeypatch.setattr(
        Causes,
        "_search_with_knocks",
        lambda self, possible, start=(): (self._search(possible, start), possible),
    )
    causes = Causes(scene, [*effects, law], STATED, 1.0, 120)
    stuck = causes.sum.search()
    assert [one.block.name for one in stuck.chosen] == ["law"]
    found, _, named = causes.explain()
    assert causes.sum.judge(found) > causes.sum.judge(stuck) + 3
    assert {one.name for one in named} == {one.block.name for one in found.chosen} == {*names}


def test_an_effect_is_added_beside_those_that_the_compared_model_does_not_have(search, base):
    """As `discover` adds one law after the other, and compares all with the model it began with."""
    data = base.fitted.dataset
    beside = with_given_model_of(search.fit(PLAY, insist=True, judged=False).fitted, base.fitted)
    found = find_addition(
        beside.start, "encoder_gain", data, FitOptions(hold_out=0), knocked=(), known=(beside, None)
    )
    names = [effect.name for effect in found.result.model.effects]
    assert names == ["backlash", "encoder_gain"]


def with_law(law, seed=0, n=150):
    """Samples of a Delta of points and rods whose joint 2 errs by a law (rad) of its standardised
    readings; the joints mostly came from below where their readings are large."""
    rng = np.random.default_rng(seed)
    r = rng.uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (n, 3))
    q = random_delta(0).inverse(r)[0]
    z = (q - q.mean(axis=0)) / q.std(axis=0)
    sides = np.where(z + 0.5 * rng.standard_normal(z.shape) > 0, 1.0, -1.0)
    q[:, 1] += law(z, sides)
    model = new_model("delta24")
    return model, Dataset.from_arrays(
        model.joints,
        q + rng.normal(0, 2e-5, q.shape),
        r + rng.normal(0, 3e-5, r.shape),
        measured=[True] * 3 + [False] * 3,
        pose_cov=np.diag([3e-5**2] * 3 + [1e6] * 3),
        joint_sigma=[2e-5] * 3,
        conditions={f"direction.{j}": sides[:, i] for i, j in enumerate(model.joints)},
    )


@pytest.mark.parametrize(
    ("law", "depends"),
    [
        (lambda z, sides: 2e-3 * np.tanh(2 * z[:, 1]), False),
        (lambda z, sides: 1e-3 * sides[:, 1] + 2e-3 * np.tanh(2 * z[:, 1]), True),
    ],
)
def test_a_direction_that_follows_the_readings_is_not_blamed_for_a_law_of_these(law, depends):
    model, data = with_law(law)
    found = diagnose(model, data, effects=["device_axes"])
    assert found.left == "yes"
    assert (found.remaining is not None and found.remaining.name == "direction") == depends


def test_an_unknown_law_of_one_joint_is_named_with_this_joint():
    model, data = with_law(lambda z, sides: 2e-3 * np.tanh(2 * z[:, 0] * z[:, 2]))
    found = diagnose(model, data, effects=["device_axes"])
    assert [*found.explanation.laws] == ["law of joint2"]
    [left] = [line.text for line in summarize(found) if line.label == "left:"]
    assert left.startswith("yes, described best by an unknown law of joint2 (")


def test_what_the_effects_of_a_verdict_left_is_unexplained_once_the_model_has_them():
    model, data = with_law(
        lambda z, sides: 1e-3 * sides[:, 1] + 5e-4 * np.tanh(2 * z[:, 0] * z[:, 2])
    )
    first = diagnose(model, data, effects=["backlash"])
    assert (first.effects, first.verdict.word, first.left) == (
        ("backlash",),
        "partly_explained",
        "yes",
    )
    better = add(model, "backlash", data, force=True).model
    second = diagnose(better, data, effects=["device_axes"])
    assert (second.effects, second.verdict.word, second.left) == ((), "unexplained", "yes")
    assert "no effect of the catalogue, beside backlash of the model, explains it" in (
        second.verdict.summary
    )
