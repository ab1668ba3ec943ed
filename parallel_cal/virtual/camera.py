"""A camera that renders images of a flat printed board: lens, blur, exposure and sensor noise.

Each pixel integrates the light over its area: rays through points of the pixel meet the board and
read its brightness. The lens blurs the result, and the sensor adds noise and rounds to grey levels.
Pixels are counted as in OpenCV: the centre of the top left pixel is (0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.virtual.robot import Array

Grey = NDArray[np.uint8]

# Places of the rays in a pixel. No two share a row or a column, so that an edge along the pixels
# is as exact as an oblique one.
ROWS = (0, 8, 4, 12, 2, 10, 6, 14, 1, 9, 5, 13, 3, 11, 7, 15)
RAYS = (np.stack([np.arange(16), ROWS], axis=1) + 0.5) / 16
BORDER_PX = 12  # around the projected outline: lens distortion bends it, and blur widens it
MAX_INVERSIONS = 60  # steps that find the ray of a distorted point
MAX_ANGLE = 1.5  # rad; a plane z = 1 cannot show rays at a right angle to the axis
SATURATION = 255.0


@dataclass(frozen=True, eq=False)
class FlatBoard:
    """A flat target: brightness `ink` (h, w) from 0 (black) to 1 (white) of cells of `cell` m.

    The corner of the first cell is the origin of {board}; x is along the rows, y along the columns.
    z points into the board: only the side away from z is printed. `paper` (m) is the width of the
    white margin, beyond which the background begins.
    """

    ink: Array
    cell: float
    paper: float = 0.02

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern, m."""
        return self.ink.shape[1] * self.cell, self.ink.shape[0] * self.cell

    @property
    def outline(self) -> Array:
        """Points (n, 3) along the edge of the paper, m."""
        width, height = self.size
        low, side = -self.paper, np.linspace(0.0, 1.0, 12)
        x, y = low + side * (width + 2 * self.paper), low + side * (height + 2 * self.paper)
        right, bottom = np.full(12, width + self.paper), np.full(12, height + self.paper)
        first = np.full(12, low)
        edges = [(x, first), (x, bottom), (first, y), (right, y)]
        return np.concatenate([np.stack([a, b, 0.0 * a], -1) for a, b in edges])

    def find_paper(self, x: Array, y: Array) -> Any:
        """Mark (...) the points x, y (...) that are on the paper, m."""
        width, height = self.size
        inside = (x > -self.paper) & (x < width + self.paper)
        return inside & (y > -self.paper) & (y < height + self.paper)

    def brightness(self, x: Array, y: Array, background: float, printed_side: bool) -> Array:
        """Return the brightness (...) at points x, y (...) of one side of the board, m."""
        rows, columns = self.ink.shape
        on_paper = self.find_paper(x, y)
        if not printed_side:
            return np.where(on_paper, 1.0, background)
        i, j = np.floor(y / self.cell).astype(np.int64), np.floor(x / self.cell).astype(np.int64)
        printed = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
        ink = self.ink[i.clip(0, rows - 1), j.clip(0, columns - 1)]
        return np.where(printed, ink, np.where(on_paper, 1.0, background))

    def find_edges(self, x: Array, y: Array, reach: Array) -> Any:
        """Mark (...) the points x, y (...) that may have an edge of the brightness less than
        `reach` (2,) away along x and y, m."""
        from scipy.ndimage import maximum_filter, minimum_filter

        cells = np.ceil(reach[::-1] / self.cell).astype(int)  # rows, columns
        around = np.pad(self.ink, [(2 * n, 2 * n) for n in cells], constant_values=1.0)
        window = 2 * cells + 1
        edges = maximum_filter(around, window) > minimum_filter(around, window)
        at = [
            (np.floor(value / self.cell).astype(np.int64) + 2 * n).clip(0, size - 1)
            for value, n, size in zip((y, x), cells, edges.shape, strict=True)
        ]
        found = edges[at[0], at[1]]
        for value, size, near in zip((x, y), self.size, reach, strict=True):
            middle = size / 2
            found |= np.abs(np.abs(value - middle) - middle - self.paper) < near
        return found


@dataclass(frozen=True)
class Imager:
    """What makes grey levels of light.

    A white surface has the grey level `white` at an `exposure` of 1, a black one `black`. `noise`
    is 1 sigma of the read noise in grey levels, `shot_noise` the variance per grey level.
    """

    exposure: float = 1.0
    white: float = 200.0
    black: float = 25.0
    noise: float = 1.0
    shot_noise: float = 0.02

    def expose(self, light: Array, falloff: Array, rng: np.random.Generator | None = None) -> Grey:
        """Return the image (height, width) of light from 0 to 1, of which the share `falloff`
        (height, width) arrives; without `rng`, it has no noise."""
        grey = self.black + (self.white - self.black) * light
        grey = self.exposure * grey * falloff
        if rng is not None:
            sigma = np.sqrt(self.noise**2 + self.shot_noise * np.maximum(grey, 0.0))
            grey = grey + sigma * rng.standard_normal(grey.shape)
        return np.clip(np.round(grey), 0.0, SATURATION).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with an image of `size` (width, height) px.

    `focal` and `centre` are in px. `distortion` is k1 k2 p1 p2 k3 of a pinhole camera (Brown 1971),
    or k1 k2 k3 k4 of a `fisheye`, whose image radius is a polynomial of the ray's angle (Kannala
    and Brandt 2006). `blur` (px) is 1 sigma of the lens. The light falls off by `shading` from the
    centre to the corner of the image. `background` is the brightness beside the board, from 0 to 1.
    """

    size: tuple[int, int] = (1280, 1024)
    focal: tuple[float, float] = (1200.0, 1200.0)
    centre: tuple[float, float] = (639.5, 511.5)
    distortion: Sequence[float] = ()
    fisheye: bool = False
    blur: float = 0.8
    background: float = 0.45
    shading: float = 0.15
    imager: Imager = field(default_factory=Imager)

    def project(self, points: Array) -> Array:
        """Return the pixels (..., 2) of points (..., 3) in the camera's frame, m; z is forward."""
        plane = points[..., :2] / points[..., 2:]
        return self._distort(plane) * np.array(self.focal) + np.array(self.centre)

    def sees(self, pixels: Array) -> Any:
        """Mark (...) the pixels (..., 2) that are inside the image."""
        return np.all((pixels >= -0.5) & (pixels <= np.array(self.size) - 0.5), axis=-1)

    def render(
        self,
        board: FlatBoard,
        positions: Array,
        rotations: Array,
        rng: np.random.Generator | None = None,
    ) -> Grey:
        """Render the image (height, width) of a board at a pose (3,), (3, 3) in the camera's frame.

        With several poses (n, 3), (n, 3, 3), the board moved through them during the exposure.
        Without `rng`, the sensor has no noise.
        """
        poses = list(zip(positions.reshape(-1, 3), rotations.reshape(-1, 3, 3), strict=True))
        light = np.mean([self._light(board, r, R) for r, R in poses], axis=0)
        return self.imager.expose(_blur(light, self.blur), self._falloff, rng)

    def _light(self, board: FlatBoard, r: Array, R: Array) -> Array:
        """Return the brightness (height, width) from 0 to 1 before the lens blurs it."""
        width, height = self.size
        light = np.full((height, width), self.background)
        outline = board.outline @ R.T + r
        if (outline[:, 2] <= 0.0).any():
            return light  # behind the camera
        at = self.project(outline)
        low = np.clip(np.floor(at.min(axis=0)) - BORDER_PX, 0, (width, height)).astype(int)
        high = np.clip(np.ceil(at.max(axis=0)) + BORDER_PX, 0, (width, height)).astype(int)
        if (low >= high).any():
            return light
        part = slice(low[1], high[1]), slice(low[0], high[0])
        ray, along_u, along_v = (grid[part] for grid in self._rays)
        to_board = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], r]))
        printed_side = bool(R[:, 2] @ r > 0.0)

        def meet(rays: Array) -> tuple[Array, Array]:
            """Return x and y (...) of the points of the board that rays (..., 2) meet, m."""
            a, b = rays[..., 0], rays[..., 1]
            x, y, scale = (row[0] * a + row[1] * b + row[2] for row in to_board)
            return x / scale, y / scale

        x, y = meet(ray)
        light[part] = board.brightness(x, y, self.background, printed_side)
        # Many rays only where a pixel may see an edge: they do not change the others. A pixel sees
        # at most half of `span` on each side of its middle.
        span = np.stack([np.abs(np.gradient(one)).sum(axis=0) for one in (x, y)])
        on_paper = board.find_paper(x, y)
        widest = span[:, on_paper].max(axis=1, initial=0.0)  # rays next to the horizon go far
        mixed = board.find_edges(x, y, np.minimum(widest, board.size))
        mixed |= (span > 2 * widest[:, None, None]).any(axis=0)
        total = np.zeros(np.count_nonzero(mixed))
        ray, along_u, along_v = ray[mixed], along_u[mixed], along_v[mixed]
        for du, dv in RAYS - 0.5:
            x, y = meet(ray + du * along_u + dv * along_v)
            total += board.brightness(x, y, self.background, printed_side)
        light[part][mixed] = total / len(RAYS)
        return light

    @cached_property
    def _rays(self) -> tuple[Array, Array, Array]:
        """Points (height, width, 2) of the plane z = 1 through the pixels, and their derivatives
        along u and v."""
        width, height = self.size
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
        rays = self._undistort((pixels - np.array(self.centre)) / np.array(self.focal))
        return rays, np.gradient(rays, axis=1), np.gradient(rays, axis=0)

    @cached_property
    def _falloff(self) -> Array:
        """Share (height, width) of the light that reaches each pixel."""
        width, height = self.size
        u = (np.arange(width) - (width - 1) / 2) / (width / 2)
        v = (np.arange(height) - (height - 1) / 2) / (height / 2)
        return 1.0 - self.shading * (u**2 + v[:, None] ** 2) / 2

    def _distort(self, plane: Array) -> Array:
        """Bend points (..., 2) of the plane z = 1 as the lens does."""
        k = np.zeros(5)
        k[: len(self.distortion)] = self.distortion
        x, y = plane[..., 0], plane[..., 1]
        s = x**2 + y**2
        if self.fisheye:
            radius = np.sqrt(s)
            bent = _bend_angle(np.arctan(radius), k)
            factor = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 0)
            return plane * factor[..., None]
        k1, k2, p1, p2, k3 = k
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (s + 2 * x**2),
                y * radial + p1 * (s + 2 * y**2) + 2 * p2 * x * y,
            ],
            -1,
        )

    def _undistort(self, bent: Array) -> Array:
        """Return the points (..., 2) that the lens bends to the given ones.

        ValueError if the distortion folds the image, so that a pixel has no ray.
        """
        if not (self.fisheye or any(self.distortion)):
            return bent
        radius, k = np.linalg.norm(bent, axis=-1), np.zeros(5)
        k[: len(self.distortion)] = self.distortion
        angle, plane = radius.copy(), bent.copy()
        for _ in range(MAX_INVERSIONS):
            if self.fisheye:
                angle = np.minimum(angle + radius - _bend_angle(angle, k), MAX_ANGLE)
                factor = np.divide(
                    np.tan(angle), radius, out=np.ones_like(radius), where=radius > 0
                )
                plane = bent * factor[..., None]
                away = bent - self._distort(plane)
            else:
                away = bent - self._distort(plane)
                plane = plane + away
            if np.abs(away).max() < 1e-12:
                return plane
        worst = float(np.abs(away).max())
        if worst > 1e-6:
            raise ValueError(
                f"distortion={tuple(self.distortion)}: some pixels have no ray (remaining error "
                f"{worst:.2g}); expected a lens whose image does not fold within {self.size} px"
            )
        return plane


def _bend_angle(angle: Array, k: Array) -> Array:
    """Return the image radius of rays at an angle from the axis of a fisheye lens."""
    return np.asarray(angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(k[:4]))))


def _blur(image: Array, sigma: float) -> Array:
    """Return the image after a Gaussian of `sigma` px in both directions."""
    from scipy.ndimage import correlate1d

    if sigma <= 0.0:
        return image
    reach = int(np.ceil(4.0 * sigma))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    taps /= taps.sum()
    for axis in (0, 1):
        image = correlate1d(image, taps, axis=axis, mode="nearest")
    return image
