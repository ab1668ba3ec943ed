"""A robot that a camera sees calibrates itself: poses at which the board is seen, images that show
too little, and the true error afterwards."""

from dataclasses import replace

import numpy as np
import pytest
from camera_cells import Cell as PixelCell
from campaign_cells import CameraCell, model_of
from scipy.optimize import least_squares

from parallel_cal.base.errors import FitError
from parallel_cal.campaign.campaign import MAX_UNSEEN_IN_A_ROW, Campaign
from parallel_cal.campaign.cell import UnseenError
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.identification.observations import observe
from parallel_cal.identification.placement import place_sensors
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.planning.plan import plan
from parallel_cal.planning.visibility import find_seen_poses, predict_shown_readings
from parallel_cal.virtual.robot import turn

CELL = PixelCell("delta", 1)


def seen_by(cell):
    """The model of the Delta as drawn, with a camera that has no place yet."""
    drawn = model_of("delta")
    noise = replace(drawn.noise, position=None, orientation=None)
    return replace(drawn.with_sensors((cell.sensor,)), noise=noise)


@pytest.fixture(scope="module")
def placed():
    """A Delta whose camera has a place, and samples of it."""
    data = CELL.seen_by_camera(20)
    model = CELL.drawn.with_sensors((CELL.sensor(),))
    model = place_sensors(model, observe(model, data))
    return replace(model, noise=replace(model.noise, joint=1e-5)), data


def test_predicted_pixels_are_near_those_in_images_and_nan_off_the_image(placed):
    model, data = placed
    at = Kinematics(model).direct(data.q)
    a = model.condition_rows(None, len(data))
    predicted = predict_shown_readings(model, at.configuration.rows, a)
    columns = [data.conditions[f"reading.{c}"] for c in model.structure.channels]
    seen = np.stack(columns, axis=1)
    assert np.nanmedian(np.abs(predicted - seen)) < 3.0
    assert find_seen_poses(model, at).all()
    # A narrow image loses the corners beyond its edge, and then the pose.
    [camera] = model.sensors
    narrow = model.with_sensors((replace(camera, image_size=(640, 1024)),))
    cut = predict_shown_readings(narrow, at.configuration.rows, a)
    assert np.nanmax(cut[:, ::2]) < 640
    assert not find_seen_poses(narrow, at).all()


def test_the_back_of_a_board_is_not_seen(placed):
    model, data = placed
    at = Kinematics(model).direct(data.q)
    [camera] = model.sensors
    mirrored = camera.find_visible(
        predict_shown_readings(model, at.configuration.rows, model.condition_rows(None, len(data)))
        * np.tile([-1.0, 1.0], len(model.structure.channels) // 2)
        + np.tile([camera.image_size[0], 0.0], len(model.structure.channels) // 2)
    )
    assert not mirrored.any()


def test_a_guard_measures_only_where_the_board_is_in_the_image(placed):
    model, data = placed
    [camera] = model.sensors
    narrow = model.with_sensors((replace(camera, image_size=(640, 1024)),))
    guard = Guard.of(narrow)
    allowed, measurable = guard.is_allowed(data.q), guard.is_measurable(data.q)
    seen = find_seen_poses(narrow, Kinematics(narrow).direct(data.q))
    np.testing.assert_array_equal(measurable, allowed & seen)
    assert 0 < measurable.sum() < allowed.sum()


def test_a_plan_with_a_placed_camera_is_of_poses_that_show_the_board(placed):
    model, _ = placed
    [camera] = model.sensors
    narrow = model.with_sensors((replace(camera, image_size=(700, 1024)),))
    found = plan(narrow, 10, pool=120, fix=["chain[23].*"])
    assert find_seen_poses(narrow, found.poses).all()
    assert found.expected.position_rms < found.random.position_rms
    # The pixels of this camera determine its focal length: a device of poses could not.
    assert np.isfinite(found.expected.sigma[found.names.index("camera.fx")])


def test_a_plan_without_any_pose_that_shows_the_board_is_refused(placed):
    model, _ = placed
    [camera] = model.sensors
    blind = model.with_sensors((replace(camera, image_size=(40, 40)),))
    with pytest.raises(FitError, match="no camera sees its board at any of"):
        plan(blind, 10, pool=60, fix=["chain[23].*"])


def test_targets_at_which_the_board_is_not_seen_are_skipped_until_too_many_are(tmp_path):
    class Covered(CameraCell):
        covered = (1, 3)
        asked_for = 0

        def sample(self, go_on):
            self.asked_for += 1
            if self.asked_for in self.covered:
                raise UnseenError("the image shows fewer than 6 corners of the board")
            return super().sample(go_on)

    cell = Covered("delta", 2)
    cell.covered = (1, 3, *range(6, 40))
    one = Campaign(tmp_path, dump_model(seen_by(cell)), Goal(30), cell)
    outcome = one.run()
    one.close()
    assert not outcome.success
    assert outcome.message == "the image shows fewer than 6 corners of the board"
    assert len(one.samples) == 3
    assert len(one.left_out) == 2 + MAX_UNSEEN_IN_A_ROW - 1


def true_error(cell, model):
    """Rms distance (m) of true and predicted positions at unseen poses, after the best frames."""
    rng = np.random.default_rng(99)
    drawn = model_of("delta")
    q = Kinematics(drawn).inverse(*drawn.mechanism.poses(drawn.mechanism.sample(100, rng))).joints
    q = q[np.isfinite(q).all(axis=1)]
    sides = np.sign(rng.standard_normal(q.shape))
    r, R = map(np.array, zip(*map(cell.cell.true_pose, q, sides), strict=True))
    at = {f"direction.{joint}": sides[:, i] for i, joint in enumerate(model.joints)}
    reached = Kinematics(model).direct(q, at).position

    def away(u):
        return ((r + R @ u[6:]) @ turn(u[:3]).T + u[3:6] - reached).ravel()

    left = away(least_squares(away, np.zeros(9), x_scale="jac").x).reshape(-1, 3)
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


@pytest.mark.slow
def test_a_hidden_backlash_is_named_from_images_and_the_true_error_falls(tmp_path):
    cell = CameraCell("delta", 2, ["backlash"])
    one = Campaign(tmp_path, dump_model(seen_by(cell)), Goal(60, seed=2), cell)
    outcome = one.run()
    one.close()
    assert one.judgements[-1].effects == ("backlash",)
    assert outcome.verdict == "explained"
    better = parse_model(outcome.text)
    before, after = true_error(cell, model_of("delta")), true_error(cell, better)
    assert before > 200e-6
    assert after < 50e-6
    # The error that the campaign states is that of the robot, not that of single images.
    assert 0.3 < one.judgements[-1].validation_error / after < 3
    # Planned poses spread the board over what the camera sees of the workspace, half of its image.
    [camera] = better.sensors
    corners = np.concatenate(
        [
            np.stack([one.dataset.conditions[f"reading.camera.{k}.{a}"] for a in "uv"], axis=1)
            for k in range(35)
        ]
    )
    spread = np.ptp(corners[np.isfinite(corners).all(axis=1)], axis=0)
    everywhere = PixelCell("delta").draw_poses(1000, np.random.default_rng(3))
    pixels = cell.camera.see(everywhere.r, everywhere.R, np.random.default_rng(4)).reshape(-1, 2)
    whole = np.ptp(pixels[np.isfinite(pixels).all(axis=1)], axis=0)
    assert (whole / camera.image_size < 0.8).all()
    assert (spread / whole > 0.95).all()
