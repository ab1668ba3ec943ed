"""How the heights of a touched bed change if one number of the machine is wrong."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.linearisation import follow_closure
from parallel_cal.identification.predictions import predict_poses

CHANNEL = "probe"
N_DIRECTIONS = 6
MIN_CHANGE = 1e-9  # of the largest, m per tolerance; below it a parameter moves no height
OF_ALL = "{} of all chains"
CHAIN = re.compile(r"chain\d+\.(.+)")


@dataclass(frozen=True)
class HeightChange:
    """Heights (m) that grow per m or rad of a parameter, one for each place; `unit` is that of the
    parameter, m or rad (or another one of an effect)."""

    unit: str
    slopes: np.ndarray


@dataclass(frozen=True)
class HeightChanges:
    """Some touches (samples) at places (n, 2) m, and by parameter how much higher the tip is there,
    at the same joint readings, if this parameter is larger."""

    samples: tuple[int, ...]
    places: np.ndarray
    parameters: Mapping[str, HeightChange]

    @classmethod
    def of(cls, result: FitResult) -> HeightChanges | None:
        """Return the changes at the middle of the bed and towards its edge, None without touches.

        dz = - e_z C^-1 J dp, with the derivatives C and J of the closure by the pose and by the
        parameters p.
        """
        model, observations = result.model, result.observations
        channels = list(model.structure.channels)
        if CHANNEL not in channels or "z" not in model.mechanism.moves:
            return None
        touched = np.isfinite(observations.reading[:, channels.index(CHANNEL)])
        reached, _ = predict_poses(model, observations)
        used = np.flatnonzero(touched & reached.solved)
        if not len(used):
            return None
        chosen = used[_spread(reached.position[used, :2])]
        rows, a = reached.configuration.rows[chosen], observations.a[chosen]
        by_pose = follow_closure(model, *model.structure.jacobians(rows, a, model.values))[0]
        slopes = by_pose[:, model.mechanism.moves.index("z")].T
        tolerance, units = model.table.tolerance, [p.unit for p in model.table]
        size = np.abs(slopes * tolerance[:, None]).max(axis=1)
        found = dict[str, HeightChange]()
        for i, name in enumerate(model.table.names):
            if size[i] > MIN_CHANGE * size.max():
                found[name] = HeightChange(units[i], slopes[i])
        return cls(
            tuple(int(result.dataset.numbers[k]) for k in chosen),
            reached.position[chosen, :2],
            _with_common(found) | found,
        )


def _spread(xy: np.ndarray) -> list[int]:
    """Choose the touch nearest to the middle, and the outermost in six directions."""
    away = xy - xy.mean(axis=0)
    turns = np.pi / 6 + np.arange(N_DIRECTIONS) * 2 * np.pi / N_DIRECTIONS  # towers, and between
    outermost = [int(np.argmax(away @ [np.cos(t), np.sin(t)])) for t in turns]
    return list(dict.fromkeys([int(np.argmin(np.linalg.norm(away, axis=1))), *outermost]))


def _with_common(found: Mapping[str, HeightChange]) -> dict[str, HeightChange]:
    """Return what one number of a firmware changes in all chains at once, such as their rods."""
    parts = dict[str, list[HeightChange]]()
    for name, change in found.items():
        if chain := CHAIN.fullmatch(name):
            parts.setdefault(chain[1], []).append(change)
    return {
        OF_ALL.format(part): HeightChange(all_[0].unit, np.sum([c.slopes for c in all_], axis=0))
        for part, all_ in parts.items()
        if len(all_) > 1
    }
