"""Writes the recordings in `bags/`: `python test/make_bags.py [--only NAME] [--check]`.

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
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
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
from virtual_robot import (
    TABLE_5_12,
    TABLE_5_18,
    THESIS_NOISE,
    Backlash,
    Effect,
    EncoderEccentricity,
    record,
)

BAGS = Path(__file__).resolve().parent.parent / "bags"
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


@dataclass(frozen=True)
class Bag:
    """One recording: its seed, what is hidden in it, and how it is stored."""

    about: str
    seed: int
    effects: tuple[Effect, ...] = ()
    sqlite: bool = False


RECORDINGS = {
    "delta_clean": Bag("geometry errors only", 1),
    "delta_clean_sqlite": Bag("the messages of `delta_clean`, stored as sqlite3", 1, sqlite=True),
    "delta_eccentricity": Bag(
        "encoder discs off-centre by 2 mrad (40 um on a disc of 20 mm radius)",
        2,
        (EncoderEccentricity(sin=(1.8e-3, -1.05e-3, 0.6e-3), cos=(-0.85e-3, 1.7e-3, 1.9e-3)),),
    ),
    "delta_eccentricity_faint": Bag(
        "the same at 0.4 mrad, which geometry can imitate to within the noise",
        2,
        (EncoderEccentricity(sin=(0.36e-3, -0.21e-3, 0.12e-3), cos=(-0.17e-3, 0.34e-3, 0.38e-3)),),
    ),
    "delta_backlash": Bag(
        "play of 0.2 to 0.3 mrad in the gears", 3, (Backlash(width=(0.30e-3, 0.20e-3, 0.25e-3)),)
    ),
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


def joint_state(stamp: int, q: np.ndarray) -> Any:
    """Encoder readings; an encoder knows neither velocity nor effort."""
    names, nothing = ["joint1", "joint2", "joint3"], np.zeros(0)
    return kind("sensor_msgs/JointState")(header(stamp), names, q, nothing, nothing)


def measured_pose(stamp: int, r: np.ndarray, quaternion: np.ndarray) -> Any:
    """The device's pose in the base frame, with the accuracy its data sheet claims."""
    sigmas = [THESIS_NOISE.position] * 3 + [THESIS_NOISE.orientation] * 3
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


def messages(data: dict[str, np.ndarray]) -> list[tuple[int, str, Any]]:
    """A session's streams as (stamp, topic, message) in the order of time."""
    joints = zip(nanoseconds(data["joint_time"]), stored(data["q"]), strict=True)
    turns = stored(Rotation.from_matrix(data["R"]).as_quat(canonical=True))
    poses = zip(nanoseconds(data["pose_time"]), stored(data["r"]), turns, strict=True)
    warmth = stored(data["temperature"]).tolist()
    slow = zip(nanoseconds(data["temperature_time"]), warmth, strict=True)
    streams = [(START, "payload", payload(START, float(data["payload"][0])))]
    streams += [(t, "temperature", air(t, warm)) for t, warm in slow]
    streams += [(t, "joint_states", joint_state(t, q)) for t, q in joints]
    streams += [(t, "measured_pose", measured_pose(t, *pose)) for t, *pose in poses]
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
    return record(seed=bag.seed, pose_seed=bag.seed, effects=bag.effects)


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
        for stamp, topic, message in messages(session(bag)):
            writer.write(topics[topic], stamp, ROS.serialize_cdr(message, TYPES[topic]))
    return next(file for file in path.iterdir() if file.name != "metadata.yaml")


def truth_of(bag: Bag) -> dict[str, Any]:
    """All that is hidden in a recording, and when each dwell was."""
    data = session(bag)
    columns = ("arrive", "leave", "pose_index", "direction")
    dwells = zip(*(data[name].tolist() for name in columns), strict=True)
    return {
        "seed": bag.seed,
        "effects": [{"name": type(e).__name__} | _lists(asdict(e)) for e in bag.effects],
        "noise": asdict(THESIS_NOISE),
        "true_parameters": TABLE_5_18,
        "controller_parameters": TABLE_5_12,
        "dwells_arrive_leave_pose_direction": [
            [round(arrive, 3), round(leave, 3), pose, [int(d) for d in direction]]
            for arrive, leave, pose, direction in dwells
        ],
    }


def _lists(numbers: dict[str, Any]) -> dict[str, list[float]]:
    return {name: list(values) for name, values in numbers.items()}


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

README = """# Recordings of a virtual Delta robot
All are synthetic: `test/virtual_robot.py` builds the robot from points and rods, independently of
the package, and `test/make_bags.py` records it. One command writes them all (and this page):

    python test/make_bags.py            # --only NAME for one, --check to compare instead

**The robot** has the geometry that Vischer's thesis identified on the Delta mock-up (EPFL 1996,
table 5.18); its controller believes in the nominal one (table 5.12, D_x = 76 mm). So it misses its
targets by 0.6 mm on average, as the mock-up did.

**The session**: 74 poses spread over a cube of 0.12 m side at (0, 0, 0.2) m, and 20 of them once
more later, reached from another side. The robot rests 1 s at each and moves for 0.5 to 0.8 s in
between, joints in straight lines. The device goes on publishing during the moves.

| topic | type | rate |
|---|---|---|
| `joint_states` | `sensor_msgs/JointState`, position only | 100 Hz |
| `measured_pose` | `geometry_msgs/PoseWithCovarianceStamped`, frame `base` | 20 Hz |
| `temperature` | `sensor_msgs/Temperature`, degC | 1 Hz |
| `payload` | `geometry_msgs/InertiaStamped`, 0.2 kg | once, latched |

**Noise** (1 sigma; the thesis' instruments, sections 2.3.2 and 4.2): joints 25 arcsec, position
10 um and orientation 15 arcsec per axis. Each is one error per dwell, constant while the robot
rests, plus a fifth of it anew in every message: averaging within a dwell hardly helps, as in life.
The covariance in the messages is that accuracy. Time starts at 2026-01-01 00:00 UTC; header stamp
= log time. All are compressed with zstd: mcap inside the file, sqlite3 as a whole (`.db3.zstd`).

**What is hidden** in each is in `truth/NAME.yaml`, for tests only.

| recording | holds | data file | bytes | sha256 |
|---|---|---|---|---|
"""


def readme(folder: Path) -> str:
    """The page that says where the recordings come from."""
    rows = []
    for name, bag in RECORDINGS.items():
        file = next(f for f in sorted((folder / name).iterdir()) if f.name != "metadata.yaml")
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        rows.append(
            f"| `{name}` | {bag.about} | `{file.name}` | {file.stat().st_size} | {digest} |"
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
