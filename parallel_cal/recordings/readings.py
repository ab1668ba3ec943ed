"""Readings of other sensors than the pose device: constraints of the tip, and distances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.recordings.recording import Array, Recording, TextStream
from parallel_cal.recordings.samples import READING, Sample


def words_between(stream: TextStream | None, start: float, end: float) -> list[str]:
    """Return the words that were valid between two times, in order; "" before the first one."""
    if stream is None:
        return [""]
    first, last = np.searchsorted(stream.time, [start, end], side="right")
    before = stream.value[first - 1] if first else ""
    words = [before, *stream.value[first:last]]
    return [w for k, w in enumerate(words) if k == 0 or w != words[k - 1]]


def readings_between(recording: Recording, start: float, end: float) -> dict[str, float]:
    """Return the mean reading (m) of each channel between two times; a constraint reads zero."""
    word = words_between(recording.constraint, start, end)[0]
    readings = {word: 0.0} if word else {}
    for channel, stream in {**recording.passive, **recording.distances}.items():
        a, b = np.searchsorted(stream.time, [start, end])
        if b > a:
            readings[channel] = float(stream.value[a:b].mean())
    return readings


def reading_columns(samples: Sequence[Sample]) -> dict[str, Array]:
    """Return `reading.CHANNEL` (N,) of every channel with a reading; NaN in samples without one."""
    channels = dict.fromkeys(channel for sample in samples for channel in sample.readings)
    return {
        READING + channel: np.array([s.readings.get(channel, np.nan) for s in samples])
        for channel in channels
    }
