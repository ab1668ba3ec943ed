"""What a chain's rows determine: configurations that close, freedoms, rows and parameters that
others replace. All of it is found by rank, at home and at configurations around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import casadi as ca
import numpy as np

from parallel_cal.model.configuration import Configuration

CLOSED = 1e-12  # m or rad: the norm of the rows of a closed configuration
RELATIVE_RANK = 1e-7  # singular values of closed configurations are exact to about 1e-12
MIN_INDEPENDENT_PART = 1e-5  # of the motion by a parameter, after what others explain
STEPS = 60  # of Newton's method, damped
LARGEST_STEP = 0.4  # lengths or rad: of one step
AMPLITUDES = (0.05, 0.3, 0.8)  # rad, or shares of the length, by which the joints are moved
TRIES = 30  # random starts from which the loops are closed
CLEARLY_BETTER = 1.2  # times: of less, no further step is made, and no usual choice is changed
PATHS, PATH_STEPS = 16, 6  # over the range of the joints, each from home
MIN_MOVED_SHARE = 1e-4  # of a motion, by the controlled coordinates; less is a dead point
MIN_MOTION = 1e-3  # of the largest one: of less, the platform does not move in a way
MIN_SAME_MODE = 0.3  # cosine between neighbouring motions; less is a jump to another mode
# Of the best share. `length` is 0.3 times the farthest joint, so turns have a share of 0.28 even at
# the end of a foot as long as the robot.
MIN_SHARE_OF_BEST = 0.25


@dataclass(frozen=True)
class Survey:
    """The rows of a chain as a function of (q, r, R9, u), and its configurations around home.

    `function` computes rows (m,), their derivatives (m, nq + 6 + nu) by (q, r, w, u) and
    (m, n_parameters) by the parameters. `row_scale` and `scale` turn rows and coordinates into
    metres; `n_joints` and `n_passive` count joints and passive coordinates. A configuration whose
    rows have a norm of less than `closed` (m) counts as closed.
    """

    function: ca.Function
    nominal: np.ndarray
    row_scale: np.ndarray
    scale: np.ndarray
    n_joints: int
    n_passive: int
    length: float
    closed: float

    @property
    def least_rank(self) -> float:
        """Least singular value, relative to the largest, of an independent row: where loops stay
        open a little, dependent rows are so only as exactly as this."""
        return max(RELATIVE_RANK, self.closed / self.length)

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute rows and derivatives in metres, the latter by parameters in their units."""
        phi, J, J_p = (np.array(part) for part in self.function(x, self.nominal))
        weight = self.row_scale[:, None]
        return phi.ravel() * self.row_scale, weight * J / self.scale, weight * J_p

    def compute_rank(self, x: np.ndarray) -> int:
        """Compute the number of independent rows at a configuration."""
        return _rank(self.evaluate(x)[1], self.least_rank)

    def close(self, x: np.ndarray, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Change some coordinates (columns of (q, r, w, u)) as little as possible so that all rows
        are zero; return the configuration and what is left of the rows."""
        phi, J, _ = self.evaluate(x)
        if not np.isfinite(phi).all():  # two frames are half a turn apart
            return x, np.full(len(phi), np.inf)
        for _ in range(STEPS):
            if np.linalg.norm(phi) < CLOSED * self.length:
                break
            step = -np.linalg.lstsq(J[:, columns], phi, rcond=self.least_rank)[0]
            step *= min(1.0, LARGEST_STEP * self.length / max(np.abs(step).max(), 1e-300))
            for share in (1.0, 0.5, 0.25, 0.1):
                change = np.zeros(len(self.scale))
                change[columns] = share * step / self.scale[columns]
                there = Configuration.from_rows(x, self.n_passive).apply_change(change).rows
                found = self.evaluate(there)
                if np.linalg.norm(found[0]) < np.linalg.norm(phi):
                    break
            else:
                break
            x, (phi, J, _) = there, found
        return x, phi

    def close_near(
        self, guess: np.ndarray, columns: Sequence[int], limits: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Change some coordinates so that the loops close, from starts farther and farther from a
        guess; return the configuration with the least rest, and this rest.

        A configuration beyond the limits of the joints (nq, 2) counts only if there is no other.
        """
        rng = np.random.default_rng(0)
        start, beyond, open_ones = guess, None, list[tuple[float, np.ndarray, np.ndarray]]()
        for k in range(TRIES):
            x, left = self.close(start, columns)
            size = float(np.linalg.norm(left))
            if size < self.closed:
                if self._is_within(limits, x):
                    return x, left
                beyond = beyond or (x, left)
            open_ones.append((size, x, left))
            change = np.zeros(len(self.scale))
            change[columns] = rng.uniform(-1, 1, len(columns)) * self.length * (k + 1) / TRIES
            at = Configuration.from_rows(guess, self.n_passive)
            start = at.apply_change(2 * change / self.scale).rows
        return beyond or min(open_ones, key=lambda one: one[0])[1:]

    def _is_within(self, limits: np.ndarray, x: np.ndarray) -> bool:
        q = x[: self.n_joints]
        return bool(np.all((limits[:, 0] <= q) & (q <= limits[:, 1])))

    def climb(
        self, x: np.ndarray, moves: Sequence[int], limits: np.ndarray, spread: np.ndarray
    ) -> np.ndarray:
        """Return the most regular configuration that small motions of all joints reach from a
        closed one.

        The nearest readings at which loops close are at the edge of all possible readings, where
        rods are in line: two assembly modes meet there, and no solver can tell them apart.
        """
        while True:
            near = self.around(x, 12, spread)
            near = np.array([x, *(each for each in near[1:] if self._is_within(limits, each))])
            regular = Motion.of(self, near, moves).regularity
            best = int(np.argmax(regular))
            if regular[best] <= CLEARLY_BETTER * regular[0]:
                return x
            x = near[best]

    def walk(self, home: np.ndarray, limits: np.ndarray) -> list[np.ndarray]:
        """Return paths of closed configurations from home over the range of the joints, equal in
        each call; a path ends where the loops no longer close.

        `limits` (nq, 2) are those of the readings. A joint moves by half a turn, or by as many
        lengths, at most.
        """
        rng, n, paths = np.random.default_rng(0), self.n_joints, list[np.ndarray]()
        most = np.pi * self.length / self.scale[:n]
        low, high = (np.clip(end, home[:n] - most, home[:n] + most) for end in limits.T)
        for end in rng.uniform(low, high, (PATHS, n)):
            path = [home]
            for share in np.linspace(0, 1, PATH_STEPS + 1)[1:]:
                moved = path[-1].copy()
                moved[:n] = home[:n] + share * (end - home[:n])
                closed, left = self.close(moved, range(n, len(self.scale)))
                if np.linalg.norm(left) > self.closed:
                    break
                path.append(closed)
            paths.append(np.array(path))
        return paths

    def around(self, home: np.ndarray, count: int, spread: np.ndarray) -> np.ndarray:
        """Return closed configurations (at most `count`) near home, the same in each call;
        `spread` (nq,) limits how far each joint is moved, in its unit."""
        rng, found = np.random.default_rng(0), [home]
        every = list(range(len(self.scale)))
        for k in range(4 * count):
            if len(found) == count:
                break
            amplitude = AMPLITUDES[k % len(AMPLITUDES)]
            moved = home.copy()
            reach = np.minimum(amplitude * self.length / self.scale[: self.n_joints], spread)
            moved[: self.n_joints] += reach * rng.uniform(-1, 1, self.n_joints)
            closed, left = self.close(moved, every[self.n_joints :])
            if np.linalg.norm(left) > self.closed:
                closed, left = self.close(moved, every)
            if np.linalg.norm(left) <= self.closed:
                found.append(closed)
        return np.array(found)


@dataclass(frozen=True)
class Motion:
    """The derivatives at closed configurations: `by` (K, m, nq + 6 + nu) and `by_parameters`
    (K, m, n_parameters), in metres. Of the pose, the coordinates `moves` may change; the
    derivatives by the others are zero."""

    by: np.ndarray
    by_parameters: np.ndarray
    n_joints: int
    moves: Sequence[int]
    least_rank: float  # of singular values, relative to the largest

    @classmethod
    def of(cls, survey: Survey, x: np.ndarray, moves: Sequence[int]) -> Motion:
        """Evaluate the derivatives at configurations."""
        _, found, by_parameters = zip(*map(survey.evaluate, x), strict=True)
        by, n = np.array(found), survey.n_joints
        by[:, :, [n + i for i in range(6) if i not in moves]] = 0.0
        return cls(by, np.array(by_parameters), n, moves, survey.least_rank)

    @property
    def regularity(self) -> np.ndarray:
        """How far each configuration is from a singular one (K,), from 0 to 1: the smallest
        singular value of the derivatives by platform and passive coordinates as a share of the
        largest. Motions that are free at all configurations do not count."""
        sizes = np.linalg.svd(self.by[:, :, self.unknown], compute_uv=False)
        rank = int(np.max(np.sum(sizes > self.least_rank * sizes[:, :1], axis=1), initial=0))
        return sizes[:, rank - 1] / sizes[:, 0] if rank else np.ones(len(sizes))

    def find_idle(self) -> list[int]:
        """Return passive coordinates that can move while joints and platform rest, such as the turn
        of a rod about its own axis: as many as there are such freedoms."""
        first = self.n_joints + 6
        idle = list[int]()
        while True:
            rest = [c for c in range(first, self.by.shape[2]) if c not in idle]
            if not rest:
                return idle
            singular = [_null_space(J[:, rest], self.least_rank) for J in self.by]
            if any(Z.shape[1] == 0 for Z in singular):
                return idle
            idle.append(rest[int(np.argmax(np.linalg.norm(singular[0], axis=1)))])

    @cached_property
    def tangents(self) -> list[np.ndarray]:
        """Motions (nq + 6 + nu, freedoms) that keep all rows, at each configuration."""
        n, size = self.n_joints, self.by.shape[2]
        columns = [*range(n), *(n + i for i in self.moves), *range(n + 6, size)]
        found = []
        for J in self.by:
            motion = _null_space(J[:, columns], self.least_rank)
            found.append(np.zeros((size, motion.shape[1])))
            found[-1][columns] = motion
        return found

    @property
    def freedoms(self) -> int:
        """Number of independent motions: the smallest one, as a singular pose has more."""
        return min(tangent.shape[1] for tangent in self.tangents)

    def find_loose(self) -> np.ndarray:
        """Return motions (nq + 6 + nu, n) that remain if all driven joints are locked, at the
        configuration with the fewest."""
        locked = [T @ _null_space(T[: self.n_joints], self.least_rank) for T in self.tangents]
        return min(locked, key=lambda motion: motion.shape[1])

    def find_moves(self, loops: Sequence[int]) -> list[int]:
        """Return the coordinates x y z rx ry rz in which the platform moves, also if its nominal
        geometry prevents it: the rods of a Delta, or the parallelograms of a palletizer, keep their
        platform from turning only as far as their lengths are equal.

        `loops` are the rows of the loops; those of a platform in the tree are before them.
        """
        n = self.n_joints
        if len(loops) < self.by.shape[1]:
            others = [c for c in range(self.by.shape[2]) if not n <= c < n + 6]
            size = np.abs(self.by[:, :6, others]).max(axis=(0, 2))
            return [i for i in range(6) if size[i] > self.least_rank]
        pose = [T[n : n + 6] for T in self.tangents]
        size = np.max([np.abs(part).max(axis=1) for part in pose], axis=0)
        moves = [i for i in range(6) if size[i] > self.least_rank]

        def rank_with(coordinates: Sequence[int]) -> int:
            held = [n + i for i in range(6) if i not in coordinates]
            return max(_rank(np.delete(J, held, axis=1), self.least_rank) for J in self.by)

        for i in range(6):
            if i not in moves and rank_with([*moves, i]) > rank_with(moves):
                moves.append(i)
        return sorted(moves)

    @cached_property
    def platform(self) -> list[np.ndarray]:
        """Orthonormal bases (6, n) of the platform's motions, at each configuration."""
        found = []
        for T in self.tangents:
            basis, sizes, _ = np.linalg.svd(T[self.n_joints : self.n_joints + 6])
            found.append(basis[:, : int(np.sum(sizes > MIN_MOTION * sizes.max(initial=1e-300)))])
        return found

    def is_dead_point(self, controlled: Sequence[int]) -> bool:
        """Whether joints move at the first configuration while the controlled coordinates rest."""
        motion = self.tangents[0][[self.n_joints + i for i in controlled]]
        return bool(np.linalg.svd(motion, compute_uv=False).min(initial=1.0) < MIN_MOVED_SHARE)

    @property
    def independent(self) -> int:
        """Number of independent motions of the platform; a singular pose may have fewer or more."""
        return min(max(basis.shape[1] for basis in self.platform), self.freedoms)

    def find_rows(self) -> np.ndarray | None:
        """Return a matrix (n_kept, m) that makes the independent rows of all rows, in metres; None
        if no matrix makes them at all configurations, but least squares do (`normal_rows`).

        Directions in which no coordinate moves any row are omitted: in a plane mechanism, all that
        leaves the plane. A row of 0 and one 1 keeps a row as it is.
        """
        m, least = self.by.shape[1], self.least_rank
        every = np.hstack(list(self.by))
        local = max(_rank(J, least) for J in self.by)
        if local == m:
            return np.eye(m)
        if _rank(every, least) > local:  # the directions turn with the bodies
            if local == len(self.unknown):
                return None
            from scipy.linalg import qr

            pivots = qr(self.by[0].T, pivoting=True, mode="r")[1]
            return np.eye(m)[sorted(pivots[:local])]
        unused = _null_space(every.T, least)
        mixed = np.flatnonzero(np.abs(unused).max(axis=1) > least)
        alone = [i for i in range(m) if i not in mixed]
        keep = [np.eye(m)[alone]]
        zero = np.abs(every[mixed]).max(axis=1) < least * np.abs(every).max()
        turning = mixed[~zero]
        if len(turning):
            left, sizes, _ = np.linalg.svd(every[turning], full_matrices=False)
            basis = np.zeros((int(np.sum(sizes > least * sizes[0])), m))
            basis[:, turning] = left[:, : len(basis)].T
            keep.append(basis)
        return np.vstack(keep)

    @property
    def unknown(self) -> list[int]:
        """Columns of the moved coordinates of the pose and of the passive ones."""
        n = self.n_joints
        return [*(n + i for i in self.moves), *range(n + 6, self.by.shape[2])]

    @property
    def normal_rows(self) -> np.ndarray:
        """Matrices (K, n_unknown, m) of the normal equations of all rows, at each configuration."""
        return np.swapaxes(self.by[:, :, self.unknown], 1, 2)

    def find_replaced(
        self,
        rows: np.ndarray,
        tolerance: np.ndarray,
        preference: np.ndarray,
        passive: Sequence[int],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return two masks of parameters: those that others, or passive coordinates, replace in the
        kept rows; and those of them that other rows alone contain. `rows` is what makes the kept
        rows of all: a matrix, or one for each configuration.

        Of parameters that replace each other, the one whose tolerance moves the rows most is kept;
        `preference` multiplies this motion.
        """
        J = self._columns(rows, tolerance, passive)
        size = np.linalg.norm(J, axis=0)
        felt = size > self.least_rank * size.max(initial=0.0)
        kept, rest = np.zeros(len(size), dtype=bool), J.copy()
        while True:
            left = np.where(felt & ~kept, np.linalg.norm(rest, axis=0), 0.0)
            left[left <= max(MIN_INDEPENDENT_PART, self.least_rank) * size] = 0.0
            if not left.any():
                break
            k = int(np.argmax(left * preference))
            kept[k] = True
            direction = rest[:, k] / left[k]
            rest = rest - np.outer(direction, direction @ rest)
        whole = self._columns(np.eye(self.by.shape[1]), tolerance, passive)
        in_others = np.linalg.norm(whole, axis=0) > self.least_rank * np.abs(whole).max(
            initial=1e-300
        )
        return ~kept, ~felt & in_others

    def _columns(
        self, rows: np.ndarray, tolerance: np.ndarray, passive: Sequence[int]
    ) -> np.ndarray:
        """Return d rows / d parameters, one tolerance each, without what passive coordinates
        explain, of all configurations below each other."""
        parts = []
        every = np.broadcast_to(rows, (len(self.by), *rows.shape[-2:]))
        for kept, J, J_p in zip(every, self.by, self.by_parameters, strict=True):
            U, A = kept @ J[:, list(passive)], kept @ J_p * tolerance
            parts.append(A - U @ (np.linalg.pinv(U, rcond=self.least_rank) @ A))
        return np.concatenate(parts)


def find_controls(paths: Sequence[Motion], count: int) -> list[int]:
    """Return `count` coordinates of the pose that determine the platform over the range of the
    joints.

    `paths` are motions along paths from home. The share of some coordinates at a configuration is
    the least part that they have in a motion of the platform: 1 if it moves in these coordinates
    alone, 0 where one of them has a maximum. Beyond that, where their determinant has the other
    sign, two poses have the same coordinates: the share is 0. The least share on the path from home
    counts, and its mean over all configurations is compared.

    Of coordinates that determine the platform well, turns alone are the usual choice, as of an
    ankle or a wrist, then those with the most positions, in their order.
    """
    choices = list(combinations(paths[0].moves, count))
    rows, share = np.array(choices, dtype=int), np.zeros(len(choices))
    for motion in paths:
        before = least = np.zeros(0)
        for basis in motion.platform:
            if basis.shape[1] != count:  # a singular one, such as a stretched wrist
                continue
            volume = np.linalg.det(basis[rows])
            size = np.linalg.svd(basis[rows], compute_uv=False).min(axis=1, initial=1.0)
            if not before.size:
                first, least = np.sign(volume), size
            elif abs(same := volume @ before) < MIN_SAME_MODE:
                break
            else:
                volume *= np.sign(same)
                least = np.where(volume * first > 0, np.minimum(least, size), 0.0)
            before, share = volume, share + least
    able = [k for k in range(len(choices)) if share[k] >= MIN_SHARE_OF_BEST * share.max()]

    def count_positions(k: int) -> int:
        positions = sum(i < 3 for i in choices[k])
        return positions or 4  # turns alone come first

    most = max(map(count_positions, able))
    usual = [k for k in able if count_positions(k) == most]
    best = next(k for k in usual if CLEARLY_BETTER * share[k] >= share[usual].max())
    return list(choices[best])


def _rank(J: np.ndarray, least: float) -> int:
    sizes = np.linalg.svd(J, compute_uv=False)
    return int(np.sum(sizes > least * sizes[0])) if sizes.size and sizes[0] > 0 else 0


def _null_space(J: np.ndarray, least: float) -> np.ndarray:
    """Return an orthonormal basis (columns) of what a matrix maps to zero."""
    _, sizes, right = np.linalg.svd(J)
    rank = int(np.sum(sizes > least * sizes[0])) if sizes.size and sizes[0] > 0 else 0
    return right[rank:].T
