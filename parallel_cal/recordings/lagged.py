"""Conditions that follow from recorded ones: lagged by a time constant, as warm parts are, or of a
part without a sensor of its own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np

from parallel_cal.model.effect import list_substitutes, parse_lag, parse_part
from parallel_cal.recordings.dataset import Dataset


def add_lagged_conditions(names: Iterable[str], dataset: Dataset) -> Dataset:
    """Return the dataset with the lagged conditions among `names`, such as `temperature.lag540`,
    that it lacks and that follow from its recorded ones.

    Where parts have sensors of their own, a part among `names` that has none gets the general
    temperature, or what `list_substitutes` gives. The conditions belong to the whole recording:
    samples that are chosen later keep their values.
    """
    names = tuple(names)
    known = dict(dataset.conditions)
    wanted = [lag[0] for name in names if (lag := parse_lag(name))] + list(names)
    for name in wanted:
        if parse_part(name) and name not in known and any(map(parse_part, known)):
            substitute = next((one for one in list_substitutes(name) if one in known), None)
            if substitute:
                known[name] = known[substitute]
    for name in names:
        lag = parse_lag(name)
        if lag is None or name in known or lag[0] not in known or "time" not in known:
            continue
        session = known.get("session", np.zeros(len(dataset)))
        known[name] = compute_lagged(known[lag[0]], known["time"], lag[1], session)
    added = len(known) > len(dataset.conditions)
    return dataclasses.replace(dataset, conditions=known) if added else dataset


def compute_lagged(
    values: np.ndarray, time: np.ndarray, time_constant: float, session: np.ndarray
) -> np.ndarray:
    """The values (N,) that follow a condition (N,), linear between samples, with a time constant
    (s): y' = (x - y) / time_constant. Every session begins with y = x."""
    out = np.array(values, dtype=float)
    for one in np.unique(session):
        order = np.flatnonzero(session == one)
        order = order[np.argsort(time[order], kind="stable")]
        x, t = out[order], np.asarray(time, dtype=float)[order]
        y = x.copy()
        for k in range(1, len(x)):
            y[k] = follow(y[k - 1], x[k - 1], x[k], t[k] - t[k - 1], time_constant)
        out[order] = y
    return out


def follow(lagged: float, before: float, now: float, step: float, time_constant: float) -> float:
    """Return the lagged value `step` seconds after `lagged`, while the condition that it follows
    went from `before` to `now`. A ramp is followed at a constant distance; the rest decays."""
    if step <= 0:
        return lagged
    behind = time_constant * (now - before) / step
    return now - behind + (lagged - before + behind) * math.exp(-step / time_constant)
