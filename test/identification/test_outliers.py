"""Single samples that contradict all others are named by `fit` and excluded by `diagnose`.

The samples are of the independent virtual robots; some are moved by millimetres afterwards.
"""

from dataclasses import replace

import numpy as np
import pytest
import virtual_arm as va
import virtual_findings as vf
from arms import nominal, seen
from datasets import measured
from findings import dataset
from virtual_effects_hidden import JointCompliance

from parallel_cal.base.errors import FitError
from parallel_cal.cli.main import main
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.identification.outliers import are_separated, find_outliers
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import new_model
from parallel_cal.reporting.summary import summarize
from parallel_cal.session.steps import add, fitted
from parallel_cal.virtual import robot as vr

DELTA = new_model("delta54")
SLIPPED = {20: (5e-3, 0, 0), 50: (0, -5e-3, 2e-3), 51: (0, 1e-2, 0)}  # sample: m


def moved(data, by):
    r = data.r.copy()
    for sample, shift in by.items():
        r[sample] += shift
    return replace(data, r=r)


def contradicting(result):
    return [words for words in result.warnings if "contradict" in words]


def test_a_regression_finds_what_least_squares_hide():
    """40 samples of 2 rows, 24 parameters: two outliers drag the fit."""
    rng = np.random.default_rng(0)
    X, truth = rng.standard_normal((40, 2, 24)), rng.standard_normal(24)
    y = X @ truth + 0.1 * rng.standard_normal((40, 2))
    y[[4, 9]] += 5.0
    hat = np.linalg.lstsq(X.reshape(80, 24), y.ravel(), rcond=None)[0]
    left = np.linalg.norm(y - X @ hat, axis=1)
    assert np.median(left) > 0.4  # of 0.14
    found, sizes = find_outliers(y - X @ hat, X, np.full(40, 2))
    assert found.tolist() == [4, 9]
    assert np.sort(sizes)[-3] < 0.1 * sizes[9]
    y[:8] += 5.0  # a fifth of the samples: the model fails
    assert not len(find_outliers(y, X, np.full(40, 2))[0])


@pytest.mark.parametrize(("wrong", "found"), [(6, 6), (9, 0)])
def test_if_more_than_a_tenth_of_the_samples_are_far_away_the_model_fails(wrong, found):
    """The regression sees each of them clearly."""
    rng = np.random.default_rng(2)
    X, r = rng.standard_normal((60, 2, 2)), 0.1 * rng.standard_normal((60, 2))
    r[:wrong] += 5.0
    outliers, sizes = find_outliers(r, X, np.full(60, 2))
    assert outliers.tolist() == list(range(found))
    assert sizes[:wrong].min() > 6


def test_a_sample_that_determines_a_direction_alone_is_no_outlier():
    """Its residual is large by chance, and nothing else holds the direction without it."""
    rng = np.random.default_rng(1)
    X, r = rng.standard_normal((40, 2, 5)), 0.1 * rng.standard_normal((40, 2))
    X[:, :, 4] = 0.0
    X[7, 0, 4], r[7] = 1.0, (0.0, 0.6)
    found, sizes = find_outliers(r, X, np.full(40, 2))
    assert found.tolist() in ([], [7])
    assert sizes[7] < 8


def test_samples_at_which_the_target_slipped_are_named_and_excluded():
    few = {k: SLIPPED[k] for k in (20, 50)}
    data, clean = moved(measured(0), few), fit(DELTA, measured(0))
    bad = fit(DELTA, data)
    assert bad.held_out.summary.position_rms > 20 * clean.held_out.summary.position_rms
    (words,) = contradicting(bad)
    assert words.startswith("sample 20 (100 times the usual residual) and sample 50 (139 times")
    assert words.endswith("exclude them: --data exclude=20,50")
    assert not contradicting(fit(DELTA, data.excluding([20, 50])))
    found = diagnose(DELTA, data)
    assert (found.verdict.word, {one.sample for one in found.knocked}) == ("at_noise", {20, 50})
    size = found.best.fitted.held_out.summary.position_rms
    assert size == pytest.approx(clean.held_out.summary.position_rms, rel=0.1)


def test_a_refused_geometry_is_put_down_to_them():
    data = moved(measured(0, effects=[vr.Backlash((1e-3,) * 3)]), SLIPPED)
    assert fit(DELTA, data, hold_out=0).implausible
    with pytest.raises(
        FitError, match=r"^sample 20 .*, sample 50 .* and sample 51 .* without"
    ) as e:
        fitted(DELTA, data)
    assert "diagnose" not in str(e.value)  # no effect is put forward
    found = diagnose(DELTA, data)
    assert (found.verdict.word, found.effects) == ("explained", ("backlash",))
    assert "sample 51 (213 sigmas" in found.verdict.text


def test_a_fit_that_one_sample_spoils_is_refused_for_that_sample():
    """Neither another geometry nor the tolerances of the drawing help."""
    with pytest.raises(FitError, match=r"held-out poses .*\. Sample 20 .* contradicts all") as e:
        fitted(DELTA, moved(measured(0, n_poses=60), {20: (0.2, 0, 0)}))
    assert "exclude=20" in str(e.value)
    assert "prior" not in str(e.value)


def test_wrong_readings_of_an_arm_in_a_trackers_frame_are_found():
    session = va.session(va.arm("ur5", 1), 80, 3)
    q = session.q.copy()
    q[10, 2] += 0.01
    q[33, 4] -= 0.02
    data = seen(replace(session, q=q), pose=False)
    (words,) = contradicting(fit(nominal("ur5"), data))
    assert words.endswith("exclude=10,33")
    found = diagnose(nominal("ur5"), data)
    assert (found.verdict.word, {one.sample for one in found.knocked}) == ("at_noise", {10, 33})


def under_load(few, seed=0):
    """A compliant robot that carries 3 kg at a few of its 150 samples only."""
    day = vf.session(seed)
    payload = np.zeros(len(day.reading))
    payload[few] = 3.0
    hidden = [JointCompliance((2e-3,) * 3)]
    samples = vf.samples(replace(day, payload=payload), hidden, vr.THESIS_NOISE, seed)
    return dataset(samples, vr.THESIS_NOISE)


@pytest.mark.wide
@pytest.mark.parametrize("knocked", [(77,), pytest.param((), marks=pytest.mark.slow)])
def test_a_few_samples_under_load_are_not_excluded_but_explained(knocked):
    """They are as far away as outliers, and the others agree without them."""
    samples = moved(under_load([20, 60, 90, 110]), dict.fromkeys(knocked, (4e-3, 0, 0)))
    found = diagnose(DELTA, samples, effects=["joint_compliance", "backlash"])
    assert (found.verdict.word, found.effects) == ("explained", ("joint_compliance",))
    assert tuple(one.sample for one in found.knocked) == knocked
    step = add(fit(DELTA, samples).model, "joint_compliance", samples)
    assert (step.acceptance.against, step.knocked) == ("", knocked)


def test_samples_that_a_condition_separates_are_no_outliers():
    data = under_load([20, 60, 90, 110])
    assert are_separated(data, [20, 60, 90, 110])
    assert not are_separated(data, [20, 60, 90])  # another one carries the load, too
    assert not are_separated(data, [20, 60, 90, 110, 5])
    assert not are_separated(data, [20])  # one sample always has the largest of something
    assert not contradicting(fit(DELTA, data))
    # A law that is not in the catalogue: the platform sinks by 2 mm under load.
    sunk = moved(measured(0), dict.fromkeys((10, 30, 40, 70), (0, 0, -2e-3)))
    loaded = {**sunk.conditions, "payload": 5.0 * np.isin(sunk.numbers, (10, 30, 40, 70))}
    found = diagnose(DELTA, replace(sunk, conditions=loaded), effects=["backlash"])
    assert (found.verdict.word, found.knocked) == ("unexplained", ())
    assert "payload" in found.verdict.text


def test_noise_that_nobody_stated_does_not_hide_an_outlier():
    data = moved(measured(0), {20: (5e-3, 0, 0)})
    unstated = replace(data, pose_cov=np.full_like(data.pose_cov, np.nan))
    (words,) = contradicting(fit(DELTA, unstated))
    assert words.startswith("sample 20 ")


@pytest.mark.parametrize("seed", range(3))
def test_a_missing_effect_and_noise_make_no_outlier(seed):
    for effects in ((), [vr.Backlash((5e-3,) * 3)]):
        assert not contradicting(fit(DELTA, measured(seed, effects=effects)))


@pytest.mark.wide
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], " parallel-cal fit m.yaml s.json --data=exclude=3,20 -o fitted.yaml"),
        (["--prior"], ": the same command with --data exclude=3,20"),
    ],
)
def test_fit_ends_with_the_command_that_fits_without_an_outlier(
    tmp_path, monkeypatch, capsys, options, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    write_model(DELTA, "m.yaml")
    moved(measured(0), {20: SLIPPED[20]}).to_json("s.json")
    with pytest.raises(SystemExit, match="0"):
        main(["fit", "m.yaml", "s.json", "--data", "exclude=3", "--hold-out", "0.25", *options])
    following = capsys.readouterr().out.partition("next:")[2]
    shown = " ".join(following.replace("\\\n", " ").split())
    assert shown == f"check sample 20, and fit without it if wrong{words}"


def test_a_model_that_was_fitted_with_an_outlier_may_be_fitted_without_it():
    """Its error with the outlier proves nothing, so that the new one need not fall."""
    data = moved(measured(0), {20: SLIPPED[20]})
    data = replace(data, sha256="of these samples")
    first = fitted(DELTA, data, hold_out=0.2, free=["chain*.theta"])
    assert first.result.outliers.numbers == (20,)
    left = summarize(first)[3]
    assert left.text == "not known, because sample 20 contradicts all others"
    others = data.select(np.arange(len(data)) != 20)
    others = replace(others, excluded={20: "slipped"})
    again = fitted(first.model, others, hold_out=0.2, free=["chain*.theta"])
    assert not again.acceptance.against
