"""`diagnose` names what `add` accepts, with the error that `add` reaches, and excludes the samples
that `add` excludes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import virtual_findings as vf
from findings import hiding
from marks import keep

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.addition import find_addition
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.patterns import OddSample, find_innocent_samples
from parallel_cal.effects.encoder_gain import EncoderGain
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.session.steps import add, fitted

ROOT = Path(__file__).parents[2]
MOCK_UP = ROOT / "config" / "delta_mockup_nominal.yaml"
FINE = ROOT / "bags" / "models" / "delta54_fine.yaml"
HEXAPOD = ROOT / "real" / "jugglebot"
HP4 = ROOT / "real" / "hangprinter_hp4" / "hp4_2021-12-14.csv"


def held_out(result):
    return result.held_out.summary.position_rms


def follow(found, model, data):
    """Add what a diagnosis proposes, to the samples that its command keeps."""
    (command,) = (step for step in found.next_steps if step.startswith("add what was found"))
    effects, excluded = found.addition.text, sorted(found.dataset.excluded)
    assert f"add MODEL {effects} RECORDING" in command
    assert (f"exclude={','.join(map(str, excluded))} " in command) == bool(excluded)
    return add(model, effects, data.excluding(excluded))


@pytest.fixture(scope="module")
def hexapod():
    """A real hexapod of which 60 poses were measured, after the fit of its geometry."""
    model = read_model(HEXAPOD / "model.yaml")
    columns = str(HEXAPOD / "columns.yaml")
    data = load_dataset(HEXAPOD / "poses_60.csv", mechanism=model.mechanism, columns=columns)
    return fitted(model, data).model, data


@pytest.mark.wide
def test_effects_may_be_added_together_if_they_may_be_added_one_after_the_other(hexapod):
    """Next to the residuals of the geometry, which contain the gains, an effect of the device
    explains more than the spools; next to the gains it does not."""
    model, data = hexapod
    first = fitted(model, data, effects=["encoder_gain"])
    then = add(first.model, "spool_buildup", data)
    both = add(model, "encoder_gain+spool_buildup", data)
    assert held_out(both.result) == pytest.approx(held_out(then.result), rel=0.02)
    assert held_out(both.result) < 0.5 * held_out(both.rival)


@pytest.mark.wide
def test_what_is_named_for_a_real_hexapod_is_accepted_and_reaches_the_named_error(hexapod):
    found = diagnose(*hexapod)
    assert found.effects == ("encoder_gain", "spool_buildup")
    step = follow(found, *hexapod)
    assert held_out(found.best.fitted) == pytest.approx(held_out(step.result), rel=1e-6)


@pytest.mark.wide
def test_the_named_error_is_reached_although_the_noise_is_estimated_anew_with_the_effect():
    """With the noise that the geometry alone leaves, the error would be half a per cent smaller."""
    model = read_model(ROOT / "config" / "hangprinter_hp4.yaml")
    columns = str(ROOT / "config" / "columns" / "hangprinter_hp4.yaml")
    data = load_dataset(HP4, mechanism=model.mechanism, columns=columns)
    model = fitted(model, data).model
    found = diagnose(model, data, effects=["spool_buildup", "encoder_gain"])
    assert found.effects == ("spool_buildup",)
    step = follow(found, model, data)
    assert held_out(found.best.fitted) == pytest.approx(held_out(step.result), rel=1e-6)


def knocked(name, model, sample, by, without=()):
    """A recording in which somebody knocked the device at one sample, without some conditions."""
    data = load_dataset(ROOT / "bags" / name, joints=model.joints)
    r = data.r.copy()
    r[sample] += by
    kept = {key: values for key, values in data.conditions.items() if key not in without}
    return replace(data, r=r, conditions=kept)


@pytest.mark.wide
def test_a_knocked_sample_with_which_no_plausible_effect_fits_is_excluded_by_add():
    """With the sample, the shafts would have a negative compliance."""
    model = read_model(MOCK_UP)
    data = knocked("delta_compliance", model, 3, [0, 0, -5e-3])
    with pytest.raises(FitError, match="allows no negative value"):
        add(model, "joint_compliance", data, knocked=())
    step = add(model, "joint_compliance", data)
    assert step.knocked == (3,)
    alone = add(model, "joint_compliance", data.excluding([3]))
    assert held_out(step.result) == pytest.approx(held_out(alone.result), rel=1e-6)


@pytest.mark.wide
@pytest.mark.parametrize("sample", keep([5, 30], 30))
def test_a_sample_that_hides_a_part_of_the_error_is_excluded_by_diagnose_as_by_add(sample):
    """Nobody recorded the temperature, so that the backlash explains a part only."""
    model = read_model(FINE)
    data = knocked("delta_backlash_thermal", model, sample, [2e-3, 0, 0], ["temperature"])
    found = diagnose(model, data, effects=["backlash", "hysteresis"])
    assert found.verdict.word == "partly_explained"
    assert sample in [one.sample for one in found.knocked]
    step = follow(found, model, data)
    assert step.knocked == ()
    assert held_out(found.best.fitted) == pytest.approx(held_out(step.result), rel=1e-6)
    every = add(model, found.addition.text, data)
    assert list(every.knocked) == sorted(one.sample for one in found.knocked)


def test_what_only_another_model_took_for_knocked_is_taken_back():
    """Of a sample without sides, a model predicts nothing."""

    def odd(sample, **what):
        what = {"outlier": False, "sideless": False} | what
        shape = {"cooks_distance": 0.1, "leverage": 0.1, "position_error": np.zeros(3)}
        return OddSample(sample, 0.0, 1.0, 1.0, place=np.zeros(3), **shape, **what)

    far = [odd(3, outlier=True), odd(5), odd(7, sideless=True)]
    assert find_innocent_samples(far, [3, 5, 7, 9]) == {5, 9}


@pytest.mark.wide
def test_the_next_command_excludes_the_samples_that_the_owner_excluded():
    model = read_model(MOCK_UP)
    data = load_dataset(ROOT / "bags" / "delta_backlash", joints=model.joints)
    found = diagnose(model, data.excluding([7, 9]), effects=["backlash"])
    assert "RECORDING --data exclude=7,9 -o" in found.next_steps[0]
    assert held_out(follow(found, model, data).result) == held_out(found.best.fitted)
    blind = diagnose(model, data.excluding([7, 9]), effects=["target_offset"])
    [discover] = (step for step in blind.next_steps if "parallel-cal discover" in step)
    assert "discover MODEL RECORDING --data exclude=7,9 -o" in discover


def test_no_command_is_proposed_that_add_refuses_for_want_of_held_out_poses():
    model = read_model(MOCK_UP)
    data = load_dataset(ROOT / "bags" / "delta_backlash", joints=model.joints)
    found = diagnose(model, data, effects=["backlash"], hold_out=0)
    assert found.effects == ("backlash",)
    assert not any("parallel-cal add" in step for step in found.next_steps)


CORNERS = ((-1.5, -1.15), (1.5, -1.15), (1.5, 1.15), (-1.5, 1.15))
ANCHORS = [(x, y, z) for z in (0.0, 2.0) for x, y in CORNERS]


def eight_lines(gains, columns):
    """80 positions of a point on eight lines, whose drives have gains, read in some columns."""
    rng = np.random.default_rng(1)
    place = rng.uniform((-0.6, -0.6, 0.4), (0.6, 0.6, 1.6), (80, 3))
    lengths = np.linalg.norm(place[:, None] - np.array(ANCHORS), axis=2) * gains
    read = lengths[:, columns] + 5e-4 * rng.standard_normal(lengths.shape)
    model = new_model(load_mechanism("cable", anchors=ANCHORS, zero="anchors"))
    return model, Dataset.from_arrays(
        model.joints,
        read,
        place + 5e-4 * rng.standard_normal(place.shape),
        np.tile(np.eye(3), (80, 1, 1)),
        measured=np.tile([True] * 3 + [False] * 3, (80, 1)),
        pose_cov=np.diag([2.5e-7] * 3 + [1.0] * 3),
        joint_sigma=5e-4,
        source="lines.csv",
    )


@pytest.mark.wide
def test_gains_of_some_per_cent_are_not_taken_for_exchanged_columns():
    gains = (0.975, 0.926, 0.923, 0.896, 1.028, 1.133, 0.898, 1.008)
    model, data = eight_lines(gains, list(range(8)))
    with pytest.raises(FitError) as refusal:
        fitted(model, data)
    assert "are in the columns of" not in str(refusal.value)
    assert "diagnose MODEL RECORDING" in str(refusal.value)
    # What resembles gains; all effects against each other are the subject of other tests.
    alike = ["encoder_gain", *EncoderGain.lookalikes, "spool_buildup"]
    assert diagnose(model, data, effects=alike).effects == ("encoder_gain",)
    found = fitted(model, data, effects=["encoder_gain"]).result.parameters()
    # What the motor reads is the length times the gain: the effect divides by it.
    identified = [1 + found[f"encoder_gain.{joint}.gain"].value for joint in model.joints]
    np.testing.assert_allclose(np.array(identified) * gains, 1.0, atol=2e-3)


def test_exchanged_columns_of_lines_are_still_named():
    model, data = eight_lines(np.ones(8), [0, 1, 2, 7, 4, 5, 6, 3])
    with pytest.raises(FitError, match="line4, line8 are in the columns of line8, line4"):
        fitted(model, data)


@pytest.mark.wide
def test_an_effect_is_added_if_it_is_likelier_than_noise_that_happens_to_look_like_it():
    """Both lower the error at held-out poses; a tenth of a sigma in 150 poses may do so by
    chance, a fifth of a sigma does not."""
    model, kinds = new_model("delta54"), [vf.KINDS["joint compliance"]]
    weak, strong = (hiding(kinds, size, 1)[0] for size in (0.1, 0.2))
    refused = find_addition(model, "joint_compliance", weak, FitOptions())
    assert held_out(refused.result) < held_out(refused.base)
    assert 0.02 < refused.probability < 0.5
    assert "chance rather than an effect" in refused.acceptance.against
    accepted = find_addition(model, "joint_compliance", strong, FitOptions())
    assert accepted.probability > 0.99
    assert not accepted.acceptance.against
