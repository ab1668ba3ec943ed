"""Raw messages -> a clean Recording: stamps, names, finite numbers, quaternions, covariances.

`bag.py` fills the raw lists from a file and a live node may fill them from its callbacks; both get
the same checks. A bad message is dropped and counted; a stream without a good one is a BagError.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.recording import (
    COORDINATES,
    NO_POSES,
    Array,
    Bools,
    Dropped,
    JointStream,
    PoseStream,
    Raw,
    Recording,
    ScalarStream,
    TextStream,
    TopicInfo,
)

NOT_MEASURED = 1e3  # a variance above this says "this coordinate is not measured"
NOT_GIVEN = 1e-24  # no device knows a pose to 1e-12 m or rad: a variance up to this is no statement
ABSURD = 1e9  # m or rad: no robot reads this, and the sums of its squares would overflow
CLOCK_JUMP = 1_000_000_000  # ns; a stamp further back than this is a clock that was reset


class Sieve:
    """Marks single messages of one topic as unusable, remembers why, and counts them."""

    def __init__(self, raw: Raw, stamp: NDArray[np.int64], start_ns: int) -> None:
        self.topic = raw.topic
        self.time = np.asarray((stamp - start_ns) * 1e-9, float)
        self.keep: Bools = np.ones(len(stamp), bool)
        self.dropped: list[Dropped] = []
        self._stamps(stamp)

    def drop(
        self, bad: ArrayLike, reason: str, hint: str = "", values: Array | None = None
    ) -> None:
        """Drop the messages marked in `bad` (n,), the first of them told with its row of `values`;
        BagError when nothing is left."""
        bad = np.asarray(bad, bool) & self.keep
        if not bad.any():
            return
        self.keep &= ~bad
        first, count = int(np.argmax(bad)), int(bad.sum())
        shown = "" if values is None else ": " + " ".join(f"{v:.6g}" for v in values[first])
        message = f"message {first}{shown}"
        if not self.keep.any():
            raise BagError(
                f"{self.topic}: none of its {len(bad)} messages can be used; the last {count} "
                f"were dropped because: {reason} ({message}). {hint}".rstrip()
            )
        detail = f"{self.topic}: {count} of {len(bad)} messages, the first is {message}"
        self.dropped.append(Dropped(float(self.time[first]), reason, detail, count))

    def _stamps(self, stamp: NDArray[np.int64]) -> None:
        """Drop messages that are late or repeat a time; BagError when the clock jumped back."""
        latest = np.maximum.accumulate(stamp)
        before = np.concatenate([[stamp[0] - 1], latest[:-1]])
        jump = np.flatnonzero(stamp < before - CLOCK_JUMP)[:1]
        for i in jump:
            raise BagError(
                f"{self.topic}: time runs backwards at message {i}: {stamp[i] * 1e-9:.3f} s comes "
                f"after {before[i] * 1e-9:.3f} s. Record again with one clock, cut the bag there, "
                "or read it by log time (stamps='log')."
            )
        self.drop(stamp < before, "stamp earlier than the message before")
        self.drop(stamp == before, "stamp repeats the message before")


def assemble(
    joints: Raw,
    poses: Raw | None,
    *,
    temperature: Raw | None = None,
    payload: Raw | None = None,
    constraint: Raw | None = None,
    distance: Raw | None = None,
    joint_names: Sequence[str] | None = None,
    measures: Sequence[str] | None = None,
    stamps: str = "header",
    source: str = "",
    sha256: str = "",
    topics: tuple[TopicInfo, ...] = (),
    notes: Sequence[str] = (),
) -> Recording:
    """Clean raw messages into a Recording; BagError when a whole stream cannot be used.

    `poses` is None where a constraint or distances stand in for a pose device. `measures`
    overrides what the pose messages say they measure, e.g. ("x", "y", "z").
    """
    said, dropped = list(notes), []
    streams = [raw for raw in (joints, poses) if raw is not None]
    times = [resolve_stamps(raw, stamps, said) for raw in streams]
    start = int(min(ns.min() for ns in times))
    sieves = [Sieve(raw, ns, start) for raw, ns in zip(streams, times, strict=True)]
    joint_stream, pose_stream = clean_joints(joints, sieves[0], joint_names, said), NO_POSES
    if poses is not None:
        pose_stream = clean_poses(poses, sieves[1], measures, said)
        _require_overlap(joint_stream, pose_stream, start)
    for sieve, raw in zip(sieves, streams, strict=True):
        dropped += _undecodable(raw) + sieve.dropped
    gauges = _by_gauge(distance)
    warmth, load, *read = (
        _scalar(raw, stamps, start, joint_stream, said, dropped)
        for raw in (temperature, payload, *gauges.values())
    )
    dropped += _undecodable(constraint) + _undecodable(distance)
    return Recording(
        source, sha256, start, topics, joint_stream, pose_stream, warmth, load,
        _held(constraint, joints, times[0], start),
        {channel: stream for channel, stream in zip(gauges, read, strict=True) if stream},
        tuple(dropped), tuple(said),
    )  # fmt: skip


def resolve_stamps(raw: Raw, stamps: str, notes: list[str]) -> NDArray[np.int64]:
    """Time (n,) in ns of each message: the header's, or the log's where headers carry none."""
    if not raw.stamp:
        why = f" ({raw.undecodable} cannot be decoded)" if raw.undecodable else ""
        raise BagError(
            f"{raw.topic}: no usable message{why}. Record again with this topic; where messages "
            "were compressed one by one, give the bag's folder with its metadata.yaml."
        )
    header, log = np.array(raw.stamp, np.int64), np.array(raw.log, np.int64)
    if stamps == "log":
        return log
    empty = header == 0
    if np.mean(empty) > 0.5:
        notes.append(f"{raw.topic}: header stamps are zero; the time of recording is used instead")
        return log
    # a few zeros among real stamps repeat the time before them, and the sieve drops repeats
    last = np.maximum.accumulate(np.where(empty, int(np.argmin(empty)), np.arange(len(header))))
    header = header[last]
    return header


def clean_joints(
    raw: Raw, sieve: Sieve, wanted: Sequence[str] | None, notes: list[str]
) -> JointStream:
    """Joint readings in the order of `wanted`, matched by name; rows are (names, q, effort)."""
    names = _joint_names(raw, wanted, notes)
    q = np.full((len(raw.rows), len(names)), np.nan)
    effort = np.full_like(q, np.nan)
    columns: dict[tuple[str, ...], list[int] | None] = {}
    missing, ragged = np.zeros(len(q), bool), np.zeros(len(q), bool)
    for i, (present, position, torque) in enumerate(raw.rows):
        if present not in columns:
            complete = set(names) <= set(present)
            columns[present] = [present.index(n) for n in names] if complete else None
        index = columns[present]
        missing[i], ragged[i] = index is None, len(position) != len(present)
        if index is not None and not ragged[i]:
            q[i] = position[index]
            if len(torque) == len(present):
                effort[i] = torque[index]
    hint = f"Expected a position in rad or m for each of {', '.join(names)}: check their driver."
    sieve.drop(missing, f"lacks some of the joints {', '.join(names)}")
    sieve.drop(ragged, "position and name differ in length", hint)
    sieve.drop(~np.isfinite(q).all(axis=1), "joint reading is not finite", hint, q)
    sieve.drop((np.abs(q) > ABSURD).any(axis=1), "joint reading is beyond 1e9", hint, q)
    keep = sieve.keep
    return JointStream(raw.topic, names, sieve.time[keep], q[keep], effort[keep])


def _joint_names(raw: Raw, wanted: Sequence[str] | None, notes: list[str]) -> tuple[str, ...]:
    """The requested joints, or those of most messages; BagError when one is never reported."""
    counts = Counter(row[0] for row in raw.rows)
    names = tuple(wanted) if wanted else counts.most_common(1)[0][0]
    seen = list(dict.fromkeys(name for present in counts for name in present))
    unknown = [name for name in names if name not in seen]
    if unknown or not names or len(set(names)) < len(names):
        raise BagError(
            f"{raw.topic}: joints expected: {', '.join(names) or 'none'}; joints recorded: "
            f"{', '.join(seen) or 'none'}; not found: {', '.join(unknown) or 'none'}. "
            "Give the joints' names as they are recorded, each once."
        )
    if not any(set(names) <= set(present) for present in counts):
        raise BagError(
            f"{raw.topic}: no message holds all the joints {', '.join(names)}; messages hold "
            f"{'; '.join(', '.join(present) for present in counts)}. Publish them in one message."
        )
    extra = [name for name in seen if name not in names]
    if extra:
        notes.append(f"{raw.topic}: joints ignored: {', '.join(extra)}")
    return names


def clean_poses(
    raw: Raw, sieve: Sieve, measures: Sequence[str] | None, notes: list[str]
) -> PoseStream:
    """Poses with what each measures; rows are (frame, position, quaternion or None, covariance)."""
    position = np.array([row[1] for row in raw.rows], float)
    quaternion = np.array([row[2] or (0.0, 0.0, 0.0, 1.0) for row in raw.rows], float)
    has_rotation = np.array([row[2] is not None for row in raw.rows])
    variance = [np.zeros(36) if row[3] is None else row[3] for row in raw.rows]
    covariance, measured = read_covariance(np.array(variance).reshape(-1, 6, 6))
    notes += _without_impossible_correlations(covariance, raw.topic)
    measured[:, 3:] &= has_rotation[:, None]
    if measures is not None:
        measured &= np.isin(COORDINATES, _known(measures))
    frame = _sieve_frames(raw, sieve)
    _sieve_poses(sieve, position, quaternion, measured)
    if np.all(quaternion[measured[:, 3:].any(1)] == (0, 0, 0, 1)) and measured[:, 3:].any():
        notes.append(
            f"{raw.topic}: every orientation is exactly identity; if the device measures "
            "positions only, say so (measures=x,y,z, PointStamped, or variances above 1e3)"
        )
    covariance[~measured] = np.nan
    np.swapaxes(covariance, 1, 2)[~measured] = np.nan
    keep = sieve.keep
    return PoseStream(
        raw.topic, raw.type, frame, sieve.time[keep], position[keep], quaternion[keep],
        measured[keep], covariance[keep],
    )  # fmt: skip


def read_covariance(covariance: Array) -> tuple[Array, Bools]:
    """Covariance (n, 6, 6), NaN where not given (variance <= 1e-24), what is measured (n, 6)."""
    covariance = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    measured = ~(variance > NOT_MEASURED)
    unknown = ~(variance > NOT_GIVEN) | ~measured | ~np.isfinite(variance)
    covariance[unknown] = np.nan
    np.swapaxes(covariance, 1, 2)[unknown] = np.nan
    return covariance, measured


def _without_impossible_correlations(covariance: Array, topic: str) -> list[str]:
    """Leave matrices (n, 6, 6) that are no covariance their variances only; a sentence if any."""
    sigma = np.sqrt(np.nan_to_num(np.diagonal(covariance, axis1=1, axis2=2)))
    sigma[sigma == 0.0] = 1.0
    with np.errstate(over="ignore"):
        correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    correlation = np.clip(np.nan_to_num(correlation), -2.0, 2.0)
    correlated = np.flatnonzero(np.count_nonzero(correlation, axis=(1, 2)) > 6)
    least = np.linalg.eigvalsh(correlation[correlated])[:, 0]
    bad = correlated[least < -1e-6]
    if not len(bad):
        return []
    alone = np.isnan(covariance[bad]) | np.eye(6, dtype=bool)
    covariance[bad] = np.where(alone, covariance[bad], 0.0)
    return [
        f"{topic}: no covariance, as it has a negative eigenvalue, in {len(bad)} of "
        f"{len(covariance)} messages, the first is message {bad[0]}: its variances alone are used"
    ]


def _known(measures: Sequence[str]) -> list[str]:
    """The coordinates asked for; BagError for a name that is none."""
    unknown = [name for name in measures if name not in COORDINATES]
    if unknown:
        raise BagError(f"measures: {unknown} unknown; expected some of {', '.join(COORDINATES)}")
    return list(measures)


def _sieve_frames(raw: Raw, sieve: Sieve) -> str:
    """The frame most poses are given in; drops poses in any other."""
    frames = np.array([row[0] for row in raw.rows])
    frame = Counter(frames[sieve.keep].tolist()).most_common(1)[0][0]
    sieve.drop(frames != frame, f"frame_id is not '{frame}' like the others'")
    return frame


def _sieve_poses(sieve: Sieve, position: Array, quaternion: Array, measured: Bools) -> None:
    """Drop poses that are not finite or no rotation; put placeholders where nothing is measured."""
    rotates = measured[:, 3:].any(axis=1)
    position[~measured[:, :3]] = 0.0
    quaternion[~rotates] = (0.0, 0.0, 0.0, 1.0)
    finite = np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1)
    norm = np.linalg.norm(np.clip(np.nan_to_num(quaternion, nan=1.0), -ABSURD, ABSURD), axis=1)
    hint = (
        "If the device measures positions only, say so: measures=x,y,z, a PointStamped topic, "
        "or orientation variances above 1e3."
    )
    shown = np.hstack([position, quaternion])
    absurd = (np.abs(position) > ABSURD).any(axis=1)
    sieve.drop(~measured.any(axis=1), "nothing measured (all variances above 1e3)")
    sieve.drop(~finite, "pose is not finite", hint, shown)
    sieve.drop(absurd, "position is beyond 1e9", "Expected metres.", shown)
    sieve.drop(norm < 1e-6, "quaternion is zero", hint, quaternion)
    sieve.drop(np.abs(norm - 1.0) > 0.05, "quaternion is not of unit length", hint, quaternion)
    quaternion /= np.maximum(norm, 1e-300)[:, None]


def _scalar(
    raw: Raw | None,
    stamps: str,
    start: int,
    joints: JointStream,
    notes: list[str],
    dropped: list[Dropped],
) -> ScalarStream | None:
    """A condition's stream; None, with a note, when it cannot belong to this recording."""
    if raw is None or not raw.stamp:
        return None
    sieve = Sieve(raw, resolve_stamps(raw, stamps, notes), start)
    value = np.array([row[0] for row in raw.rows], float)
    if not np.isfinite(value).any():
        notes.append(f"{raw.topic}: ignored, no finite value")
        return None
    sieve.drop(~np.isfinite(value), "value is not finite")
    dropped += _undecodable(raw) + sieve.dropped
    time = sieve.time[sieve.keep]
    if time[0] > joints.time[-1] or (len(time) > 1 and time[-1] < joints.time[0]):
        notes.append(f"{raw.topic}: ignored, its times do not overlap {joints.topic}'s")
        return None
    return ScalarStream(raw.topic, time, value[sieve.keep])


def _by_gauge(raw: Raw | None) -> dict[str, Raw]:
    """The messages of each ball-bar or probe; rows are (frame, m), and the frame is its channel,
    or where that is empty the topic's own name."""
    gauges: dict[str, Raw] = {}
    if raw is None:
        return gauges
    for log, stamp, (frame, value) in zip(raw.log, raw.stamp, raw.rows, strict=True):
        channel = frame or raw.topic.rsplit("/", 1)[-1]
        gauge = gauges.setdefault(channel, Raw(f"{raw.topic} ({channel})", raw.type))
        gauge.log.append(log)
        gauge.stamp.append(stamp)
        gauge.rows.append((value,))
    return gauges


def _held(
    raw: Raw | None, joints: Raw, joint_ns: NDArray[np.int64], start: int
) -> TextStream | None:
    """Words without a header: said when the joint state was that was logged just before them."""
    if raw is None or not raw.log:
        return None
    order = np.argsort(raw.log, kind="stable")
    before = np.searchsorted(joints.log, np.array(raw.log)[order], side="right") - 1
    time = np.asarray((joint_ns[before.clip(0)] - start) * 1e-9, float)
    return TextStream(raw.topic, time, tuple(raw.rows[i][0] for i in order))


def _undecodable(raw: Raw | None) -> list[Dropped]:
    """The report of messages whose bytes are no message of their type."""
    if raw is None or not raw.undecodable:
        return []
    detail = f"{raw.topic}: {raw.undecodable} messages"
    return [Dropped(0.0, "message cannot be decoded", detail, raw.undecodable)]


def _require_overlap(joints: JointStream, pose: PoseStream, start: int) -> None:
    """BagError when joints and poses were never recorded at the same time."""
    if joints.time[0] <= pose.time[-1] and pose.time[0] <= joints.time[-1]:
        return
    spans = [
        f"{s.topic} from {s.time[0] + start * 1e-9:.3f} to {s.time[-1] + start * 1e-9:.3f} s"
        for s in (joints, pose)
    ]
    raise BagError(
        f"the streams never overlap: {spans[0]}, {spans[1]}. Their clocks differ or one was off: "
        "record both together, or read by log time (stamps='log')."
    )
