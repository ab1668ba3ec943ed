"""How precisely a fit knows where a camera shows a point, over the whole image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.model.parameters import Named
from parallel_cal.sensors.camera import Camera

CELLS_ACROSS = 32  # of the grid over the image
RELATIVE_RANK = 1e-9  # of a motion of the camera that moves no pixel


@dataclass(frozen=True)
class ProjectionUncertainty:
    """Standard deviation (rows, columns) px of the projection at the cells of a grid over the
    image, in its worst direction, of points at `distance` (m); NaN where the lens shows nothing.
    `count` (rows, columns) says how many corners each cell has; u and v (px) are the middles of the
    cells."""

    u: np.ndarray
    v: np.ndarray
    sigma: np.ndarray
    count: np.ndarray
    distance: float

    @property
    def usual(self) -> float:
        """Rms (px) over the cells with corners."""
        seen = self.sigma[self.count > 0]
        return float(np.sqrt(np.nanmean(seen**2)))

    @classmethod
    def of(
        cls, result: FitResult, camera: Camera, corners: np.ndarray
    ) -> ProjectionUncertainty | None:
        """Compute it from the covariance of the lens and the corners (n, 2) px that were seen.

        A wrong lens that a motion of the camera makes good shows no point elsewhere. So the motion
        that compensates best at the corners is taken away first. None if the model was not
        identified.
        """
        model = result.model
        if model.covariance is None:
            return None
        names = [f"{camera.name}.{name}" for name in camera.lens_parameters]
        lens = [model.table.index_of(name) for name in names]
        grid, edges = _divide_image(camera)
        count = np.histogram2d(corners[:, 0], corners[:, 1], bins=edges)[0].T
        fx, fy, cx, cy, *k = model.values[lens].tolist()
        fitted = replace(
            camera, focal_length=(fx, fy), principal_point=(cx, cy), distortion=tuple(k)
        )
        distance = _find_distance(result, camera)
        rays = np.append(fitted.rays(grid), np.ones((len(grid), 1)), axis=1)
        points = distance * rays / np.linalg.norm(rays, axis=1, keepdims=True)
        known = np.isfinite(points).all(axis=1)
        by_lens, by_motion = _differentiate(result, camera, lens, points[known])
        weight = np.repeat(np.sqrt(count.ravel()[known]), 2)[:, None]
        motion = np.linalg.pinv(weight * by_motion, rcond=RELATIVE_RANK) @ (weight * by_lens)
        left = (by_lens - by_motion @ motion).reshape(-1, 2, len(lens))
        spread = left @ np.asarray(model.covariance)[np.ix_(lens, lens)] @ left.transpose(0, 2, 1)
        sigma = np.full(len(grid), np.nan)
        sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, -1], 0.0))
        u, v = (np.unique(column) for column in grid.T)
        return cls(u, v, sigma.reshape(len(v), len(u)), count, distance)


def _divide_image(camera: Camera) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the middles (m, 2) px of the cells of a grid, row by row, and the edges of u and v."""
    cell = camera.image_size[0] / CELLS_ACROSS
    edges = [
        np.linspace(-0.5, size - 0.5, 1 + max(round(size / cell), 1)) for size in camera.image_size
    ]
    u, v = np.meshgrid(*((edge[:-1] + edge[1:]) / 2 for edge in edges))
    return np.stack([u.ravel(), v.ravel()], axis=1), edges


def _find_distance(result: FitResult, camera: Camera) -> float:
    """Find the median distance (m) of the board's corners from the camera."""
    model = result.model
    pose = model.configuration(predict_configurations(model, result.observations))
    at = Named(model.table.names, ca.DM(model.values))[camera.name]
    middles = [
        np.array(ca.evalf(camera.points(ca.DM(r), ca.DM(R), at))).reshape(-1, 3).mean(axis=0)
        for r, R in zip(pose.r, pose.R, strict=True)
    ]
    return float(np.nanmedian(np.linalg.norm(middles, axis=1)))


def _differentiate(
    result: FitResult, camera: Camera, lens: list[int], points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate the pixels (2m) of points (m, 3) in the camera's frame by the parameters of the
    lens, and by a motion (6) of the camera."""
    names = result.model.table.names
    value, point, motion = (ca.SX.sym(k, n) for k, n in (("v", len(names)), ("p", 3), ("m", 6)))
    moved = point + motion[:3] + ca.cross(motion[3:], point)
    pixel = camera.show(moved, Named(names, value)[camera.name])
    slopes = [ca.jacobian(pixel, value)[:, lens], ca.jacobian(pixel, motion)]
    function = ca.Function("slopes", [value, point, motion], slopes)
    found = [function(ca.DM(result.model.values), ca.DM(one), 0) for one in points]
    by_lens, by_motion = (np.vstack([np.array(one[k]) for one in found]) for k in (0, 1))
    return by_lens, by_motion
