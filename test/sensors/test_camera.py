"""The sensor `camera`: pixels of a board's corners identify lens, hand-eye and robot in one fit."""

import dataclasses
import re

import numpy as np
import pytest
import virtual_camera as vc
from camera_cells import Cell
from marks import as_slow
from scipy.optimize import least_squares
from virtual_effects_hidden import JointCompliance

import parallel_cal as pc
from parallel_cal.base.errors import FitError, ModelError, ModelFileError
from parallel_cal.base.rotation import matrix_to_quaternion, quaternion_to_matrix, rotation_vector
from parallel_cal.identification.image_poses import (
    add_joint_noise,
    estimate_robot_error,
    find_shown_poses,
)
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import observe
from parallel_cal.identification.placement import place_sensors
from parallel_cal.identification.prediction_errors import compute_rms_sigmas
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.parameters import Named
from parallel_cal.reporting.image_figures import draw_cameras, residual_arrows
from parallel_cal.reporting.images import list_images
from parallel_cal.reporting.projection_uncertainty import ProjectionUncertainty
from parallel_cal.reporting.text import show
from parallel_cal.sensors.camera import Camera
from parallel_cal.virtual.robot import Backlash

SENSOR = Camera(8, 6, 0.03, (1280, 1024))
LENS = {"fx": 1210.0, "fy": 1206.0, "cx": 648.0, "cy": 503.0, "k1": -0.11, "p1": 8e-4}
FISHEYE = vc.Lens(620.0, 618.0, 645.0, 507.0, (-0.02, 0.01, -0.004, 0.001), fisheye=True)


def with_camera(cell, **options):
    return cell.drawn.with_sensors((cell.sensor(**options),))


@pytest.fixture(scope="module")
def hexapod_fit():
    """A hexapod, of which a camera in an unknown place with an unknown lens took 60 images."""
    cell = Cell("stewart", 1)
    return cell, pc.fit(with_camera(cell), cell.seen_by_camera(), hold_out=0.5)


@pytest.mark.wide
def test_pixels_alone_identify_lens_hand_eye_and_robot_from_nothing(hexapod_fit):
    cell, found = hexapod_fit
    numbers = found.parameters()
    for name, true in LENS.items():
        one = numbers[f"camera.{name}"]
        assert abs(one.value - true) < 4 * one.sigma
    assert numbers["camera.fx"].sigma < 5.0  # px
    assert cell.error_at_unseen_poses(found.model) < 45e-6 < cell.error_at_unseen_poses(cell.drawn)
    assert found.held_out.summary.pixel_rms == pytest.approx(0.3 * 2**0.5, rel=0.1)


@pytest.mark.wide
def test_the_error_of_the_nominal_model_is_the_same_after_a_second_fit(hexapod_fit):
    """Its camera is placed anew: with the place that the first fit began with, it was twice as
    large."""
    cell, found = hexapod_fit
    again = pc.fit(found.model, cell.seen_by_camera(), hold_out=0.5)
    assert again.nominal_errors.summary.position_rms == pytest.approx(
        found.nominal_errors.summary.position_rms, rel=0.02
    )


@pytest.mark.wide
def test_the_noise_of_images_is_measured_without_the_robot(hexapod_fit):
    """So the fit states a noise floor, although nobody stated the noise of a corner."""
    _, found = hexapod_fit
    [noise] = [kind for kind in found.document()["noise"] if kind["name"] == "camera"]
    assert noise["unit"] == "px"
    assert noise["value"] == pytest.approx(0.3, rel=0.05)
    assert noise["source"] == "scatter within images"
    assert found.noise_floor.pixel_rms == pytest.approx(0.3 * 2**0.5, rel=0.05)


@pytest.mark.wide
def test_the_text_says_the_error_without_the_noise_of_images_and_what_determines_the_lens(
    hexapod_fit,
):
    cell, found = hexapod_fit
    text = show(found)
    assert "camera: 60 images with 2100 corners, 0.4" in text
    assert re.search(r"camera.fx +1[12]\d\d\.\d\d .* px +the data", text)
    assert re.search(r"camera.k3 .* fixed", text)
    own, sigma = map(float, re.search(r"noise of the images: (\d+) \+- (\d+) um", text).groups())
    assert own < 45 + 3 * sigma
    assert re.search(r"without the noise of the joint readings, too: \d+ \+- \d+ um\.", text)
    wide = float(re.search(r"with that of the lens: (\d+) um", text)[1])
    assert 0.5 < cell.error_at_unseen_poses(found.model) / (1e-6 * wide) < 2


@pytest.mark.wide
def test_the_error_of_the_robot_contains_the_noise_of_the_joints_unless_it_is_subtracted(
    hexapod_fit,
):
    """The readings of a perfect model, at joint readings that err by a known noise."""
    _, found = hexapod_fit
    model, at = found.model, found.observations
    n, sigma = len(model.joints), 100e-6
    true = predict_configurations(model, at)
    noise = sigma * np.random.default_rng(3).standard_normal((len(true), n))
    S = at.S.copy()
    S[:, range(n), range(n)] = sigma**2
    wrong = true.copy()
    wrong[:, :n] += noise
    exact = Linearisation(model, at, np.zeros(len(model.values), dtype=bool), weighted=True)
    residual = exact.blocks(model.values, true)[0][:, model.structure.phi.shape[0] :]
    at = dataclasses.replace(at, x=wrong, S=S, reading=at.reading + residual)
    predicted = predict_configurations(model, at)
    shown = find_shown_poses(model, at, predicted)
    moved = predicted[:, n : n + 3] - true[:, n : n + 3]
    np.testing.assert_allclose(shown.change[:, :3], -moved, atol=2e-6)
    contained, sigma_of_it = estimate_robot_error(shown)
    assert contained > 5 * sigma_of_it
    alone, sigma_of_it = estimate_robot_error(add_joint_noise(shown, model, at, predicted))
    assert alone < min(2 * sigma_of_it, 0.5 * contained)


@pytest.mark.wide
def test_the_sigma_of_the_validation_error_is_that_of_poses_beside_the_camera(hexapod_fit):
    """Robot and camera may shift together: neither their place nor its large sigma is an error."""
    _, found = hexapod_fit
    scatter = compute_rms_sigmas(found.held_out, np.arange(found.samples))
    for kind, sigma in found.rms_sigmas(found.held_out).items():
        assert scatter[kind] < sigma < 2 * scatter[kind]


def test_the_report_draws_residuals_as_arrows_over_the_image(hexapod_fit):
    _, found = hexapod_fit
    [one] = list_images(found)
    assert one.coverage > 0.2
    figure, scale = residual_arrows(one)
    assert scale >= 10
    points = figure["data"][-1]
    assert len(points["x"]) == 2100
    assert figure["layout"]["yaxis"]["range"] == [1023.5, -0.5]  # v points down
    ends = np.array([v for line in figure["data"][:-1] for v in line["x"] if v is not None])
    assert len(ends) == 2 * 2100


@pytest.mark.wide
def test_pictures_of_what_a_camera_saw_say_what_they_show(hexapod_fit):
    _, found = hexapod_fit
    corners, worst, lens = draw_cameras(found)
    assert corners.name == "corners"
    assert "at poses that were held out, magnified" in corners.words
    # Six images, with measured and predicted corners and the lines between them.
    assert len(worst.figure["data"]) == 18
    sizes = [
        float(re.search(r"(\d\.\d\d) px rms", axis["title"]["text"])[1])
        for name, axis in worst.figure["layout"].items()
        if name.startswith("xaxis")
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert 0.45 < sizes[0] < 0.9
    colours = lens.figure["data"][0]
    sigma = np.array(colours["z"], dtype=float)
    assert sigma[len(sigma) // 2, 16] < 0.05 < 1 < sigma[0, 0]  # corners were seen in the middle
    assert f"the colours end at {colours['zmax']:.2g} px" in lens.words


@pytest.mark.wide
def test_the_uncertainty_of_the_projection_is_that_of_an_independent_camera(hexapod_fit):
    """Lenses drawn from the covariance, each moved to where it shows the corners seen best."""
    _, found = hexapod_fit
    [one] = list_images(found)
    known = ProjectionUncertainty.of(found, one.camera, one.corners)
    names = [f"camera.{name}" for name in (*LENS, "k2", "p2")]
    index = [found.model.table.index_of(name) for name in names]
    values, spread = found.model.values[index], found.model.covariance[np.ix_(index, index)]

    def project(numbers, points, motion=None):
        fx, fy, cx, cy, k1, p1, k2, p2 = numbers
        lens = vc.Lens(fx, fy, cx, cy, (k1, k2, p1, p2), size=(9999, 9999))
        moved = points if motion is None else points + motion[:3] + np.cross(motion[3:], points)
        return lens.project(moved)

    def place(pixels):
        """Find the points that the fitted lens shows at these pixels."""
        return np.stack(
            [
                least_squares(
                    lambda x, at=pixel: (
                        project(values, np.array([[*x, 1.0]]))[0] - at if max(abs(x)) < 2 else x
                    ),
                    (pixel - values[2:4]) / values[:2],
                ).x
                for pixel in pixels
            ]
        )

    cells = [(13, 16), (10, 14), (17, 20), (5, 16)]  # rows and columns, the last without corners
    wanted = np.array([(known.u[column], known.v[row]) for row, column in cells])
    rays = np.append(place(np.vstack([wanted, one.corners[::4]])), np.ones((4 + 525, 1)), axis=1)
    points = known.distance * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    steps = 1e-6 * np.eye(6)
    slopes = np.stack(
        [(project(values, points, s) - project(values, points, -s)).ravel() / 2e-6 for s in steps],
        axis=1,
    )
    changes = []
    for numbers in np.random.default_rng(0).multivariate_normal(values, spread, 400):
        change = (project(numbers, points) - project(values, points)).ravel()
        motion = np.linalg.lstsq(slopes[8:], change[8:], rcond=None)[0]
        changes.append((change - slopes @ motion)[:8].reshape(4, 2))
    sizes = [np.linalg.eigvalsh(np.cov(np.array(changes)[:, k].T))[-1] ** 0.5 for k in range(4)]
    assert [known.sigma[cell] for cell in cells] == pytest.approx(sizes, rel=0.25)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("cell", "limit"),
    [
        (Cell("delta", 1), 90e-6),
        as_slow((Cell("ur5", 1), 90e-6)),
        as_slow((Cell("delta", 1, on_platform=True), 140e-6)),
        as_slow((Cell("stewart", 1, lens=FISHEYE), 60e-6)),
        (Cell("ur5", 0, on_platform=True, lens=FISHEYE, board=vc.Board(sag=(2e-3, -1e-3))), 1.5e-4),
    ],
    ids=["delta", "arm", "camera on the platform", "fisheye", "fisheye on an arm, bent board"],
)
def test_other_robots_lenses_and_places_are_identified_from_nothing(cell, limit):
    found = pc.fit(with_camera(cell), cell.seen_by_camera(), hold_out=0)
    assert found.after.summary.pixel_rms == pytest.approx(0.3 * 2**0.5, rel=0.03)
    assert cell.error_at_unseen_poses(found.model) < limit
    numbers = found.parameters()
    for name in ("fx", "fy", "cx", "cy"):
        one = numbers[f"camera.{name}"]
        assert abs(one.value - getattr(cell.lens, name)) < 4 * one.sigma
    for axis, sag in zip("xy", cell.board.sag, strict=True):
        one = numbers[f"camera.bend.{axis}"]
        assert abs(one.value - sag) < 4 * one.sigma


@pytest.mark.wide
def test_a_stated_lens_replaces_the_search_and_its_sigma_is_the_tolerance():
    cell = Cell("stewart", 1)
    model = with_camera(
        cell, focal_length=(1215.0, 1215.0), principal_point=(640.0, 510.0), intrinsics_sigma=4.0
    )
    assert model.table["camera.cx"].tolerance == 4.0
    found = pc.fit(model, cell.seen_by_camera(20), hold_out=0)
    assert found.model.sensors[0].focal_length == (1215.0, 1215.0)
    free = pc.fit(with_camera(cell), cell.seen_by_camera(20), hold_out=0)
    own, other = (one.parameters()["camera.cy"].sigma for one in (found, free))
    assert own < other


@pytest.mark.slow
def test_a_board_may_sit_anywhere_on_a_platform_that_hardly_turns():
    """Nobody states where. If a fit takes the board to be at {P}, the error here is 2.8 times."""
    near, far = Cell("delta", 2), Cell("delta", 2, board_at=(0.03, -0.02, -0.08))
    error = [
        cell.error_at_unseen_poses(
            pc.fit(with_camera(cell), cell.seen_by_camera(), hold_out=0).model
        )
        for cell in (near, far)
    ]
    assert error[1] < 1.2 * error[0]


@pytest.mark.wide
def test_a_camera_and_a_board_that_are_held_where_the_start_has_them_stay_there():
    cell = Cell("stewart", 1)
    model = with_camera(cell, fixed=("pose.*", "board.*", "k3", "scale"))
    found = pc.fit(model, cell.seen_by_camera(20), hold_out=0, insist=True)
    held = found.model.table.matching(["camera.pose.*", "camera.board.*"])
    assert not found.model.values[held].any()


@pytest.mark.slow
def test_a_descent_along_a_curved_valley_ends():
    """The platform hardly tells where the board sits."""
    gears = JointCompliance((0.36985896e-3, 0.30828404e-3, 0.39870595e-3))
    cell = Cell(
        "delta",
        6,
        (gears,),
        board_at=(0.02428061, 0.0578851, -0.01335119),
        payloads=(0.0, 1.5, 3.0),
    )
    found = pc.fit(with_camera(cell), cell.seen_by_camera(seed=6), hold_out=0)
    assert found.estimate.chi2_per_dof == pytest.approx(1, abs=0.03)


def test_a_stated_position_of_the_board_is_where_the_fit_begins():
    cell = Cell("delta", 1, board_at=(0.03, -0.02, -0.08))
    stated = tuple(cell.camera().mount[:3, 3].tolist())
    found = pc.fit(with_camera(cell, board_position=stated), cell.seen_by_camera(20), hold_out=0)
    assert found.model.sensors[0].board_position == stated
    # The camera stands where it saw this board, next to the errors of the drawn lens and robot.
    assert found.model.sensors[0].position == pytest.approx(cell.camera().pose[:3, 3], abs=0.03)


@pytest.mark.slow
def test_two_cameras_are_identified_together():
    one = Cell("stewart", 1)
    other = Cell("stewart", 1, name="camera2", lens=vc.Lens(900.0, 905.0, 630.0, 520.0))
    data = one.seen_by_camera(40)
    data = dataclasses.replace(
        data, conditions=data.conditions | other.seen_by_camera(40).conditions
    )
    model = one.drawn.with_sensors((one.sensor(), other.sensor()))
    numbers = pc.fit(model, data, hold_out=0).parameters()
    for name, true in (("camera.fx", 1210.0), ("camera2.fx", 900.0), ("camera2.cy", 520.0)):
        assert abs(numbers[name].value - true) < 4 * numbers[name].sigma


@pytest.mark.wide
def test_diagnose_names_a_hidden_backlash_from_pixels_alone():
    cell = Cell("delta", effects=(Backlash((2e-3, 1.5e-3, 2.5e-3)),))
    found = pc.diagnose(with_camera(cell), cell.seen_by_camera(30), effects=("backlash",))
    assert found.effects == ("backlash",)
    assert found.verdict.word == "explained"


def test_the_start_finds_the_focal_length_and_frames_of_a_robot_as_drawn():
    cell = Cell("stewart", 1)
    data = cell.seen_by_camera(20)
    model = with_camera(cell)
    [camera] = place_sensors(model, observe(model, data)).sensors
    assert camera.is_placed
    assert camera.focal_length[0] == pytest.approx(1208.0, rel=0.06)
    true = cell.camera().pose
    # 6 % of the focal length are 6 % of the distance.
    assert np.linalg.norm(np.array(camera.position) - true[:3, 3]) < 0.06
    turn = quaternion_to_matrix(camera.quaternion).T @ true[:3, :3]
    assert np.degrees(np.linalg.norm(rotation_vector(turn))) < 3


def test_images_of_too_little_of_the_board_are_refused_with_numbers():
    cell = Cell("stewart", 1)
    data = cell.seen_by_camera(20)
    hidden = {
        name: values
        if name.startswith(("reading.camera.0.", "reading.camera.1."))
        else values + np.nan
        for name, values in data.conditions.items()
    }
    data = dataclasses.replace(data, conditions=hidden)
    model = with_camera(cell)
    with pytest.raises(FitError, match="camera: 0 of 20 samples show enough of the board"):
        place_sensors(model, observe(model, data))


def test_a_camera_without_any_corner_is_refused():
    cell = Cell("stewart", 1)
    data = cell.seen_by_tracker(20)
    with pytest.raises(FitError, match="no measurement with the corners of camera"):
        observe(with_camera(cell), data)


def test_readings_of_another_board_are_refused_in_one_line():
    cell = Cell("stewart", 1)
    model = cell.drawn.with_sensors((Camera(5, 4, 0.03, (1280, 1024)),))
    expected = (
        "readings of the corners of camera, but the model's sensors have camera.0.u to camera.11.v"
    )
    with pytest.raises(FitError, match=expected):
        observe(model, cell.seen_by_camera(20))


def test_the_sensor_projects_like_an_independent_camera():
    """Pixels of the sensor at the true numbers, for both lenses, beside the virtual camera."""
    import casadi as ca

    for cell in (Cell("stewart", 1), Cell("ur5", 1, on_platform=True, lens=FISHEYE)):
        true, lens = cell.camera(), cell.lens
        placed = {
            f"{prefix}{kind}": value
            for prefix, matrix in (("", true.pose), ("board_", true.mount))
            for kind, value in (
                ("position", tuple(matrix[:3, 3].tolist())),
                ("quaternion", tuple(matrix_to_quaternion(matrix[:3, :3]).tolist())),
            )
        }
        sensor = cell.sensor(
            focal_length=(lens.fx, lens.fy),
            principal_point=(lens.cx, lens.cy),
            distortion=lens.k,
            **placed,
        )
        table = sensor.table(cell.drawn.mechanism)
        at = cell.draw_poses(5, np.random.default_rng(0))
        numbers = Named(table.names, ca.DM(table.nominal))[sensor.name]
        for r, R, pixels in zip(at.r, at.R, true.see(at.r, at.R), strict=True):
            shown = ca.evalf(sensor.readings(ca.DM(r), ca.DM(R), numbers)).full().reshape(-1, 2)
            seen = np.isfinite(pixels)
            assert seen.sum() > 20
            assert shown[seen] == pytest.approx(pixels[seen], abs=1e-6)


def test_the_derivatives_of_pixels_are_those_of_finite_differences():
    cell = Cell("stewart", 1)
    model = with_camera(cell, focal_length=(1200.0, 1200.0), position=(0.3, 0.1, 0.9))
    model = model.with_values(model.table.nominal + 0.1 * model.table.tolerance)
    at = cell.draw_poses(2, np.random.default_rng(0))
    x = Configuration(at.q, at.r, at.R).rows
    a = np.zeros((2, 0))
    rows, _, J = model.structure.rows_batch(x, a, model.values)
    J = J.reshape(2, -1, rows.shape[1]).transpose(0, 2, 1)
    for i in np.flatnonzero([n.startswith("camera.") for n in model.table.names]):
        step = 1e-5 * model.table.tolerance[i]
        ends = [
            model.structure.residuals(
                x, a, model.values + sign * step * (np.arange(len(model.values)) == i)
            )[0]
            for sign in (1, -1)
        ]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(J[:, :, i], rel=1e-4, abs=1e-4)


def test_a_model_file_keeps_two_cameras_apart():
    second = Camera(8, 6, 0.03, (640, 480), name="camera2", model="fisheye", mounted="platform")
    model = pc.new_model("delta24", sensors=[SENSOR, second])
    again = parse_model(dump_model(model))
    assert again.sensors == model.sensors
    assert "camera2.34.v" in again.structure.channels
    assert {"camera.k3", "camera2.k4"} <= set(again.table.names)


def test_a_fit_identifies_all_four_coefficients_of_a_fisheye():
    """With k3 fixed, no other coefficients show a lens of 170 degrees to half a pixel."""
    angles = np.radians(np.linspace(1.0, 85.0, 85))
    series = 1 + angles**2 * (0.08 + angles**2 * (-0.05 + angles**2 * (0.03 - 0.008 * angles**2)))

    def largest_misfit(**options):
        camera = Camera(8, 6, 0.03, (1280, 1024), model="fisheye", **options)
        model = pc.new_model("delta24", sensors=[camera])
        known = dict(zip(model.table.names, model.fixed, strict=True))
        free = [name for name in ("k1", "k2", "k3", "k4") if not known[f"camera.{name}"]]
        columns = [angles ** (2 * int(name[1]) + 1) for name in free]
        design = 620.0 * np.stack([angles, *columns], axis=1)
        image = 620.0 * angles * series
        return np.abs(design @ np.linalg.lstsq(design, image, rcond=None)[0] - image).max()

    assert largest_misfit() < 1e-6
    assert largest_misfit(fixed=("k3", "scale")) > 0.5


def test_a_stated_list_of_fixed_parameters_replaces_the_default():
    def fixed(**options):
        sensor = Camera(8, 6, 0.03, (1280, 1024), **options)
        model = parse_model(dump_model(pc.new_model("delta24", sensors=[sensor])))
        assert model.sensors == (sensor,)
        names = np.array(model.table.names)[model.fixed]
        return {name.removeprefix("camera.") for name in names if name.startswith("camera.")}

    assert fixed() == {"k3", "scale"}
    assert fixed(model="fisheye") == {"scale"}
    assert fixed(model="fisheye", fixed=("k4", "scale")) == {"k4", "scale"}
    assert fixed(fixed=()) == set()


def test_two_cameras_of_one_name_are_refused():
    text = dump_model(pc.new_model("delta24", sensors=[SENSOR]))
    entry = "- name: camera\n  options: {columns: 8, rows: 6, square: 0.03, image_size: [9, 9]}\n"
    twice = text.replace("- name: camera\n", entry + "- name: camera\n")
    with pytest.raises(ModelFileError, match="the sensor 'camera' occurs twice"):
        parse_model(twice)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": 2}, "columns and rows is 2 and 6; expected at least 3 squares each"),
        ({"square": -0.03}, "square is -0.03; expected a length of 0 to 1 m"),
        ({"square": 30}, "square is 30; expected a length of 0 to 1 m"),
        ({"name": "a.b"}, "name is a.b; expected a word without a dot"),
        ({"mounted": "wall"}, "mounted is wall; expected fixed or platform"),
        ({"distortion": (0.1,) * 6}, "distortion has 6 numbers; expected at most 5"),
    ],
)
def test_an_impossible_camera_is_refused_with_option_value_and_expectation(options, message):
    given = {"columns": 8, "rows": 6, "square": 0.03, "image_size": (1280, 1024)} | options
    with pytest.raises(ModelError, match=message):
        Camera(**given)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        pytest.param({"columns": 6, "rows": 8}, "columns: 8, rows: 6", marks=pytest.mark.wide),
        pytest.param({"mounted": "platform"}, "mounted: fixed", marks=pytest.mark.wide),
        pytest.param({"square": 0.06}, "square: about 0.03", marks=pytest.mark.wide),
        pytest.param({"square": 0.0003}, "square: about 0.03", marks=pytest.mark.slow),
    ],
)
def test_options_that_people_mix_up_are_named_before_the_fit(wrong, named):
    cell = Cell("delta", 1)
    data = cell.seen_by_camera(20)
    sensor = dataclasses.replace(cell.sensor(), **wrong)
    model = cell.drawn.with_sensors((sensor,))
    with pytest.raises(FitError, match=f"With the options {named} they are"):
        pc.fit(model, data)
    [placed] = place_sensors(model, observe(model, data), insist=True).sensors
    assert placed.is_placed
