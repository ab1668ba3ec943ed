"""Make a clean Recording on one clock from the raw messages of each channel.

`bag.py` fills the raw lists from a file, and a live node fills them from its callbacks. Both get
the same checks. A bad message is dropped and counted. A stream without a good one is a BagError.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import BagError
from parallel_cal.base.float_fields import NEGATIVE_INT, UNCONVERTED, is_unconverted
from parallel_cal.recordings.channels import Kind, list_channels
from parallel_cal.recordings.clocks import require_overlap
from parallel_cal.recordings.joint_stream import clean_joints, order_readings, split_passive
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.partial_states import merge_partial_states
from parallel_cal.recordings.pose_stream import clean_poses, pose_values
from parallel_cal.recordings.publishers import keep_one_publisher, separate_publishers
from parallel_cal.recordings.recording import (
    NO_POSES,
    Dropped,
    JointStream,
    Raw,
    Recording,
    ScalarStream,
    TextStream,
)
from parallel_cal.recordings.sieve import Sieve, find_stray_stamps, require_messages, resolve_stamps


def assemble(
    raws: Mapping[str, Raw],
    options: ReadOptions,
    source: str,
    notes: Sequence[str] = (),
) -> Recording:
    """Clean the raw messages of each channel; BagError if a whole stream cannot be used.

    There are no poses if a constraint or distances replace a pose device. Of several channels of
    poses, the first one is used.
    """
    said = list(notes)
    dropped = [
        Dropped(0.0, "message cannot be decoded", f"{raw.topic}: {n} messages", n)
        for raw in raws.values()
        if (n := raw.undecodable)
    ]

    def of(kind: Kind) -> dict[str, Raw]:
        return {name: raws[name] for name in list_channels(kind, among=raws) if name in raws}

    streams = [*of("joints").values(), *of("poses").values()][:2]
    for raw in streams:
        require_messages(raw)
    encoders = split_passive(streams[0], options.passive_joints)
    streams[0] = merge_partial_states(streams[0], options.joints, options.stamps == "log", said)
    readings = order_readings(streams[0], options.joints, said, options.passive_joints)
    for k, values in enumerate([readings.q, *map(pose_values, streams[1:])]):
        at = keep_one_publisher(streams[k], values, said, dropped)
        if len(at) < len(values):
            streams[k] = streams[k].select(at)
            readings = readings if k else readings.select(at)
    times = [resolve_stamps(raw, options.stamps, said) for raw in streams]
    strays = [find_stray_stamps(ns, raw.log) for raw, ns in zip(streams, times, strict=True)]
    clocks = list(zip(streams, times, strays, strict=True))
    start = int(min(ns[~stray].min(initial=ns.max()) for _, ns, stray in clocks))
    sieves = [Sieve(raw, ns, start, stray) for raw, ns, stray in clocks]
    joints, pose = clean_joints(streams[0].topic, readings, sieves[0]), NO_POSES
    if len(streams) > 1:
        pose = clean_poses(streams[1], sieves[1], options.measures, said)
        pose = require_overlap(pose, joints, streams, times, start, said)
    for sieve in sieves:
        dropped += sieve.dropped
    numbers = partial(_clean_numbers, options.stamps, start, joints, said, dropped)
    conditions, distances = numbers(of("condition")), numbers(_by_gauge(of("readings").values()))
    distances |= numbers(_by_corner(of("images").values()))
    read = {name: raw for name, raw in encoders.items() if name not in distances}  # no own topic
    words = (_latch_texts(raw, streams[0], times[0], start) for raw in of("words").values())
    return Recording(
        source,
        start,
        joints,
        pose,
        conditions,
        next(words, None),
        distances,
        numbers(read),
        tuple(dropped),
        tuple(said),
    )


def _clean_numbers(
    stamps: str,
    start: int,
    joints: JointStream,
    notes: list[str],
    dropped: list[Dropped],
    raws: Mapping[str, Raw],
) -> dict[str, ScalarStream]:
    """Return each number over time that belongs to this recording; a note for each other one."""
    streams = dict[str, ScalarStream]()
    for name, raw in raws.items():
        if not raw.stamp:
            continue
        value = np.array([row[0] for row in raw.rows], float)
        usable = np.flatnonzero(np.isfinite(value))
        if groups := separate_publishers(raw, value[:, None], usable):
            listed = "; ".join(f"{len(at)} messages {words}" for words, at in groups.items())
            notes.append(
                f"{raw.topic}: ignored; it has several publishers, whose values disagree: "
                f"{listed}. Give each sensor a topic of its own"
            )
            continue
        sieve = Sieve(raw, resolve_stamps(raw, stamps, notes), start)
        unconverted = is_unconverted(value)
        also = NEGATIVE_INT if unconverted.any() else ""
        if not (np.isfinite(value) & ~unconverted).any():
            shown = "no finite value"
            if also:
                shown = f"{UNCONVERTED}; the first is {value[unconverted][0]:.3g}"
            notes.append(f"{raw.topic}: ignored; {shown}")
            continue
        sieve.drop(unconverted, UNCONVERTED, "", value[:, None])
        sieve.drop(~np.isfinite(value), f"value is not finite{also}")
        dropped += sieve.dropped
        time = sieve.time[sieve.keep]
        if time[0] > joints.time[-1] or (len(time) > 1 and time[-1] < joints.time[0]):
            times = f"its times do not overlap the times of {joints.topic}"
            notes.append(f"{raw.topic}: ignored; {times}")
            continue
        streams[name] = ScalarStream(raw.topic, time, value[sieve.keep])
    return streams


def _by_gauge(raws: Iterable[Raw]) -> dict[str, Raw]:
    """Group the messages of each ball-bar or probe by channel; rows are (frame, m).

    The frame is the channel, or the topic's name if the frame is empty. BagError if a channel comes
    on two topics.
    """
    gauges: dict[str, Raw] = {}
    for raw in raws:
        for log, stamp, (frame, value) in zip(raw.log, raw.stamp, raw.rows, strict=True):
            channel = frame or raw.topic.rsplit("/", 1)[-1]
            name = f"{raw.topic} ({channel})"
            gauge = gauges.setdefault(channel, Raw(name, raw.type))
            if gauge.topic != name:
                raise BagError(f"{name} is also on {gauge.topic}: give the two different names")
            gauge.append(log, stamp, (value,))
    return gauges


def _by_corner(raws: Iterable[Raw]) -> dict[str, Raw]:
    """Make one stream for each coordinate of each corner that a camera sees, in px; rows are
    (camera, numbers, pixels)."""
    corners: dict[tuple[str, int, str], Raw] = {}
    for raw in raws:
        for log, stamp, (camera, numbers, pixels) in zip(raw.log, raw.stamp, raw.rows, strict=True):
            for number, pixel in zip(numbers.tolist(), pixels.tolist(), strict=True):
                for axis, value in zip("uv", pixel, strict=True):
                    at = camera, number, axis
                    if at not in corners:
                        corners[at] = Raw(f"images of {camera}", raw.type)
                    corners[at].append(log, stamp, (value,))
    return {f"{camera}.{n}.{axis}": corners[camera, n, axis] for camera, n, axis in sorted(corners)}


def _latch_texts(
    raw: Raw, joints: Raw, joint_ns: NDArray[np.int64], start: int
) -> TextStream | None:
    """Give texts without a header the stamp of the joint state logged just before them."""
    if not raw.log:
        return None
    order = np.argsort(raw.log, kind="stable")
    before = np.searchsorted(joints.log, np.array(raw.log)[order], side="right") - 1
    time = np.asarray((joint_ns[before.clip(0)] - start) * 1e-9, float)
    return TextStream(raw.topic, time, tuple(raw.rows[i][0] for i in order))
