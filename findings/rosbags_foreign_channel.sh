#!/bin/sh
# Versions: rosbags 0.11.9, mcap 1.6.0
# Question: An intact MCAP file has a channel of ROS 2 and one of JSON (or an empty profile). What does
#   rosbags read?
# Guess: "The ROS 2 channel. It skips what it cannot decode; the profile is only a hint."
# True: Nothing. AnyReader raises KeyError 'jsonschema', or "Profile is not ros2". mcap's own reader reads
#   both files.
# Matters: Tools that log a tracker beside ROS write such files. The error reads like a damaged recording,
#   and the measurements are taken again for nothing.
cd "$(dirname "$0")" && ./with_packages rosbags==0.11.9 mcap==1.6.0 numpy==2.4.6 <<'END'
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
KIND = "geometry_msgs/msg/Point"


def write(profile, foreign):
    with open("log.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        schema = writer.register_schema(KIND, "ros2msg", b"float64 x\nfloat64 y\nfloat64 z\n")
        channel = writer.register_channel("/point", "cdr", schema)
        data = bytes(store.serialize_cdr(store.types[KIND](1.0, 2.0, 3.0), KIND))
        writer.add_message(channel, 1, data, 1)
        if foreign:
            schema = writer.register_schema("note", "jsonschema", b'{"type": "object"}')
            writer.add_message(writer.register_channel("/note", "json", schema), 2, b"{}", 2)
        writer.finish()


def read():
    try:
        with AnyReader([Path("log.mcap")], default_typestore=store) as reader:
            return len([*reader.messages()])
    except Exception as error:
        return f"{type(error).__name__} {error}"


expected = {("ros2", False): 1, ("ros2", True): "KeyError 'jsonschema'",
            ("", False): "AnyReaderError Profile is not ros2."}
for (profile, foreign), result in expected.items():
    write(profile, foreign)
    with open("log.mcap", "rb") as stream:
        whole = len([*make_reader(stream).iter_messages()])
    print(f"profile {profile!r}, JSON channel {foreign}: mcap reads {whole}, rosbags: {read()}")
    assert whole == 1 + foreign
    assert read() == result
END
# Seen:
#   profile 'ros2', JSON channel False: mcap reads 1, rosbags: 1
#   profile 'ros2', JSON channel True: mcap reads 2, rosbags: KeyError 'jsonschema'
#   profile '', JSON channel False: mcap reads 1, rosbags: AnyReaderError Profile is not ros2.
