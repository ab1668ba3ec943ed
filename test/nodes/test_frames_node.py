"""Samples of another frame are moved by TF where it is there, and refused where it is not."""

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

from rclpy.time import Time  # noqa: E402

from parallel_cal.base.errors import DatasetError  # noqa: E402
from parallel_cal.base.rotation import rotation_matrix  # noqa: E402
from parallel_cal.model.file.modelfile import read_model  # noqa: E402
from parallel_cal.nodes.frames import Transform, lookup, to_base_frame, transform_dataset  # noqa: E402
from parallel_cal.recordings.dataset import Dataset  # noqa: E402
from parallel_cal.recordings.loading import load_dataset  # noqa: E402

ROOT = Path(__file__).parents[2]
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # z by 90 degrees
STANDS = Transform(np.array([1.0, 2.0, 3.0]), QUARTER, 0.0)


@pytest.fixture(scope="module")
def model():
    return read_model(ROOT / "config" / "delta_mockup_nominal.yaml")


@pytest.fixture
def samples(model):
    cov = np.diag([1e-10, 4e-10, 9e-10, 1e-8, 4e-8, 9e-8])
    made = Dataset.from_arrays(
        model.joints, [[0.5] * 3], [[0.1, 0.2, 0.3]], [np.eye(3)], pose_cov=cov
    )
    return replace(made, frame="tracker")


def test_a_pose_is_moved_by_hand_worked_numbers(samples):
    """A quarter turn about z: x goes to y, y to -x; then 1, 2, 3 m on."""
    there = transform_dataset(samples, STANDS, "base")
    np.testing.assert_allclose(there.r[0], [0.8, 2.1, 3.3], atol=1e-15)
    np.testing.assert_allclose(there.R[0], QUARTER)
    np.testing.assert_allclose(np.diag(there.pose_cov[0]), [4e-10, 1e-10, 9e-10, 4e-8, 1e-8, 9e-8])
    assert there.frame == "base"


def test_a_transform_leaves_unmeasured_coordinates_unmeasured(samples):
    blind = replace(
        samples, measured=np.array([[True] * 3 + [False] * 3]), pose_cov=np.full((1, 6, 6), np.nan)
    )
    there = transform_dataset(blind, STANDS, "base")
    np.testing.assert_array_equal(there.R, samples.R)
    assert np.isnan(there.pose_cov).all()


def test_a_transform_keeps_single_coordinates_that_it_does_not_mix_with_unmeasured_ones(samples):
    flat = replace(samples, measured=np.array([[True, True] + [False] * 4]))
    there = transform_dataset(flat, STANDS, "base")
    np.testing.assert_allclose(there.r[0, :2], [0.8, 2.1], atol=1e-15)
    assert there.measured.tolist() == [[True, True] + [False] * 4]
    only_x = replace(samples, measured=np.array([[True] + [False] * 5]))
    assert transform_dataset(only_x, STANDS, "base").measured.tolist() == [
        [False, True] + [False] * 4
    ]
    tilted = Transform(STANDS.r, rotation_matrix(np.array([0.1, 0.0, 0.0])), 0.0)
    with pytest.raises(DatasetError, match="single coordinates"):
        transform_dataset(flat, tilted, "base")


def test_another_frame_without_a_transform_is_refused_where_the_samples_do_not_tell_it(
    samples, model
):
    with pytest.raises(DatasetError, match="frame 'tracker', the model's base is 'base'"):
        to_base_frame(samples, model, lambda target, source: None)
    there, said = to_base_frame(samples, model, lambda target, source: STANDS)
    assert (there.frame, said) == (
        "base",
        "poses transformed from 'tracker' to 'base' by TF (static)",
    )


def test_a_tracker_s_frame_is_registered_by_the_samples_as_the_command_line_does_it():
    """The tracker shows Q r + s with Q a quarter turn: it stands at -Q^T s = (-2, 1, -3) m."""
    model = read_model(ROOT / "config" / "delta_mockup_identified.yaml")
    own = load_dataset(ROOT / "bags" / "delta_clean")
    shown = transform_dataset(own, STANDS, "tracker")
    there, said = to_base_frame(shown, model, lambda target, source: None, 1e-4)
    assert there is shown
    assert said.startswith(
        "frame 'tracker' was registered to 'base' (the poses are in another frame): "
    )
    numbers = said.split("): ")[1].split(" m, rotation ")
    np.testing.assert_allclose(np.array(numbers[0].split(), float), [-2, 1, -3], atol=2e-3)
    turned = np.array(numbers[1].split(" deg")[0].split(), float)
    np.testing.assert_allclose(turned, [0, 0, -90], atol=0.05)
    assert to_base_frame(own, model, lambda target, source: None, 1e-4) == (own, "")


def test_poses_of_the_right_name_in_the_wrong_place_are_registered_too():
    model = read_model(ROOT / "config" / "delta_mockup_identified.yaml")
    wrong = transform_dataset(load_dataset(ROOT / "bags" / "delta_clean"), STANDS, "base")
    there, said = to_base_frame(wrong, model, lambda target, source: None, 1e-4)
    assert there is wrong
    assert "frame 'base' of the poses was registered to 'base' of the model" in said


def test_transforms_come_from_tf2_with_their_age(monkeypatch):
    """tf2_ros as its API has it, of which no wheel exists."""
    found = SimpleNamespace(
        header=SimpleNamespace(stamp=Time(seconds=40).to_msg()),
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=1.0, y=2.0, z=3.0),
            rotation=SimpleNamespace(x=0.0, y=0.0, z=np.sqrt(0.5), w=np.sqrt(0.5)),
        ),
    )

    class TransformException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target, source, time):
            if source != "tracker":
                raise TransformException
            return found

    tf2 = ModuleType("tf2_ros")
    tf2.Buffer, tf2.TransformException = Buffer, TransformException
    tf2.TransformListener = lambda buffer, node: object()
    monkeypatch.setitem(sys.modules, "tf2_ros", tf2)
    clock = SimpleNamespace(now=lambda: Time(seconds=42, clock_type=found_clock()))
    look = lookup(SimpleNamespace(get_clock=lambda: clock))
    r, R, age = look("base", "tracker")
    np.testing.assert_allclose(r, STANDS.r)
    np.testing.assert_allclose(R, QUARTER, atol=1e-15)
    assert age == 2.0
    assert look("base", "moon") is None


def found_clock():
    from rclpy.clock import ClockType

    return ClockType.ROS_TIME
