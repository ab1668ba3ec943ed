"""What people read: units that fit the joint, numbers found by a search, who left what out."""

import numpy as np

from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.model.words import direction_in_words, parameters_in_words
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.simulate import with_effects
from parallel_cal.reporting.blocks import as_text
from parallel_cal.reporting.tables import errors_table, find_given_parameters


def test_winches_err_in_degrees_and_arms_in_arcmin():
    e = {"error": Summary(joint_mean=0.1, joint_rms=0.1)}
    winches, arms = (
        as_text([errors_table(e, Summary(), model)])
        for model in (read_model("config/hangprinter_hp4.yaml"), new_model("delta24"))
    )
    assert winches.splitlines()[1].split() == ["joint", "error,", "mean", "5.73", "deg"]
    assert "343.77  arcmin" in arms


def test_a_found_gear_ratio_is_shown_and_an_unstated_mass_is_not():
    model = new_model("delta24", effects=["gear_transmission_error", "joint_compliance"])
    found = with_effects(model, [("gear_transmission_error", {"ratio": 37.0})])
    assert find_given_parameters(found) == {"gear_transmission_error.ratio"}


def test_a_simulated_compliance_hides_no_masses():
    model = with_effects(new_model("delta24"), [("joint_compliance", {})])
    assert model.value("joint_compliance.joint1.compliance") == 1e-3
    assert model.value("joint_compliance.mass.platform") == 0
    assert model.value("joint_compliance.mass.arm") == 0


def test_samples_excluded_by_a_loss_are_not_reported_as_excluded_on_request():
    data = Dataset.from_arrays(["a"], np.arange(4.0)[:, None], np.zeros((4, 3)))
    assert data.excluding([2], "by the loss").warnings == ("excluded by the loss: sample 2",)
    assert data.excluding([2]).warnings == ("excluded on request: sample 2",)


def test_parameters_that_several_chains_share_are_named_once():
    table = new_model("linear_delta").table
    names = ["chain1.D_x", "chain2.D_x", "chain3.D_x", "chain1.D_y", "chain2.D_y", "chain2.Lb"]
    assert parameters_in_words(names, table) == (
        "D_x of chain 1, 2, 3 and D_y of chain 1, 2 and Lb of chain 2"
    )
    cable = new_model("cable").table
    assert parameters_in_words(["line1.offset", "spool2.R"], cable) == (
        "error of the line's length at reading zero of line 1 and radius of spool 2"
    )
    assert parameters_in_words(["La", "Lb"], new_model("delta_nominal").table) == (
        "arm length, rod length"
    )
    nominal = new_model("delta_nominal").table
    assert parameters_in_words(["Lb", "chain1.theta", "chain3.theta"], nominal) == (
        "rod length and chain's direction about z of chain 1, 3"
    )


def test_a_direction_names_the_joints_of_an_effect():
    table = new_model("delta24", effects=["encoder_eccentricity"]).table
    parts = {f"encoder_eccentricity.joint{k}.sin": 1.0 for k in (3, 1)} | {"chain2.Lb": -1.0}
    assert direction_in_words(parts, table) == (
        "sine part of joint 1, 3 of encoder eccentricity against rod length of chain 2"
    )
