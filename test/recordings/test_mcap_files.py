"""Sound MCAP files are read whatever else they hold; what is not read is named by its channel."""

import shutil

import bag_writing as bw
import numpy as np
import pytest
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

import parallel_cal as pc
from parallel_cal.base.errors import BagError
from parallel_cal.recordings.bag import raw_messages, read_bag

ROBOT = bw.Session([[0.1, 0.2], [0.4, 0.0], [0.2, 0.5]])
MESSAGES = [*bw.joint_states(ROBOT), *bw.poses(ROBOT)]


def write_mcap(
    path,
    *,
    profile="ros2",
    foreign=(),
    json_topic="",
    name=lambda kind: kind,
    encoding="cdr",
    end=True,
    **options,
):
    """Write the messages with the MCAP library, and one message of each foreign encoding."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile, library="test")
        channels = {}
        for k, kind in enumerate(foreign):
            schema = writer.register_schema(f"cell.{kind}", f"{kind}schema", b"{}") if kind else 0
            channel = writer.register_channel(f"/other{k}", kind, schema)
            writer.add_message(channel, bw.ns(0.5), b"{}", bw.ns(0.5))
        for topic, kind, log, message in sorted(MESSAGES, key=lambda m: m[2]):
            if topic not in channels:
                text, _ = bw.ROS.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(name(kind), "ros2msg", text.encode())
                how = "json" if topic == json_topic else encoding
                channels[topic] = writer.register_channel(f"/{topic}", how, schema)
            data = bytes(bw.ROS.serialize_cdr(message, kind))
            writer.add_message(channels[topic], log, data, log)
        if end:
            writer.finish()
    return path


SOUND = {
    "no profile": {"profile": ""},
    "the profile of another tool": {"profile": "px4"},
    "a JSON channel": {"foreign": ["json"]},
    "channels of three encodings": {"foreign": ["json", "protobuf", ""]},
    "type names of ROS 1": {"name": lambda kind: kind.replace("/msg/", "/")},
    "no summary": {
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "no chunks and no profile": {"use_chunking": False, "profile": ""},
}


@pytest.mark.parametrize("options", SOUND.values(), ids=SOUND)
def test_a_sound_file_gives_the_samples_of_its_ros_2_messages(options, tmp_path):
    path = write_mcap(tmp_path / "a.mcap", **options)
    recording = read_bag(path)
    np.testing.assert_array_equal(recording.joints.position, ROBOT.q)
    assert len(recording.pose.time) == len(bw.poses(ROBOT))
    assert len(list(raw_messages(path))) == len(MESSAGES)
    assert pc.info(path)["samples"] == 3


def test_channels_that_are_not_read_are_named_with_their_encoding(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", foreign=["json", "protobuf", ""])
    (note,) = (n for n in read_bag(path).notes if "not read" in n)
    assert "/other0 (json), /other1 (protobuf), /other2 (no encoding)" in note
    topics = {t["name"]: (t["encoding"], t["count"]) for t in pc.info(path)["topics"]}
    assert topics["/other0"] == ("json", 1)
    assert topics["/joint_states"] == ("cdr", len(ROBOT.time))


def test_joint_states_in_json_are_named_and_not_read(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", json_topic="joint_states")
    with pytest.raises(BagError, match=r"topic /joint_states is encoded as json; expected CDR"):
        read_bag(path)


@pytest.mark.parametrize("encoding", ["ros1", "json"])
def test_a_file_without_messages_of_ros_2_is_not_called_damaged(encoding, tmp_path):
    path = write_mcap(tmp_path / "a.mcap", encoding=encoding, profile="")
    with pytest.raises(BagError, match=f"is encoded as {encoding}") as error:
        read_bag(path)
    assert "damaged" not in str(error.value)


@pytest.mark.parametrize("part", [0.3, 0.9, 1.0])
@pytest.mark.parametrize("profile", ["", "ros2"])
def test_a_cut_file_is_called_damaged_with_the_cure(part, profile, tmp_path):
    path = write_mcap(tmp_path / "a.mcap", profile=profile, end=part == 0.9, foreign=["json"])
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(BagError, match=r"a\.mcap: damaged or truncated.*mcap recover"):
        read_bag(path)


def test_a_changed_byte_in_a_chunk_is_called_damaged(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", profile="")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(BagError, match=r"a\.mcap: damaged or truncated"):
        read_bag(path)


@pytest.mark.parametrize("name", ["a.bag", "recording", "a.mcap.part", "a.db3"])
def test_a_renamed_file_is_recognised_by_its_first_bytes(name, tmp_path):
    path = write_mcap(tmp_path / "a.mcap").rename(tmp_path / name)
    np.testing.assert_array_equal(read_bag(path).joints.position, ROBOT.q)


def test_a_renamed_sqlite_file_too(tmp_path):
    bag = bw.write_bag(tmp_path / "bag", MESSAGES, sqlite=True)
    (file,) = bag.glob("*.db3")
    path = shutil.copy(file, tmp_path / "a.sqlite")
    np.testing.assert_array_equal(read_bag(path).joints.position, ROBOT.q)


@pytest.mark.parametrize("sqlite", [False, True])
def test_a_file_renamed_in_its_folder_is_read_with_a_note(sqlite, tmp_path):
    bag = bw.write_bag(tmp_path / "bag", MESSAGES, sqlite=sqlite)
    (file,) = (f for f in bag.iterdir() if f.suffix != ".yaml")
    file.rename(bag / f"other{file.suffix}")
    recording = read_bag(bag)
    np.testing.assert_array_equal(recording.joints.position, ROBOT.q)
    assert any("without metadata.yaml" in note for note in recording.notes)


def test_a_compressed_file_is_named_with_the_command_that_helps(tmp_path):
    (tmp_path / "a.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfdrest")
    with pytest.raises(BagError, match=r"compressed as a whole.*zstd -d a\.mcap\.zstd"):
        read_bag(tmp_path / "a.mcap.zstd")


def test_the_files_of_these_tests_are_sound_by_the_library_that_defines_the_format(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", foreign=["json", ""], profile="")
    with path.open("rb") as stream:
        assert len(list(StreamReader(stream, validate_crcs=True).records)) > len(MESSAGES)
