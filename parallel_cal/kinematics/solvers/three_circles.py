"""A triangle on three circles: every solution of the direct problem of Argos 27 (6.7.2).

For mechanisms with a method `circles(q, p)`: each ball of the platform lies on a circle in space.
With P_i(z) = C_i + a_i z + conj(a_i) / z and z = exp(i t), the three side lengths of the triangle
are equations in z_1, z_2, z_3, quadratic in each. Their resultant in z_1 is a polynomial of degree
16, as Nanua found; its coefficients come from its values on the unit circle.

Prefer it where every assembly mode of an Argos 27 is wanted, as --all does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from parallel_cal.base.rotation import nearest_rotation
from parallel_cal.kinematics.evaluating import (
    get_kinematics,
    is_pose_unaffected,
    order_from_home,
    parts,
    solve_on_home_branch,
)
from parallel_cal.kinematics.solutions import Solutions, Status, stack_solutions
from parallel_cal.model.model import Model

RESULTANT_DEGREE = 16
SIDES = ((0, 1), (0, 2), (1, 2))
SAMPLES = 64  # on the unit circle; more than the resultant's 17 coefficients need
NEGLIGIBLE = 1e-12  # relative to the largest coefficient; the degree is lower in symmetric cases
NEARLY_REAL = 1e-3  # distance from the unit circle; within it, Newton's method decides


def direct_all(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find every real pose at joints q (nq,), home branch first; `count_complex` is usually 16."""
    q = np.asarray(q, dtype=float)
    C, u, radius, B = parts(model, "circles", q, at)
    z, starts = balls(C, u, radius, B)
    found: list[Solutions] = []
    kinematics = get_kinematics(model)
    for points in starts:
        r, R = fit_pose(B, points)
        start = Solutions(q, r, R, np.array(np.nan), np.array(0))
        pose = kinematics.direct(q, at, start, keep_branch=True)
        known = any(np.abs(pose.rotation - f.rotation).max() < 1e-6 for f in found)
        if pose.status in (Status.CONVERGED, Status.OUTSIDE_LIMITS) and not known:
            found.append(pose)
    none = np.empty((0, len(q) + 12))
    poses = stack_solutions(found) if found else Solutions.of(none, none[:, 0], none[:, 0])
    complete = is_pose_unaffected(model.structure)
    poses = order_from_home(model, poses, at)
    return replace(poses, count_complex=len(z), complete=complete)


def direct(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find the pose on the home branch for joints (nq,) or (N, nq); unreachable if none is real."""
    return solve_on_home_branch(model, q, at, direct_all)


def balls(
    C: np.ndarray, u: np.ndarray, radius: np.ndarray, B: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Find all complex z_1 (up to 16), and the three balls (3, 3) of the nearly real ones."""
    size = float(radius.mean())
    terms = [_terms(*one) for one in zip(C / size, u, radius / size, strict=True)]
    # Coefficients (3, 3) of |P_i - P_j|^2 - side^2 in powers -1, 0, 1 of z_i and z_j.
    pairs = {}
    for i, j in SIDES:
        side = (B[i] - B[j]) / size
        M = -2 * terms[i][0] @ terms[j][0].T
        M[:, 1] += terms[i][1]
        M[1, :] += terms[j][1]
        M[1, 1] -= side @ side
        pairs[i, j] = M
    z = _roots(pairs)
    near = [one / abs(one) for one in z if abs(np.log(abs(one))) < NEARLY_REAL]
    return z, [point * size for one in near for point in _triangles(one, terms, pairs)]


def _terms(C: np.ndarray, u: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Laurent coefficients (z^-1, z^0, z^1) of P and of P.P on a circle."""
    first = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
    first /= np.linalg.norm(first)
    a = radius * (first - 1j * np.cross(u, first)) / 2
    P = np.stack([a.conj(), C.astype(complex), a])
    return P, np.array([2 * C @ a.conj(), C @ C + radius**2, 2 * C @ a])


def _roots(pairs: dict[tuple[int, int], np.ndarray]) -> np.ndarray:
    """Zeros of the resultant in z_1."""
    z = np.exp(2j * np.pi * np.arange(SAMPLES) / SAMPLES)
    values = []
    for one in z:
        # Poisson's formula: lead^4 lead^4 times the third equation at all pairs of roots.
        f, g = (_powers(one) @ pairs[0, j] for j in (1, 2))
        roots = product(np.roots(f[::-1]), np.roots(g[::-1]))
        third = [x * y * (_powers(x) @ pairs[1, 2] @ _powers(y)) for x, y in roots]
        values.append(complex(f[2] ** 4 * g[2] ** 4 * np.prod(third)))
    half = RESULTANT_DEGREE // 2
    coefficients = np.roll(np.fft.fft(np.array(values)) / SAMPLES, half)[: RESULTANT_DEGREE + 1]
    size = np.abs(coefficients).max()
    significant = np.flatnonzero(np.abs(coefficients) > NEGLIGIBLE * size)
    return np.roots(coefficients[significant[0] : significant[-1] + 1][::-1])


def _powers(z: complex) -> np.ndarray:
    return np.array([1 / z, 1, z])


def _triangles(z: complex, terms: list[Any], pairs: dict[tuple[int, int], np.ndarray]) -> list[Any]:
    """Balls on their circles that nearly close the triangle for a given z_1."""
    second, third = (np.roots((_powers(z) @ pairs[0, j])[::-1]) for j in (1, 2))
    choices = [(x / abs(x), y / abs(y)) for x, y in product(second, third)]
    gaps = [abs(_powers(x) @ pairs[1, 2] @ _powers(y)) for x, y in choices]
    best = sorted(range(len(gaps)), key=gaps.__getitem__)[:2]  # two, because of double roots
    return [
        np.array([(_powers(w) @ t[0]).real for w, t in zip((z, *choices[k]), terms, strict=True)])
        for k in best
    ]


def fit_pose(B: np.ndarray, P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the pose (r, R) that brings points B (n, 3) nearest to P (n, 3)."""
    b, p = B - B.mean(axis=0), P - P.mean(axis=0)
    turn = nearest_rotation(p.T @ b)
    return P.mean(axis=0) - turn @ B.mean(axis=0), turn
