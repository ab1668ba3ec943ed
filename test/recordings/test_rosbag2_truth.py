"""What `ros2 bag record` writes where readers differ: files, versions of metadata, static frames.

The forms are those of rosbag2's own writer (64717ee8, Jazzy; `yaml.hpp`, `qos.cpp` and
`sequential_writer.cpp` were read). Each recording must give the samples of the plain one.
"""

import bag_writing as bw
import numpy as np
import pytest
import yaml
from test_tf_chain import TIMES, messages, tool

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions

MOVES = bw.Session([[0.1, 0.2], [0.4, 0.0], [0.2, 0.5]])
FOREVER = {"sec": 9223372036, "nsec": 854775807}
FOXY_FOREVER = {"sec": 2147483647, "nsec": 4294967295}
CHAIN = ReadOptions(topics={"measured_pose": "/tf:world->tool"})


def make_qos(version, forever=FOREVER, history="unknown", durability="volatile"):
    """The quality of service of a publisher: numbers in a text before version 9, then words."""
    numbers = {"unknown": 3, "keep_last": 1, "volatile": 2, "transient_local": 1}
    words = {
        "history": history,
        "depth": 0,
        "reliability": "best_effort",
        "durability": durability,
        "deadline": forever,
        "lifespan": forever,
        "liveliness": "automatic",
        "liveliness_lease_duration": forever,
        "avoid_ros_namespace_conventions": False,
    }
    if version >= 9:
        return [words]
    numbered = numbers | {"best_effort": 2, "automatic": 1}
    return yaml.safe_dump(
        [{k: numbered.get(v, v) if isinstance(v, str) else v for k, v in words.items()}]
    )


def rewrite(bag, version, **qos):
    """Write the metadata of a recording as a release with this version of it does."""
    page = yaml.safe_load((bag / "metadata.yaml").read_text())
    about = page["rosbag2_bagfile_information"]
    about["version"] = version
    for topic in about["topics_with_message_count"]:
        inner = topic["topic_metadata"]
        inner["offered_qos_profiles"] = make_qos(version, **qos)
        for key, since in (("offered_qos_profiles", 4), ("type_description_hash", 7)):
            if version < since:
                del inner[key]
    keys = {"compression_format": 3, "compression_mode": 3, "files": 5, "custom_data": 6}
    for key, since in {**keys, "ros_distro": 8}.items():
        if version < since:
            del about[key]
    (bag / "metadata.yaml").write_text(yaml.safe_dump(page))


def moves():
    return bw.joint_states(MOVES) + bw.poses(MOVES)


@pytest.mark.parametrize("version", range(2, 10))
def test_every_version_of_the_metadata_gives_the_same_samples(tmp_path, version):
    bag = bw.write_bag(tmp_path / "bag", moves(), sqlite=version < 5)
    plain = read_bag(bag)
    rewrite(bag, version)
    found = read_bag(bag)
    assert not found.notes
    np.testing.assert_array_equal(found.joints.position, plain.joints.position)
    np.testing.assert_array_equal(found.pose.position, plain.pose.position)
    assert len(found.pose.time) > 50


@pytest.mark.parametrize(
    "qos",
    [
        {"forever": FOXY_FOREVER},
        {"history": "keep_last", "durability": "transient_local"},
        {"durability": "best_available"},
    ],
)
@pytest.mark.parametrize("version", [8, 9])
def test_the_quality_of_service_of_a_publisher_changes_no_sample(tmp_path, qos, version):
    """A file for --qos-profile-overrides-path changes the recorder's subscription only."""
    bag = bw.write_bag(tmp_path / "bag", moves())
    rewrite(bag, version, **qos)
    found = read_bag(bag)
    assert not found.notes
    np.testing.assert_array_equal(found.joints.position, MOVES.q)


def split_chain(tmp_path, repeated=False):
    """A recording of static frames and a tracker in three files; `repeated`: with the static
    frames again at the begin of each file, as newer recorders write latched topics."""
    whole, end = messages(), TIMES[-1]
    static = [one for one in whole if one[0] == "tf_static"]
    parts = []
    for k in range(3):
        low, high = bw.ns(k * end / 3), bw.ns((k + 1) * end / 3 + (k == 2))
        part = [one for one in whole if low <= one[2] < high]
        if k and repeated:
            part += [(*one[:2], low, one[3]) for one in static]
        parts.append(part)
    (tmp_path / "s").mkdir()
    for part in parts[1:]:  # each file's metadata lists all topics
        assert repeated or not any(one[0] == "tf_static" for one in part)
    return parts


@pytest.mark.parametrize("repeated", [False, True])
def test_static_frames_of_the_first_file_serve_all_files_of_a_recording(tmp_path, repeated):
    parts = split_chain(tmp_path, repeated)
    bag = bw.split(tmp_path / "s", *parts)
    found = read_bag(bag, CHAIN)
    times = found.pose.time + (found.start_ns - bw.START) * 1e-9
    r, R = tool(times)
    assert len(times) == len(TIMES)
    np.testing.assert_allclose(found.pose.position, r, atol=1e-12)
    np.testing.assert_allclose(found.pose.rotation, R.as_matrix(), atol=1e-12)


def test_a_later_file_alone_has_no_static_frames_and_says_so(tmp_path):
    bag = bw.split(tmp_path / "s", *split_chain(tmp_path))
    with pytest.raises(BagError, match=r"no chain.*'world' to 'tool'"):
        read_bag(bag / "part1.mcap", CHAIN)
