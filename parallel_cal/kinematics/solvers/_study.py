"""Poses as dual quaternions: a rod between two balls is a quadric (eq. 6.19).

(e, g) with scalar parts first: R b = e b e* / e.e and P = g e* / e.e, on Study's quadric
e.g = 0. Everything holds for complex numbers, too, with x.x instead of |x|^2.
"""

from __future__ import annotations

import numpy as np


def quadrics(C: np.ndarray, B: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Matrices (7, 8, 8) of |g + W e|^2 - L^2 e.e with W e = e B - C e, and of 2 e.g (eq. 6.19).

    If e.g = 0, |g + W e|^2 equals |e.e (P + R B - C)|^2 / e.e.
    """
    W = _right(B) - _left(C)
    M = np.zeros((7, 8, 8), dtype=W.dtype)
    # W is skew, so W^T W needs no conjugate even if the platform is complex.
    M[:6, :4, :4] = np.swapaxes(W, 1, 2) @ W - squares[:, None, None] * np.eye(4)
    M[:6, :4, 4:], M[:6, 4:, :4] = np.swapaxes(W, 1, 2), W
    M[:6, 4:, 4:] = np.eye(4)
    M[6, :4, 4:] = M[6, 4:, :4] = np.eye(4)
    return M


def poses(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert dual quaternions (k, 8), scalar parts first, to positions (k, 3) and rotations."""
    e, g = X[:, :4], X[:, 4:]
    norm = (e**2).sum(axis=1)
    w, v = e[:, 0], e[:, 1:]
    position = (w[:, None] * g[:, 1:] - g[:, :1] * v - np.cross(g[:, 1:], v)) / norm[:, None]
    cross = _left(v)[:, 1:, 1:]
    rotation = np.eye(3) + 2 / norm[:, None, None] * (w[:, None, None] * cross + cross @ cross)
    return position, rotation


def _left(v: np.ndarray) -> np.ndarray:
    """(k, 4, 4) matrices of x -> v x for pure quaternions v (k, 3)."""
    matrix = _right(v)
    matrix[:, 1:, 1:] *= -1
    return matrix


def _right(v: np.ndarray) -> np.ndarray:
    """(k, 4, 4) matrices of x -> x v for pure quaternions v (k, 3)."""
    x, y, z = v.T
    o = np.zeros_like(x)
    rows = [[o, -x, -y, -z], [x, o, z, -y], [y, -z, o, x], [z, y, -x, o]]
    return np.moveaxis(np.array(rows), -1, 0)
