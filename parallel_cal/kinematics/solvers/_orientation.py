"""General orientation problem (6.2.3): a spherical triangle fitted to three small circles.

Three conditions u_i . R v_i = c_i have at most eight solutions R. Two angles satisfy the first
one by construction; the other two are bilinear in their cosines and sines (eq. 6.7), and the
resultant of their half-tangent forms is a polynomial of eighth order in one angle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from parallel_cal.base.errors import SolveError

# (cos, sin, 1) (1 + u^2) = HALF_TANGENT (u^2, u, 1)
HALF_TANGENT = np.array([[-1.0, 0, 1], [0, 2, 0], [1, 0, 1]])
TURNS = (0.0, 0.7, 1.9, 2.6, 4.1)  # rad: origins to try, so that no root is at u = inf
NEARLY_REAL = 1e-4  # imaginary part of u that rounding may leave on a double root
MAX_CLOSED_RESIDUAL = 1e-11  # of a solution, relative to the size of the conditions


def orientations(
    u: np.ndarray, v: np.ndarray, c: np.ndarray, form: str = "eigenvalue"
) -> np.ndarray:
    """Find all rotations R (k, 3, 3), k <= 8, with u_i . R v_i = c_i.

    The rows of u (3, 3) are fixed in the base, those of v (3, 3) in the platform; c (3,) are
    cosines if these are unit vectors. `form` selects the method for the first angle: "polynomial"
    or "eigenvalue".
    """
    u, v, c = (np.asarray(a, dtype=float) for a in (u, v, c))
    size_u, size_v = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    u, v, c = u / size_u[:, None], v / size_v[:, None], c / (size_u * size_v)
    # Begin with the widest circle: a circle of radius zero would leave one angle undetermined.
    first = int(np.argmin(np.abs(c)))
    if abs(c[first]) > 1:
        return np.empty((0, 3, 3))
    A = _find_carrying_rotation(v[first], u[first], c[first])
    m, k = (
        sw(-u[first], u[i]).T @ A @ sw(v[first], v[i]) - c[i] * np.diag([0.0, 0, 1])
        for i in range(3)
        if i != first
    )
    found = [_rot3(u[first], a) @ A @ _rot3(v[first], b) for a, b in angles(m, k, form)]
    return np.array(found).reshape(-1, 3, 3)


def angles(m: np.ndarray, k: np.ndarray, form: str = "eigenvalue") -> np.ndarray:
    """Find all real pairs (theta2, theta3), (n, 2) rad, of eq. 6.7 for matrices m and k (3, 3).

    A half tangent is infinite at pi. Both angles have an origin that keeps the solutions away from
    pi.
    """
    m, k = (a / np.linalg.norm(a) for a in (np.asarray(m, dtype=float), np.asarray(k, dtype=float)))
    roots, turn = _first_roots(m, k, FORMS[form])
    real = roots[np.abs(roots.imag) < NEARLY_REAL * (1 + np.abs(roots))].real
    pairs = [pair for t in 2 * np.arctan(real) + turn for pair in _find_second_angles(t, m, k)]
    found: list[np.ndarray] = []
    for start in pairs:
        pair = np.array(start)
        for _ in range(8):  # Newton's method; least squares, as a double solution is singular
            value, slope = _bilinear(pair, m, k)
            pair = pair - np.linalg.lstsq(slope, value, rcond=1e-9)[0]
        new = np.all([np.abs(np.exp(1j * pair) - np.exp(1j * old)).max() > 1e-6 for old in found])
        if new and np.abs(_bilinear(pair, m, k)[0]).max() < MAX_CLOSED_RESIDUAL:
            found.append(np.angle(np.exp(1j * pair)))  # between -pi and pi
    return np.array(sorted(found, key=tuple)).reshape(-1, 2)


def coefficients(m: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Compute P_8 .. P_0 of the polynomial in u_2 (eqs 6.11, 6.12 and 6.17)."""
    M, K = ((HALF_TANGENT.T @ a @ HALF_TANGENT).T for a in (m, k))  # rows: columns of eq. 6.9

    def term(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
        """(u.a)(u.b)(u.c)(u.d), expanded and shrunk (eq. 6.16)."""
        return sh(np.outer(sh(np.outer(a, b)), sh(np.outer(c, d))))

    (M1, M2, M3), (K1, K2, K3) = M, K
    squares = term(M1, M1, K3, K3) + term(M2, M2, K1, K3) + term(M3, M3, K1, K1)
    mixed = term(M1, M2, K2, K3) + term(M2, M3, K1, K2)
    return squares - mixed + term(M1, M3, K2, K2) - 2 * term(M1, M3, K1, K3)


def sh(G: np.ndarray) -> np.ndarray:
    """Shrink (eq. B.5): coefficients of the polynomial x G x, as sums along the antidiagonals."""
    n = len(G)
    flipped = G[:, ::-1]
    return np.array([np.trace(flipped, offset) for offset in range(n - 1, -n, -1)])


def sw(k: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Swap (eq. B.3): Rot3(k, t) v = Sw(k, v) (cos t, sin t, 1), for a unit vector k."""
    along = k * (k @ v)
    return np.column_stack([v - along, np.cross(k, v), along])


def _by_polynomial(m: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, float]:
    """Roots u_2 of eq. 6.12, and the relative size of its leading coefficient."""
    P = coefficients(m, k)
    size = np.abs(P).max()
    if size < 1e-14:
        return np.empty(0), 0.0
    return np.roots(P), float(abs(P[0]) / size)


def _by_eigenvalues(m: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, float]:
    """Roots u_2 as eigenvalues: by eq. 6.10, u^2 S2 + u S1 + S0 is singular.

    This is better conditioned than the polynomial, whose coefficients are products of four factors.
    """
    S = np.zeros((3, 4, 4))
    for row, a in ((0, m), (2, k)):
        a = HALF_TANGENT.T @ a @ HALF_TANGENT
        S[:, row, :3], S[:, row + 1, 1:] = a, a
    singular = np.linalg.svd(S[0], compute_uv=False)
    if singular[-1] < 1e-13 * np.linalg.norm(S):
        return np.empty(0), 0.0
    companion = np.zeros((8, 8))
    companion[:4, 4:] = np.eye(4)
    companion[4:, :4] = -np.linalg.solve(S[0], S[2])
    companion[4:, 4:] = -np.linalg.solve(S[0], S[1])
    return np.linalg.eigvals(companion), float(singular[-1] / np.linalg.norm(S))


FORMS = {"polynomial": _by_polynomial, "eigenvalue": _by_eigenvalues}


def _first_roots(m: np.ndarray, k: np.ndarray, roots: Callable) -> tuple[np.ndarray, float]:
    """Roots u_2 for the best of a few origins of both angles, and the origin of the first angle."""
    tried = []
    for turn in TURNS:
        # theta = turn + theta' rotates cosine and sine; the second angle's origin moves, too.
        there, other = _rot3(np.eye(3)[2], turn), _rot3(np.eye(3)[2], 0.3 - turn)
        tried.append((*roots(there.T @ m @ other, there.T @ k @ other), turn))
    best = max(tried, key=lambda t: t[1])
    if best[1] < 1e-12:
        raise SolveError(
            "the general orientation problem has no eighth-order polynomial here: "
            "its conditions depend on each other, or determine only one position for "
            "each direction"
        )
    return best[0], best[2]


def _find_second_angles(t: float, m: np.ndarray, k: np.ndarray) -> list[tuple[float, float]]:
    """theta_3 for a given theta_2: the solution of two equations a cos + b sin + c = 0 (eq. 6.18).

    As lines in the plane (cos, sin) they meet in one point. If they coincide, a double root of the
    polynomial has two values of theta_3: those at which the line meets the unit circle.
    """
    q = np.array([np.cos(t), np.sin(t), 1.0])
    lines = np.array([q @ m, q @ k])
    _, sizes, right = np.linalg.svd(lines)
    if sizes[1] > 1e-4 * sizes[0]:
        x, y, z = right[2]
        return [(t, float(np.arctan2(y * np.sign(z), x * np.sign(z))))]
    a, b, c = right[0]
    apart = np.arccos(np.clip(-c / max(np.hypot(a, b), 1e-300), -1, 1))
    return [(t, float(np.arctan2(b, a) + side * apart)) for side in (1, -1)]


def _bilinear(pair: np.ndarray, m: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (2,) of eq. 6.7 and their derivatives (2, 2) in both angles."""
    q2, q3 = (np.array([np.cos(t), np.sin(t), 1.0]) for t in pair)
    d2, d3 = (np.array([-np.sin(t), np.cos(t), 0.0]) for t in pair)
    value = np.array([q2 @ a @ q3 for a in (m, k)])
    return value, np.array([[d2 @ a @ q3, q2 @ a @ d3] for a in (m, k)])


def _find_carrying_rotation(v: np.ndarray, u: np.ndarray, cosine: float) -> np.ndarray:
    """Some rotation that carries the unit vector v to the angle arccos(cosine) from u."""
    across = np.eye(3)[np.argmin(np.abs(v))]
    axis = np.cross(v, across) / np.linalg.norm(np.cross(v, across))
    aside = np.cross(u, np.eye(3)[np.argmin(np.abs(u))])
    aside /= np.linalg.norm(aside)
    goal = cosine * u + np.sqrt(max(0.0, 1 - cosine**2)) * aside
    # Two frames, with first axis v and `goal`: their quotient carries v to `goal`.
    other = np.cross(goal, np.eye(3)[np.argmin(np.abs(goal))])
    other /= np.linalg.norm(other)
    there = np.column_stack([goal, other, np.cross(goal, other)])
    return there @ np.column_stack([v, axis, np.cross(v, axis)]).T


def _rot3(k: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit vector (eq. B.1)."""
    return np.column_stack([sw(k, e) @ [np.cos(angle), np.sin(angle), 1.0] for e in np.eye(3)])
