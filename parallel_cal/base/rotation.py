"""Rotations: the symbolic building blocks of closures, and quaternions at the border."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np


def rot_x(angle: Any) -> Any:
    """Rotation about x (eq. B.1)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, c, -s), ca.horzcat(0, s, c))


def rot_y(angle: Any) -> Any:
    """Rotation about y (eq. B.1)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, 0, s), ca.horzcat(0, 1, 0), ca.horzcat(-s, 0, c))


def rot_z(angle: Any) -> Any:
    """Rotation about z (eq. B.1)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def cayley(w: Any) -> Any:
    """A rotation equal to exp(w) to second order, rational in w: smooth at w = 0."""
    h = ca.skew(w / 2)
    return ca.SX.eye(3) + 2 / (1 + ca.dot(w, w) / 4) * (h + h @ h)


def exponential(w: Any) -> Any:
    """exp(w), by Rodrigues' formula (eq. B.1); smooth at w = 0."""
    square = ca.dot(w, w) + 1e-30  # far below rounding, and its root has a derivative
    angle = ca.sqrt(square)
    half = ca.sin(angle / 2)
    S = ca.skew(w)
    return ca.SX.eye(3) + ca.sin(angle) / angle * S + 2 * half**2 / square * (S @ S)


def left_generators(R: Any) -> Any:
    """d vec(exp(w) R) / dw at w = 0, row-major vec; shape (9, 3)."""
    columns = [ca.vec((ca.skew(ca.DM(axis)) @ R).T) for axis in np.eye(3)]
    return ca.horzcat(*columns)


def quaternion_to_matrix(quaternion: np.ndarray | Sequence[float]) -> np.ndarray:
    """(..., 4) quaternions x y z w, of any non-zero length, to (..., 3, 3) matrices."""
    q = np.asarray(quaternion, dtype=float)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(R: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrices to (..., 4) quaternions x y z w with w >= 0."""
    R = np.asarray(R, dtype=float)
    if R.ndim == 2:
        return _single_quaternion(R)
    a, b, c, d, e, f, g, h, i = np.moveaxis(R.reshape(*R.shape[:-2], 9), -1, 0)
    # 4 q q^T: every row is along q, that of the largest component is the safest (Shepperd).
    rows = [
        [1 + a - e - i, b + d, c + g, h - f],
        [b + d, 1 + e - a - i, f + h, c - g],
        [c + g, f + h, 1 + i - a - e, d - b],
        [h - f, c - g, d - b, 1 + (a + e + i)],  # the bits of a single one
    ]
    products = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    best = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(products, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def _single_quaternion(R: np.ndarray) -> np.ndarray:
    """Convert one matrix without the overhead of arrays: nodes convert one pose at a time."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace, largest = a + e + i, max(a, e, i)
    if trace >= largest:
        q = [h - f, c - g, d - b, 1 + trace]
    elif a == largest:
        q = [1 + a - e - i, b + d, c + g, h - f]
    elif e == largest:
        q = [b + d, 1 + e - a - i, f + h, c - g]
    else:
        q = [c + g, f + h, 1 + i - a - e, d - b]
    size = math.sqrt(sum(part * part for part in q))
    return np.array(q) / (size if q[3] >= 0 else -size)


def nearest_rotation(M: np.ndarray) -> np.ndarray:
    """The rotation R (3, 3) for which tr(R^T M) is greatest."""
    left, _, right = np.linalg.svd(M)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotation matrices to (..., 3) rotation vectors (rad)."""
    q = matrix_to_quaternion(R)
    sine = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2 * np.arctan2(sine, q[..., 3])
    # angle / sine tends to 2 where the rotation vanishes.
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1), 2.0)
    return scale[..., None] * q[..., :3]


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """(..., 3) rotation vectors (rad) to (..., 3, 3) matrices: exp(w)."""
    vector = np.asarray(vector, dtype=float)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    axis = 0.5 * np.sinc(half / np.pi) * vector
    return quaternion_to_matrix(np.concatenate([axis, np.cos(half)], axis=-1))
