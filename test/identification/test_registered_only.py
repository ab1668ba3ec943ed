"""What a fit must beat: the given model with nothing changed but the device's frame and target."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import virtual_arm as va
from arms import nominal, seen
from marks import as_slow
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification import prediction_errors
from parallel_cal.identification.acceptance import acceptance
from parallel_cal.identification.fit import fit
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.observations import observe
from parallel_cal.identification.registration import register_device
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Model, new_model
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.contents import HeldOutErrors
from parallel_cal.reporting.text import show
from parallel_cal.session.steps import add, fitted
from parallel_cal.virtual import robot as vr

LASER_ARMS = Path(__file__).parents[2] / "real" / "laser_arms"
TIGHT_TOLERANCES = {"m": 5e-4, "rad": 8.7e-3}
WIDE_TOLERANCES = {"m": 0.03, "rad": 0.1}
REFLECTOR = va.Tracker(target=(0.0, 0.0, 0.053))


def with_tolerances(model: Model, sizes: dict[str, float]) -> Model:
    return replace(model, tolerances={p.name: sizes[p.unit] for p in model.table})


@pytest.fixture(scope="module")
def arm_in_its_base() -> Dataset:
    """Positions of an arm whose device stands in {B}; its own errors look like a rotated frame."""
    return seen(va.session(va.arm("ur5", 1), 60, 0, va.Tracker()), pose=False)


def test_compare_fit_and_report_show_the_same_registered_only_error(arm_in_its_base):
    model = nominal("ur5")
    shown, result = compare(model, arm_in_its_base), fit(model, arm_in_its_base)
    assert shown.registration is None  # it is not needed
    assert result.document()["before"] == shown.errors.document()
    assert result.held_out_before.summary == shown.held_out.summary
    found = diagnose(model, arm_in_its_base, effects=("backlash",))
    assert HeldOutErrors.of(found).before == shown.held_out.summary
    for text in (show(shown, html=True), show(result, html=True)):
        assert "held-out, registered only" in text
    as_given = shown.given.errors_as_given.summary.position_rms
    assert shown.errors.summary.position_rms < 0.5 * as_given
    assert result.document()["as_given"]["position_rms"] == as_given


def find_smallest_rms(model: Model, data: Dataset) -> float:
    """The smallest rms error (m) of positions over device and target, by an independent search."""
    reached = Kinematics(model).direct(data.q)

    def distances(x):
        at = reached.position + reached.rotation @ x[6:]
        return (data.r - Rotation.from_rotvec(x[3:6]).apply(at) - x[:3]).ravel()

    return np.sqrt(3 * np.mean(least_squares(distances, np.zeros(9), x_scale="jac").fun ** 2))


def test_no_other_frames_leave_a_smaller_error_of_an_arm_in_its_base(arm_in_its_base):
    shown = compare(nominal("ur5"), arm_in_its_base).errors.summary.position_rms
    best = find_smallest_rms(nominal("ur5"), arm_in_its_base)
    assert shown == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("kind", ["ur5", "wam"])
def test_no_other_frames_leave_a_smaller_error_of_a_real_arm(kind):
    """Least squares in units of the joints' noise left up to 3 % more."""
    data = laser_arm(kind).select(np.arange(0, 200, 2))
    shown = compare(nominal(kind), data).errors.summary.position_rms
    assert shown == pytest.approx(find_smallest_rms(nominal(kind), data), rel=1e-6)


def test_the_error_budget_begins_with_the_registered_model():
    data = seen(va.session(va.arm("ur5", 2), 60, 0, REFLECTOR), pose=False)
    result = fit(nominal("ur5"), data)
    (budget,) = result.budgets
    assert budget.total == pytest.approx(result.held_out_before.summary.position_rms, rel=1e-6)


def test_the_nominal_model_of_a_later_step_gets_its_own_frames_too():
    """Those of the fitted geometry would make its error look larger."""
    data = seen(va.session(va.arm("ur5", 2), 60, 0, REFLECTOR), pose=False)
    first = fit(nominal("ur5"), data)
    later = fit(first.model, data, insist=True)
    begin = first.nominal_errors.summary.position_rms
    assert later.nominal_errors.summary.position_rms == pytest.approx(begin, rel=0.01)
    assert later.budgets[0].total == pytest.approx(first.budgets[0].total, rel=0.01)


def test_a_fit_of_a_fitted_file_starts_where_the_first_fit_ended(arm_in_its_base):
    data = replace(arm_in_its_base, sha256="a" * 64)
    first = fitted(nominal("ur5"), data)
    again = fitted(parse_model(dump_model(first.model)), data, force=True).result
    ended = first.result.held_out.summary.position_rms
    assert again.held_out_before.summary.position_rms == pytest.approx(ended, rel=1e-3)
    assert again.held_out.summary.position_rms == pytest.approx(ended, rel=1e-3)


@pytest.mark.parametrize("kind", ["ur5", pytest.param("wam", marks=pytest.mark.wide)])
@pytest.mark.parametrize("sizes", [TIGHT_TOLERANCES, WIDE_TOLERANCES])
def test_a_reflector_beyond_the_flange_is_found_whatever_the_tolerances_say(kind, sizes):
    data = seen(va.session(va.arm(kind, 1), 80, 0, REFLECTOR), pose=False)
    model = with_tolerances(nominal(kind), sizes)
    shown = compare(model, data)
    assert np.allclose(shown.registration.target_position, REFLECTOR.target, atol=3e-3)
    result = fit(model, data)
    floor = result.noise_floor.position_rms
    assert result.held_out.summary.position_rms < 1.15 * floor
    assert result.before.summary == shown.errors.summary


@pytest.mark.parametrize("offset", [0.008, 0.02])
def test_a_reflector_close_to_the_flange_is_found(offset):
    data = seen(va.session(va.arm("wam", 1), 80, 0, va.Tracker(target=(0, 0, offset))), False)
    shown = compare(nominal("wam"), data)
    assert shown.registration.target_position[2] == pytest.approx(offset, abs=3e-3)


def test_five_positions_are_too_few_to_move_a_target():
    data = seen(va.session(va.arm("ur5", 1), 5, 0, va.Tracker()), pose=False)
    shown = compare(nominal("ur5"), data)
    assert shown.registration is None
    assert not shown.given.is_registered


def test_a_target_that_an_effect_states_is_not_registered():
    data = seen(va.session(va.arm("ur5", 1), 60, 0, va.FAR_AWAY), pose=False, frame="tracker")
    model = nominal("ur5").with_effect("target_offset")
    stated = np.where(
        [n.startswith("target_offset.") for n in model.table.names], 0.0, model.values
    )
    stated[[n.startswith("target_offset.") for n in model.table.names]] = va.FAR_AWAY.target
    _, where = register_device(model.with_values(stated), data)
    assert where is not None
    assert where.target_position == (0.0, 0.0, 0.0)
    assert np.abs(np.array(where.position) - va.FAR_AWAY.shift).max() < 20e-3


def laser_arm(kind: str) -> Dataset:
    table = np.genfromtxt(LASER_ARMS / f"{kind}.csv", delimiter=",", names=True)
    joints = [name for name in table.dtype.names if name.startswith("joint_")]
    q = np.radians(np.stack([table[name] for name in joints], axis=1))
    r = 1e-3 * np.stack([table[f"{a}_mm"] for a in "xyz"], axis=1)
    return Dataset.from_arrays([f"joint{i + 1}" for i in range(len(joints))], q, r)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("kind", "independent", "sizes"),
    [
        ("ur5", 103.2e-6, TIGHT_TOLERANCES),
        ("wam", 2172e-6, WIDE_TOLERANCES),
        as_slow(("ur5", 103.2e-6, WIDE_TOLERANCES)),
        as_slow(("wam", 2172e-6, TIGHT_TOLERANCES)),
    ],
)
def test_real_arms_with_an_unknown_reflector_reach_an_independent_fit(kind, independent, sizes):
    """`independent`: mean error of a NumPy fit of frame, target and all links in the same folds."""
    model = with_tolerances(nominal(kind), sizes)
    model = replace(model, noise=replace(model.noise, joint=1e-5, position=3e-5, assumed=True))
    data = laser_arm(kind)
    shown, result = compare(model, data), fit(model, data)
    assert shown.registration is not None
    assert result.document()["before"] == shown.errors.document()
    assert result.held_out.summary.position_mean < 1.05 * independent


def test_a_fit_that_leaves_the_robot_as_it_was_is_no_better_model():
    """The frames alone were fitted, and before without the held-out poses."""
    data = seen(va.session(va.arm("ur5", 1), 60, 0, va.FAR_AWAY))
    result = fit(nominal("ur5"), data, fix=["*"], free=["link1.theta"])
    assert result.held_out.summary.position_rms < result.held_out_before.summary.position_rms
    assert "so the fit did not improve the robot" in acceptance(result).against


def test_the_frame_moves_in_the_place_of_a_parameter_that_is_fixed_later():
    """The first joint turns the whole arm, as a turn of the device does: no prediction changes."""
    data = seen(va.session(va.arm("ur5", 1), 60, 0, va.FAR_AWAY))
    known = fitted(nominal("ur5"), data)
    model, zero = known.model, known.model.table.index_of("link1.theta")
    assert known.result.free[zero]
    values = np.where(np.arange(len(model.values)) == zero, 0.0, model.values)
    again = fit(model.with_values(values), data, fix=["link1.theta"], hold_out=0)
    assert again.estimate.chi2_per_dof == pytest.approx(known.result.estimate.chi2_per_dof)
    assert again.free.sum() == known.result.free.sum()


@pytest.mark.wide
def test_a_fit_whose_error_is_half_of_the_motion_is_of_another_machine(arm_in_its_base):
    other = replace(arm_in_its_base, r=arm_in_its_base.r[::-1])
    result = fit(nominal("ur5"), other, fix=["*"], free=["link1.theta"])
    found = acceptance(result)
    assert "so the model describes another machine" in found.against
    assert found.cure.startswith("check the mechanism")


def test_a_model_that_is_judged_by_some_of_its_samples_observes_only_these(arm_in_its_base):
    """A diagnosis sets knocked samples aside: it must not use what was observed at all samples."""
    given = GivenModel.of(nominal("ur5"), arm_in_its_base)

    def observed(numbers):
        judged = given.with_dataset(given.dataset.excluding(numbers))
        return judged.observe(given.unregistered, judged.dataset, None, False)

    assert len(observed([3])) == len(arm_in_its_base) - 1
    assert observed([]) is given.unregistered_observations


@pytest.mark.wide
def test_an_added_effect_moves_the_frame_back_from_where_its_lack_had_moved_it():
    """A wrist of which only the orientations are measured: a turn of its target, which the balls on
    the platform can take over, stood where an eccentric joint had moved it. The same model is
    reached in two steps and in one, and its robot is as near to the drawing."""
    rng, drawn = np.random.default_rng(3), new_model("argos27")
    q = rng.uniform(-0.8, 0.8, (90, 3))
    eccentric = np.radians(0.05) * np.array([1.0, -0.6, 0.8]) * np.sin(q + [0.4, 1.9, -0.8])
    off = 0.5 * drawn.table.tolerance * rng.standard_normal(len(drawn.values))
    R = Kinematics(drawn.with_values(drawn.values + off)).direct(q + eccentric).rotation
    R = vr.turn(rng.normal(0, 2e-5, (90, 3))) @ vr.turn(np.array([0.5, -0.4, 2.9])) @ R
    data = Dataset.from_arrays(
        ["joint1", "joint2", "joint3"],
        q + rng.normal(0, 5e-6, q.shape),
        np.zeros((90, 3)),
        R,
        measured=[False] * 3 + [True] * 3,
        pose_cov=4e-10 * np.eye(6),
        joint_sigma=5e-6,
    )
    plain = fitted(drawn, data).model
    two_steps = add(plain, "encoder_eccentricity", data).result
    one_step = fit(drawn, data, effects=["encoder_eccentricity"])

    def distance(found):
        table, robot = found.model.table, found.free & ~found.model.table.matching(["*.*.r[xyz]"])
        return np.sum(((found.model.values - table.nominal) / table.tolerance)[robot] ** 2)

    assert two_steps.estimate.chi2_per_dof == pytest.approx(one_step.estimate.chi2_per_dof, 2e-3)
    assert distance(two_steps) < 1.2 * distance(one_step)
    # One pose is predicted on another branch; the residuals of a diagnosis are those of the fit.
    scene = Scene.of(two_steps.model, data, two_steps.observations, two_steps.free)
    assert scene.chi2_per_dof == pytest.approx(two_steps.estimate.chi2_per_dof, rel=1e-3)


def test_a_pose_is_judged_on_the_branch_on_which_the_robot_was_measured(monkeypatch):
    """Far from home, forward kinematics may arrive on another branch. The robot was not there."""

    class Elsewhere(Kinematics):
        def direct(self, q, at=None, start=None, keep_branch=False):
            found = super().direct(q, at, start, keep_branch)
            if start is None:
                found.rotation[4] = vr.turn(np.array([0.0, 2.0, 0.0])) @ found.rotation[4]
            return found

    model = new_model("argos27")
    q = np.random.default_rng(1).uniform(-0.3, 0.3, (10, 3))
    R = Kinematics(model).direct(q).rotation
    known = {"measured": [False] * 3 + [True] * 3, "pose_cov": 1e-10 * np.eye(6)}
    data = Dataset.from_arrays(model.joints, q, np.zeros((10, 3)), R, joint_sigma=1e-6, **known)
    monkeypatch.setattr(prediction_errors, "Kinematics", Elsewhere)
    found = prediction_errors.errors(model, observe(model, data))
    assert found.norms("orientation").max() < 1e-9
