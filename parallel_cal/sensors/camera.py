"""A camera that sees the corners of a printed board: pixels, not poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import cayley, matrix_to_quaternion, quaternion_to_matrix
from parallel_cal.model.mechanism import POSE, Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor, View
from parallel_cal.sensors._board_pose import compute_board_poses

Pair = tuple[float, float]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

NO_TURN = (0.0, 0.0, 0.0, 1.0)
COEFFICIENTS = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),  # Brown and Conrady, as OpenCV orders them
    "fisheye": ("k1", "k2", "k3", "k4"),  # Kannala and Brandt
}
# What no fit identifies unless `fixed` is stated. An image hardly tells a pinhole's k3 from k1 and
# k2. A fisheye's image reaches so far from the axis that four coefficients are needed.
FIXED = {"pinhole": ("k3", "scale"), "fisheye": ("scale",)}
LENS_TOLERANCE = {"k": 0.3, "p": 5e-3}
FISHEYE_TOLERANCE = 0.05
FOCAL_TOLERANCE, CENTRE_TOLERANCE = 0.1, 0.03  # shares of focal length and width, if not stated
# Of a start that the robot's own errors turned. Where a board or a camera sits on a platform that
# hardly turns, nobody has told: the start is {P}, and such mountings are some cm away.
POSE_TOLERANCE = {"m": 0.1, "rad": 0.05}
MAX_SQUARE = 1.0  # m, of a square's side: more is a length in mm
BEND_TOLERANCE_M = 1e-3  # of a printed board
SCALE_TOLERANCE = 0.02  # of a print that nobody measured: only a fit that frees it uses it
# Focal lengths that are tried if none is stated, in widths of the image: fields of view of 120 to
# 10 degrees. A step is small enough for the descent that follows.
FOCAL = np.geomspace(0.29, 5.7, 28)
# Sides of a square that are tried beside the stated one: half and twice as long, and units that
# are mixed up (mm, inches and cm in place of m).
SQUARE_FACTORS = (1e-3, 0.01, 0.0254, 0.5, 0.7, 1.4, 2.0, 10.0, 39.37, 100.0)
UNDISTORT_STEPS = 20
MAX_START_ANGLE = 1.3  # rad from the axis, of corners that start a fisheye
NEXT_TO_NOTHING = 1e-18
IMAGE_MARGIN_PX = 8.0  # a corner nearer to the edge of the image is not detected surely


@dataclass(frozen=True)
class Camera(Sensor):
    """Pixels of the inner corners of a ChArUco board or chess board.

    The board has `columns` x `rows` squares of `square` m. Corner ROW * (columns - 1) + COLUMN lies
    at ((COLUMN + 1) square, (ROW + 1) square, 0) of the board's frame. Its readings are the
    channels `camera.NUMBER.u` and `camera.NUMBER.v` in px; the centre of the first pixel is (0, 0).
    A corner that an image does not show has no reading.

    The camera is `mounted` `fixed` to the base, with the board on the platform, or on the
    `platform`, with the board fixed to the base. Its frame is that of OpenCV: z points forward, x
    to the right of the image and y down. Whatever is not stated is found from the readings.

    Parameters
    ----------
    columns, rows : int
        Squares of the board.
    square : float
        Side of a square as printed, m.
    image_size : (int, int)
        Width and height of the images, px.
    mounted : str
        `fixed` or `platform`. Default `fixed`.
    model : str
        `pinhole` (k1 k2 p1 p2 k3) or `fisheye` (k1 k2 k3 k4). Default `pinhole`.
    name : str
        Name of this camera: several cameras need different names. Default `camera`.
    focal_length, principal_point : (float, float), optional
        fx fy and cx cy, px, as a CameraInfo states them.
    distortion : tuple of float
        Coefficients as a CameraInfo states them. Default none.
    intrinsics_sigma : float, optional
        Standard deviation of the stated focal lengths and principal point, px. Default: 1 % of the
        focal length.
    position, quaternion : optional
        Pose of the camera in {B}, or in {P} if it is on the platform (m; x y z w).
    board_position, board_quaternion : optional
        Pose of the board in {P}, or in {B} if the camera is on the platform. Unless everything is
        stated, a fit begins at the stated positions, and at rotations that it finds.
    sigma : float, optional
        Standard deviation of a corner's coordinate, px. Default: estimated from the residuals.
    fixed : tuple of str, optional
        Parameters that a fit does not identify. Default: `k3` and `scale` of a pinhole, `scale` of
        a fisheye.
    """

    columns: int
    rows: int
    square: float
    image_size: tuple[int, int]
    mounted: Literal["fixed", "platform"] = "fixed"
    model: Literal["pinhole", "fisheye"] = "pinhole"
    name: str = "camera"
    focal_length: Pair | None = None
    principal_point: Pair | None = None
    distortion: tuple[float, ...] = ()
    intrinsics_sigma: float | None = None
    position: Vector | None = None
    quaternion: Quaternion | None = None
    board_position: Vector | None = None
    board_quaternion: Quaternion | None = None
    sigma: float | None = None
    fixed: tuple[str, ...] | None = None  # type: ignore[assignment]

    physics = "a lens projects the corners of a flat printed board onto the image"
    source = "Zhang 2000; Brown 1966; Kannala and Brandt 2006"
    guessed_sigma = 0.3
    unit = "px"
    shows_pose = True
    stated_length = "square"
    scale_parameters = ("scale",)

    def __post_init__(self) -> None:
        problems = (
            (min(self.columns, self.rows) < 3, "columns and rows", "at least 3 squares each"),
            (not 0 < self.square < MAX_SQUARE, "square", f"a length of 0 to {MAX_SQUARE:g} m"),
            (min(self.image_size) < 1, "image_size", "width and height in px"),
            (not self.name or "." in self.name, "name", "a word without a dot"),
            (self.mounted not in ("fixed", "platform"), "mounted", "fixed or platform"),
            (self.model not in COEFFICIENTS, "model", " or ".join(COEFFICIENTS)),
            (min(self.focal_length or (1.0,)) <= 0, "focal_length", "fx and fy above 0 px"),
            ((self.sigma is not None and self.sigma <= 0), "sigma", "a number above 0 px"),
            ((self.intrinsics_sigma or 1) <= 0, "intrinsics_sigma", "a number above 0 px"),
        )
        for wrong, option, expected in problems:
            if wrong:
                value = " and ".join(str(getattr(self, one)) for one in option.split(" and "))
                raise ModelError(f"{self.name}: {option} is {value}; expected {expected}")
        if len(self.distortion) > len(self._coefficients):
            raise ModelError(
                f"{self.name}: distortion has {len(self.distortion)} numbers; expected at most "
                f"{len(self._coefficients)} for the model {self.model}: "
                f"{' '.join(self._coefficients)}"
            )

    # ------------------------------------------------------------------ the board and its channels

    @property
    def corners(self) -> np.ndarray:
        """Inner corners (n, 3) in the board's frame, m, in the order of their numbers."""
        row, column = np.divmod(np.arange((self.columns - 1) * (self.rows - 1)), self.columns - 1)
        return self.square * np.stack([column + 1, row + 1, 0 * row], axis=1).astype(float)

    @property
    def _middle(self) -> np.ndarray:
        """The middle (3,) of the board, m."""
        return np.array([self.columns, self.rows, 0]) * self.square / 2

    @property
    def channels(self) -> tuple[str, ...]:
        count = (self.columns - 1) * (self.rows - 1)
        return tuple(f"{self.name}.{k}.{axis}" for k in range(count) for axis in "uv")

    @property
    def lens_parameters(self) -> tuple[str, ...]:
        """Short names of the parameters of the lens."""
        return ("fx", "fy", "cx", "cy", *self._coefficients)

    @property
    def _coefficients(self) -> tuple[str, ...]:
        return COEFFICIENTS[self.model]

    # ------------------------------------------------------------------ parameters

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        moves = [c for c in POSE if c in mechanism.moves]
        turns = any(c.startswith("r") for c in moves)
        # A shift on a platform that does not turn is the same as one of the other part.
        carried = POSE if turns else POSE[3:]
        poses = {"pose": POSE, "board": carried}
        if self.mounted == "platform":
            poses = {"pose": carried, "board": POSE}
        focal, centre = self._nominal_focal_length, self._nominal_principal_point
        size = self.intrinsics_sigma or FOCAL_TOLERANCE * focal[0]
        found = [Parameter(f"f{a}", "px", v, size) for a, v in zip("xy", focal, strict=True)]
        size = self.intrinsics_sigma or CENTRE_TOLERANCE * self.image_size[0]
        found += [Parameter(f"c{a}", "px", v, size) for a, v in zip("xy", centre, strict=True)]
        for name, value in zip(self._coefficients, self._nominal_distortion, strict=True):
            size = FISHEYE_TOLERANCE if self.model == "fisheye" else LENS_TOLERANCE[name[0]]
            found.append(Parameter(name, "1", value, size))
        for part, coordinates in poses.items():
            for c in coordinates:
                unit = "rad" if c.startswith("r") else "m"
                found.append(Parameter(f"{part}.{c}", unit, 0.0, POSE_TOLERANCE[unit]))
        found += [Parameter(f"bend.{a}", "m", 0.0, BEND_TOLERANCE_M) for a in ("x", "y", "xy")]
        return [*found, Parameter("scale", "1", 1.0, SCALE_TOLERANCE)]

    def fixed_patterns(self) -> list[str]:
        fixed = FIXED[self.model] if self.fixed is None else self.fixed
        return [f"{self.name}.{pattern}" for pattern in fixed]

    @property
    def _nominal_focal_length(self) -> Pair:
        return self.focal_length or (float(self.image_size[0]),) * 2

    @property
    def _nominal_principal_point(self) -> Pair:
        width, height = self.image_size
        return self.principal_point or ((width - 1) / 2, (height - 1) / 2)

    @property
    def _nominal_distortion(self) -> tuple[float, ...]:
        return (*self.distortion, *[0.0] * (len(self._coefficients) - len(self.distortion)))

    # ------------------------------------------------------------------ what it sees

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        """Return u and v of every corner (px)."""
        return self.show(self.points(r, R, s), s)

    def points(self, r: Any, R: Any, s: Named) -> Any:
        """Return x, y and z of every corner in the camera's frame (m)."""
        camera = _pose(s, "pose", self.position, self.quaternion)
        board = _pose(s, "board", self.board_position, self.board_quaternion)
        # From {P} to {B} for the part on the platform
        if self.mounted == "platform":
            camera = (r + R @ camera[0], R @ camera[1])
        else:
            board = (r + R @ board[0], R @ board[1])
        turn = camera[1].T @ board[1]
        shift = camera[1].T @ (board[0] - camera[0])
        corners = [
            shift + s.scale * (turn[:, 0] * x + turn[:, 1] * y) + turn[:, 2] * z
            for x, y, z in self._bent_corners(s)
        ]
        return ca.vertcat(*corners)

    def show(self, points: Any, s: Named) -> Any:
        corners = (points[i : i + 3] for i in range(0, points.shape[0], 3))
        return ca.vertcat(*[pixel for corner in corners for pixel in self._project(corner, s)])

    def _bent_corners(self, s: Named) -> Iterator[tuple[float, float, Any]]:
        """Yield corners (m) of a board with a sag in the middle and a twist: low orders only."""
        half = np.array([self.columns, self.rows]) * self.square / 2
        for x, y, _ in self.corners:
            across, along = ((x, y) - half) / half
            sag = s["bend.x"] * (1 - across**2) + s["bend.y"] * (1 - along**2)
            yield x, y, sag + s["bend.xy"] * across * along

    def _project(self, point: Any, s: Named) -> tuple[Any, Any]:
        """Return u and v of a point in the camera's frame."""
        x, y = point[0], point[1]
        if self.model == "fisheye":
            away = ca.sqrt(x**2 + y**2 + NEXT_TO_NOTHING)
            angle = ca.atan2(away, point[2])
            square = angle**2
            series = ((s.k4 * square + s.k3) * square + s.k2) * square + s.k1
            grown = angle * (1 + series * square) / away
            return s.fx * grown * x + s.cx, s.fy * grown * y + s.cy
        x, y = x / point[2], y / point[2]
        square = x**2 + y**2
        grown = 1 + ((s.k3 * square + s.k2) * square + s.k1) * square
        u = x * grown + 2 * s.p1 * x * y + s.p2 * (square + 2 * x**2)
        v = y * grown + 2 * s.p2 * x * y + s.p1 * (square + 2 * y**2)
        return s.fx * u + s.cx, s.fy * v + s.cy

    def find_visible(self, readings: np.ndarray) -> np.ndarray:
        """Mask the predicted corners inside the image, if the camera sees the printed side."""
        pixels = readings.reshape(len(readings), -1, 2)
        high = np.array(self.image_size) - 1 - IMAGE_MARGIN_PX
        inside = ((pixels >= IMAGE_MARGIN_PX) & (pixels <= high)).all(axis=2)
        # From the printed side, the board's y is 90 degrees clockwise from its x in the image.
        along = pixels[:, self.columns - 2] - pixels[:, 0]
        down = pixels[:, -(self.columns - 1)] - pixels[:, 0]
        faces = along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0] > 0
        return np.repeat(inside & faces[:, None], 2, axis=1)

    # ------------------------------------------------------------------ start values

    @property
    def base_part(self) -> str:
        return "pose.*" if self.mounted == "fixed" else "board.*"

    @property
    def platform_part(self) -> str:
        return "board.*" if self.mounted == "fixed" else "pose.*"

    @property
    def is_placed(self) -> bool:
        stated = (self.focal_length, self.position, self.quaternion)
        return None not in (*stated, self.board_position, self.board_quaternion)

    def views(self, reading: np.ndarray) -> Iterator[View]:
        pixels = reading.reshape(len(reading), -1, 2)
        width = self.image_size[0]
        tried = [self.focal_length] if self.focal_length else [(f, f) for f in width * FOCAL]
        for focal_length in tried:
            lens = replace(
                self,
                focal_length=(float(focal_length[0]), float(focal_length[1])),
                principal_point=self._nominal_principal_point,
            )
            # Of the middle of the board: where a platform does not turn, it stands for {P}.
            seen, r, R = compute_board_poses(self.corners - self._middle, lens.rays(pixels))
            if self.mounted == "platform":  # the camera in the board's frame
                R = R.transpose(0, 2, 1)
                r = -(R @ r[:, :, None])[:, :, 0]
            yield View(lens, r, R, seen)

    def variants(self) -> Iterator[tuple[str, Camera]]:
        """Yield the other mounting, rows in place of columns, and sides of the squares."""
        other: Literal["fixed", "platform"] = "platform" if self.mounted == "fixed" else "fixed"
        yield f"mounted: {other}", replace(self, mounted=other)
        if self.columns != self.rows:
            turned = replace(self, columns=self.rows, rows=self.columns)
            words = f"columns: {turned.columns}, rows: {turned.rows}"
            yield words, turned
            yield f"{words}, mounted: {other}", replace(turned, mounted=other)
        for factor in SQUARE_FACTORS:
            side = factor * self.square
            if side < MAX_SQUARE:
                yield f"square: about {side:.2g}", replace(self, square=side)

    def placed(
        self, f: np.ndarray, F: np.ndarray, t: np.ndarray, T: np.ndarray, R: np.ndarray
    ) -> Camera:
        if self.mounted == "platform":
            f = f - F @ self._middle
            on_base, on_platform = self.board_position, self.position
        else:
            t = t - T @ self._middle
            on_base, on_platform = self.position, self.board_position
        # While the platform hardly turns, images only tell how far the parts are from each other:
        # if one position is stated, the other part is shifted by as much.
        if on_platform is not None:
            f, t = f + R @ (on_platform - t), np.array(on_platform)
        elif on_base is not None:
            t = t + R.T @ (on_base - f)
        if on_base is not None:
            f = np.array(on_base)
        base = tuple(f.tolist()), tuple(matrix_to_quaternion(F).tolist())
        carried = tuple(t.tolist()), tuple(matrix_to_quaternion(T).tolist())
        camera, board = (carried, base) if self.mounted == "platform" else (base, carried)
        return replace(
            self,
            position=camera[0],
            quaternion=camera[1],
            board_position=board[0],
            board_quaternion=board[1],
        )

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Return x / z and y / z (..., 2) of the rays of pixels (..., 2), by the nominal lens; NaN
        beside or behind a fisheye."""
        focal, centre = np.array(self._nominal_focal_length), self._nominal_principal_point
        wanted = (pixels - centre) / focal
        k = self._nominal_distortion
        if self.model == "fisheye":
            away = np.linalg.norm(wanted, axis=-1, keepdims=True)
            angle = away
            for _ in range(UNDISTORT_STEPS):
                angle = away / (1 + sum(one * angle ** (2 * i + 2) for i, one in enumerate(k)))
            angle = np.where(angle < MAX_START_ANGLE, angle, np.nan)
            return np.asarray(wanted * np.tan(angle) / np.maximum(away, NEXT_TO_NOTHING))
        x = wanted
        for _ in range(UNDISTORT_STEPS):
            square, product = np.sum(x**2, axis=-1), x[..., 0] * x[..., 1]
            grown = 1 + ((k[4] * square + k[1]) * square + k[0]) * square
            shift = [
                2 * k[2] * product + k[3] * (square + 2 * x[..., 0] ** 2),
                2 * k[3] * product + k[2] * (square + 2 * x[..., 1] ** 2),
            ]
            x = (wanted - np.stack(shift, axis=-1)) / grown[..., None]
        return x


def _pose(s: Named, part: str, position: Vector | None, quaternion: Quaternion | None) -> Any:
    """Return position and rotation: the nominal pose, shifted and turned by its parameters."""
    shift = ca.vertcat(*[s.get(f"{part}.{c}", 0) for c in POSE[:3]])
    turn = ca.vertcat(*[s.get(f"{part}.{c}", 0) for c in POSE[3:]])
    nominal = quaternion_to_matrix(quaternion or NO_TURN)
    return ca.DM(position or (0.0, 0.0, 0.0)) + shift, cayley(turn) @ ca.DM(nominal)
