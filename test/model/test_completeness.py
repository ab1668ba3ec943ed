"""How many parameters a complete model has: the thesis' formulas, its table, and the rank."""

import json

import numpy as np
import parameter_counts
import pytest
from test_serial import PUMA

from parallel_cal.base.errors import ModelError
from parallel_cal.identification import completeness
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

# Table 3.1: robot, joint-link-trains, R, P, SS, E, L, C.
TABLE_3_1 = [
    ("SCARA", "2RP", 2, 1, 0, 3, 0, 16),
    ("Puma", "6R", 6, 0, 0, 6, 0, 30),
    ("Kite", "3R + 2R", 5, 0, 0, 2, 1, 29),
    ("PantoScope", "R(2R/2S)2R + 4R", 9, 0, 1, 2, 2, 48),
    ("Argos", "3[R(2R/2S)S]", 3 * 3, 0, 3 * 1, 3, 5, 69),
    ("Argos", "3[R(2R/5R)3R]", 3 * 11, 0, 0, 3, 5, 138),
    ("Agile Eye", "3[3R]", 3 * 3, 0, 0, 3, 2, 48),
    ("Agile Eye", "3[2RS]", 3 * 2, 0, 0, 3, 2, 39),
    ("Agile Eye", "3[5R]", 3 * 5, 0, 0, 3, 2, 66),
    ("Delta-Cardan", "3[5R]", 3 * 5, 0, 0, 3, 2, 66),
    ("Linear-Delta", "3[P(2S/2S)]", 0, 3 * 1, 3 * 2, 3, 5, 48),
    ("Linear-Delta", "3[P(5R/5R)]", 3 * 10, 3 * 1, 0, 3, 5, 132),
    ("Delta", "3[R(2S/2S)]", 3 * 1, 0, 3 * 2, 3, 5, 54),
    ("Delta", "3[R(5R/5R)]", 3 * 11, 0, 0, 3, 5, 138),
    ("Stewart", "6[2S]", 0, 0, 6 * 1, 0, 5, 42),
    ("Stewart", "6[SPS]", 0, 6 * 1, 0, 6, 5, 48),
    ("Stewart", "6[2RP3R]", 6 * 5, 6 * 1, 0, 6, 5, 138),
]


@pytest.mark.parametrize("row", TABLE_3_1, ids=lambda row: f"{row[0]} {row[1]}")
def test_every_row_of_table_3_1(row):
    *_, R, P, SS, E, L, C = row
    assert parameter_counts.multi_loop(R, P, SS, E, L) == C


@pytest.mark.parametrize("row", TABLE_3_1[:2], ids=lambda row: row[0])
def test_an_open_chain_counts_the_same_by_everetts_formula(row):
    _, _, R, P, _, E, _, C = row
    assert parameter_counts.serial(R, P) == C  # eq. 3.1
    assert R + P == E  # an open chain has an encoder in every joint


def test_one_loop_counts_the_same_by_lins_formula_with_one_frame():
    kite = parameter_counts.single_loop(R=5, P=0, SS=0, E=2)  # eq. 3.2
    assert kite == parameter_counts.multi_loop(5, 0, 0, 2, L=1, F=1)
    assert kite + 6 == 29


def test_the_examples_in_a_plane_and_on_a_sphere():
    assert parameter_counts.planar_or_spherical(R=0, S=6, E=3, L=2) == 18  # figure 3.2
    assert parameter_counts.planar_or_spherical(R=9, S=0, E=3, L=2) == 21  # Gosselin's 3[3R]


# Mechanism, parameters left out, C by the formulas with both frames arbitrary, frames it has.
COMPLETE = [
    ("scara16", (), parameter_counts.serial(R=2, P=1), 2),
    ("serial", (), parameter_counts.serial(R=6, P=0), 2),
    ("delta54", (), parameter_counts.multi_loop(R=3, P=0, SS=6, E=3, L=5), 2),
    ("linear_delta", (), parameter_counts.multi_loop(R=0, P=3, SS=6, E=3, L=5), 2),
    ("stewart42", (), parameter_counts.multi_loop(R=0, P=0, SS=6, E=0, L=5), 2),
    ("planar_stewart", (), parameter_counts.planar_or_spherical(R=0, S=6, E=3, L=2), 2),
    ("argos27", (), parameter_counts.multi_loop(R=6, P=0, SS=0, E=3, L=2), 0),
]


def mechanism(name):
    return load_mechanism(name, **(PUMA if name == "serial" else {}))


@pytest.mark.wide
@pytest.mark.parametrize(("name", "without", "C", "frames"), COMPLETE, ids=lambda v: str(v))
def test_the_rank_of_the_identification_jacobian_is_what_the_formulas_count(
    name, without, C, frames
):
    found = completeness.compute_completeness(mechanism(name), without=without)
    assert found.needed == C
    assert found.rank == found.parameters == C - 6 * (2 - frames)
    assert found.redundant == 0
    assert found.is_complete(frames)
    assert frames == 0 or not found.is_complete(frames - 1)


SIMPLIFIED = [  # C by the formulas with both frames arbitrary; what the smaller model neglects
    (
        "argos9",
        parameter_counts.planar_or_spherical(R=3, S=3, E=3, L=2),
        "motor axes off the circles",
    ),
    ("delta24", parameter_counts.multi_loop(R=3, P=0, SS=6, E=3, L=5), "set P1 and the platform"),
    ("delta_nominal", parameter_counts.multi_loop(R=3, P=0, SS=6, E=3, L=5), "unequal chains"),
]


@pytest.mark.parametrize(("name", "C", "neglected"), SIMPLIFIED, ids=lambda v: str(v))
def test_a_simplified_model_with_both_frames_is_still_less_than_complete(name, C, neglected):
    found = completeness.compute_completeness(load_mechanism(name))
    assert found.rank == found.parameters
    assert found.needed < C, neglected


def test_the_rank_does_not_depend_on_the_robot_or_the_poses_drawn():
    ranks = {
        completeness.compute_completeness(load_mechanism("delta54"), seed=seed).rank
        for seed in range(3)
    }
    assert ranks == {54}


@pytest.mark.parametrize("name", load_mechanism("scara16").parameters.names)
def test_a_scara_without_any_one_parameter_is_not_complete(name):
    found = completeness.compute_completeness(load_mechanism("scara16"), without=[name])
    assert (found.rank, found.needed, found.is_complete()) == (15, 16, False)


def test_the_papers_51_parameters_hold_48_independent_ones_and_54_with_the_hubs():
    without_hubs = completeness.compute_completeness(
        load_mechanism("delta51"), without=["chain*.p_*"]
    )
    assert (without_hubs.parameters, without_hubs.rank, without_hubs.needed) == (51, 48, 54)
    with_hubs = completeness.compute_completeness(load_mechanism("delta51"))
    assert (with_hubs.parameters, with_hubs.rank, with_hubs.needed) == (60, 54, 54)
    assert with_hubs.is_complete()
    assert with_hubs.redundant == 6  # an arm turned on its axis, and slid along it, three times


@pytest.mark.parametrize("name", ["delta51", "delta54"])
def test_a_perfect_delta_shows_42_of_them_which_are_the_ones_free_by_default(name):
    """Its platform does not tilt, so a ball on the platform is a point on the base (eq. 13)."""
    delta = load_mechanism(name)
    assert completeness.compute_completeness(delta, spread=0).rank == 42
    free = completeness.compute_completeness(delta, spread=0, without=delta.fixed)
    assert (free.parameters, free.rank) == (42, 42)


def test_the_papers_parallelogram_lacks_one_coordinate_of_the_base_frame():
    found = completeness.compute_completeness(load_mechanism("parallelogram"))
    C = parameter_counts.planar_or_spherical(R=4, S=0, E=1, L=1)
    assert (found.parameters, found.rank, found.needed) == (10, 10, C) == (10, 10, 11)
    perfect = completeness.compute_completeness(
        load_mechanism("parallelogram"), spread=0, without=["h"]
    )
    assert (perfect.parameters, perfect.rank) == (9, 6)  # section III-B
    fixed = load_mechanism("parallelogram").fixed
    free = completeness.compute_completeness(
        load_mechanism("parallelogram"), spread=0, without=fixed
    )
    assert (free.parameters, free.rank) == (6, 6)  # eq. 73


def test_poses_taken_for_the_rank_close_exactly():
    model = new_model("delta54")
    x = completeness.closed_poses(model, 40, np.random.default_rng(0))
    phi, _, _ = model.structure.closure_batch(x, np.empty((40, 0)), model.values)
    assert np.abs(phi).max() < 1e-11
    again = Kinematics(model).direct(x[:, :3])
    assert np.abs(again.position - x[:, 3:6]).max() < 1e-12


def test_a_frame_moved_on_purpose_is_felt_as_the_frame_jacobian_says():
    """Moving {P} by 1 um along its own y, or {B} about its z by 1 urad, by finite difference."""
    model = new_model("delta54")
    x = completeness.closed_poses(model, 5, np.random.default_rng(0))
    J = completeness.frame_jacobian(model, x)
    r, R = x[:, 3:6], x[:, 6:].reshape(-1, 3, 3)
    platform = np.hstack([x[:, :3], r + 1e-6 * R[:, :, 1], x[:, 6:]])
    c, s = np.cos(1e-6), np.sin(1e-6)
    Z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    base = np.hstack([x[:, :3], r @ Z.T, (Z @ R).reshape(-1, 9)])
    length = model.mechanism.length
    for moved, column, scale in ((platform, J[:, 7], 1.0), (base, J[:, 5], length)):
        felt = model.structure.closure_batch(moved, np.empty((5, 0)), model.values)[0].ravel()
        assert felt / 1e-6 == pytest.approx(column * scale, abs=1e-5)


@pytest.mark.wide
def test_a_robot_that_cannot_be_assembled_is_refused():
    model = new_model("parallelogram", {"l2": 0.1})
    with pytest.raises(ModelError, match="0 of 5 poses around home close"):
        completeness.closed_poses(model, 5, np.random.default_rng(0))


def test_the_command_shows_a_mechanism_s_numbers_and_whether_they_are_complete(run_cli):
    shown = run_cli("mechanisms", "planar_stewart")
    assert shown.splitlines()[-1].endswith("any place of the frames of base and platform")
    assert "pantograph's shift along the motor axis" in run_cli("mechanisms", "argos27")
    given = json.loads(run_cli("mechanisms", "delta_nominal", "--json"))
    assert given["completeness"]["frames"] == 1
    assert given["completeness"]["rank"] == len(given["parameters"]) == 6
    more = run_cli("mechanisms", "cable")
    assert "26 parameters, 20 of them independent" in more
