"""A virtual camera and a printed board: true poses of a platform in, pixels of corners out.

It shares nothing with the package's sensor: matrices of 4 x 4, an explicit loop over the terms of
the lens, and a board whose shape is a height over the sheet. Units are m, rad and px.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from parallel_cal.virtual.robot import Array, turn


def frame(position: Array, rotation: Array) -> Array:
    """Return the matrix (..., 4, 4) of a pose."""
    matrix = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, position, 1.0
    return matrix


def look_at(eye: Array, at: Array, roll: float = 0.0) -> Array:
    """Return the pose (4, 4) of a camera at `eye` whose axis meets the point `at`."""
    forward = np.asarray(at, float) - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return frame(np.asarray(eye, float), rotation @ turn(np.array([0.0, 0.0, roll])))


@dataclass(frozen=True)
class Board:
    """Squares of a printed sheet; `sag` (m) is its height in the middle along x and y."""

    columns: int = 8
    rows: int = 6
    square: float = 0.03
    sag: tuple[float, float] = (0.0, 0.0)

    def corners(self) -> Array:
        """Return the inner corners (n, 4) in the board's frame, homogeneous, row by row."""
        points = []
        for row in range(1, self.rows):
            for column in range(1, self.columns):
                x, y = column * self.square, row * self.square
                u, v = 2 * column / self.columns - 1, 2 * row / self.rows - 1
                height = self.sag[0] * (1 - u * u) + self.sag[1] * (1 - v * v)
                points.append([x, y, height, 1.0])
        return np.array(points)


@dataclass(frozen=True)
class Lens:
    """Focal lengths and principal point (px), and the polynomial of a pinhole's or fisheye's
    distortion."""

    fx: float = 1210.0
    fy: float = 1206.0
    cx: float = 648.0
    cy: float = 503.0
    k: tuple[float, ...] = (-0.11, 0.09, 8e-4, -5e-4)
    fisheye: bool = False
    size: tuple[int, int] = (1280, 1024)

    def project(self, points: Array) -> Array:
        """Return pixels (..., 2) of points (..., 3) in the camera's frame; NaN off the image."""
        x, y, z = np.moveaxis(points, -1, 0)
        if self.fisheye:
            radius = np.hypot(x, y)
            theta = np.arctan2(radius, z)
            bent = theta + sum(c * theta ** (3 + 2 * i) for i, c in enumerate(self.k))
            direction = np.arctan2(y, x)
            u, v = bent * np.cos(direction), bent * np.sin(direction)
        else:
            x, y = x / z, y / z
            k1, k2, p1, p2 = self.k
            r2 = x**2 + y**2
            radial = 1 + k1 * r2 + k2 * r2**2
            u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
            v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        pixels = np.stack([self.fx * u + self.cx, self.fy * v + self.cy], axis=-1)
        inside = (pixels >= 0) & (pixels <= np.array(self.size) - 1)
        seen = inside.all(axis=-1) & (z > 0)
        return np.where(seen[..., None], pixels, np.nan)


@dataclass(frozen=True)
class Camera:
    """A camera at `pose` and a board at `mount` (4, 4): one in the base's frame, the other in the
    platform's. `sigma` is the noise of a corner's coordinate, px."""

    pose: Array
    mount: Array
    lens: Lens = field(default_factory=Lens)
    board: Board = field(default_factory=Board)
    on_platform: bool = False
    sigma: float = 0.3

    def see(self, r: Array, R: Array, rng: np.random.Generator | None = None) -> Array:
        """Return pixels (N, n, 2) of the corners at platform poses (N, 3), (N, 3, 3)."""
        platform = frame(r, R)
        camera = platform @ self.pose if self.on_platform else self.pose
        board = self.mount if self.on_platform else platform @ self.mount
        seen = np.linalg.inv(camera) @ board
        points = np.einsum(
            "nij,kj->nki", np.broadcast_to(seen, (len(r), 4, 4)), self.board.corners()
        )
        pixels = self.lens.project(points[..., :3])
        if rng is not None:
            pixels = pixels + self.sigma * rng.standard_normal(pixels.shape)
        return pixels


def as_conditions(pixels: Array, name: str = "camera") -> dict[str, Array]:
    """Return a dataset's columns of pixels (N, n, 2)."""
    return {
        f"reading.{name}.{k}.{axis}": pixels[:, k, i]
        for k in range(pixels.shape[1])
        for i, axis in enumerate("uv")
    }
