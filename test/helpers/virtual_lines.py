"""Cable robots whose lines are more than straight distances: they run over pulleys, stretch, sag
and creep.

Nothing of it comes from the package. The tangent to a pulley is found by bisection, tensions by
singular vectors, a sagging line by adding up its pieces, creep by small steps in time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import Array, solve

UP = np.array([0.0, 0.0, 1.0])
PIECES, WEIGHTS = np.polynomial.legendre.leggauss(24)  # of a sagging line, on -1..1


@dataclass(frozen=True)
class Pulleys:
    """Pulleys of a radius (m), to which the lines come along the axes (n, 3)."""

    radius: float
    axes: ArrayLike


@dataclass(frozen=True)
class Tension:
    """Lines of the stiffness EA and the weight per metre (N, N/m), a platform of the weight (N) and
    a pretension (N) to which a controller keeps all lines as near as it can."""

    EA: float = np.inf
    weight_per_metre: float = 0.0
    platform: float = 0.0
    pretension: float = 0.0


@dataclass(frozen=True)
class Creep:
    """Two Voigt elements: the strains to which they creep, and their time constants (s)."""

    strains: tuple[float, float]
    times: tuple[float, float]


class LinedRobot:
    """A point that n lines hold; `way` is the line (m) that a reading of 1 lets out.

    Readings are zero where the point is at the origin, without creep.
    """

    def __init__(
        self,
        anchors: ArrayLike,
        way: ArrayLike,
        pulleys: Pulleys | None = None,
        tension: Tension | None = None,
        creep: Creep | None = None,
    ) -> None:
        self.anchors, self.way = np.asarray(anchors, float), np.asarray(way, float)
        self.pulleys, self.tension, self.creep = pulleys, tension, creep

    def readings(self, r: ArrayLike, time: ArrayLike = 0.0) -> Array:
        """Readings (N, n) that let out what reaches the points r (N, 3) at a time (N,) s."""
        r = np.atleast_2d(np.asarray(r, float))
        crept = np.zeros(len(r)) if self.creep is None else creep_strain(self.creep, time, len(r))
        home = self.unstrained(np.zeros((1, 3)))
        return np.asarray((self.unstrained(r) / (1 + crept[:, None]) - home) / self.way)

    def unstrained(self, r: Array) -> Array:
        """Length (N, n) of the line as its spool let it out, before it crept."""
        if self.pulleys is not None:
            axes = np.broadcast_to(np.asarray(self.pulleys.axes, float), self.anchors.shape)
            lines = zip(self.anchors, axes, strict=True)
            return np.stack([taut_length(r, a, u, self.pulleys.radius) for a, u in lines], axis=1)
        chords = self.anchors - r[:, None]
        lengths = np.linalg.norm(chords, axis=-1)
        if self.tension is None:
            return np.asarray(lengths)
        pull = np.array([find_tensions(chord, self.tension) for chord in chords])
        if not self.tension.weight_per_metre:
            return np.asarray(lengths / (1 + pull / self.tension.EA))
        return hanging_length(chords, pull, self.tension)


def routed_length(r: ArrayLike, stops: list[list[ArrayLike | None]]) -> Array:
    """Length (N, n) of lines that go from stop to stop; None is a pulley on the platform, at r."""
    r = np.atleast_2d(np.asarray(r, float))
    lengths = []
    for line in stops:
        points = [
            r if stop is None else np.broadcast_to(np.asarray(stop), r.shape) for stop in line
        ]
        pieces = np.diff(points, axis=0)
        lengths.append(np.linalg.norm(pieces, axis=2).sum(axis=0))
    return np.stack(lengths, axis=1)


def taut_length(r: Array, anchor: Array, axis: Array, radius: float) -> Array:
    """Line (N,) m from the anchor over the pulley to the points: where it leaves, it is tangent."""
    axis = axis / np.linalg.norm(axis)
    side = (r - anchor) - ((r - anchor) @ axis)[:, None] * axis
    side /= np.linalg.norm(side, axis=1)[:, None]
    hub = anchor + radius * side

    def spoke(angle: Array) -> Array:
        return np.sin(angle)[:, None] * axis - np.cos(angle)[:, None] * side

    low, high = np.zeros(len(r)), np.full(len(r), np.pi)
    for _ in range(60):
        middle = (low + high) / 2
        arm = spoke(middle)
        outside = np.sum((r - hub - radius * arm) * arm, axis=1) > 0  # not yet past the tangent
        low, high = np.where(outside, low, middle), np.where(outside, middle, high)
    leaves = hub + radius * spoke(low)
    return np.asarray(np.linalg.norm(r - leaves, axis=1) + radius * low)


def find_tensions(chord: Array, given: Tension) -> Array:
    """Tensions (n,) N that carry the platform, as near to the pretension as lines can be."""
    pull = (chord / np.linalg.norm(chord, axis=1)[:, None]).T
    moving = np.abs(chord).max(axis=0) > 0  # a planar robot's lines do not leave its plane
    carried = (given.platform * UP)[moving]
    u, size, vt = np.linalg.svd(pull[moving])
    found = vt[: len(size)].T @ ((u.T @ carried) / size)
    free = vt[len(size) :]
    return np.asarray(found + free.T @ (free @ (given.pretension - found)))


def hanging_length(chords: Array, pull: Array, given: Tension) -> Array:
    """Unstretched length (N, n) of lines whose tension has the horizontal part of `pull`."""
    span = np.linalg.norm(chords[..., :2], axis=-1)
    rise = chords[..., 2]
    chord = np.linalg.norm(chords, axis=-1)
    across = pull * span / chord

    def gaps(u: Array) -> Array:
        reached = add_up(across, u[..., 1] * pull, u[..., 0] * chord, given)
        return (reached - np.stack([span, rise], -1)) / chord[..., None]

    start = np.stack([np.ones_like(chord), rise / chord], -1)
    return np.asarray(solve(gaps, start)[..., 0] * chord)


def add_up(across: Array, middle: Array, length: Array, given: Tension) -> Array:
    """Where a line ends (..., 2): horizontally and in height, with the tension `across` and, in its
    middle, the vertical part `middle`."""
    steep = middle[..., None] + PIECES / 2 * (given.weight_per_metre * length)[..., None]
    flat = np.broadcast_to(across[..., None], steep.shape)
    strained = 1 / np.hypot(flat, steep) + 1 / given.EA  # unit vector and stretch, per tension
    half = (WEIGHTS * strained / 2) * length[..., None]
    return np.stack([np.sum(half * flat, -1), np.sum(half * steep, -1)], -1)


def balanced_length(anchors: ArrayLike, r: ArrayLike, given: Tension) -> Array:
    """Unstretched lengths (2,) of two lines in the plane x, z whose ends balance the platform's
    weight: without the assumption that they pull along their chords."""
    chord = np.asarray(anchors, float) - np.asarray(r, float)
    size = np.linalg.norm(chord, axis=1)
    side = np.sign(chord[:, 0])
    pull = find_tensions(chord, given)

    def gaps(u: Array) -> Array:
        across, middle, length = (part * given.platform for part in (u[:2], u[2:4])), 0, u[4:]
        across, middle = across
        ends = add_up(across, middle, length, given)
        missed = (ends - np.stack([np.abs(chord[:, 0]), chord[:, 2]], -1)).ravel()
        low = middle - given.weight_per_metre * length / 2
        force = np.array([np.sum(side * across), np.sum(low) - given.platform]) / given.platform
        return np.concatenate([missed, force])

    start = np.concatenate([pull * np.abs(chord[:, 0]) / size, pull * chord[:, 2] / size])
    return solve(gaps, np.concatenate([start / given.platform, size]))[4:]


def creep_strain(creep: Creep, time: ArrayLike, n: int, steps: int = 4000) -> Array:
    """Strain (n,) at each time: two dashpots beside springs, stepped through time."""
    time = np.broadcast_to(np.asarray(time, float), n)
    step = time / steps
    strain = np.zeros((2, n))
    goal, tau = np.reshape(creep.strains, (2, 1)), np.reshape(creep.times, (2, 1))
    for _ in range(steps):
        slope = (goal - strain) / tau
        half = (goal - strain - step / 2 * slope) / tau
        later = (goal - strain - step / 2 * half) / tau
        last = (goal - strain - step * later) / tau
        strain = strain + step / 6 * (slope + 2 * half + 2 * later + last)
    return np.asarray(strain.sum(axis=0))
