"""How far the platform moves from one identification to another at the same joints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.frames import IDENTITY_FRAMES, PosePairs
from parallel_cal.identification.predictions import condition_columns, reach
from parallel_cal.identification.registration import shows_pose
from parallel_cal.identification.thresholds import (
    MAX_MOVED_TOLERANCES,
    MAX_SHIFT_TO_SHOWN_RATIO,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class PlatformShift:
    """Rms distance (m) of the platform between two models at the same joints.

    `measured` is at the measured poses, `workspace` over the workspace under neutral conditions.
    `shown` is the root of the fall of the squared validation errors. None if not known. Where only
    images were measured, a common motion of {B} or of {P} is not counted: no pixel shows it.
    `neutral` names the conditions (`temperature`, without joint or part) that the models depend on
    and that differ in the samples from their neutral values, with (neutral value, unit).
    """

    measured: float
    workspace: float | None
    shown: float | None
    neutral: Mapping[str, tuple[float, str]] = field(default_factory=dict)


@single_threaded()
def compute_platform_shift(before: FitResult, after: FitResult) -> PlatformShift:
    """Compute how far the robot (not the device) moves with another identification of the same
    samples."""
    old, new = before.model.robot(), after.model.robot()
    target = Kinematics(old).inverse(
        *poses_in_workspace(old.mechanism, 200, np.random.default_rng(0))
    )
    at_measured = (reach(old, before.observations), reach(new, after.observations))
    anywhere = [Kinematics(robot).direct(target.joints) for robot in (old, new)]
    # Both frames, {B} and {P}, may move.
    poses = [
        PosePairs(
            ours.position,
            ours.rotation,
            theirs.position,
            theirs.rotation,
            measured=(ours.solved & theirs.solved)[:, None] & (np.arange(6) < 3),
            length=1.0,
            target_is_free=True,
        )
        for theirs, ours in (at_measured, anywhere)
    ]
    frames, device = IDENTITY_FRAMES, after.observations.measured[:, len(old.joints) :].any()
    if shows_pose(after.model) and not device:
        frames = poses[0].descend(frames, poses[0].placed)
    measured, workspace = (p.compute_rms(frames) if p.placed.any() else None for p in poses)
    rms = [e.held_out.summary.position_rms for e in (before, after)]
    shown = None
    if rms[0] is not None and rms[1] is not None:
        shown = math.sqrt(max(rms[0] ** 2 - rms[1] ** 2, 0.0))
    neutral: dict[str, tuple[float, str]] = {}
    units = dict(zip(new.joints, new.mechanism.joint_units, strict=True))
    for robot, result in ((old, before), (new, after)):
        for name, values in condition_columns(robot, result.observations).items():
            kind, _, joint = name.partition(".")
            unit, value, of_joints = CONDITIONS[kind]
            if of_joints:
                unit = unit.replace("rad", units[joint])
            if np.any(values != value):
                neutral[kind] = (value, unit)
    return PlatformShift(measured or 0.0, workspace, shown, neutral)


def find_large_device_effects(model: Model) -> list[str]:
    """Names of the effects of the device with a parameter far beyond its tolerance: such a prior no
    longer separates the device from the robot."""
    away = np.abs(model.values - model.table.nominal) > MAX_MOVED_TOLERANCES * model.table.tolerance
    large = {
        name.partition(".")[0] for name, far in zip(model.table.names, away, strict=True) if far
    }
    return sorted(large & {effect.name for effect in model.effects if effect.of_device})


def explain_unseparated_device(before: FitResult, after: FitResult) -> str:
    """Explain that effects of the device move the robot much further than the errors show; empty
    if they do not.

    The usual size of such an effect is a prior that separates the device from the robot. If the
    data contradict it, only the data separate them, and some directions they cannot: a device
    whose scale is wrong shows the same poses as a robot of another size.
    """
    large = find_large_device_effects(after.model)
    if not large:
        return ""
    shift = compute_platform_shift(before, after)
    furthest = max(shift.measured, shift.workspace or 0.0)
    if shift.shown is None or furthest <= MAX_SHIFT_TO_SHOWN_RATIO * shift.shown:
        return ""
    return (
        f"with {' and '.join(large)} the robot moves by {1e6 * furthest:.3g} um, but the change "
        f"removes only {1e6 * shift.shown:.3g} um of the error at held-out poses: the samples do "
        "not separate errors of the device from those of the robot. Measure an artefact of known "
        "length, or state the device's certificate in the model file"
    )
