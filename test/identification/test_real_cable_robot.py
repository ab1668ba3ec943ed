"""A measured robot: the Hangprinter HP4, from its table by command line to a better model.

The reference numbers are of an independent computation on the same 37 poses: line errors (closure
rows), unweighted, each pose judged by a fit that left it out.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.cli import main as cli
from parallel_cal.identification.fit import fit
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import Noise
from parallel_cal.recordings.loading import load_dataset

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "real/hangprinter_hp4/hp4_2021-12-14.csv"
MODEL = ROOT / "config/hangprinter_hp4.yaml"
COLUMNS = ROOT / "config/columns/hangprinter_hp4.yaml"
EACH_POSE = 1e-3  # share left out: as many folds as poses
BUILDUP = "spool_buildup.Q"


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """The table imported as a person would."""
    path = tmp_path_factory.mktemp("hp4") / "hp4.json"
    assert run("import-csv", TABLE, "--columns", COLUMNS, "-o", path) == 0
    return path


@pytest.fixture(scope="module")
def dataset(samples):
    return load_dataset(samples)


@pytest.fixture(scope="module")
def model():
    return read_model(MODEL)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def line_errors(model, dataset, index=slice(None)):
    """|P - A| - |A| - line let out (n, 4) in m, of each line at the measured position."""
    turns = np.tile(np.eye(3).ravel(), (len(dataset), 1))
    x = np.column_stack([dataset.q, dataset.r, turns])[index]
    return model.structure.closure_batch(x, np.zeros((len(x), 0)), model.values)[0]


def left_out(model, dataset, **how):
    """Line errors (37, 4) at each pose, of a fit that did not see it."""
    observations, free = observe(model, dataset), ~model.fixed
    found = []
    for i in range(len(dataset)):
        rest = estimate(model, observations.select(np.arange(len(dataset)) != i), free, **how)
        found.append(line_errors(model.with_values(rest.values), dataset, [i])[0])
    return np.array(found)


@pytest.mark.parametrize(
    ("effects", "expected"),
    [([], (1.557e-3, 1.795e-3)), (["spool_buildup"], (1.165e-3, 1.337e-3))],
)
def test_unweighted_line_errors_are_those_of_the_independent_computation(
    model, dataset, effects, expected
):
    for effect in effects:
        model = model.with_effect(effect)
    found = estimate(model, observe(model, dataset), ~model.fixed, weighted=False)
    model = model.with_values(found.values)
    assert rms(line_errors(model, dataset)) == pytest.approx(expected[0], abs=1e-6)
    assert rms(left_out(model, dataset, weighted=False)) == pytest.approx(expected[1], abs=1e-6)
    if effects:
        scale = np.sqrt(found.chi2_per_dof)
        sigma = scale * found.sigma[model.table.index_of(BUILDUP)]
        assert model.value(BUILDUP) == pytest.approx(0.098e-3, abs=0.5e-6)
        assert sigma == pytest.approx(0.010e-3, abs=0.5e-6)


def test_spool_build_up_added_by_command_line_lowers_the_held_out_error(samples, tmp_path, capsys):
    plain, better = tmp_path / "plain.yaml", tmp_path / "better.yaml"
    fold = ("--hold-out", EACH_POSE, "--json")
    assert run("fit", MODEL, samples, "-o", plain, *fold) == 0
    before = json.loads(capsys.readouterr().out)
    assert run("add", plain, "spool_buildup", samples, "-o", better, *fold) == 0
    after = json.loads(capsys.readouterr().out)
    assert before["noise_from"] == dict.fromkeys(("joint", "pose"), "estimated from the residuals")
    errors = [d["held_out"]["after"]["position_rms"] for d in (before, after)]
    np.testing.assert_allclose(errors, [2.85e-3, 2.13e-3], rtol=0.02)
    assert 0.08e-3 < after["parameters"][BUILDUP]["value"] < 0.12e-3
    assert after["rank"] == after["free"] == 19
    lines = [d["held_out"]["after"]["closure_rms"] for d in (before, after)]
    assert lines[0] > 1.75e-3
    assert lines[1] < 1.36e-3
    written = [step["held_out"]["after"] for step in read_model(better).history[1:]]
    assert [e["closure_rms"] for e in written] == lines


def test_the_closure_error_of_the_documents_is_that_of_the_lines(model, dataset):
    found = fit(model.with_effect("spool_buildup"), dataset, hold_out=0)
    document = found.document()
    assert document["before"]["closure_rms"] == pytest.approx(rms(line_errors(model, dataset)))
    assert document["after"]["closure_rms"] == pytest.approx(rms(line_errors(found.model, dataset)))
    assert document["held_out"]["after"]["closure_rms"] is None
    height = np.tile([True, True, False, False, False, False], (len(dataset), 1))
    blind = fit(model, replace(dataset, measured=height), hold_out=0, prior=True).document()
    assert blind["after"]["closure_rms"] is None


def test_people_see_the_closure_error_of_a_robot_with_more_lines_than_freedoms(samples, capsys):
    assert run("compare", MODEL, samples) == 0
    shown = capsys.readouterr().out
    assert re.search(r"closure, rms of its rows +7234\.15  um", shown)
    assert "noise floor" not in shown


def test_estimated_noise_cannot_show_whether_the_model_is_complete(model, dataset):
    found = fit(model, dataset, hold_out=0)
    document = found.document()
    assert set(document["noise_floor"]) == set(document["before"])
    assert set(document["noise_floor"].values()) == {None}
    assert document["chi2_band"] == [None, None]
    assert sum("it was estimated from the residuals" in w for w in document["warnings"]) == 1
    assert not any("chi2/dof" in w for w in document["warnings"])
    # Without tolerances, which do not grow with the noise that is found.
    found = fit(model, dataset, hold_out=0, prior=False)
    assert found.estimate.chi2_per_dof == pytest.approx(1, abs=0.03)
    joint, position = (one["value"] for one in found.document()["noise"])
    stated = replace(model, noise=Noise(joint, position))
    known = fit(stated, dataset, hold_out=0, prior=False)
    assert not known.observations.noise_assumed
    ratio = found.estimate.sigma[found.free] / known.estimate.sigma[found.free]
    np.testing.assert_allclose(ratio, np.sqrt(known.estimate.chi2_per_dof), rtol=1e-3)


def test_noise_that_nobody_states_is_unknown_and_no_reason_to_refuse(model, dataset):
    silent = replace(model, noise=Noise())
    assert observe(silent, dataset).noise_from == {"joint": "not stated", "pose": "not stated"}
    assert observe(silent, dataset, joint_sigma=0.35).noise_from["joint"] == "option"
    assert observe(silent, dataset).noise_assumed
    assert observe(model, dataset).noise_assumed
    stated = replace(model, noise=replace(model.noise, assumed=False))
    assert not observe(stated, dataset).noise_assumed


def test_only_the_ratio_of_assumed_figures_moves_the_estimates(model, dataset):
    noise = model.noise
    tenfold = replace(noise, joint=10 * noise.joint, position=10 * noise.position)
    one, ten = (
        fit(replace(model, noise=n).with_effect("spool_buildup"), dataset, hold_out=0)
        for n in (noise, tenfold)
    )
    tolerance = model.with_effect("spool_buildup").table.tolerance
    np.testing.assert_allclose(
        one.model.values / tolerance, ten.model.values / tolerance, atol=1e-3
    )
    np.testing.assert_allclose(one.estimate.sigma, ten.estimate.sigma, rtol=1e-3)


def test_build_up_is_found_first_and_nothing_claims_that_the_noise_is_reached(model, dataset):
    from parallel_cal.diagnosis.diagnose import diagnose

    found = diagnose(model, dataset).document()
    assert found["candidates"][0]["effect"] == "spool_buildup"
    assert found["candidates"][0]["p_value"] < 1e-12
    assert found["effects"] == ["spool_buildup"]
    [cause] = found["missing"]
    assert cause["probability"] > 0.95
    assert (found["verdict"], found["left"]) == ("partly_explained", "unknown")


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_a_robust_loss_finds_its_own_scale_where_the_noise_is_assumed(model, dataset, loss):
    noise, model = model.noise, model.with_effect("spool_buildup")
    tenfold = replace(noise, joint=10 * noise.joint, position=10 * noise.position)
    one, ten = (
        fit(replace(model, noise=n), dataset, hold_out=0, loss=loss) for n in (noise, tenfold)
    )
    np.testing.assert_allclose(one.estimate.weight, ten.estimate.weight, atol=1e-3)
    assert one.estimate.weight.min() < 0.8


def test_a_robust_loss_copes_with_three_gross_outliers(model, dataset):
    wrong = dataset.r.copy()
    wrong[[5, 17, 30]] += [[0.1, 0, 0], [0, -0.06, 0.08], [0, 0.05, 0]]
    spoilt = replace(dataset, r=wrong)
    model = model.with_effect("spool_buildup")
    truth = fit(model, dataset, hold_out=0).model
    pulled = fit(model, spoilt, hold_out=0).model
    robust = fit(model, spoilt, hold_out=0, loss="cauchy").model
    clean = rms(line_errors(truth, dataset))
    assert rms(line_errors(pulled, dataset)) > 2 * clean
    assert rms(line_errors(robust, dataset)) < 1.1 * clean
    assert robust.value(BUILDUP) == pytest.approx(truth.value(BUILDUP), abs=0.02e-3)
