"""Joint states that are read from their bytes are those that the general decoder returns."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from parallel_cal.recordings.joint_state_bytes import JointStateReader

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPE = "sensor_msgs/msg/JointState"


def serialized(names, position, velocity=(), effort=(), stamp=(3, 500), frame="base", endian=True):
    types = STORE.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*stamp), frame)
    arrays = [np.array(values, float) for values in (position, velocity, effort)]
    message = types[TYPE](header, list(names), *arrays)
    return bytes(STORE.serialize_cdr(message, TYPE, little_endian=endian))


@pytest.mark.parametrize("frame", ["", "b", "ba", "base", "a longer frame"])
@pytest.mark.parametrize("names", [("a",), ("joint1", "j2", "arm_3")])
@pytest.mark.parametrize("arrays", [(0, 0), (1, 0), (0, 1), (1, 1)])
def test_a_second_message_is_read_as_the_general_decoder_reads_it(frame, names, arrays):
    rng = np.random.default_rng(0)
    first, second = (
        serialized(
            names,
            rng.normal(size=len(names)),
            rng.normal(size=arrays[0] * len(names)),
            rng.normal(size=arrays[1] * len(names)),
            stamp=(2_000_000_000, 999_999_999),
            frame=frame,
        )
        for _ in range(2)
    )
    reader = JointStateReader()
    assert not reader.fits(second)
    reader.learn(first, names)
    assert reader.fits(second)
    stamps, rows = reader.read([first, second])
    for data, stamp, row in zip((first, second), stamps, rows, strict=True):
        expected = STORE.deserialize_cdr(data, TYPE)
        assert stamp == 2_000_000_000_999_999_999
        assert row[0] == tuple(expected.name)
        np.testing.assert_array_equal(row[1], expected.position)
        np.testing.assert_array_equal(row[2], expected.effort)


def test_messages_of_another_layout_are_left_to_the_general_decoder():
    names = ("a", "b")
    usual = serialized(names, [1.0, 2.0], effort=[3.0, 4.0])
    reader = JointStateReader()
    reader.learn(usual, names)
    assert reader.fits(usual)
    assert not reader.fits(serialized(("a", "c"), [1.0, 2.0], effort=[3.0, 4.0]))
    assert not reader.fits(serialized(names, [1.0, 2.0], velocity=[3.0, 4.0]))
    assert not reader.fits(serialized(names, [1.0, 2.0], effort=[3.0, 4.0], frame="race"))
    assert not reader.fits(serialized(names, [1.0, 2.0], effort=[3.0, 4.0], endian=False))
    assert not reader.fits(usual + b"\0" * 8)
    for cut in range(len(usual)):
        assert not reader.fits(usual[:cut]), cut


def test_a_message_with_bytes_behind_its_arrays_teaches_the_reader_nothing():
    reader = JointStateReader()
    data = serialized(("a",), [1.0]) + b"\0" * 8
    reader.learn(data, ("a",))
    assert not reader.fits(data)


def test_a_big_endian_message_teaches_the_reader_nothing():
    reader = JointStateReader()
    data = serialized(("a",), [1.0], endian=False)
    reader.learn(data, ("a",))
    assert not reader.fits(data)
