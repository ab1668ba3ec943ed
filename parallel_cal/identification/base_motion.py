"""How far an identified robot stands from the drawn one in the base frame {B}, as a rigid motion.

Poses that are measured in a device's own frame do not determine {B}: the robot and the device may
move together. So a change of the poses in {B} has two parts, a rigid motion and a change of shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.identification.frames import IDENTITY_FRAMES
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import reach
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.identification.thresholds import MIN_FRAME_POSES
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class BaseMotion:
    """The motions of {B} and {P} that move the identified poses nearest to the drawn robot's.

    `position` (3,) m and `rotation` (3,) rad, a rotation vector, state where the identified base
    stands in the drawn one; `platform_position` and `platform_rotation` where the point that the
    identified poses state as {P} sits on the drawn platform. `change` is the rms distance (m)
    between the origins of {P} of both robots at the measured joints, as stated in {B};
    `change_of_shape` is what remains of it after both motions.
    """

    base: str
    platform: str
    position: tuple[float, ...]
    rotation: tuple[float, ...]
    platform_position: tuple[float, ...]
    platform_rotation: tuple[float, ...]
    change: float
    change_of_shape: float

    @property
    def description(self) -> str:
        size = np.linalg.norm
        motions = [
            f"'{name}' ({1e3 * size(shift):.2f} mm, {1e3 * size(turn):.2f} mrad)"
            for name, shift, turn in (
                (self.base, self.position, self.rotation),
                (self.platform, self.platform_position, self.platform_rotation),
            )
        ]
        return (
            f"at the same joints, the origin of '{self.platform}' of the identified robot is "
            f"{1e6 * self.change:.0f} um (rms) from that of the drawn one as stated in "
            f"'{self.base}', and {1e6 * self.change_of_shape:.0f} um after the best rigid motions "
            f"of {' and '.join(motions)}. The poses do not determine these frames: they lie where "
            "the drawing fits best within the tolerances. To tie them to features, fix the "
            "features' parameters (--fix)"
        )

    def document(self) -> dict[str, Any]:
        return dict(vars(self))


def compute_base_motion(model: Model, observations: Observations) -> BaseMotion | None:
    """Compare an identified robot with the one drawn (all parameters nominal) at the same joints.

    None if fewer than MIN_FRAME_POSES positions can be compared.
    """
    robot = model.robot()
    drawn = DevicePoses.of(robot.with_values(robot.table.nominal), observations)
    if drawn is None:
        return None
    found = reach(robot, observations)
    # Both poses are predicted: where one coordinate was measured, all are known.
    both = np.stack([drawn.placed, drawn.turned], axis=1) & found.solved[:, None]
    if both[:, 0].sum() < MIN_FRAME_POSES:
        return None
    poses = replace(
        drawn,
        seen_r=found.position,
        seen_R=found.rotation,
        measured=np.repeat(both, 3, axis=1),
        now=IDENTITY_FRAMES,
    )
    frames = poses.frames
    return BaseMotion(
        robot.frames["base"],
        robot.frames["platform"],
        tuple(frames.f.tolist()),
        tuple(rotation_vector(frames.F).tolist()),
        tuple(frames.t.tolist()),
        tuple(rotation_vector(frames.T).tolist()),
        poses.compute_rms(IDENTITY_FRAMES),
        poses.compute_rms(frames),
    )
