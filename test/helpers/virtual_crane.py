"""A virtual platform on eight lines, measured by cameras: points, distances and spools.

The equations are its own: nothing here is of the package. SI units.
"""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

POSTS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
ANCHORS = np.array([[(3 - k) * x, (2.2 + k) * y, 3.2] for x, y in POSTS for k in (0, 0.1)])
# The lines of a post cross: one ends low on its own side of the platform, one high on the other.
CORNERS = np.array([[-0.4 * x, 0.3 * y * s, -0.25 * s] for x, y in POSTS for s in (1, -1)])
HOME = np.array([0.0, 0.0, 1.2])
RADIUS, GEAR = 0.05, 10.0
BUILDUP = 3.2e-5  # m: cross-section of the line, divided by pi and by the width of the spool
LINE_SIGMA, CAMERA_SIGMA, CAMERA_TURN_SIGMA = 0.15e-3, 0.3e-3, np.radians(0.03)
LOW, HIGH, TILT = (-1.3, -0.9, 0.5), (1.3, 0.9, 1.8), 0.15

_rng = np.random.default_rng(862)
TRUE_ANCHORS = ANCHORS + _rng.normal(0, 5e-3, (8, 3))
TRUE_CORNERS = CORNERS + _rng.normal(0, 1.5e-3, (8, 3))
ZEROS = _rng.normal(0, 4e-3, 8)  # of the lines at reading zero


def lines(r, turn, anchors=TRUE_ANCHORS, corners=TRUE_CORNERS):
    """Lengths (8,) from anchor to corner."""
    return np.linalg.norm(anchors - r - turn.apply(corners), axis=1)


ZERO_LENGTHS = lines(HOME, Rotation.identity(), ANCHORS, CORNERS) + ZEROS


def motors(lengths):
    """Motor angles (8,): a spool that has turned by f has let out RADIUS f - BUILDUP f^2 / 4."""
    let_out = lengths - ZERO_LENGTHS
    spool = 2 * (RADIUS - np.sqrt(RADIUS**2 - BUILDUP * let_out)) / BUILDUP
    return GEAR * spool


def reached(angles, r, turn):
    """The pose (r, turn) that agrees best with the motor angles, near a given one."""
    spool = angles / GEAR
    lengths = ZERO_LENGTHS + RADIUS * spool - BUILDUP * spool**2 / 4

    def missing(change):
        return lines(r + change[:3], Rotation.from_rotvec(change[3:]) * turn) - lengths

    change = least_squares(missing, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    return r + change[:3], Rotation.from_rotvec(change[3:]) * turn


def poses(n, seed):
    """Positions (n, 3) and orientations (n) in the workspace."""
    rng = np.random.default_rng(seed)
    return rng.uniform(LOW, HIGH, (n, 3)), Rotation.from_rotvec(rng.uniform(-TILT, TILT, (n, 3)))


def table(n=60, twice=12, seed=11):
    """A table in CSV: turns of the motors, and poses of a target in the frame of the cameras."""
    rng = np.random.default_rng([seed, 1])
    r, turn = poses(n, seed)
    camera, shift = Rotation.from_euler("xyz", [-90, 3, 12], degrees=True), [0.35, 1.02, -0.4]
    target = [0.031, -0.018, 0.262]
    target_turn = Rotation.from_euler("xyz", [1.5, -2, 178], degrees=True)
    rows = [",".join([*(f"W{i}_rev" for i in range(1, 9)), *"xyz", *("qx", "qy", "qz", "qw")])]
    for i in [*range(n), *rng.choice(n, twice, replace=False)]:
        let_out = lines(r[i], turn[i]) + rng.normal(0, LINE_SIGMA, 8)
        seen = camera.apply(r[i] + turn[i].apply(target)) + shift + rng.normal(0, CAMERA_SIGMA, 3)
        shaken = Rotation.from_rotvec(rng.normal(0, CAMERA_TURN_SIGMA, 3))
        q = (shaken * camera * turn[i] * target_turn).as_quat()
        cells = [f"{a / (2 * np.pi):.4f}" for a in motors(let_out)]
        rows.append(",".join([*cells, *(f"{1e3 * v:.2f}" for v in seen), *(f"{v:.6f}" for v in q)]))
    return "\n".join(rows) + "\n"


def position_errors(inverse, n=200, seed=777):
    """Position errors (n,) of the robot at unmeasured poses, sent there by motors inverse(r, R).

    The frames of base and platform are free: poses measured by a camera do not determine them.
    Their small motions that suit all poses best are taken out.
    """
    r, turn = poses(n, seed)
    went = [reached(inverse(p, t.as_matrix()), p, t)[0] for p, t in zip(r, turn, strict=True)]
    moved = [
        np.hstack([np.eye(3), -np.cross(np.eye(3), p), t.as_matrix()])
        for p, t in zip(r, turn, strict=True)
    ]
    A, error = np.vstack(moved), np.ravel(went - r)
    rest = error - A @ np.linalg.lstsq(A, error, rcond=None)[0]
    return np.linalg.norm(rest.reshape(n, 3), axis=1)
