#!/bin/sh
# Versions: mcap-ros2-support 0.6.0, mcap 1.6.0
# Question: What does mcap_ros2.writer do with a dictionary that has a misspelled key, or lacks one?
# Guess: "It raises: it has the message definition, so it knows the fields."
# True: It writes 0 for the field that it does not find, and drops the key that it does not know, silently.
# Matters: A converter from a tracker's log that writes {"X": .., "Y": .., "Z": ..} produces an intact MCAP
#   in which every position is 0 0 0, with the right number of messages and stamps.
cd "$(dirname "$0")" && ./with_packages mcap-ros2-support==0.6.0 mcap==1.6.0 <<'END'
import io

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

file = io.BytesIO()
writer = Writer(file)
schema = writer.register_msgdef("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z\n")
messages = [{"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 1.0, "Y": 2.0, "z": 3.0}, {"z": 3.0}]
for message in messages:
    writer.write_message("/point", schema, message)
writer.finish()
file.seek(0)
reader = make_reader(file, decoder_factories=[DecoderFactory()])
read = [message.decoded_message for message in reader.iter_decoded_messages()]
for message, point in zip(messages, read):
    print(message, "is read back as", point.x, point.y, point.z)
assert [(p.x, p.y, p.z) for p in read] == [(1, 2, 3), (1, 0, 3), (0, 0, 3)]
END
# Seen:
#   {'x': 1.0, 'y': 2.0, 'z': 3.0} is read back as 1.0 2.0 3.0
#   {'x': 1.0, 'Y': 2.0, 'z': 3.0} is read back as 1.0 0.0 3.0
#   {'z': 3.0} is read back as 0.0 0.0 3.0
