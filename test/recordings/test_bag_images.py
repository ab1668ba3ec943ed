"""Images in a bag: detected while reading, at rest, the sharpest of each standstill."""

import numpy as np
import pytest
from bag_writing import Session, joint_states, kind, ns, write_bag

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.info import info
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.samples import READING
from parallel_cal.virtual.camera import Camera

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed (extra camera)")

import board_images  # noqa: E402

from parallel_cal.imaging.messages import decode_image  # noqa: E402
from parallel_cal.imaging.opencv import ImageError  # noqa: E402

SMALL = Camera((640, 512), (600.0, 600.0), (319.5, 255.5), board_images.LENS)
STOPS = [[0.1, 0.2], [0.4, 0.0], [0.2, 0.5]]
PERIOD = 0.2  # s between images


def header(seconds, frame="camera"):
    time = kind("builtin_interfaces/msg/Time")
    stamp = ns(seconds)
    return kind("std_msgs/msg/Header")(time(stamp // 10**9, stamp % 10**9), frame)


def image_message(image, seconds, encoding="mono8"):
    height, width = image.shape[:2]
    step = image.strides[0]
    data = np.ascontiguousarray(image).view(np.uint8).ravel()
    return kind("sensor_msgs/msg/Image")(header(seconds), height, width, encoding, 0, step, data)


def compressed_message(image, seconds):
    data = cv2.imencode(".png", image)[1].ravel()
    return kind("sensor_msgs/msg/CompressedImage")(header(seconds), "mono8; png compressed", data)


@pytest.fixture(scope="module")
def shots():
    return list(board_images.shots(len(STOPS), SMALL, near=0.38, far=0.5, tilt=0.4))


def recorded_images(shots, make=image_message, kind_of="Image", topic="/cam/image_raw"):
    """Images all the time: the shot of the stop at rest, blurred versions of it first and last,
    and grey ones in motion."""
    session, messages = Session(STOPS), []
    for seconds in np.arange(0.05, session.time[-1], PERIOD):
        stop, since = divmod(seconds, session.dwell + session.move)
        image = shots[int(stop)].image
        if since > session.dwell:
            image = np.full_like(image, 120)
        elif not 0.3 < since < 0.7:
            image = cv2.GaussianBlur(image, (0, 0), 0.7)
        message = make(image, seconds)
        messages.append((topic, f"sensor_msgs/msg/{kind_of}", ns(seconds + 0.02), message))
    return messages


def check_samples(dataset, shots, camera="camera"):
    assert len(dataset) == len(STOPS)
    assert dataset.q == pytest.approx(np.array(STOPS), abs=1e-4)
    for row, shot in enumerate(shots):
        errors = []
        for number in range(35):
            columns = [dataset.conditions.get(f"{READING}{camera}.{number}.{a}") for a in "uv"]
            pixel = [np.nan if column is None else column[row] for column in columns]
            errors.append(pixel - shot.pixels[number])
        errors = np.array(errors)
        assert np.isfinite(errors).all(axis=1).sum() > 20
        assert np.nanstd(errors) < 0.06


@pytest.mark.wide
@pytest.mark.parametrize(
    ("make", "kind_of"), [(image_message, "Image"), (compressed_message, "CompressedImage")]
)
def test_each_standstill_gets_the_corners_of_its_sharpest_images(tmp_path, shots, make, kind_of):
    messages = joint_states(Session(STOPS)) + recorded_images(shots, make, kind_of)
    bag = write_bag(tmp_path / "bag", messages)
    dataset = load_dataset(bag, images="/cam/image_raw")
    check_samples(dataset, shots)
    assert not dataset.measured.any()
    assert any("the 9 sharpest were searched and 9 are used" in n for n in dataset.warnings)
    document = info(bag, ReadOptions(images="/cam/image_raw"))
    assert document["channels"]["camera"] == "/cam/image_raw"
    assert not any(name.startswith("distance camera") for name in document["channels"])


@pytest.mark.wide
def test_the_lens_of_camera_info_becomes_the_entry_of_the_model_file(tmp_path, shots):
    roi = kind("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    k = np.array([600.0, 0, 319.5, 0, 601.0, 255.5, 0, 0, 1])
    lens = kind("sensor_msgs/msg/CameraInfo")(
        header(0.1),
        512,
        640,
        "plumb_bob",
        np.array(board_images.LENS),
        k,
        np.eye(3).ravel(),
        np.zeros(12),
        0,
        0,
        roi,
    )
    topic = "/cam/image_raw/compressed"
    messages = joint_states(Session(STOPS)) + recorded_images(
        shots, compressed_message, "CompressedImage", topic
    )
    messages.append(("/cam/camera_info", "sensor_msgs/msg/CameraInfo", ns(0.1), lens))
    dataset = load_dataset(write_bag(tmp_path / "bag", messages), images=topic)
    (note,) = (w for w in dataset.warnings if "states the lens" in w)
    assert "focal_length: [600, 601], principal_point: [319.5, 255.5]" in note
    assert "model: pinhole" in note
    assert "distortion: [-0.2, 0.05, 0.001, -0.0005, 0]" in note


@pytest.mark.wide
def test_two_cameras_have_channels_of_their_own(tmp_path, shots):
    messages = joint_states(Session(STOPS)) + recorded_images(shots)
    messages += recorded_images(shots, topic="/right/image")
    bag = write_bag(tmp_path / "bag", messages)
    dataset = load_dataset(bag, images=["/cam/image_raw", "/right/image"])
    check_samples(dataset, shots)
    check_samples(dataset, shots, "camera2")


@pytest.mark.wide
def test_a_topic_without_images_and_a_board_that_is_not_seen_are_errors(tmp_path, shots):
    bag = write_bag(tmp_path / "bag", joint_states(Session(STOPS)) + recorded_images(shots))
    with pytest.raises(BagError, match=r"no images on topic '/other'.*In the bag: /cam/image_raw"):
        load_dataset(bag, images="/other")
    with pytest.raises(BagError, match=r"none of 21 images .*a board of 8 columns.*--data board="):
        load_dataset(bag, images="/cam/image_raw", board="9x6")


def test_without_images_a_bag_of_joints_alone_is_refused_as_before(tmp_path, shots):
    bag = write_bag(tmp_path / "bag", joint_states(Session(STOPS)) + recorded_images(shots))
    with pytest.raises(BagError, match="no messages on topic 'measured_pose'"):
        load_dataset(bag)


def test_every_encoding_gives_the_grey_levels():
    grey = np.arange(0, 240, 5, dtype=np.uint8).reshape(6, 8)
    colour = np.repeat(grey[:, :, None], 3, axis=2)
    alpha = np.concatenate([colour, np.full((6, 8, 1), 255, np.uint8)], axis=2)
    for encoding, image in (
        ("mono8", grey),
        ("rgb8", colour),
        ("bgr8", colour),
        ("rgba8", alpha),
        ("bgra8", alpha),
    ):
        assert np.array_equal(decode_image(image_message(image, 0.0, encoding)), grey)
    even = np.full((6, 8), 77, np.uint8)
    for encoding in ("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"):
        assert np.array_equal(decode_image(image_message(even, 0.0, encoding)), even)
    deep = (grey.astype(np.uint16) * 257).astype("<u2")
    found = decode_image(image_message(deep, 0.0, "mono16"))
    assert found == pytest.approx(255.0 * grey / grey.max(), abs=1.0)
    with pytest.raises(ImageError, match="encoding 32FC1: expected one of mono8"):
        decode_image(image_message(grey, 0.0, "32FC1"))
    short = image_message(grey, 0.0)
    short.data = short.data[:-1]
    with pytest.raises(ImageError, match="has 47 bytes, expected 48"):
        decode_image(short)
