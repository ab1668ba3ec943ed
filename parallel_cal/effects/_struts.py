"""Shared by effects on struts with universal joints: which mechanisms have them, and their axes."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

FIXED_AXES = ("*.base_?", "*.platform_?")


def needs_struts(mechanism: Mechanism) -> str:
    """Return why an effect of struts does not apply; empty if it does."""
    return "" if len(_place_struts(mechanism)) else "its joints are no struts to a moving platform"


def list_axes(mechanism: Mechanism) -> list[Parameter]:
    """Return the directions of the fixed axes of the universal joints, `base` in {B} and `platform`
    in {P}: horizontal, and perpendicular to the strut of the nominal robot at home."""
    ends = _place_struts(mechanism)
    across = np.cross([0.0, 0.0, 1.0], ends[:, 1] - ends[:, 0])
    size = np.linalg.norm(across, axis=1, keepdims=True)
    upright = size < 1e-6  # such a strut has no horizontal direction of its own
    base = np.where(upright, [0.0, 1.0, 0.0], across / np.where(upright, 1.0, size))
    axes = {"base": base, "platform": base @ _home_rotation(mechanism)}
    return [
        Parameter(
            f"{joint}.{end}_{axis}",
            "1",
            round(float(value), 13) + 0.0,
            0.02,
            low=-1.0,
            high=1.0,
            label=f"{end} joint's {axis}",
        )
        for i, joint in enumerate(mechanism.joints)
        for end, directions in axes.items()
        for axis, value in zip("xyz", directions[i], strict=True)
    ]


def find_axes(seen: Seen, own: Named) -> tuple[Any, Any]:
    """Return the fixed axes at base and platform of the strut with the parameters `own`, in {B}."""
    base, platform = (
        own.vector(f"{end}_x", f"{end}_y", f"{end}_z") for end in ("base", "platform")
    )
    return base / ca.norm_2(base), seen.R @ platform / ca.norm_2(platform)


def _place_struts(mechanism: Mechanism) -> np.ndarray:
    """Return the ends (n, 2, 3) m of the struts of the nominal robot at home."""
    p = Named(mechanism.parameters.names, ca.DM(mechanism.parameters.nominal))
    r, R = ca.DM(mechanism.home.position), ca.DM(_home_rotation(mechanism))
    ends = [[np.array(ca.DM(end)) for end in pair] for pair in mechanism.struts(r, R, p)]
    return np.reshape(ends, (-1, 2, 3))


def _home_rotation(mechanism: Mechanism) -> np.ndarray:
    return np.asarray(quaternion_to_matrix(np.array(mechanism.home.quaternion)))
