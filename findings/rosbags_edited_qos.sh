#!/bin/sh
# Versions: rosbags 0.11.9
# Question: The quality of service of a topic in metadata.yaml was changed from reliable to best effort, so
#   that `ros2 bag play` offers it so. The data file is untouched. What does rosbags read of the topic?
# Guess: "The same messages. The quality of service is about transport; a reader of files does not look at
#   it, and the number of messages in metadata.yaml still agrees."
# True: The connection is listed with its number of messages, but no message is returned, without an error.
#   rosbags takes a channel of the data file for another one if its quality of service differs.
# Matters: A recorded session looks as if the tracker had been silent.
cd "$(dirname "$0")" && ./with_packages rosbags==0.11.9 <<'END'
from pathlib import Path

from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
kind, never = "std_msgs/msg/Float64", QosTime(0, 0)
reliable = Qos(
    QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, never, never,
    QosLiveliness.AUTOMATIC, never, False,
)  # fmt: skip


def count(bag):
    with Reader(bag) as reader:
        return reader.connections[0].msgcount, sum(1 for _ in reader.messages())


for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
    bag = Path(plugin.name.lower())
    with Writer(bag, version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection(
            "/position", kind, typestore=store, offered_qos_profiles=[reliable]
        )
        for k in range(100):
            writer.write(topic, k, store.serialize_cdr(store.types[kind](float(k)), kind))
    before = count(bag)
    page = bag / "metadata.yaml"
    text = page.read_text()
    assert text.count("reliability: reliable") == 1
    page.write_text(text.replace("reliability: reliable", "reliability: best_effort"))
    after = count(bag)
    print(f"{plugin.name}: stated and read {before} before, {after} after the change")
    assert before == (100, 100)
    assert after == (100, 0)
END
# Seen:
#   MCAP: stated and read (100, 100) before, (100, 0) after the change
#   SQLITE3: stated and read (100, 100) before, (100, 0) after the change
