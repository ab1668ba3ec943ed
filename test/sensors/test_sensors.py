"""One routine for every set-up: sensors tie poses to what they show; truth has no closure."""

import numpy as np
import pytest
import virtual_day as vd
import virtual_setups as vs
from datasets import JOINTS, as_dataset
from tied import blind, dataset

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import argos as va
from parallel_cal.virtual import robot as vr

PLATE = vs.Plate()


def plate_sensor(plate=PLATE, **options):
    bars = (plate.bar,) * len(plate.holes)
    return load_sensor(
        "plane_spheres", height=plate.height, holes=plate.holes, bars=bars, **options
    )


def on_the_plate(seed=0, n=40, plate=PLATE):
    robot = vs.random_delta(seed)
    return robot, dataset(plate, *plate.session(robot, n, seed))


def workspace_error(model, robot):
    """Mean position error (m) all over the workspace."""
    joints, where = vs.workspace(robot)
    return np.linalg.norm(Kinematics(model).direct(joints).position - where, axis=1).mean()


def check_jacobian(model, observations):
    """The rows' Jacobians are finite differences of the rows."""
    free, step = np.ones(len(model.values), dtype=bool), 1e-6
    linearise = Linearisation(model, observations, free, weighted=True)
    x = linearise.start()
    phi, C, J = linearise.blocks(model.values, x)
    for k, column in enumerate(np.eye(len(model.values))):
        changed = linearise.blocks(model.values + step * column, x)[0]
        assert np.abs((changed - phi) / step - J[:, :, k]).max() < 1e-4
    for k, column in enumerate(np.eye(C.shape[2])):
        near = Configuration.from_rows(x).apply_change(np.tile(step * column, (len(x), 1))).rows
        changed = linearise.blocks(model.values, near)
        assert np.abs((changed[0] - phi) / step - C[:, :, k]).max() < 1e-4


# ------------------------------------------------------------------------ plane and spheres


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(4))
def test_a_plate_with_two_holes_calibrates_the_whole_workspace(seed):
    robot, data = on_the_plate(seed)
    model = new_model("delta24", sensors=[plate_sensor()])
    result = fit(model, data, prior=True, hold_out=0)
    before, after = (workspace_error(m, robot) for m in (model, result.model))
    assert 1e-3 < before < 4e-3
    assert after < 45e-6
    assert result.estimate.spectrum.rank == 24
    assert not result.estimate.spectrum.unidentifiable
    assert 120 - 24 <= result.estimate.dof < 120 - 20  # tolerances hold some of the directions
    low, high = chi2_band(result.estimate.dof)
    assert low < result.estimate.chi2_per_dof < high


def test_the_workspace_error_is_the_one_that_the_covariance_predicts():
    ratio = []
    model = new_model("delta24", sensors=[plate_sensor()])
    for seed in range(8):
        robot, data = on_the_plate(seed)
        with single_threaded():
            found = estimate(model, observe(model, data), ~model.fixed, prior=True)
        fitted = model.with_values(found.values, found.covariance)
        joints, where = vs.workspace(robot, 20)
        kinematics = Kinematics(fitted)
        solved = kinematics.direct(joints)
        expected = [np.trace(kinematics.direct_covariance(s)[:3, :3]) for s in solved]
        ratio.append(np.sum((solved.position - where) ** 2) / np.sum(expected))
    assert 0.5 < np.mean(ratio) < 2


def test_no_start_leads_into_another_minimum():
    """The thesis' hundreds of minima: from the truth and from twelve wrong robots, one answer."""
    robot, data = on_the_plate(5)
    model = new_model("delta24", sensors=[plate_sensor()])
    observations, found = observe(model, data), []
    starts = [model.values, *(start_at(model, vs.random_delta(100 + k, 1.5)) for k in range(12))]
    with single_threaded():
        for values in [start_at(model, robot), *starts]:
            found.append(estimate(model.with_values(values), observations, ~model.fixed).values)
    apart = np.abs(np.array(found) - found[0]) / model.table.tolerance
    assert apart.max() < 1e-3


def test_what_the_plate_shows_falls_from_millimetres_to_the_noise_on_poses_not_fitted():
    robot, data = on_the_plate(0)
    model = new_model("delta24", sensors=[plate_sensor()])
    result = fit(model, data, prior=True, hold_out=0)
    unseen = observe(model, dataset(PLATE, *PLATE.session(robot, 30, seed=77)))
    before, after = (np.nanstd(errors(m, unseen).reading, axis=0) for m in (model, result.model))
    assert before.shape == (3,)
    assert before.min() > 0.2e-3
    assert after.max() < 40e-6  # plate 15 um, three encoders of 15 um at the arm's end


def start_at(model, robot):
    names = model.mechanism.parameters.names
    return model.table.vector({name: robot.parameters[name] for name in names})


@pytest.mark.slow
def test_of_a_hundred_random_robots_none_is_trapped():
    model, errors = new_model("delta24", sensors=[plate_sensor()]), []
    with single_threaded():
        for seed in range(100):
            robot, data = on_the_plate(seed)
            found = estimate(model, observe(model, data), ~model.fixed, prior=True)
            errors.append(workspace_error(model.with_values(found.values), robot))
    assert np.median(errors) < 30e-6
    assert np.max(errors) < 60e-6


@pytest.mark.parametrize(("holes", "lost"), [(0, 3), (1, 1), (2, 0)])
def test_holes_are_what_stops_the_robot_from_sliding_and_turning_on_the_plate(holes, lost):
    """5.4.4: the plane alone leaves x, y and the turn about z; one hole leaves the turn."""
    plate = vs.Plate(holes=PLATE.holes[:holes])
    _, data = on_the_plate(0, 120, plate)
    model = new_model("delta24", sensors=[plate_sensor(plate)])
    result = fit(model, data, prior=True, hold_out=0)
    unseen = result.document()["unidentifiable"]
    assert len(unseen) == lost
    assert all("chain" in u["text"] for u in unseen)
    said = [w for w in result.warnings if "the data do not determine" in w]
    assert len(said) == (lost > 0)  # one warning names all of them
    assert all(one["text"] in said[0] for one in unseen)


def test_the_plates_pose_in_an_arbitrary_base_is_six_more_unknowns_that_nothing_can_tell():
    _, data = on_the_plate(0)
    model = new_model("delta24", sensors=[plate_sensor()])
    pose = ["*.plane.*", "*.hole?.x", "*.hole?.y"]  # 3 + 4, of which the distance is seen
    result = fit(model, data, free=pose, prior=True, hold_out=0)
    assert result.free.sum() == 24 + 7
    assert result.estimate.spectrum.rank == 24 + 1
    assert np.isfinite(result.estimate.sigma).all()


def test_rows_of_a_tied_tip_have_exact_jacobians():
    _, data = on_the_plate(0, 4)
    model = new_model("delta24", sensors=[plate_sensor(tip=(1e-3, 2e-3, 5e-3))])
    check_jacobian(model, observe(model, data))


def test_a_forgotten_plane_an_unknown_hole_and_too_few_poses_are_clear_errors():
    model, (_, data) = new_model("delta24", sensors=[plate_sensor()]), on_the_plate(0)
    spheres = {k: v for k, v in data.conditions.items() if k != "reading.plane"}
    tied = np.isfinite(spheres["reading.sphere1"]) | np.isfinite(spheres["reading.sphere2"])
    channels = {k.removeprefix("reading."): v[tied] for k, v in spheres.items() if "sphere" in k}
    with pytest.raises(FitError, match=r"no measurement with plane, .*recorded: sphere1"):
        fit(model, blind(data.q[tied], 1e-4, channels))
    one_hole = new_model("delta24", sensors=[plate_sensor(vs.Plate(holes=PLATE.holes[:1]))])
    with pytest.raises(FitError, match=r"readings of sphere2, but .* have plane, sphere1"):
        fit(one_hole, data)
    with pytest.raises(FitError, match=r"readings of plane, sphere1, sphere2, but .* no channel"):
        fit(new_model("delta24"), data)
    few = data.select(np.r_[0:7, 40:47, 80:87])
    with pytest.raises(
        FitError, match=r"21 different poses give 21 equations, but 24 .*at least 24 different"
    ):
        fit(model, few)


def test_a_sample_without_a_reading_of_a_constraint_gives_no_equation():
    model, (_, data) = new_model("delta24", sensors=[plate_sensor()]), on_the_plate(0)
    silent = {k: v.copy() for k, v in data.conditions.items() if "reading" in k}
    for values in silent.values():
        values[np.arange(len(values)) % 40 >= 5] = np.nan
    channels = {k.removeprefix("reading."): v for k, v in silent.items()}
    with pytest.raises(FitError, match="120 different poses give 15 equations"):
        fit(model, blind(data.q, 1e-4, channels))


# ------------------------------------------------------------------- one number at a time


def test_a_ball_bar_alone_gives_a_robot_that_is_right_along_the_bar():
    """One distance a pose: 24 parameters, the centre unknown, nothing else measured."""
    robot, model = vs.random_delta(1), new_model("delta24", sensors=[bar_sensor()])
    joints, r = vs.workspace(robot, 150)
    rng = np.random.default_rng(0)
    length = np.linalg.norm(r - [0.0, 0.0, 0.45], axis=1) + rng.normal(0, 2e-6, len(r))
    noisy = joints + rng.normal(0, 5e-6, joints.shape)
    result = fit(model, blind(noisy, 5e-6, {"ball_bar": length}), prior=True, hold_out=0)
    joints, r = vs.workspace(robot, 100, seed=9)
    truth = np.linalg.norm(r - [0.0, 0.0, 0.45], axis=1)
    before, after = (
        np.abs(predicted_length(m, joints) - truth).mean() for m in (model, result.model)
    )
    assert before > 0.2e-3
    assert after < 5e-6
    rank = result.estimate.spectrum.rank
    assert 150 - rank <= result.estimate.dof < 150 - 0.8 * rank
    assert result.estimate.dof == round(150 - result.estimate.spectrum.taken)
    # Robot and centre may move together anywhere: the six freedoms of {B}.
    assert result.free.sum() - result.estimate.spectrum.rank == 6


def bar_sensor():
    return load_sensor("ball_bar", centre=(0.5e-3, 0.0, 0.4505), sigma=2e-6)


def predicted_length(model, joints):
    centre = [model.value(f"ball_bar.centre.{a}") for a in "xyz"]
    return np.linalg.norm(Kinematics(model).direct(joints).position - centre, axis=1)


def test_a_height_probe_alone_gives_a_robot_that_is_right_in_height():
    robot = vs.random_delta(2)
    model = new_model("delta24", sensors=[load_sensor("probe", height=0.3)])
    joints, r = vs.workspace(robot, 150)
    rng = np.random.default_rng(0)
    height = r[:, 2] - 0.3004 + rng.normal(0, 2e-6, len(r))
    noisy = joints + rng.normal(0, 5e-6, joints.shape)
    result = fit(model, blind(noisy, 5e-6, {"probe": height}), prior=True, hold_out=0)
    joints, r = vs.workspace(robot, 100, seed=9)
    shift, tilt = result.model.value("probe.plate.z") - 0.3004, 0.02
    assert abs(shift) < 3e-3
    assert abs(result.model.value("probe.plate.rx")) < tilt
    truth = r[:, 2] - 0.3004
    before, after = (
        np.abs(predicted_height(m, joints) - truth).mean() for m in (model, result.model)
    )
    assert before > 0.2e-3
    assert after < 5e-6


def predicted_height(model, joints):
    r = Kinematics(model).direct(joints).position
    rx, ry, z = (model.value(f"probe.plate.{a}") for a in ("rx", "ry", "z"))
    normal = np.array([ry, -rx, 1.0])
    return (r - [0, 0, z]) @ (normal / np.linalg.norm(normal))


def test_a_probe_beside_a_position_device_uses_both():
    samples = vd.dwell_samples(vs.random_delta(3), seed=4)
    mask = np.tile([True, True, False, False, False, False], (len(samples["q"]), 1))
    data = as_dataset(samples, measured=mask)
    data.conditions["reading.probe"] = samples["true_r"][:, 2] - 0.3
    model = new_model("delta24", sensors=[load_sensor("probe", height=0.3)])
    with_probe = fit(model, data, hold_out=0, fix=["probe.*"])
    del data.conditions["reading.probe"]
    without = fit(new_model("delta24"), data, hold_out=0, prior=True)
    assert with_probe.estimate.spectrum.rank == 24
    assert with_probe.estimate.dof == 94 * 3 - 24
    assert without.estimate.dof == round(94 * 2 - without.estimate.spectrum.taken)


# ------------------------------------------------------------------------- device frames

LEVEL = (5e-3, -8e-3, 12e-3)  # rad: what a person mounts by eye
HOME_TURN = va.Argos.home_turn
# The device is mounted so that it reads about zero at home: target turned by home's inverse.
HOME_QUATERNION = (3**-0.5, -(3**-0.5), 0.0, 3**-0.5)


def argos_device(zeros=(0.02, -0.03, 0.015)):
    target = HOME_TURN.T @ vr.turn([-0.01, 0.02, 0.015])
    return vs.Device((1e-3, -2e-3, 1.5e-3), LEVEL, (1e-3, 2e-3, -1e-3), target, zeros)


def argos_session(device, n=47, seed=0, spherical=True):
    """Joints over +-30 degrees, the pose that the device shows, 1' and 5 um of noise."""
    rng = np.random.default_rng(seed)
    q = np.radians(rng.uniform(-30, 30, (n, 3)))
    if spherical:
        robot = va.Argos(va.spherical(va.TABLE_5_22))
        R = np.array([robot.orientation_at_origin(row, HOME_TURN) for row in q])
        r = np.zeros((n, 3))
    else:
        r, R = va.Argos(spatial_argos()).forward(q)
    r, R = device.shows(r, R)
    noise = vr.Noise(5e-5, 5e-6, 3e-4)
    dq, dr, w = noise.draw(rng, n)
    measured = np.tile([not spherical] * 3 + [True] * 3, (n, 1))
    cov = np.diag([noise.position**2] * 3 + [noise.orientation**2] * 3)
    return Dataset.from_arrays(
        JOINTS,
        q + dq,
        r + dr,
        vr.turn(w) @ R,
        measured=measured,
        pose_cov=cov,
        joint_sigma=[noise.joint] * 3,
        pose_id=np.arange(n),
        source="virtual argos",
    )


def spatial_argos():
    """Every dimension of table 5.21 off by about a millimetre or a degree."""
    rng = np.random.default_rng(7)
    angular = ("alpha0", "Omega", "Phi", "omega", "phi", "gamma")
    return {
        name: value + rng.normal() * (0.017 if name.endswith(angular) else 1e-3)
        for name, value in va.TABLE_5_21.items()
    }


def argos_frames(gimbal):
    return load_sensor("device_frame", target_quaternion=HOME_QUATERNION, gimbal=gimbal)


@pytest.fixture(scope="module")
def misaligned_argos():
    return argos_session(argos_device())


def turned_home(mechanism):
    """The frames taken for perfectly referenced, as the drawing has them."""
    sensor = load_sensor(
        "device_frame", target_quaternion=HOME_QUATERNION, gimbal=True, fixed=("*",)
    )
    return new_model(mechanism, sensors=[sensor])


@pytest.mark.wide
def test_argos_without_device_frames_is_not_found_and_with_them_it_is(misaligned_argos):
    data = misaligned_argos
    plain = fit(turned_home("argos9"), data, prior=True)
    assert plain.estimate.chi2_per_dof > 100
    result = fit(new_model("argos9", sensors=[argos_frames(True)]), data, prior=True)
    held_out, floor = result.held_out.summary, result.noise_floor
    assert result.before.summary.orientation_mean > 0.02
    assert held_out.orientation_mean < 1.2 * floor.orientation_mean
    assert held_out.joint_mean < 1.2 * floor.joint_mean


@pytest.mark.slow
def test_two_of_the_nine_device_parameters_of_the_argos_are_its_frames_turns(misaligned_argos):
    """5.5.1 counts 9 + 9 = 18; the gimbal's outer and inner zeros turn the frames (eq. 3.4: 15
    independent parameters of a spherical Argos, and the middle zero)."""
    data = misaligned_argos
    result = fit(new_model("argos9", sensors=[argos_frames(True)]), data, prior=True, hold_out=0)
    unseen = result.document()["unidentifiable"]
    assert result.free.sum() == 18
    assert result.estimate.spectrum.rank == 16
    names = {name for u in unseen for name in u["parameters"]}
    assert {"device_frame.zero.rx", "device_frame.zero.rz"} <= names
    assert "device_frame.zero.ry" not in names
    aligned = argos_session(argos_device((0, 0, 0)))
    six = fit(new_model("argos9", sensors=[argos_frames(False)]), aligned, hold_out=0)
    assert six.free.sum() == six.estimate.spectrum.rank == 15


@pytest.mark.parametrize(("gimbal", "free", "rank"), [(False, 39, 39), (True, 42, 41)])
def test_a_spatial_argos_with_arbitrary_frames_has_42_parameters(gimbal, free, rank):
    """The footnote of 5.5.1: 27 + 12 + 3. The inner zero is the target's turn; the outer one is
    told from the frame's turn by the position, which a gimbal does not measure."""
    device = argos_device() if gimbal else argos_device((0, 0, 0))
    data = argos_session(device, n=60, spherical=False)
    model = new_model("argos27", va.TABLE_5_21, sensors=[argos_frames(gimbal)])
    result = fit(model, data, prior=True)
    assert result.free.sum() == free
    assert result.estimate.spectrum.rank == rank
    for kind in ("position_mean", "orientation_mean"):
        held, floor = (getattr(e, kind) for e in (result.held_out.summary, result.noise_floor))
        assert held < 1.25 * floor


def delta_seen(device, seed=3):
    """A tracker that knows positions only, and stands where it likes."""
    samples = vd.dwell_samples(vs.random_delta(seed, 0.5), seed=4)
    rng = np.random.default_rng(0)
    r, _ = device.shows(samples["true_r"], samples["true_R"])
    samples["r"] = r + rng.normal(0, 10e-6, r.shape)
    samples["R"] = np.broadcast_to(np.eye(3), samples["R"].shape)
    mask = np.tile([True] * 3 + [False] * 3, (len(r), 1))
    return as_dataset(samples, measured=mask)


BESIDE = vs.Device((0.8, -0.5, 0.3), np.array([0, 0, np.pi / 2]) + np.array([6e-3, 9e-3, -0.01]))


def beside():
    """The nominal frame: what a person can say about where the tracker stands."""
    return load_sensor(
        "device_frame", position=(0.8, -0.5, 0.3), quaternion=(0, 0, 0.5**0.5, 0.5**0.5)
    )


def test_a_tracker_beside_the_delta_is_found_together_with_the_robot():
    data = delta_seen(BESIDE)
    result = fit(new_model("delta24", sensors=[beside()]), data, prior=True)
    held_out, floor = result.held_out.summary, result.noise_floor
    assert result.before.summary.position_mean > 1e-3
    assert held_out.position_mean < 1.2 * floor.position_mean
    assert held_out.joint_mean < 1.2 * floor.joint_mean


def test_where_a_tracker_stands_and_where_model_24_stands_are_one_and_the_same():
    """Gauge: model 24 places itself in any {B}, so that a frame adds six unknowns, no rank."""
    data = delta_seen(BESIDE)
    result = fit(new_model("delta24", sensors=[beside()]), data, prior=True, hold_out=0)
    assert result.free.sum() == 30
    assert result.estimate.spectrum.rank == 24
    assert len(result.estimate.spectrum.unidentifiable) == 6
    fixed = fit(new_model("delta24", sensors=[beside()]), data, fix=["device_frame.*"], hold_out=0)
    assert fixed.estimate.spectrum.rank == 24
    assert fixed.estimate.chi2_per_dof == pytest.approx(result.estimate.chi2_per_dof, abs=0.1)


def test_with_a_fixed_geometry_only_the_six_parameters_of_the_frame_are_identified():
    data = delta_seen(BESIDE)
    result = fit(new_model("delta24", sensors=[beside()]), data, fix=["chain*"], hold_out=0)
    assert result.estimate.spectrum.rank == result.free.sum() == 6
    assert result.document()["improvement"]["position"] > 2


@pytest.mark.parametrize("mechanism", ["delta24", "argos9", "argos27"])
def test_rows_in_unknown_frames_have_exact_jacobians(mechanism):
    if mechanism == "delta24":
        model, data = new_model(mechanism, sensors=[beside()]), delta_seen(BESIDE)
    else:
        data = argos_session(argos_device(), 6, spherical=mechanism == "argos9")
        model = new_model(mechanism, sensors=[argos_frames(True)])
    values = model.values + 0.3 * model.table.tolerance
    check_jacobian(model.with_values(values), observe(model, data))


def test_what_a_device_shows_and_where_the_platform_is_are_inverse():
    model = new_model("argos27", sensors=[argos_frames(True)])
    values = model.values + 0.3 * model.table.tolerance
    pose = np.concatenate([np.ones((3, 3)) * 0.01, np.tile(HOME_TURN.ravel(), (3, 1))], axis=1)
    seen = np.concatenate(model.structure.to_device(pose, values), axis=1)
    back = np.concatenate(model.structure.to_base(seen, values), axis=1)
    assert np.abs(seen - pose).max() > 0.01
    assert np.abs(back - pose).max() < 1e-12


def test_a_plate_described_wrongly_is_a_clear_error():
    with pytest.raises(ModelError, match=r"2 holes and 1 bars"):
        load_sensor("plane_spheres", height=0.2, holes=PLATE.holes, bars=(0.07,))
    with pytest.raises(ModelError, match=r"positive lengths"):
        load_sensor("plane_spheres", height=0.2, sigma=0.0)
    with pytest.raises(ModelError, match=r"sensor probe: .*missing.*height"):
        load_sensor("probe")


def test_an_unknown_sensor_names_those_there_are():
    known = "ball_bar, camera, certificate, device"
    with pytest.raises(ModelError, match=f"no sensor 'laser': expected one of {known}"):
        load_sensor("laser")


def test_joint_errors_of_positions_alone_are_right_with_a_target_beside_the_tool():
    # The target hangs 60 mm beside the tool and the device is turned by 90 degrees: taking an
    # orientation that nobody measured for "not turned" would be off by 85 mm.
    device = vs.Device((0.8, -0.5, 0.3), (0, 0, np.pi / 2), (0.06, 0.0, 0.02))
    robot = vs.random_delta(0, factor=0.0)
    joints, r = vs.workspace(robot, n=20)
    shown, _ = device.shows(r, np.tile(np.eye(3), (len(r), 1, 1)))
    sensor = load_sensor(
        "device_frame",
        position=(0.8, -0.5, 0.3),
        quaternion=(0, 0, 0.5**0.5, 0.5**0.5),
        target_position=(0.06, 0.0, 0.02),
    )
    model = new_model("delta24", sensors=[sensor])
    data = Dataset.from_arrays(model.joints, joints, shown, pose_cov=1e-10 * np.eye(6))
    found = errors(model, observe(model, data, 1e-4))
    assert np.abs(found.position).max() < 1e-9
    assert np.abs(found.joint).max() < 1e-9
