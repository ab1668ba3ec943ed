"""Recordings of one robot for which the measuring device, or its target, was set up anew.

Every recording has its own frame and target. The closed-form registrations move the poses of the
later recordings into the frame of the first one. What remains are a small shift and rotation of
each later station, and the offset of its target. They are free parameters of the effect `Stations`,
so that their uncertainty reaches the robot's parameters. They are no part of the robot: a model
file does not keep them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import cayley
from parallel_cal.identification.moved_frames import describe_what_moved
from parallel_cal.identification.observations import observe
from parallel_cal.identification.registration import (
    STATION_EFFECT,
    DevicePoses,
    is_identified,
)
from parallel_cal.identification.thresholds import MIN_REGISTRATION_POSES
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import POSE, Mechanism, list_shown_displacements
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.transforming import transform_poses

LATER_RECORDINGS = (1, 2, 3)  # that may have a station of their own
TOLERANCE = {"m": 2e-3, "rad": 0.035}  # of a station after its closed-form registration
TARGET_TOLERANCE_M = 0.05
PARTS = {"frame": "device frame", "target": "target"}  # in plain words


class Stations(Effect):
    """R_ideal = exp(w) R exp(z), r_ideal = exp(w) r + v + R_ideal d, for each later recording.

    `frame` has v (m) and w (rad) about axes of {B}, `target` has d (m) and z (rad) about axes of
    {P}.
    """

    needs = ("session",)
    fixed = ("recording*",)  # `register_recordings` frees those that the samples determine
    of_device = True
    title = "stations of the recordings"
    physics = "Between two recordings the measuring device or its target was set up anew."
    source = "anywhere"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        moves = [c for c in POSE if c in mechanism.moves]
        turns = any(c.startswith("r") for c in moves)
        found = []
        for k in LATER_RECORDINGS:
            for part, coordinates in (("frame", POSE), ("target", moves if turns else [])):
                for c in coordinates:
                    unit = "rad" if c.startswith("r") else "m"
                    at_target = part == "target" and unit == "m"
                    size = TARGET_TOLERANCE_M if at_target else TOLERANCE[unit]
                    title = f"recording {k + 1}'s {PARTS[part]}, {c}"
                    name = f"recording{k + 1}.{part}.{c}"
                    found.append(Parameter(name, unit, 0.0, size, title=title))
        return found

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        r, R = seen.r, seen.R
        for k in LATER_RECORDINGS:
            its = at.session == k

            def vector(part: str, axes: tuple[str, ...], k: int = k, its: Any = its) -> Any:
                names = [f"recording{k + 1}.{part}.{c}" for c in axes]
                return its * ca.vertcat(*[e.get(name, 0) for name in names])

            turn = cayley(vector("frame", POSE[3:]))
            R = turn @ R @ cayley(vector("target", POSE[3:]))
            r = turn @ r + vector("frame", POSE[:3]) + R @ vector("target", POSE[:3])
        return seen.with_pose(r, R)


@dataclass(frozen=True)
class Station:
    """The poses of one recording, with the frames of the first recording as those of `now`, and
    what is likeliest to have moved."""

    there: DevicePoses
    what_moved: str

    def move(self, dataset: Dataset) -> Dataset:
        """The samples as the first device would have shown the orientation of the first target, at
        the position of this target: the orientation that the offset depends on may be unknown."""
        first, own = self.there.now, self.there.frames
        turn, shift = first.F.T @ own.F, first.F.T @ (own.f - first.f)
        moved = transform_poses(dataset, shift, turn, dataset.frame)
        if not self.there.turned.any():
            return moved
        turned = np.any(moved.measured[:, 3:], axis=1)[:, None, None]
        return replace(moved, R=np.where(turned, moved.R @ own.T.T @ first.T, moved.R))

    def describe(self, k: int) -> str:
        """`recording 2 has a station of its own: its device stands 812.3 mm and 12.30 deg ...`"""
        return (
            f"recording {k + 1} has a station of its own: "
            f"{self.there.now.describe_move(self.there.frames)} from where recording 1 has it. "
            f"Each recording was registered by itself; {self.what_moved}"
        )


def register_recordings(
    model: Model, dataset: Dataset, joint_sigma: float | None = None, insist: bool = False
) -> tuple[Model, Dataset]:
    """Move every recording that has a station or a target of its own into the frame of the first.

    The model gets the effect `Stations`, and the dataset a warning that names each station. Both
    stay as they are if there is one recording, or if the samples are too few to register each.
    FitError if more recordings have stations of their own than the effect can describe.
    """
    bare = without_stations(model)
    session = dataset.conditions.get("session", np.zeros(len(dataset)))
    recordings = np.unique(session).astype(int)
    if len(recordings) < 2:
        return bare, dataset
    if bare is not model and not _find_stations(model, dataset, joint_sigma, insist):
        return model, dataset  # these samples were moved into one frame before
    found = _find_stations(bare, dataset, joint_sigma, insist)
    if found is None:
        return bare, dataset
    if not found:
        words = (
            f"the {len(recordings)} recordings share one station: registered one by one, no device "
            "or target stands clearly elsewhere"
        )
        return bare, replace(dataset, warnings=tuple(dict.fromkeys((*dataset.warnings, words))))
    if max(found) > LATER_RECORDINGS[-1]:
        raise FitError(
            f"{dataset.source}: recording {max(found) + 1} has a station of its own; expected at "
            f"most {LATER_RECORDINGS[-1] + 1} recordings then: fit fewer recordings at once"
        )
    described = tuple(station.describe(k) for k, station in found.items())
    for k, station in found.items():
        its = np.flatnonzero(session == k)
        moved, parts = station.move(dataset.select(its)), dict[str, Any]()
        for name in ("r", "R", "measured", "pose_cov"):
            parts[name] = np.array(getattr(dataset, name))
            parts[name][its] = getattr(moved, name)
        dataset = replace(dataset, **parts)
    return _with_stations(bare, found), replace(dataset, warnings=(*dataset.warnings, *described))


def without_stations(model: Model) -> Model:
    """The robot alone, without the stations of recordings."""
    if not has_stations(model):
        return model
    kept = tuple(effect for effect in model.effects if effect.name != STATION_EFFECT)
    return model.with_effects(kept).with_covariance_of(model)


def has_stations(model: Model) -> bool:
    return model.has_effect(STATION_EFFECT)


def _find_stations(
    model: Model, dataset: Dataset, joint_sigma: float | None, insist: bool
) -> dict[int, Station] | None:
    """Stations that differ from the one of the first recording, by the number of the recording;
    None if a recording has too few poses to be registered."""
    observations = observe(model, dataset, joint_sigma, insist)
    session = dataset.conditions["session"]
    stations, first = dict[int, Station](), None
    for k in np.unique(session).astype(int):
        own_samples = observations.select(np.flatnonzero(session == k))
        there = DevicePoses.of(model, own_samples)
        if there is None or there.poses < MIN_REGISTRATION_POSES:
            return None
        first = first or there.frames
        relative = replace(there, now=first)
        if relative.is_displaced(relative.frames, is_identified(model)):
            words = describe_what_moved(model, own_samples, relative)
            stations[k] = Station(relative, words)
    return stations


def _with_stations(model: Model, stations: Mapping[int, Station]) -> Model:
    """The model with the effect, whose parameters for these recordings are free."""
    extended = model.with_effects((load_effect(STATION_EFFECT), *model.effects))
    values, fixed = extended.values.copy(), extended.fixed.copy()
    names, shown = np.array(extended.table.names), list_shown_displacements(model.mechanism.moves)
    for k, one in stations.items():
        there, own = one.there, f"{STATION_EFFECT}.recording{k + 1}."
        target = [c for c in POSE if (there.turned.any() if c.startswith("r") else there.tilts)]
        free = [*(f"{own}frame.{c}" for c in shown), *(f"{own}target.{c}" for c in target)]
        fixed &= ~np.isin(names, free)
        for axis, offset in zip("xyz", there.now.t - there.frames.t, strict=True):
            values[~fixed & (names == f"{own}target.{axis}")] = offset
    return replace(extended, values=values, fixed=fixed).with_covariance_of(model)
