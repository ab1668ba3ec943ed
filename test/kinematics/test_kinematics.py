"""Status, limits, uncertainty and input checks of the direct and inverse problem."""

import pickle
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from datasets import measured
from distant_poses import distant_poses

from parallel_cal.base.errors import ModelError, SolveError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.all_solutions import inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Solutions, Status
from parallel_cal.kinematics.solutions import make_unsolved, stack_solutions
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.virtual import robot as vr


@pytest.fixture(scope="module")
def mock_up():
    return Kinematics(new_model("delta54", vr.TABLE_5_18))


def test_a_point_out_of_reach_is_unreachable(mock_up):
    assert mock_up.inverse([0, 0, 0.6]).status == Status.UNREACHABLE
    assert mock_up.inverse([1.0, 0, 0.2]).status == Status.UNREACHABLE


def test_joints_beyond_the_stops_are_solved_and_marked(mock_up):
    answer = mock_up.direct(np.radians([-35, 0, 0]))
    assert answer.status == Status.OUTSIDE_LIMITS
    assert answer.residual < 1e-12


def test_arms_stretched_into_one_line_are_singular():
    """Arm and rod of chain 1 in one line: an inverse singularity (6.2.4)."""
    model = new_model("delta24")
    q = Kinematics(model).inverse([0, 0, 0.2]).joints
    p = model.table.mapping(model.values)
    angle = q[0] + np.arctan2(p["chain1.La_y"], p["chain1.La_x"])
    reach = np.hypot(p["chain1.La_x"], p["chain1.La_y"]) + p["chain1.Lb"]
    foot = np.array([p["chain1.D_x"], 0, p["chain1.D_y"]])
    stretched = foot + reach * np.array([np.cos(angle), 0, np.sin(angle)])
    free = model.with_values(
        model.values
        * np.where(np.array(["Lb" in n and "chain1" not in n for n in model.table.names]), 2, 1)
    )
    assert Kinematics(free).inverse(stretched).status == Status.SINGULAR
    beyond = foot + (reach + 1e-6) * np.array([np.cos(angle), 0, np.sin(angle)])
    assert Kinematics(free).inverse(beyond).status == Status.UNREACHABLE
    near = foot + (reach - 1e-12) * np.array([np.cos(angle), 0, np.sin(angle)])
    assert Kinematics(free).inverse(near).status == Status.SINGULAR


def test_nan_and_infinity_are_invalid_input_and_spoil_no_neighbour(mock_up):
    answers = mock_up.inverse([[0, 0, 0.2], [np.nan, 0, 0.2], [0, np.inf, 0.2], [0, 0.01, 0.2]])
    assert [Status(s).text for s in answers.status] == [
        "converged",
        "invalid_input",
        "invalid_input",
        "converged",
    ]
    assert np.isnan(answers.joints[1]).all()


def test_wrong_number_of_joints_is_an_error_that_names_them(mock_up):
    with pytest.raises(SolveError, match=r"2 joint values given.*3 joints: joint1, joint2, joint3"):
        mock_up.direct([0.1, 0.2])


def test_single_and_batch_calls_answer_the_same(mock_up):
    targets = mock_up.model.mechanism.sample(50, np.random.default_rng(0))
    batch = mock_up.inverse(targets)
    singles = [mock_up.inverse(t) for t in targets]
    assert all(np.array_equal(b.joints, s.joints) for b, s in zip(batch, singles, strict=True))


def test_fk_and_ik_are_other_names_of_direct_and_inverse(mock_up):
    joints = mock_up.ik([0.01, 0.02, 0.2]).joints
    assert np.array_equal(joints, mock_up.inverse([0.01, 0.02, 0.2]).joints)
    assert mock_up.fk(joints).position == pytest.approx([0.01, 0.02, 0.2])


def test_a_start_keeps_its_assembly_mode(mock_up):
    everything = inverse_all(mock_up.model, [0.01, 0.02, 0.2])
    other = everything[len(everything) - 1]
    moved = mock_up.inverse([0.011, 0.02, 0.2], start=other, keep_branch=True)
    assert np.abs(moved.joints - other.joints).max() < 0.05
    assert np.abs(moved.joints - mock_up.inverse([0.011, 0.02, 0.2]).joints).max() > 0.1


def test_a_start_that_leads_outside_the_limits_yields_to_the_solution_inside():
    """From there, Newton's method takes joint 1 half a turn beyond the nearest solution."""
    kinematics = Kinematics(new_model("argos27"))
    start = kinematics.direct([0.5191, -0.7350, -0.3644])
    wanted = kinematics.direct([-0.6889, -0.0841, -0.4883])
    found = kinematics.inverse(wanted.position, wanted.rotation, start=start)
    assert found.status == Status.CONVERGED
    assert found.joints == pytest.approx(wanted.joints, abs=1e-12)
    kept = kinematics.inverse(wanted.position, wanted.rotation, start=start, keep_branch=True)
    assert kept.status == Status.OUTSIDE_LIMITS
    assert kept.joints == pytest.approx([2.45269265, -0.0841, -0.4883], abs=1e-8)
    onward = kinematics.inverse(wanted.position, wanted.rotation, start=kept)
    assert onward.joints == pytest.approx(wanted.joints, abs=1e-12)


@pytest.mark.parametrize("name", ["argos27", "delta54", "stewart42"])
def test_an_answer_from_a_start_is_inside_the_limits_if_one_without_it_is(name):
    kinematics = Kinematics(new_model(name))
    poses = distant_poses(kinematics, 1000)
    start, r, R = poses[:500], poses.position[500:], poses.rotation[500:]
    cold, warm = kinematics.inverse(r, R), kinematics.inverse(r, R, start=start)
    assert warm.ok[cold.ok].all()
    kept = kinematics.inverse(r, R, start=start, keep_branch=True)
    assert kept.ok.all() == (name != "argos27")
    for ok, same in ((kept.ok, kept), (warm.ok & ~kept.ok, cold)):
        assert np.array_equal(warm.configuration.rows[ok], same.configuration.rows[ok])
    lost = ~warm.ok
    assert np.array_equal(warm.configuration.rows[lost], kept.configuration.rows[lost])
    assert np.array_equal(warm.status[lost], kept.status[lost])


def test_a_start_that_does_not_converge_yields_to_the_solution_without_it():
    model = new_model("argos27").with_effect("backlash")
    rng = np.random.default_rng(1)
    q, direction = rng.uniform(-0.7, 0.7, (2, 40, 3)).round(3)
    at = {f"direction.{joint}": np.sign(direction[:, i]) for i, joint in enumerate(model.joints)}
    kinematics = Kinematics(model, quick=True)
    pose, nowhere = kinematics.direct(q, at), stack_solutions([make_unsolved(model)] * 40)
    lost = kinematics.inverse(pose.position, pose.rotation, at, nowhere, keep_branch=True)
    assert (lost.status == Status.NOT_CONVERGED).all()
    for start in (nowhere, pose[::-1]):
        found = kinematics.inverse(pose.position, pose.rotation, at, start)
        assert found.ok.all()
        assert found.joints == pytest.approx(q, abs=1e-10)
    assert kinematics.direct(q, at, nowhere).position == pytest.approx(pose.position, abs=1e-12)


def test_pose_covariance_is_the_spread_of_answers_over_parameter_draws(mock_up):
    model = mock_up.model
    rng = np.random.default_rng(3)
    root = rng.standard_normal((54, 54)) * 2e-6
    uncertain = Kinematics(model.with_values(model.values, root @ root.T))
    q = np.array([0.5, 0.55, 0.6])
    predicted = uncertain.direct_covariance(uncertain.direct(q))
    draws = model.values + rng.standard_normal((4000, 54)) @ root.T
    spread = [Kinematics(model.with_values(v)).direct(q) for v in draws[:400]]
    centre = mock_up.direct(q)
    pose = np.array(
        [
            [*(s.position - centre.position), *rotation_vector(s.rotation @ centre.rotation.T)]
            for s in spread
        ]
    )
    assert np.sqrt(np.diag(np.cov(pose.T))) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.12)


def test_the_covariance_of_many_answers_is_that_of_each(mock_up):
    model = mock_up.model
    uncertain = Kinematics(model.with_values(model.values, 1e-10 * np.eye(54)))
    found = uncertain.direct([[0.5, 0.55, 0.6], [0.7, 0.2, 0.4]])
    for covariance in (uncertain.direct_covariance, uncertain.inverse_covariance):
        assert covariance(found) == pytest.approx(np.array([covariance(one) for one in found]))
    at = {"temperature": 30.0}
    assert uncertain.direct_covariance(found[:1], at).shape == (1, 6, 6)


def test_covariance_of_both_problems_holds_for_what_an_identification_left_uncertain():
    """Its parameters are known together, forty times better than each alone would suggest."""
    known = fit(new_model("delta54"), measured(1), hold_out=0).model
    size, directions = np.linalg.eigh(known.covariance)
    root = directions * np.sqrt(np.clip(size, 0, None))
    draws = np.random.default_rng(2).standard_normal((400, len(size)))
    drawn = [Kinematics(known.with_values(known.values + root @ draw)) for draw in draws]
    kinematics = Kinematics(known)
    joints, position = np.array([0.5, 0.55, 0.6]), [0.05, -0.05, 0.15]
    pose, answer = kinematics.direct(joints), kinematics.inverse(position)
    poses = np.array([k.direct(joints).position for k in drawn]) - pose.position
    turned = np.array([k.inverse(position).joints for k in drawn]) - answer.joints
    for spread, predicted in (
        (np.cov(poses.T), kinematics.direct_covariance(pose)[:3, :3]),
        (np.cov(turned.T), kinematics.inverse_covariance(answer)),
    ):
        ratios = np.linalg.eigvals(np.linalg.solve(predicted, spread)).real
        assert np.abs(ratios - 1).max() < 0.25  # in every direction, not only along the axes


def test_the_last_reading_inside_the_limits_is_inside(mock_up):
    low, high = mock_up.model.mechanism.joint_limits[0]
    for joint, status in ((low, 0), (low - 1e-12, 3), (high, 0), (high + 1e-12, 3)):
        assert mock_up.direct([joint, 0.5, 0.5]).status == status
        assert mock_up.direct([[joint, 0.5, 0.5]]).status == status


def test_rods_too_short_to_meet_are_unreachable_in_the_direct_problem():
    model = new_model("delta24", {f"chain{i}.Lb": 0.08 for i in (1, 2, 3)})
    answer = Kinematics(model).direct([0.0, 0.0, 0.0])
    assert answer.status == Status.UNREACHABLE
    assert answer.residual > 1e-3


def test_backlash_moves_the_answer_by_half_its_width_with_the_direction():
    plain = new_model("delta54", vr.TABLE_5_18)
    values = {**vr.TABLE_5_18, "backlash.joint2.width": 4e-4}
    model = new_model("delta54", values, effects=["backlash"])
    q = np.array([0.5, 0.5, 0.5])
    up = Kinematics(model).direct(q, at={"direction.joint2": 1.0})
    expected = Kinematics(plain).direct(q - [0, 2e-4, 0])
    assert np.abs(up.position - expected.position).max() < 1e-14
    resting = Kinematics(model).direct(q)
    assert np.abs(resting.position - Kinematics(plain).direct(q).position).max() < 1e-14


def test_effects_hold_in_the_inverse_too():
    names = ["encoder_eccentricity", "backlash"]
    model = new_model("delta54", vr.TABLE_5_18, effects=names)
    model = model.with_values(
        model.values + 1e-3 * np.array(["sin" in n or "width" in n for n in model.table.names])
    )
    at = {"direction.joint1": 1.0, "direction.joint2": -1.0, "direction.joint3": 1.0}
    kinematics = Kinematics(model)
    targets = model.mechanism.sample(100, np.random.default_rng(4))
    joints = kinematics.inverse(targets, at=at)
    assert np.abs(kinematics.direct(joints.joints, at).position - targets).max() < 1e-13


@pytest.mark.parametrize("name", ["encoder_eccentricity", "backlash"])
def test_an_effect_at_zero_changes_nothing(name):
    plain, model = new_model("delta54"), new_model("delta54").with_effect(name)
    q = np.array([0.4, 0.5, 0.6])
    assert np.array_equal(
        Kinematics(plain).direct(q).position, Kinematics(model).direct(q).position
    )


def test_eccentricity_is_a_sine_of_the_reading_worked_by_hand():
    values = {"encoder_eccentricity.joint1.sin": 2e-3, "encoder_eccentricity.joint3.cos": 1e-3}
    model = new_model("delta54", values, effects=["encoder_eccentricity"])
    answer = Kinematics(model).direct(np.array([np.pi / 6, 0.5, np.pi / 3]))
    expected = Kinematics(new_model("delta54")).direct(
        np.array([np.pi / 6 + 1e-3, 0.5, np.pi / 3 + 0.5e-3])
    )
    assert np.abs(answer.position - expected.position).max() < 1e-15


def test_adding_an_effect_twice_or_removing_an_absent_one_is_an_error():
    model = new_model("delta24").with_effect("backlash")
    with pytest.raises(ModelError, match="already has the effect 'backlash'"):
        model.with_effect("backlash")
    with pytest.raises(ModelError, match="no effect 'encoder_eccentricity'; it has backlash"):
        model.without_effect("encoder_eccentricity")
    with pytest.raises(ModelError, match=r"no effect 'tides': expected one of .*backlash"):
        model.with_effect("tides")


@pytest.mark.parametrize("name", ["delta54", "argos27", "stewart42", "linear_delta"])
def test_a_single_solve_needs_no_arrays(name, monkeypatch):
    """The slow way, for whatever is unusual, is taken by no pose of the workspace."""
    mechanism = load_mechanism(name)
    rows = np.zeros((20, 6))
    rows[:, mechanism.controlled] = mechanism.sample(20, np.random.default_rng(8))
    kinematics = Kinematics(new_model(mechanism))
    poses = kinematics.inverse(rows[:, :3], rotation_matrix(rows[:, 3:]))
    monkeypatch.setattr(Kinematics, "_classify", None)
    for pose in poses:
        answer = kinematics.direct(pose.joints)
        assert np.abs(answer.position - pose.position).max() < 1e-9
        assert np.abs(answer.rotation - pose.rotation).max() < 1e-9


@pytest.mark.parametrize("name", ["argos27", "planar_stewart"])
def test_a_solution_that_needs_more_iterations_is_that_of_many_and_owns_its_arrays(name):
    """Off nominal, these are some iterations away from their start: one sample goes on in the
    buffers of its first iterations."""
    mechanism = load_mechanism(name)
    rows = np.zeros((20, 6))
    rows[:, mechanism.controlled] = mechanism.sample(20, np.random.default_rng(3))
    model = new_model(mechanism)
    off = model.table.tolerance * np.random.default_rng(1).standard_normal(len(model.values))
    kinematics = Kinematics(model.with_values(model.values + off))
    joints = kinematics.inverse(rows[:, :3], rotation_matrix(rows[:, 3:])).joints
    many, singles = kinematics.direct(joints), [kinematics.direct(q) for q in joints]
    assert "single_refiner" in vars(kinematics.direct_problem)
    for one, other in zip(many, singles, strict=True):
        assert np.array_equal(one.position, other.position)
        assert np.array_equal(one.rotation, other.rotation)
        assert one.residual == other.residual
        assert one.ok
        assert other.ok


@pytest.mark.parametrize("problem", ["direct", "inverse"])
def test_a_single_call_makes_its_arrays_when_one_is_read(problem):
    kinematics = Kinematics(new_model("delta54", vr.TABLE_5_18))
    found = kinematics.direct([0.5, 0.5, 0.5])
    if problem == "inverse":
        found = kinematics.inverse(found.position, found.rotation)
    assert not {"joints", "position", "rotation", "residual"} & vars(found).keys()
    again = pickle.loads(pickle.dumps(found))
    shallow = replace(copy(found), message="moved")
    assert repr(again) == repr(found)
    assert shallow.message == "moved"
    for name in ("joints", "position", "rotation", "residual", "status"):
        assert np.array_equal(getattr(again, name), getattr(found, name))
        assert np.array_equal(getattr(shallow, name), getattr(found, name))
    assert found.rotation.flags.writeable
    assert isinstance(found, Solutions)
    with pytest.raises(AttributeError, match="no attribute 'positions'"):
        found.positions  # noqa: B018


def test_a_single_solution_keeps_its_numbers_when_the_next_is_computed():
    kinematics = Kinematics(new_model("delta54", vr.TABLE_5_18))
    first = kinematics.direct([0.5, 0.5, 0.5])
    kinematics.direct([0.6, 0.4, 0.5])
    assert first.joints.tolist() == [0.5, 0.5, 0.5]
    assert np.array_equal(first.position, kinematics.direct([[0.5, 0.5, 0.5]]).position[0])


def test_a_rotation_in_a_row_is_an_error_for_one_pose_as_for_many():
    kinematics = Kinematics(new_model("stewart42"))
    position = kinematics.model.mechanism.home.position
    with pytest.raises(SolveError, match=r"rotation has the shape \(9,\)"):
        kinematics.inverse(position, np.eye(3).ravel())


@pytest.mark.parametrize("effects", [[], ["backlash"]])
def test_conditions_of_the_wrong_kind_are_an_error_for_one_sample_as_for_many(effects):
    kinematics = Kinematics(new_model("delta54", effects=effects))
    for q in ([0.5, 0.5, 0.5], [[0.5, 0.5, 0.5]]):
        with pytest.raises(ModelError, match="at is 3 "):
            kinematics.direct(q, at=3)


def test_a_call_without_conditions_forgets_those_of_the_call_before():
    values = {**vr.TABLE_5_18, "backlash.joint2.width": 4e-4}
    kinematics = Kinematics(new_model("delta54", values, effects=["backlash"]))
    q = [0.5, 0.5, 0.5]
    before = kinematics.direct(q).position
    moved = kinematics.direct(q, at={"direction.joint2": 1.0}).position
    assert not np.array_equal(moved, before)
    assert np.array_equal(kinematics.direct(q).position, before)
