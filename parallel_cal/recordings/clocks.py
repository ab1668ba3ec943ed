"""Two clocks in one recording: how much later poses are stamped than joint states, from motion.

While the robot moves, a pose's step follows from the joints' steps at the same moment, by a
Jacobian that is nearly linear in the joints: dr = sum_i (b_i + sum_k B_ik q_k) dq_i. Which robot
it is need not be known: b and B are fitted anew for every delay, and the one that leaves least is
taken. A driver's few milliseconds are the effect `latency`; more than that are two clocks.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.recordings.recording import Array, JointStream, PoseStream, Recording

DRIVER = 50e-3  # s: what one clock's stamps may differ by, and the effect `latency` reaches
PAIRS = 800  # neighbouring poses that are looked at
FEWEST = 60  # of them: with fewer nothing is said
EXPLAINED = (
    0.5  # of the steps' squares: what the delay must take of what was left, and leave at most
)
GRAIN = 1e-9  # of a unit column: joints that move alike are no fault here
LONGEST = 1 << 18  # moments of the coarse search
FINE = 14  # halvings of the fine search


@dataclass(frozen=True)
class Offset:
    """Poses are stamped so much later (s) than joint states; `sigma` is its uncertainty."""

    delay: float
    sigma: float


def on_one_clock(recording: Recording) -> Recording:
    """The recording with poses on the joints' clock, and a note where they were on another."""
    found = clock_offset(recording.joints, recording.pose)
    if found is None:
        return recording
    pose = dataclasses.replace(recording.pose, time=recording.pose.time - found.delay)
    late = "later" if found.delay > 0 else "earlier"
    note = (
        f"{pose.topic} was stamped {abs(found.delay):.4f} s {late} than {recording.joints.topic} "
        f"(+- {found.sigma:.2g} s, found from motion): two clocks, brought to that of the joints"
    )
    return dataclasses.replace(recording, pose=pose, notes=(*recording.notes, note))


def clock_offset(joints: JointStream, pose: PoseStream) -> Offset | None:
    """What lies between two clocks; None where they are one, or motion does not tell."""
    steps = _Steps.of(joints, pose)
    if steps is None:
        return None
    at_once, early, late = (steps.unexplained(d) for d in (0.0, -1.2 * DRIVER, 1.2 * DRIVER))
    if at_once <= min(early, late, EXPLAINED):
        return None
    coarse = [0.0, *_alike(joints, pose, steps)]
    near = min(coarse, key=steps.unexplained)
    delay, width = near, max(steps.period, DRIVER)
    for _ in range(FINE):
        delay = min((delay - width, delay, delay + width), key=steps.unexplained)
        width /= 2
    least = steps.unexplained(delay)
    if abs(delay) <= DRIVER or least > EXPLAINED * min(at_once, 1.0):
        return None
    return Offset(delay, steps.sigma(delay))


@dataclass(frozen=True)
class _Steps:
    """Steps `y` (n, 3) of the pose from times `begin` to `end` (n,), and the joints' readings."""

    joints: JointStream
    begin: Array
    end: Array
    y: Array
    period: float

    @classmethod
    def of(cls, joints: JointStream, pose: PoseStream) -> _Steps | None:
        placed = pose.measured[:, :3].all(axis=1)
        turned = pose.measured[:, 3:].all(axis=1)
        if len(joints.time) < FEWEST or len(pose.time) < FEWEST or np.ptp(joints.position) == 0:
            return None
        gaps = np.diff(pose.time)
        period = float(np.median(gaps))
        known = np.asarray(placed if placed.any() else turned)
        near = known[1:] & known[:-1] & (gaps > 0) & (gaps < 1.5 * max(period, 1e-9))
        at = np.flatnonzero(near)
        if len(at) < FEWEST:
            return None
        at = at[np.unique(np.linspace(0, len(at) - 1, PAIRS).astype(int))]
        if placed.any():
            y = pose.position[at + 1] - pose.position[at]
        else:
            y = rotation_vector(pose.rotation[at + 1] @ pose.rotation[at].transpose(0, 2, 1))
        return cls(joints, pose.time[at], pose.time[at + 1], y, period)

    def _left(self, delay: float) -> tuple[float, float, int]:
        """Squares of the steps that no Jacobian explains, of all steps, and how many were used."""
        t = self.joints.time
        used = (self.begin - delay >= t[0]) & (self.end - delay <= t[-1])
        if used.sum() < max(FEWEST, 0.5 * len(used)):
            return np.inf, 1.0, 1
        before, after = (
            np.stack([np.interp(w[used] - delay, t, q) for q in self.joints.position.T], axis=1)
            for w in (self.begin, self.end)
        )
        dq, q = after - before, (after + before) / 2
        q = (q - q.mean(axis=0)) / np.maximum(q.std(axis=0), 1e-12)
        X = np.hstack([dq, (dq[:, :, None] * q[:, None, :]).reshape(len(dq), -1)])
        X = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        y = self.y[used]
        B = np.linalg.solve(X.T @ X + GRAIN * np.eye(X.shape[1]), X.T @ y)
        return float(np.sum((y - X @ B) ** 2)), float(np.sum(y**2)), int(used.sum())

    def unexplained(self, delay: float) -> float:
        """Share of the steps' squares that the joints' steps `delay` earlier do not explain."""
        left, total, _ = self._left(delay)
        return left / max(total, 1e-300)

    def sigma(self, delay: float) -> float:
        """Of the delay: where the squares' parabola is one variance above its least."""
        h = self.period / 4
        here, low, high = (self._left(delay + d) for d in (0.0, -h, h))
        bend = (low[0] + high[0] - 2 * here[0]) / h**2
        return float(np.sqrt(2 * here[0] / max(3 * here[2], 1) / max(bend, 1e-300)))


def _alike(joints: JointStream, pose: PoseStream, steps: _Steps) -> list[float]:
    """Delays at which the two streams' speeds look most alike, wherever either one begins."""
    dt = max(steps.period, joints.period, max(np.ptp(joints.time), np.ptp(pose.time)) / LONGEST)
    ours = _speed(joints.time, joints.position / np.maximum(joints.position.std(axis=0), 1e-12), dt)
    seen = pose.position if pose.measured[:, :3].all() else pose.quaternion
    theirs = _speed(pose.time, seen, dt)
    n = len(ours) + len(theirs)
    both = np.fft.irfft(np.fft.rfft(theirs, n) * np.conj(np.fft.rfft(ours, n)), n)
    best = [int(k) if k < len(theirs) else int(k) - n for k in np.argsort(-both)[:3]]
    return [k * dt + float(pose.time[0] - joints.time[0]) for k in best]


def _speed(time: Array, values: Array, dt: float) -> Array:
    """Speed on a regular raster from the first reading on, less its mean."""
    raster = np.arange(time[0], time[-1], dt)
    even = np.stack([np.interp(raster, time, column) for column in values.T], axis=1)
    speed = np.linalg.norm(np.diff(even, axis=0), axis=1)
    speed = np.minimum(speed, np.quantile(speed, 0.98))  # one jump must not drown the rest
    return np.asarray(speed - speed.mean())
