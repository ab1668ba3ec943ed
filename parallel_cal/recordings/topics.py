"""Which topic of a recording serves which channel, by name and by message type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.channels import CHANNELS, Kind, named
from parallel_cal.recordings.recording import TopicInfo

Available = Sequence[TopicInfo]
Types = tuple[str, ...]

JOINTS = CHANNELS["joint_states"].types
POSES = CHANNELS["measured_pose"].types
POINTS = CHANNELS["measured_position"].types

# a topic named like this is what the robot was told or what a model computed, not a measurement
NOT_MEASUREMENTS = ("target", "command", "goal", "desired", "setpoint", "kinematics")


def choose_topics(
    available: Available, topics: Mapping[str, str], notes: list[str]
) -> dict[str, TopicInfo]:
    """The topic of each channel that has one, of those that hold poses one at most; BagError
    without joints, or without anything measured."""
    names = {channel: topics.get(channel, channel) for channel in CHANNELS}
    chosen = {
        "joint_states": _require(available, "joint_states", names["joint_states"], JOINTS, notes)
    }

    def choose(kind: Kind) -> None:
        for channel in named(kind):
            # Where a type serves for many things, only the name tells that these are meant.
            guess = None if CHANNELS[channel].by_name else notes
            types = CHANNELS[channel].types
            if found := _optional(available, channel, names[channel], types, guess):
                chosen[channel] = found

    choose("words")
    choose("readings")
    if pose := _pose(available, names, notes, needed=len(chosen) == 1):
        chosen["measured_pose" if pose.type in POSES else "measured_position"] = pose
    choose("condition")
    return chosen


def _pose(
    available: Available, names: Mapping[str, str], notes: list[str], needed: bool
) -> TopicInfo | None:
    """The pose device's topic; where another sensor was recorded, only by its name."""
    pose = _named(available, names["measured_pose"], POSES)
    point = _named(available, names["measured_position"], POINTS + POSES)
    if pose and point:
        notes.append(f"{point.name} is ignored, poses are taken from {pose.name}")
    wanted = names["measured_position"]
    if wanted == "measured_position":
        wanted = names["measured_pose"]
    if not needed:
        seen = [topic for topic in (pose, point) if topic and topic.count]
        return seen[0] if seen else _optional(available, "measured_pose", wanted, POSES + POINTS)
    return pose or point or _require(
        available, "measured_pose", wanted, POSES + POINTS, notes,
        f"; or, without a pose device, record on '{names['constraint'] or 'constraint'}' "
        f"({CHANNELS['constraint'].types[0]}) which plane or sphere holds the tip",
    )  # fmt: skip


def _named(available: Available, name: str, types: Types) -> TopicInfo | None:
    """The topic of that name, None if absent or empty; BagError if its type is another."""
    found = [t for t in available if name and t.name.strip("/") == name.strip("/")]
    fitting = [t for t in found if t.type in types]
    if found and not fitting:
        raise BagError(
            f"topic {found[0].name} holds {found[0].type}; expected {' or '.join(types)}. "
            f"Name another topic. {_listing(available)}"
        )
    return max(fitting, key=lambda t: t.count, default=None)


def _only(available: Available, types: Types) -> list[TopicInfo]:
    """Topics that may serve by their type alone."""
    return [
        topic
        for topic in available
        if topic.type in types
        and topic.count
        and not any(word in topic.name.lower() for word in NOT_MEASUREMENTS)
    ]


def _optional(
    available: Available, channel: str, name: str, types: Types, notes: list[str] | None = None
) -> TopicInfo | None:
    """The named topic, or for a default name and with `notes` the only one of that type."""
    found = _named(available, name, types)
    if found and found.count:
        return found
    if name != channel:
        if not name:
            return None
        raise BagError(f"no messages on topic '{name}' ({channel}). {_listing(available)}")
    if notes is None:
        return None
    others = _only(available, types)
    if len(others) == 1:
        notes.append(f"no topic '{name}'; {others[0].name} is used, the only one of its type")
        return others[0]
    if others:
        notes.append(
            f"no topic '{name}' and several of its type ({', '.join(t.name for t in others)}); "
            f"none is used, name one as {channel}"
        )
    return None


def _require(
    available: Available, channel: str, name: str, types: Types, notes: list[str], hint: str = ""
) -> TopicInfo:
    """As _optional, but a channel without topic is a BagError."""
    found = _optional(available, channel, name, types, notes)
    if found is None:
        raise BagError(
            f"no messages on topic '{name}' and not exactly one other topic of type "
            f"{' or '.join(types)}. Name the topic as {channel}{hint}. {_listing(available)}"
        )
    return found


def _listing(available: Available) -> str:
    return "In the bag: " + "; ".join(f"{t.name} [{t.type}] {t.count}" for t in available)
