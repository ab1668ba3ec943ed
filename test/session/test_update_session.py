"""A session that updates a calibration judges its models as a fit with --update does."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from test_recheck import calibrated, session
from typer.testing import CliRunner

from parallel_cal.base.progress import ignore_progress
from parallel_cal.cli.main import application
from parallel_cal.identification.fit import Prepared
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.recheck import recheck
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.session.saving import compare_with_model_in_use
from parallel_cal.session.session import Session
from parallel_cal.session.steps import UnprovenStepError, fitted
from parallel_cal.workbench.views import view

SAMPLES = 16  # hardly more rows than the geometry has parameters: the prior counts


@pytest.fixture
def updated(tmp_path):
    """A session with samples of a robot whose zero of joint 2 has jumped, and their fit."""
    today = session(SAMPLES, np.random.default_rng(10), (0.0, 2e-3, 0.0))
    today.to_json(tmp_path / "today.json")
    write_model(calibrated(), tmp_path / "robot.yaml")
    found = Session.new(
        tmp_path / "session",
        read_model(tmp_path / "robot.yaml"),
        [tmp_path / "today.json"],
        fitting=FitOptions(update=True),
    )
    found.fit()
    return found


@pytest.mark.wide
def test_page_and_command_line_diagnose_an_update_with_the_numbers_of_its_fit(updated, tmp_path):
    words = ["diagnose", str(tmp_path / "robot.yaml"), str(tmp_path / "today.json")]
    words += ["--update"]
    said = CliRunner().invoke(application(words), words).stdout
    assert "parallel-cal report" in said
    assert said.count("--update") == said.count("parallel-cal ")
    done = CliRunner().invoke(application(words), [*words, "--json"])
    line, page = json.loads(done.stdout), view(updated, ignore_progress)
    fitted = updated.state.errors["position_rms"]
    assert line["baseline"]["position_rms"] == pytest.approx(fitted, rel=1e-5)
    now = {tile["name"]: tile["values"][0][0] for tile in page["tiles"]}["now"]
    assert now.split()[0] == f"{1e6 * fitted:.1f}"
    assert f"chi2/dof {line['chi2_per_dof']['baseline']:.2f}," in page["chi2"]
    assert (page["verdict"]["word"], line["left"]) == (line["verdict"], "no")
    assert page["answers"]["is_left"] == line["left"]
    assert updated.state.verdict == line["verdict"]


@pytest.mark.wide
def test_the_last_calibration_stays_whatever_its_update_lacks(tmp_path):
    """It is the prior of the next diagnosis; the proposed command wrote over it."""
    today = session(40, np.random.default_rng(10), (0.0, 0.0, 0.0))
    rippled = replace(today, q=today.q + 2e-3 * np.sin(23 * today.q))
    rippled.to_json(tmp_path / "today.json")
    write_model(calibrated(), tmp_path / "better.yaml")
    words = ["diagnose", str(tmp_path / "better.yaml"), str(tmp_path / "today.json"), "--update"]
    words += ["--effect", "gear_transmission_error"]
    said = " ".join(CliRunner().invoke(application(words), words).stdout.split())
    assert re.search(r"better\.yaml gear_.* --update -o better_updated\.yaml", said)


@pytest.mark.wide
def test_a_model_of_an_update_is_saved_by_the_error_that_its_fit_had(updated, tmp_path):
    """The last calibration counts once: the model of the session knows the samples already."""
    data = updated.dataset
    found = compare_with_model_in_use(
        updated.model,
        updated.state,
        lambda: (data, updated.options_for(data)),
        tmp_path / "robot.yaml",
    )
    own = updated.state.errors["position_rms"]
    assert found.errors.position_rms == pytest.approx(own, rel=1e-5)
    again = Prepared.of(updated.model, data, updated.options).options.prior
    counted_once = updated.options_for(data).prior
    assert counted_once.document() == "mean and covariance of 24 parameters"  # in reports
    assert np.trace(again.covariance) < 0.9 * np.trace(counted_once.covariance)


@pytest.mark.wide
def test_effects_stay_when_a_session_that_updates_excludes_samples(updated):
    drift = updated.state.drift
    updated.add("encoder_gain", force=True, reason="a test")
    assert updated.state.drift == drift
    updated.exclude({3: "a test"})
    assert [effect.name for effect in updated.model.effects] == ["encoder_gain"]
    updated.remove("encoder_gain", force=True)
    last = calibrated()
    sigma = np.sqrt(np.diag(updated.model.covariance) / np.diag(last.covariance))
    geometry = np.diag(last.covariance) > 0
    assert updated.model.table.names == last.table.names
    assert np.median(sigma[geometry]) < 1.5


@pytest.mark.wide
def test_an_effect_that_the_prior_does_not_know_is_known_as_before_any_data():
    known = replace(calibrated())
    data = session(6, np.random.default_rng(3))
    prior = Prepared.of(known, data, FitOptions(update=True)).options.prior
    table = known.with_effect("encoder_gain").table
    larger = prior.of_table(table)
    new = np.array([name not in prior.names for name in table.names])
    assert larger.names == table.names
    assert new.any()
    np.testing.assert_array_equal(larger.mean[new], table.nominal[new])
    assert np.sqrt(np.diag(larger.covariance)[new]) == pytest.approx(table.prior_sigma[new])
    assert not larger.covariance[np.ix_(new, ~new)].any()
    np.testing.assert_array_equal(larger.of_table(known.table).covariance, prior.covariance)


@pytest.mark.parametrize(
    ("samples", "zero", "shift", "verdict"),
    [
        (24, 0.0, 0.0, "unchanged"),
        (24, 0.0, 5e-4, "device_moved"),
        (24, 2e-3, 0.0, "drifted"),
        (8, 0.0, 0.0, "undecided"),
    ],
)
def test_an_update_fails_only_if_it_is_not_known_what_to_use(
    tmp_path, samples, zero, shift, verdict
):
    """That nothing has drifted is a good result: nothing is written then, as by `calibrate`."""
    today = session(samples, np.random.default_rng(6), (0.0, zero, 0.0), (shift, 0.0, -shift))
    today.to_json(tmp_path / "today.json")
    write_model(calibrated(), tmp_path / "robot.yaml")
    words = ["fit", str(tmp_path / "robot.yaml"), str(tmp_path / "today.json"), "--update"]
    words += ["-o", str(tmp_path / "updated.yaml")]
    assert recheck(calibrated(), today).verdict == verdict
    done = CliRunner().invoke(application(words), words)
    assert (tmp_path / "updated.yaml").exists() == (verdict == "drifted")
    assert (done.exit_code == 0) == (verdict != "undecided")
    if verdict == "undecided":
        assert isinstance(done.exception, UnprovenStepError)
        return
    assert ("not written: " in done.stdout) == (verdict != "drifted")
    assert ("keep " in done.stdout) == (verdict != "drifted")
    found = json.loads(CliRunner().invoke(application(words), [*words, "--json"]).stdout)
    assert found["drift"]["verdict"] == verdict
    assert (found["output"] is None) == (verdict != "drifted")
    assert found["acceptance"]["accepted"] == (verdict == "drifted")


def test_a_step_is_refused_in_one_place_and_none_of_a_robot_that_is_as_it_was():
    """The command forced each update, and refused it then by a rule of its own."""
    still = session(24, np.random.default_rng(6), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    step = fitted(calibrated(), still, update=True)
    assert step.result.drift.verdict == "unchanged"
    assert step.acceptance.against == step.result.drift.warnings[0]
    with pytest.raises(UnprovenStepError, match="do not decide whether the robot has drifted"):
        fitted(calibrated(), still.select(np.arange(8)), update=True)
