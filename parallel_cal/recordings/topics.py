"""Choose the topic of each channel of a recording, by name and by message type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.channels import CHANNELS, Channel, Kind, find_channel, list_channels
from parallel_cal.recordings.mcap_files import ROS_2
from parallel_cal.recordings.pose_messages import OTHER_POSE_TYPES, may_hold_poses, split_body
from parallel_cal.recordings.recording import TopicInfo

Types = tuple[str, ...]

POSES = CHANNELS["measured_pose"].types
POINTS = CHANNELS["measured_position"].types

# Topics with these words in their name are commands or computed by a model, not measured.
NOT_MEASUREMENTS = ("target", "command", "goal", "desired", "setpoint", "kinematics")


def choose_topics(
    available: Sequence[TopicInfo],
    topics: Mapping[str, str],
    notes: list[str],
    has_images: bool = False,
    may_lack_poses: bool = False,
) -> dict[str, TopicInfo]:
    """Return the topic of each channel that has one, and at most one topic of poses.

    BagError if there are no joints, or nothing measured besides images, unless the joint states may
    contain what was measured (`may_lack_poses`).
    """
    channels: dict[str, Channel] = {n: c for n in topics if (c := find_channel(n))} | CHANNELS
    names = {channel: split_body(topics.get(channel, channel))[0] for channel in channels}
    offer = _Offer(available, notes)
    joints = CHANNELS["joint_states"].types
    chosen = {"joint_states": offer.require("joint_states", names["joint_states"], joints)}

    def choose(kind: Kind) -> None:
        for channel in list_channels(kind, among=topics):
            # If a message type has many uses, only the topic's name identifies the channel.
            guess, types = not channels[channel].by_name, channels[channel].types
            found = offer.without(chosen.values()).optional(channel, names[channel], types, guess)
            if found:
                chosen[channel] = found

    choose("words")
    choose("readings")
    if pose := _pose(offer, names, len(chosen) == 1 and not has_images, may_lack_poses):
        chosen["measured_position" if pose.type in POINTS else "measured_pose"] = pose
    choose("condition")
    return chosen


def _pose(offer: _Offer, names: Mapping[str, str], alone: bool, optional: bool) -> TopicInfo | None:
    """Return the pose device's topic; only by its name if another sensor was recorded."""
    pose = offer.find_named(names["measured_pose"], POSES)
    point = offer.find_named(names["measured_position"], POINTS + POSES)
    if pose and point:
        offer.notes.append(f"{point.name} is ignored; poses are taken from {pose.name}")
    wanted = names["measured_position"]
    if wanted == "measured_position":
        wanted = names["measured_pose"]
    if not alone or optional:
        seen = [topic for topic in (pose, point) if topic and topic.count]
        return seen[0] if seen else offer.optional("measured_pose", wanted, POSES + POINTS, alone)
    return (
        pose
        or point
        or offer.require(
            "measured_pose",
            wanted,
            POSES + POINTS,
            "; or, without a pose device, record on "
            f"'{names['constraint'] or 'constraint'}' "
            f"({CHANNELS['constraint'].types[0]}) which plane or sphere constrains "
            "the tip",
        )
    )


@dataclass(frozen=True)
class _Offer:
    """The topics of a recording, and notes about guessed ones."""

    available: Sequence[TopicInfo]
    notes: list[str]

    def without(self, taken: Iterable[TopicInfo]) -> _Offer:
        """Return the offer without the topics of other channels."""
        used = [topic.name for topic in taken]
        return replace(self, available=[t for t in self.available if t.name not in used])

    def find_named(self, name: str, types: Types) -> TopicInfo | None:
        """Return the topic of this name, or None; BagError if its type does not fit."""
        found = [t for t in self.available if name and t.name.strip("/") == name.strip("/")]
        any_pose = set(POSES) <= set(types)  # a pose may have many types if its topic is named
        foreign = [t for t in found if t.encoding != ROS_2]
        if foreign and len(foreign) == len(found):
            raise BagError(
                f"topic {found[0].name} is encoded as {foreign[0].encoding}; expected CDR, the "
                f"encoding of ROS 2. Name another topic, or convert it. {self.listing}"
            )
        found = [t for t in found if t.encoding == ROS_2]
        fitting = [t for t in found if t.type in types or (any_pose and may_hold_poses(t.type))]
        if found and not fitting:
            expected = (*types, *OTHER_POSE_TYPES, "a driver's own") if any_pose else types
            raise BagError(
                f"topic {found[0].name} has type {found[0].type}; expected "
                f"{' or '.join(expected)}. Name another topic. {self.listing}"
            )
        return max(fitting, key=lambda t: t.count, default=None)

    def optional(self, channel: str, name: str, types: Types, guess: bool) -> TopicInfo | None:
        """Return the named topic; with a default name and `guess`, the only one of its type."""
        found = self.find_named(name, types)
        if found and found.count:
            return found
        if name and name != channel:
            raise BagError(f"no messages on topic '{name}' ({channel}). {self.listing}")
        if not (name and guess):
            return None
        others = [
            topic
            for topic in self.available
            if topic.type in types
            and topic.encoding == ROS_2
            and topic.count
            and not any(word in topic.name.lower() for word in NOT_MEASUREMENTS)
        ]
        if len(others) == 1:
            only = others[0].name
            self.notes.append(
                f"no topic '{name}'; {only} is used because it is the only one of its type"
            )
            return others[0]
        if others:
            self.notes.append(
                f"no topic '{name}' and several topics of its type "
                f"({', '.join(t.name for t in others)}); none is used. Name one as "
                f"{channel}"
            )
        return None

    def require(self, channel: str, name: str, types: Types, hint: str = "") -> TopicInfo:
        """Return the topic as `optional` does; BagError if there is none."""
        found = self.optional(channel, name, types, guess=True)
        if found is None:
            raise BagError(
                f"no messages on topic '{name}', and not exactly one other topic of type "
                f"{' or '.join(types)}. Name the topic as {channel}{hint}. {self.listing}"
            )
        return found

    @property
    def listing(self) -> str:
        def kind(topic: TopicInfo) -> str:
            return topic.type if topic.encoding == ROS_2 else f"{topic.type} ({topic.encoding})"

        return "In the bag: " + "; ".join(f"{t.name} [{kind(t)}] {t.count}" for t in self.available)
