"""Rotations: symbolic matrices for closures, and conversions from and to quaternions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

# The cross products with the three unit vectors, as matrices.
SKEWS = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)


def rot_x(angle: Any) -> Any:
    """Return the rotation about x by an angle in rad (eq. B.1); shape (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(1, 0, 0), ca.horzcat(0, c, -s), ca.horzcat(0, s, c))


def rot_y(angle: Any) -> Any:
    """Return the rotation about y by an angle in rad (eq. B.1); shape (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, 0, s), ca.horzcat(0, 1, 0), ca.horzcat(-s, 0, c))


def rot_z(angle: Any) -> Any:
    """Return the rotation about z by an angle in rad (eq. B.1); shape (3, 3)."""
    c, s = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def cayley(w: Any) -> Any:
    """Return a rotation (3, 3) that equals exp(w) to second order. It is rational in w, so that it
    is smooth at w = 0."""
    h = ca.skew(w / 2)
    return ca.SX.eye(3) + 2 / (1 + ca.dot(w, w) / 4) * (h + h @ h)


def exponential(w: Any) -> Any:
    """Return exp(w) (3, 3) by Rodrigues' formula (eq. B.1); smooth at w = 0."""
    # The offset is far below rounding. Without it, the root has no derivative at w = 0.
    square = ca.dot(w, w) + 1e-30
    angle = ca.sqrt(square)
    half = ca.sin(angle / 2)
    S = ca.skew(w)
    return ca.SX.eye(3) + ca.sin(angle) / angle * S + 2 * half**2 / square * (S @ S)


def left_generators(R: Any) -> Any:
    """Return d vec(exp(w) R) / dw at w = 0, with row-major vec; shape (9, 3)."""
    columns = [ca.vec((ca.skew(ca.DM(axis)) @ R).T) for axis in np.eye(3)]
    return ca.horzcat(*columns)


def compute_left_generators(R: np.ndarray) -> np.ndarray:
    """Return d vec(exp(w) R) / dw at w = 0 of rotations (N, 3, 3), with row-major vec; shape
    (N, 9, 3)."""
    return np.asarray(np.einsum("kij,njm->nimk", SKEWS, R).reshape(len(R), 9, 3))


def quaternion_to_matrix(quaternion: np.ndarray | Sequence[float]) -> np.ndarray:
    """Convert quaternions x y z w (..., 4) of any non-zero length to matrices (..., 3, 3)."""
    q = np.asarray(quaternion, dtype=float)
    if q.ndim == 1:
        return _single_matrix(q)
    size = np.abs(q).max(axis=-1, keepdims=True)
    extreme = (size > 0) & np.isfinite(size) & ((size < 1e-100) | (size > 1e100))
    if extreme.any():  # the squares of such numbers are 0 or infinite
        q = q / np.where(extreme, size, 1.0)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _single_matrix(q: np.ndarray) -> np.ndarray:
    """Convert one quaternion without the overhead of arrays."""
    largest = max(map(abs, q.tolist()))
    x, y, z, w = (q / largest if 0 < largest < 1e-100 or 1e100 < largest < np.inf else q).tolist()
    size = math.sqrt(x * x + y * y + z * z + w * w) or math.nan
    x, y, z, w = x / size, y / size, z / size, w / size
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(R: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to quaternions x y z w (..., 4) with w >= 0."""
    R = np.asarray(R, dtype=float)
    if R.ndim == 2:
        return _single_quaternion(R)
    a, b, c, d, e, f, g, h, i = R.reshape(-1, 9).T
    # Every row of 4 q q^T is parallel to q. The row of the largest component has the smallest
    # rounding error (Shepperd).
    products = np.empty((4, 4, len(a)))
    products[0, 0], products[1, 1] = 1 + a - e - i, 1 + e - a - i
    products[2, 2], products[3, 3] = 1 + i - a - e, 1 + (a + e + i)  # as in _single_quaternion
    products[0, 1] = products[1, 0] = b + d
    products[0, 2] = products[2, 0] = c + g
    products[1, 2] = products[2, 1] = f + h
    products[0, 3] = products[3, 0] = h - f
    products[1, 3] = products[3, 1] = c - g
    products[2, 3] = products[3, 2] = d - b
    best = products.reshape(16, -1)[::5].argmax(axis=0)
    q = products[best, :, np.arange(len(best))]
    x, y, z, w = q.T
    size = np.sqrt(x * x + y * y + z * z + w * w)
    q /= np.where(w < 0, -size, size)[:, None]
    return q.reshape(*R.shape[:-2], 4)


def _single_quaternion(R: np.ndarray) -> np.ndarray:
    """Convert one matrix without the overhead of arrays, as nodes convert one pose at a time."""
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
    """Return the rotation R (3, 3) that maximises tr(R^T M)."""
    left, _, right = np.linalg.svd(M)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def turns_from_mean(R: np.ndarray) -> np.ndarray:
    """Return the rotation vectors (N, 3), rad, of rotations (N, 3, 3) from their mean."""
    return rotation_vector(R @ nearest_rotation(R.sum(axis=0)).T)


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3) in rad."""
    q = matrix_to_quaternion(R)
    axis = q[..., :3]
    sine = np.sqrt(np.einsum("...k,...k->...", axis, axis))
    turned = sine > 1e-12  # angle / sine tends to 2 as the angle tends to 0
    angle = 2 * np.arctan2(sine, q[..., 3])
    scale = np.divide(angle, sine, out=np.full_like(angle, 2.0), where=turned)
    return np.asarray(scale[..., None] * axis)


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """Convert rotation vectors w (..., 3) in rad to matrices exp(w) (..., 3, 3)."""
    vector = np.asarray(vector, dtype=float)
    if vector.ndim == 1:
        x, y, z = vector.tolist()
        half = math.sqrt(x * x + y * y + z * z) / 2
        return _single_matrix(np.array([*0.5 * np.sinc(half / np.pi) * vector, np.cos(half)]))
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    axis = 0.5 * np.sinc(half / np.pi) * vector
    return quaternion_to_matrix(np.concatenate([axis, np.cos(half)], axis=-1))
