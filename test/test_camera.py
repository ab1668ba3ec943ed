"""The sensor `camera`: pixels of a board's corners identify lens, hand-eye and robot in one fit."""

import numpy as np
import pytest
import virtual_camera as vc

import parallel_cal as pc
from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.sensors.camera import Camera
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.robot import turn

JOINTS = ("joint1", "joint2", "joint3")
SENSOR = Camera(8, 6, 0.03, (1280, 1024))
ABOVE = vc.look_at([0.25, 0.1, 0.75], [0, 0, 0.2], 0.1)
ON_PLATFORM = vc.frame(np.array([-0.12, -0.09, 0.01]), turn(np.array([0.3, 0.2, 0.4])))


def delta_seen_by(camera, images=60, seed=1):
    """A built Delta, its true poses, and what a camera and its encoders show there."""
    rng = np.random.default_rng(seed)
    robot = MACHINES["delta"].make_built(3)
    r = rng.uniform([-0.06, -0.06, 0.14], [0.06, 0.06, 0.26], (images, 3))
    q, R = robot.inverse(r)
    pixels = camera.see(r, R, rng)
    data = Dataset.from_arrays(
        JOINTS,
        q + 1e-5 * rng.standard_normal(q.shape),
        np.zeros((images, 3)),
        measured=np.zeros(6, bool),
        joint_sigma=[1e-5] * 3,
        conditions=vc.as_conditions(pixels),
        source="virtual camera",
    )
    return data


@pytest.fixture(scope="module")
def delta_images():
    return delta_seen_by(vc.Camera(ABOVE, ON_PLATFORM))


@pytest.mark.wide
def test_pixels_alone_identify_lens_hand_eye_and_delta_from_nothing(delta_images):
    found = pc.fit(pc.new_model("delta54", sensors=[SENSOR]), delta_images)
    numbers = found.parameters()
    lens = vc.Lens()
    for name, true in (("fx", lens.fx), ("fy", lens.fy), ("cx", lens.cx), ("cy", lens.cy)):
        one = numbers[f"camera.{name}"]
        assert one.sigma < 5.0  # px
        assert abs(one.value - true) < 4 * one.sigma
    corners = found.held_out.reading.reshape(60, -1, 2)
    assert np.sqrt(np.mean(corners**2)) == pytest.approx(0.3, rel=0.05)  # px
    noise = next(kind for kind in found.document()["noise"] if kind["name"] == "camera")
    assert noise["unit"] == "px"
    assert noise["value"] == pytest.approx(0.3, rel=0.05)


def test_a_model_file_keeps_two_cameras_apart():
    second = Camera(8, 6, 0.03, (640, 480), name="camera2", model="fisheye", mounted="platform")
    model = pc.new_model("delta24", sensors=[SENSOR, second])
    again = parse_model(dump_model(model))
    assert again.sensors == model.sensors
    assert "camera2.34.v" in again.structure.channels
    assert {"camera.k3", "camera2.k4"} <= set(again.table.names)


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
        ({"square": -0.03}, "square is -0.03; expected a length above 0 m"),
        ({"name": "a.b"}, "name is a.b; expected a word without a dot"),
        ({"mounted": "wall"}, "mounted is wall; expected fixed or platform"),
        ({"distortion": (0.1,) * 6}, "distortion has 6 numbers; expected at most 5"),
    ],
)
def test_an_impossible_camera_is_refused_with_option_value_and_expectation(options, message):
    given = {"columns": 8, "rows": 6, "square": 0.03, "image_size": (1280, 1024)} | options
    with pytest.raises(ModelError, match=message):
        Camera(**given)
