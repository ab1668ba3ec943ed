"""Writes the recordings in `bags/`: `python test/helpers/make_bags.py [--only NAME] [--check]`.

Every recording is a rosbag2 folder that `ros2 bag play` accepts. `bags/truth/` says what is
hidden in each; only tests may look there.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from bag_catalogue import RECORDINGS, Bag, Machine
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from virtual_day import stream

BAGS = Path(__file__).resolve().parents[2] / "bags"
START = 1_767_225_600_000_000_000  # 2026-01-01 00:00:00 UTC, in ns
# Stored numbers are multiples of this (about 1e-9 m, rad, degC): it is far below every noise,
# and keeps the files small and equal on machines whose sines differ in the last bit.
RESOLUTION = 2.0**-30

ROS = get_typestore(Stores.ROS2_JAZZY)
TYPES = {
    "payload": "geometry_msgs/msg/InertiaStamped",
    "temperature": "sensor_msgs/msg/Temperature",
    "joint_states": "sensor_msgs/msg/JointState",
    "measured_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


# ---------------------------------------------------------------------------------------------
# Arrays to messages


def kind(name: str) -> Any:
    """A ROS message class by its short name, `geometry_msgs/Pose`."""
    return ROS.types[name.replace("/", "/msg/")]


def header(stamp: int, frame: str = "") -> Any:
    """A header at `stamp` nanoseconds."""
    time = kind("builtin_interfaces/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    return kind("std_msgs/Header")(stamp=time, frame_id=frame)


def nanoseconds(time: np.ndarray) -> list[int]:
    """Seconds since the start as time stamps, exact to the microsecond."""
    return [START + round(1e6 * t) * 1000 for t in time.tolist()]


def stored(values: np.ndarray) -> np.ndarray:
    """Values as the files keep them."""
    return np.round(np.asarray(values) / RESOLUTION) * RESOLUTION


def joint_state(stamp: int, names: list[str], q: np.ndarray) -> Any:
    """Encoder readings; an encoder knows neither velocity nor effort."""
    nothing = np.zeros(0)
    return kind("sensor_msgs/JointState")(header(stamp), names, q, nothing, nothing)


def accuracy(machine: Machine) -> list[float]:
    """The six sigmas of a pose that the device's data sheet claims; 1 km: not measured."""
    position = machine.noise.position if machine.sees_position else 1e3
    return [position] * 3 + [machine.noise.orientation] * 3


def measured_pose(stamp: int, sigmas: list[float], r: np.ndarray, quaternion: np.ndarray) -> Any:
    """The device's pose in the base frame, with its accuracy."""
    pose = kind("geometry_msgs/Pose")(
        kind("geometry_msgs/Point")(*r.tolist()),
        kind("geometry_msgs/Quaternion")(*quaternion.tolist()),
    )
    inner = kind("geometry_msgs/PoseWithCovariance")(pose, np.diag(np.square(sigmas)).ravel())
    return kind("geometry_msgs/PoseWithCovarianceStamped")(header(stamp, "base"), inner)


def payload(stamp: int, mass: float) -> Any:
    """What the platform carries, as a point mass."""
    inertia = kind("geometry_msgs/Inertia")(
        mass, kind("geometry_msgs/Vector3")(0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    )
    return kind("geometry_msgs/InertiaStamped")(header(stamp, "platform"), inertia)


def air(stamp: int, degrees: float) -> Any:
    """The workshop's temperature, good to a tenth of a degree."""
    return kind("sensor_msgs/Temperature")(header(stamp), degrees, 0.01)


def messages(bag: Bag) -> list[tuple[int, str, Any]]:
    """A recording's streams as (stamp, topic, message) in the order of time."""
    data, names, sigmas = session(bag), list(bag.machine.joints), accuracy(bag.machine)
    joints = zip(nanoseconds(data["joint_time"]), stored(data["q"]), strict=True)
    turns = stored(Rotation.from_matrix(data["R"]).as_quat(canonical=True))
    poses = zip(
        nanoseconds(data["pose_time"]),
        stored(data["r"] * bag.machine.sees_position),
        turns,
        strict=True,
    )
    warmth = stored(data["temperature"]).tolist()
    slow = zip(nanoseconds(data["temperature_time"]), warmth, strict=True)
    loads = zip(nanoseconds(data["payload_time"]), data["payload"].tolist(), strict=True)
    streams = [(t, "payload", payload(t, mass)) for t, mass in loads]
    streams += [(t, "temperature", air(t, warm)) for t, warm in slow]
    streams += [(t, "joint_states", joint_state(t, names, q)) for t, q in joints]
    streams += [(t, "measured_pose", measured_pose(t, sigmas, *pose)) for t, *pose in poses]
    return sorted(streams, key=lambda message: message[0])


# ---------------------------------------------------------------------------------------------
# Files


def quality(latched: bool) -> Qos:
    """Reliable delivery; a latched topic also reaches whoever subscribes late."""
    forever = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 10,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


@cache
def session(bag: Bag) -> dict[str, np.ndarray]:
    """The recording's arrays."""
    machine, day = bag.machine, bag.day(bag.seed)
    return stream(machine.robot, day, bag.effects, machine.noise, bag.seed, bag.clocks)


def write(name: str, folder: Path) -> Path:
    """Write one recording below `folder`, in place of an older one; returns its data file."""
    bag, path = RECORDINGS[name], folder / name
    shutil.rmtree(path, ignore_errors=True)
    plugin = StoragePlugin.SQLITE3 if bag.sqlite else StoragePlugin.MCAP
    writer = Writer(path, version=9, storage_plugin=plugin)
    # mcap compresses inside the file; sqlite3 cannot, so there the file as a whole is packed.
    mode = CompressionMode.FILE if bag.sqlite else CompressionMode.STORAGE
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = {
            topic: writer.add_connection(
                topic, t, typestore=ROS, offered_qos_profiles=[quality(topic == "payload")]
            )
            for topic, t in TYPES.items()
        }
        for stamp, topic, message in messages(bag):
            writer.write(topics[topic], stamp, ROS.serialize_cdr(message, TYPES[topic]))
    return next(file for file in path.iterdir() if file.name != "metadata.yaml")


def truth_of(bag: Bag) -> dict[str, Any]:
    """All that is hidden in a recording, and when each dwell was."""
    day = bag.day(bag.seed)
    columns = (day.arrive, day.leave, day.pose_index, np.sign(day.ways))
    dwells = zip(*(column.tolist() for column in columns), strict=True)
    return {
        "seed": bag.seed,
        "baseline": bag.baseline,
        "mode": bag.mode,
        "verdict": bag.verdict,
        "found": [name.split("|") for name in bag.found],
        "effects": [{"name": type(e).__name__} | _plain(asdict(e)) for e in bag.effects],
        "noise": asdict(bag.machine.noise),
        "true_parameters": dict(bag.machine.robot.parameters),
        "controller_parameters": dict(bag.machine.controller),
        "dwells_arrive_leave_pose_direction": [
            [round(arrive, 3), round(leave, 3), pose, [int(d) for d in direction]]
            for arrive, leave, pose, direction in dwells
        ],
    }


def _plain(numbers: dict[str, Any]) -> dict[str, Any]:
    """Tuples as the lists that YAML has."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in numbers.items()}


def write_truth(name: str, folder: Path) -> None:
    """Write what the tests may know about a recording."""
    hidden = truth_of(RECORDINGS[name])
    text = yaml.safe_dump(hidden, sort_keys=False, default_flow_style=None, width=100)
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    (folder / "truth" / f"{name}.yaml").write_text(f"# {RECORDINGS[name].about}\n{text}")


# ---------------------------------------------------------------------------------------------
# Comparison


def read(path: Path) -> Iterator[tuple[int, str, bytes]]:
    """The raw messages of a recording."""
    with Reader(path) as reader:
        for connection, stamp, raw in reader.messages():
            yield stamp, connection.topic, bytes(raw)


def same(old: Path, new: Path) -> bool:
    """Whether two recordings hold the same messages, but for the last bit of the resolution."""
    one, other = list(read(old)), list(read(new))
    unequal = [(a, b) for a, b in zip(one, other, strict=False) if a != b]
    return len(one) == len(other) and all(
        a[:2] == b[:2] and close(a[1], a[2], b[2]) for a, b in unequal
    )


def close(topic: str, one: bytes, other: bytes) -> bool:
    """Whether two messages agree to a few steps of the resolution."""
    a, b = (flat(asdict(ROS.deserialize_cdr(raw, TYPES[topic]))) for raw in (one, other))
    return len(a) == len(b) and all(
        x == y if isinstance(x, (str, int)) else abs(x - y) < 3 * RESOLUTION
        for x, y in zip(a, b, strict=True)
    )


def flat(node: Any) -> list[Any]:
    """All leaves of a message."""
    if isinstance(node, dict):
        return [leaf for value in node.values() for leaf in flat(value)]
    if isinstance(node, (list, np.ndarray)):
        return [leaf for value in node for leaf in flat(value)]
    return [node]


def check(name: str, folder: Path = BAGS) -> bool:
    """Whether the recording on disk is what this program writes today."""
    with tempfile.TemporaryDirectory() as scratch:
        write(name, Path(scratch))
        return same(folder / name, Path(scratch) / name)


# ---------------------------------------------------------------------------------------------

README = """# Recordings of virtual robots

The recordings are simulated. `parallel_cal/virtual` builds the robots from points and rods,
independently of the rest of the package. `test/helpers/bag_catalogue.py` lists the recordings.
`make bags` writes all of them, and this page. You can also run the scripts:

    python test/helpers/make_bags.py            # --only NAME writes one, --check only compares
    python test/helpers/make_baselines.py       # writes models/, the model files to start from

## Robots

- **Delta.** It has the geometry that Vischer's thesis identified on the Delta mock-up (EPFL 1996,
  table 5.18). Its controller uses the nominal geometry (table 5.12, D_x = 76 mm). Its mean
  position error is therefore 0.6 mm, like that of the mock-up.
- **Argos.** It has the geometry of table 5.22.
- **Hexapod.** Its nominal geometry is that of `stewart42`. Its balls and legs deviate by 0.5 mm
  (1 sigma).

## Measurements

The robot visits 74 or 90 poses in its workspace. The workspace of the Delta is a cube of 0.12 m
side at (0, 0, 0.2) m. The robot visits 20 or 30 of these poses a second time, from another
approach direction. It rests for 1 s at each pose, or for 10 s if the recording has a slow effect.
A motion takes 0.5 to 0.8 s and is a straight line in joint space. The device also publishes during
the motions. In `delta_latency` the robot never stops, and each measured pose is one sample
(`mode="continuous"`).

| topic | type | content |
|---|---|---|
| `joint_states` | `sensor_msgs/JointState` | positions only |
| `measured_pose` | `geometry_msgs/PoseWithCovarianceStamped` | poses in the frame `base`. \
Argos: the position is not measured, and its variances are 1e6 m^2. |
| `temperature` | `sensor_msgs/Temperature` | degC |
| `payload` | `geometry_msgs/InertiaStamped` | 0.2 kg, latched. In `delta_compliance` one message \
at each change. |

Time starts at 2026-01-01 00:00 UTC. The header stamp is the log time. All recordings are compressed
with zstd: mcap inside the file, sqlite3 as a whole (`.db3.zstd`).

## Noise

The table gives one standard deviation. The values are those of the instruments in the thesis
(sections 2.3.2 and 4.2).

| recordings | joints | position per axis | orientation per axis |
|---|---|---|---|
| Delta | 25 arcsec | 10 um | 15 arcsec |
| those that start from `delta54_fine.yaml` | 5 arcsec | 2 um | 3 arcsec |
| Argos | 25 arcsec | not measured | 47 arcsec |
| hexapod | 3 um | 10 um | 15 arcsec |

Each dwell has one error, which is constant while the robot rests. Each message adds an independent
error of a fifth of this size. Averaging within a dwell therefore reduces the error only a little,
as with real instruments. In `delta_latency` the whole error is independent in each message. The
covariance in the messages is this accuracy.

## Hidden effects

`truth/NAME.yaml` has what a recording hides: the effects, the true geometry, the noise, the time
of each dwell, and the correct verdict. Only tests use these files.

## Recordings

| recording | content | start from | joints, poses | data file | bytes | sha256 |
|---|---|---|---|---|---|---|
"""


def readme(folder: Path) -> str:
    """The page that says where the recordings come from."""
    rows = []
    for name, bag in RECORDINGS.items():
        file = next(f for f in sorted((folder / name).iterdir()) if f.name != "metadata.yaml")
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        rates = f"{1 / bag.clocks.joint:g} Hz, {1 / bag.clocks.pose:g} Hz"
        rows.append(
            f"| `{name}` | {bag.about} | `{bag.baseline}` | {rates} | `{file.name}` "
            f"| {file.stat().st_size} | {digest} |"
        )
    return README + "\n".join(rows) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Write the recordings, or say which differ from what would be written."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=RECORDINGS, help="one recording instead of all")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    options = parser.parse_args(arguments)
    names = [options.only] if options.only else list(RECORDINGS)
    if options.check:
        different = [name for name in names if not check(name)]
        sys.stderr.write("".join(f"{name} differs\n" for name in different))
        return int(bool(different))
    for name in names:
        write(name, BAGS)
        write_truth(name, BAGS)
    (BAGS / "README.md").write_text(readme(BAGS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
