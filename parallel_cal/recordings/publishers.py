"""Separate the publishers of one topic by what their messages contain.

A recording does not state who published a message. Two publishers show in the values: each one
continues its own series, and the topic jumps back and forth between the two. So messages are
grouped by a feature (their names, their frame, their decimals, ...), and a group is a publisher if
its messages continue their own series rather than the message before them. Groups of one publisher
do not: the message before is nearer in time, and at rest it is as near as any other.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import BagError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.recording import MAX_PLAUSIBLE_READING, Array, Bools, Dropped, Raw

Labels = NDArray[np.int64]

N_VOTES = 32  # successive votes of one group
SIGNIFICANCE = 5.0  # sigma of as many fair coins, by which these votes show a publisher
N_NEIGHBOURS = 17  # messages whose spread tells motion from rest
N_DECIMALS = 6  # decimals to which a publisher may round; finer rounding is below the noise
MIN_OCCURRENCES = 3  # a measured value with noise does not occur so often; a command does
MIN_REST = 0.2  # share of a recording in which a robot that is to be measured rests, at least
CLEAR = 10.0  # times the usual step: another publisher's value, no noise
MIN_RETURNS = 0.05  # share of returning messages that shows another publisher, not odd messages
MAX_RETURN_S = 0.3  # s in which no robot goes somewhere, rests and returns
ROUNDING = 1e-12  # relative rounding error of a number that was converted to degrees and back
CURE = (
    "'ros2 topic info -v {topic}' lists the publishers of a running system. Stop the others, or "
    "give them another topic"
)


@dataclass(frozen=True)
class Feature:
    """A property by which messages (n,) are grouped, with the words for each group."""

    labels: Labels
    words: Sequence[str]


def keep_one_publisher(
    raw: Raw, values: Array, notes: list[str], dropped: list[Dropped]
) -> list[int]:
    """Return the numbers of the messages of the publisher that measures.

    Parameters
    ----------
    raw : Raw
        Messages of one topic.
    values : (n, k) array
        The numbers in each message. Messages with a NaN or an impossible number are kept: they are
        dropped for other reasons.
    notes, dropped : list
        Receive a warning and a count for each publisher whose messages are dropped.

    Raises
    ------
    BagError
        If two publishers disagree and neither is evidently no measurement.
    """
    keep, finite = np.ones(len(values), bool), (np.abs(values) < MAX_PLAUSIBLE_READING).all(axis=1)
    while groups := separate_publishers(raw, values, np.flatnonzero(keep & finite)):
        measured, reasons = _choose(groups, values, raw.topic)
        for group, why in reasons.items():
            keep[groups[group]] = False
            count, first = len(groups[group]), groups[group][0]
            time = (raw.log[first] - raw.log[0]) * 1e-9
            detail = f"{raw.topic}: {count} of {len(values)} messages, {group}: they {why}"
            dropped.append(Dropped(time, "message of another publisher", detail, count))
            text = (
                f"{raw.topic} has several publishers. {count} of {len(values)} messages are "
                f"dropped, {group}: they {why}. {len(groups[measured])} are used, {measured}. "
                + CURE.format(topic=raw.topic)
            )
            notes.append(KeyedWarning(text, "several publishers", raw.topic))
    used = np.flatnonzero(keep & finite)
    require_one_series(raw.topic, np.array(raw.log)[used] * 1e-9, values[used])
    return np.flatnonzero(keep).tolist()


def separate_publishers(
    raw: Raw, values: Array, at: NDArray[np.intp]
) -> dict[str, NDArray[np.intp]]:
    """Return the messages of each publisher by the words for them; empty if all messages `at` are
    of one publisher."""
    if len(at) < 4:
        return {}
    rows = np.ascontiguousarray(values[at])
    for kind in _features(raw, at, rows):
        apart = [
            {feature.words[k]: at[feature.labels == k] for k in find_series(rows, feature.labels)}
            for feature in kind
        ]
        # Some commands are by chance rounder than the others: the largest group has them all.
        best = max(
            apart, key=lambda groups: min(map(len, groups.values())) if len(groups) > 1 else 0
        )
        if len(best) > 1:
            return best
    return {}


def require_one_series(topic: str, time: Array, values: Array) -> None:
    """Raise BagError if values (n, k) at times (n,) in s often leave their series and return to it.

    No robot does so from one message to the next. Two publishers do.
    """
    if len(values) < 4:
        return
    now, n = values[3:], len(values)
    one, *more = (np.abs(now - values[3 - k : n - k]).sum(axis=1) for k in (1, 2, 3))
    back = np.minimum(*more)
    nearest = np.minimum(one, back)
    # Readings of a coarse encoder mostly repeat: then the smallest step counts.
    usual = max(float(np.median(nearest)), nearest[nearest > 0].min(initial=np.inf))
    returns = (one > CLEAR * usual) & (back < one / CLEAR) & (time[3:] - time[:-3] < MAX_RETURN_S)
    if returns.mean() <= MIN_RETURNS:
        return
    i = int(np.argmax(returns)) + 3
    before, after = (" ".join(f"{v:.4g}" for v in values[k]) for k in (i - 1, i))
    raise BagError(
        f"{topic} has several publishers, whose values disagree: {returns.sum()} of {len(values)} "
        f"messages leave the values of the message before and return to earlier ones (for example "
        f"{before}, then {after}). Nothing in the messages distinguishes the publishers. "
        f"{CURE.format(topic=topic)}, and record again"
    )


def _features(raw: Raw, at: NDArray[np.intp], rows: Array) -> Iterator[list[Feature]]:
    """Yield the features of the messages `at`, whose content is `rows` (n, k), kind by kind; first
    those that all messages of a publisher have."""

    def describe(value: Hashable) -> str:
        if isinstance(value, tuple):
            return f"with the joints {', '.join(map(str, value))}"
        named = isinstance(value, str)
        return f"with frame_id {value or '(empty)'}" if named else f"with {value} efforts"

    # A joint state begins with the names of its joints, a pose with its frame.
    heads = [row[0] if len(row) > 1 else "" for row in raw.rows]

    def group(column: Sequence[Hashable]) -> list[Feature]:
        numbers: dict[Hashable, int] = {}
        labels = np.array([numbers.setdefault(column[i], len(numbers)) for i in at])
        return [Feature(labels, [describe(value) for value in numbers])]

    yield group(heads)
    decimal = list[Feature]()
    for unit, size in (("", 1.0), (" degrees", np.pi / 180)):
        for k in range(1, N_DECIMALS + 1):
            shown = rows / (size * 10.0**-k)
            off = np.abs(shown - np.round(shown))
            rounded = np.all(off <= ROUNDING * (1.0 + np.abs(shown)), axis=1)
            known = f"rounded to {10.0**-k:.{k}f}{unit}"
            decimal.append(Feature(np.asarray(rounded, np.int64), [f"not {known}", known]))
    yield decimal
    yield group(raw.origins)
    yield group([len(row[2]) if isinstance(row[0], tuple) else 0 for row in raw.rows])
    # A command has no noise: its values recur while the robot rests.
    _, which, counts = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    often = counts[which.reshape(-1)] >= MIN_OCCURRENCES
    yield [Feature(often.astype(np.int64), ["with values that vary", "with values that recur"])]


def find_series(rows: Array, labels: Labels) -> list[int]:
    """Return the groups whose messages continue a series of their own.

    Messages that follow one of another group vote: for, if the last message of their own group is
    nearer than the one before, and against, if it is further away. In motion every message is
    nearest to the one before, and two publishers may agree for a while. So some successive votes
    suffice, of all messages or of the calmer half.
    """
    if (labels == labels[0]).all():
        return []
    order = np.argsort(labels, kind="stable")
    own = np.full(len(labels), -1)
    same = labels[order[1:]] == labels[order[:-1]]
    own[order[1:][same]] = order[:-1][same]
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    size = min(N_NEIGHBOURS, len(rows))
    spread = (maximum_filter1d(rows, size, axis=0) - minimum_filter1d(rows, size, axis=0)).sum(1)
    calm = spread <= np.median(spread)
    changes = np.flatnonzero((own[1:] >= 0) & (labels[1:] != labels[:-1])) + 1
    to_own = np.abs(rows[changes] - rows[own[changes]]).sum(axis=1)
    to_other = np.abs(rows[changes] - rows[changes - 1]).sum(axis=1)
    vote = np.sign(to_other - to_own)

    def is_series(of_it: Bools) -> bool:
        total = np.concatenate([[0.0], np.cumsum(vote[of_it])])
        n = min(N_VOTES, len(total) - 1)
        most = (total[n:] - total[: len(total) - n]).max()
        return bool(most > SIGNIFICANCE * np.sqrt(n))

    groups = labels[changes]
    return [
        group
        for group in np.unique(groups).tolist()
        if is_series(groups == group) or is_series((groups == group) & calm[changes])
    ]


def _choose(
    groups: dict[str, NDArray[np.intp]], values: Array, topic: str
) -> tuple[str, dict[str, str]]:
    """Return the publisher that measures, and why each other one does not; BagError if several
    may."""

    def repeats(words: str) -> Bools:
        rows = values[groups[words]]
        return np.asarray((rows[1:] == rows[:-1]).all(axis=1))

    why = {
        words: f"never change ({' '.join(f'{v:.4g}' for v in values[at[0]])})"
        for words, at in groups.items()
        if repeats(words).all()
    }
    moving = [words for words in groups if words not in why]
    if len(moving) > 1:
        # A measurement has noise; a command is repeated to the last digit while the robot rests.
        silent = [words for words in moving if repeats(words).mean() > MIN_REST]
        if len(silent) == len(moving) - 1:
            because = "repeat their values to the last digit at rest, as commands do"
            why |= dict.fromkeys(silent, because)
    if len(why) != len(groups) - 1:
        listed = "; ".join(f"{len(at)} messages {words}" for words, at in groups.items())
        raise BagError(
            f"{topic} has several publishers, whose values disagree, and it is not evident which "
            f"one measures: {listed}. {CURE.format(topic=topic)}, and record again"
        )
    (measured,) = (words for words in groups if words not in why)
    return measured, why
