"""Least-squares fits of the real machines in `real/` that use nothing of parallel_cal.

Each machine has its own few lines of kinematics here, and `scipy.optimize.least_squares` or a
minimum-norm Gauss-Newton finds its parameters. `bench/truth/real_machines.py` holds them beside the
results of the tool, at the same poses. All lengths are in metres, all angles in radians.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = np.ndarray
STEP = 1e-7  # of the difference quotients
NEWTON_STEPS = 30
RANK_TOLERANCE = 1e-9  # below it, a direction of parameters changes nothing measurable


def rms(errors: Array) -> float:
    """Return the rms length of error vectors (N, 3), or the rms of scalar errors (N,)."""
    squares = np.sum(errors**2, axis=1) if errors.ndim > 1 else errors**2
    return float(np.sqrt(np.mean(squares)))


def slopes(function: Callable[[Array], Array], at: Array) -> Array:
    """Return the derivatives (N, n) of a function's values (N,) by central differences."""
    columns = [
        (function(at + step) - function(at - step)) / (2 * STEP) for step in STEP * np.eye(len(at))
    ]
    return np.stack(columns, axis=1)


def gauss_newton(function: Callable[[Array], Array], start: Array, steps: int = 8) -> Array:
    """Minimise the squares of a function; directions without influence keep their start values."""
    p = start
    for _ in range(steps):
        p = p - np.linalg.lstsq(slopes(function, p), function(p), rcond=RANK_TOLERANCE)[0]
    return p


def solve_positions(residuals: Callable[[Array], Array], start: Array) -> Array:
    """Return the unknowns (N, n) that minimise residuals (N, m) sample by sample, by Newton."""
    x = start.copy()
    for _ in range(NEWTON_STEPS):
        f = residuals(x)
        J = np.stack(
            [
                (residuals(x + step) - residuals(x - step)) / (2 * STEP)
                for step in STEP * np.eye(x.shape[1])
            ],
            axis=2,
        )
        step = np.einsum("nij,nj->ni", np.linalg.pinv(J), f)
        x = x - step
        if np.abs(step).max() < 1e-12:
            break
    return x


# ------------------------------------------------------------------ a hexapod on strings


def _leg_lengths(p: Array, r: Array, R: Array) -> Array:
    """Return the distances (N, 6) of the joints of each leg."""
    base, platform = p[:18].reshape(6, 3), p[18:36].reshape(6, 3)
    ends = r[:, None] + np.einsum("nij,kj->nki", R, platform) - base
    return np.asarray(np.linalg.norm(ends, axis=2))


def _string_lengths(p: Array, turns: Array, metres_per_turn: Array) -> Array:
    """Return the lengths (N, 6) by motor turns: zero + gain * turns + bend * turns^2."""
    return np.asarray(p[36:42] + (metres_per_turn + p[42:48]) * turns + p[48:54] * turns**2)


def hexapod_start(base: Array, platform: Array, zero: float) -> Array:
    """Return the 54 numbers of a hexapod: joints, zero lengths, corrections of gain, bends."""
    return np.concatenate([base.ravel(), platform.ravel(), np.full(6, zero), np.zeros(12)])


def fit_hexapod(
    start: Array, free: int, turns: Array, metres_per_turn: Array, r: Array, R: Array
) -> Array:
    """Fit the first `free` of its numbers: 42 are geometry, 48 with gains, 54 with bends."""

    def error(part: Array) -> Array:
        p = np.concatenate([part, start[free:]])
        return (_leg_lengths(p, r, R) - _string_lengths(p, turns, metres_per_turn)).ravel()

    scale = np.concatenate([np.full(42, 1e-2), np.full(6, 1e-3), np.full(6, 1e-4)])[:free]
    found = least_squares(error, start[:free], x_scale=scale, xtol=1e-13, ftol=1e-13)
    return np.concatenate([found.x, start[free:]])


def hexapod_errors(p: Array, turns: Array, metres_per_turn: Array, r: Array, R: Array) -> Array:
    """Return measured minus computed positions (N, 3); the poses are solved from the turns."""
    lengths = _string_lengths(p, turns, metres_per_turn)

    def residuals(x: Array) -> Array:
        turned = Rotation.from_rotvec(x[:, 3:]).as_matrix() @ R
        return _leg_lengths(p, x[:, :3], turned) - lengths

    found = solve_positions(residuals, np.hstack([r, np.zeros((len(r), 3))]))
    return np.asarray(r - found[:, :3])


# ------------------------------------------------------------------ a serial arm


def _transforms(twists: Array) -> Array:
    """Return matrices (N, 4, 4) of rotation vectors and positions (N, 6)."""
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    T[:, :3, 3] = twists[:, 3:]
    return T


def _arm_positions(p: Array, rows: Sequence[tuple[float, float, float]], q: Array) -> Array:
    """Return the positions (N, 3) of the reflector.

    Before the first joint and after each link stands a free transform of six numbers. That is
    more than the geometry of an arm has; the minimum-norm fit leaves the surplus at zero.
    """
    free = p.reshape(len(rows) + 1, 6)
    T = np.tile(_transforms(free[:1]), (len(q), 1, 1))
    for angle, (a, d, alpha), twist in zip(q.T, rows, free[1:], strict=True):
        turn = np.tile(np.eye(4), (len(q), 1, 1))
        turn[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
        link = np.array([[alpha, 0, 0, a, 0, d]])
        T = T @ turn @ _transforms(link) @ _transforms(twist[None])
    return np.asarray(T[:, :3, 3])


def fit_arm(
    rows: Sequence[tuple[float, float, float]],
    q: Array,
    r: Array,
    harmonics: Sequence[float] = (),
    frames_only: bool = False,
) -> Array:
    """Fit an arm from positions alone.

    `rows` are (a, d, alpha) of each link. `harmonics` are periods per turn of each joint whose
    cosine and sine are added to its reading. With `frames_only` only the first transform and the
    position of the reflector are free.
    """
    n = len(rows)
    geometry = 6 * (n + 1)
    start = np.zeros(geometry + 2 * n * len(harmonics))
    mask = np.ones(len(start), dtype=bool)
    if frames_only:
        mask[6 : geometry - 3] = False

    def error(part: Array) -> Array:
        p = start.copy()
        p[mask] = part
        return (arm_positions(p, rows, q, harmonics) - r).ravel()

    found = start.copy()
    found[mask] = gauss_newton(error, start[mask])
    return found


def arm_positions(
    p: Array, rows: Sequence[tuple[float, float, float]], q: Array, harmonics: Sequence[float] = ()
) -> Array:
    """Return positions (N, 3) by the result of `fit_arm`."""
    n = len(rows)
    geometry = 6 * (n + 1)
    waves = p[geometry:].reshape(len(harmonics), 2, n)
    shifted = q.copy()
    for k, (cosine, sine) in zip(harmonics, waves, strict=True):
        shifted = shifted + cosine * np.cos(k * q) + sine * np.sin(k * q)
    return _arm_positions(p[:geometry], rows, shifted)


# ------------------------------------------------------------------ a cable robot


def fit_cable_robot(
    anchors: Array, radius: float, pay_out: Array, motors: Array, r: Array, bend: bool
) -> Array:
    """Fit anchors (4, 3), offsets (4), one radius of three spools, one of the fourth, and with
    `bend` one quadratic term: the radii fall while lines are paid out."""
    start = np.concatenate([anchors.ravel(), np.zeros(4), [radius, radius], np.zeros(1)])
    free = len(start) if bend else len(start) - 1

    def error(part: Array) -> Array:
        p = np.concatenate([part, start[free:]])
        return _cable_residuals(p, pay_out, motors, r).ravel()

    found = least_squares(error, start[:free], x_scale="jac", xtol=1e-13, ftol=1e-13)
    return np.concatenate([found.x, start[free:]])


def _cable_residuals(p: Array, pay_out: Array, motors: Array, r: Array) -> Array:
    anchors, offsets = p[:12].reshape(4, 3), p[12:16]
    radius = p[[16, 16, 16, 17]]
    bend = p[18] / pay_out  # a pulley block of n parts pays out 1/n, and winds n times as much
    angle = motors * pay_out  # of the spool, per part of the line
    lines = radius * angle + bend * angle**2 + offsets
    return np.asarray(
        np.linalg.norm(r[:, None] - anchors, axis=2) - np.linalg.norm(anchors, axis=1) - lines
    )


def cable_robot_errors(p: Array, pay_out: Array, motors: Array, r: Array) -> Array:
    """Return measured minus computed positions (N, 3), from four lines each."""
    found = solve_positions(lambda x: _cable_residuals(p, pay_out, motors, x), r)
    return np.asarray(r - found)


# ------------------------------------------------------------------ a delta printer


def _tower_places(radius: float, turn_x: float, turn_y: float) -> Array:
    angles = np.radians([210 + turn_x, 330 + turn_y, 90])
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _carriages(p: Array, r: Array) -> Array:
    """Return carriage heights (N, 3) by RepRapFirmware's formula.

    p: three end-stop corrections, radius, two tower angles (deg), rod length, two tilts of the bed
    (height per metre), homed height.
    """
    towers = _tower_places(*p[3:6])
    level = r[:, 2] + p[7] * r[:, 0] + p[8] * r[:, 1]
    apart = r[:, None, :2] - towers
    rods = np.sqrt(p[6] ** 2 - np.sum(apart**2, axis=2))
    homed = p[9] + np.sqrt(p[6] ** 2 - p[3] ** 2)
    return np.asarray(level[:, None] + rods - p[:3] - homed)


def printer_heights(p: Array, given: Array, touches: Array) -> Array:
    """Return the heights (N,) by the numbers `p` where the motors stood at the touches.

    The controller moved to the touches by the numbers `given`. The bed is its plane z = 0.
    """
    motors = _carriages(given, touches)
    found = solve_positions(lambda x: _carriages(p, x) - motors, touches)
    return np.asarray(found[:, 2])


def fit_printer(given: Array, free: Sequence[int], touches: Array) -> Array:
    """Fit the numbered factors so that the touches get the height 0."""
    free = list(free)

    def error(part: Array) -> Array:
        p = given.copy()
        p[free] = part
        return printer_heights(p, given, touches)

    found = given.copy()
    found[free] = gauss_newton(error, given[free])
    return found


def read_d300vs(heightmap: Path) -> tuple[Array, Array]:
    """Return the printer's numbers (10,) by its configuration, and its touches (N, 3)."""
    header, *rows = heightmap.read_text().splitlines()[2:]
    x0, _, y0, _, _, dx, dy = map(float, header.split(",")[:7])
    touches = [
        (x0 + i * dx, y0 + j * dy, float(cell))
        for j, row in enumerate(rows)
        for i, cell in enumerate(row.split(","))
        if cell.strip() != "0"  # not probed
    ]
    # M666 X Y Z, M665 R X Y L, no tilt, M665 H of config-override.g
    given = [0.304e-3, -1.064e-3, 0.761e-3, 0.205906, -0.336, -0.499, 0.375, 0.0, 0.0, 0.43959]
    return np.array(given), 1e-3 * np.array(touches)
