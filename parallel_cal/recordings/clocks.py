"""Detect two clocks in one recording, from motion: how much later poses are stamped.

While the robot moves, a step of the pose follows from the steps of the joints at the same moment,
by a Jacobian that is nearly linear in the joints: dr = sum_i (b_i + sum_k B_ik q_k) dq_i. The
robot's model is not needed: b and B are fitted for every delay, and the delay with the smallest
residual is chosen. A driver's few milliseconds are the effect `latency`; more than that are two
clocks.

Pure noise has a best delay as well. So only joints that move more than their noise count, the pose
must move too, and the best delay must explain more than the same number of parameters would explain
of noise at the best of the compared delays.

The residual of a long move is mostly the curvature that the Jacobian lacks, which is no noise: its
values at neighbouring steps are alike. So the uncertainty is that of the delays which the parts of
the motion give (delete-a-group jackknife), and a delay that another one explains nearly as well, in
the parts' opinion, is no offset: the start of a first move alone fits many.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import BagError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.recordings.dwells import jitter, noise_span
from parallel_cal.recordings.gate import MAX_STAMP_JUMP_NS, MIN_AGREEING_MESSAGES
from parallel_cal.recordings.recording import Array, Bools, JointStream, PoseStream, Raw, Recording

MAX_DRIVER_DELAY_S = 50e-3  # s by which stamps of one clock may differ; `latency` covers them
MIN_ARRIVAL_JITTER_S = 5e-3  # no device measures so irregularly, but networks deliver so
MAX_STEPS = 800  # steps between neighbouring poses that are used
MIN_STEPS = 60  # with fewer steps, no delay is estimated
# Share of the steps' squares: the delay must leave less than this, and less than this share of what
# delay 0 leaves.
MAX_UNEXPLAINED_SHARE = 0.5
RIDGE_REGULARISATION = 1e-9  # per unit column, because joints may move alike
MAX_COARSE_SAMPLES = 1 << 18  # samples of the coarse search
N_HALVINGS, N_ROUGH_HALVINGS = 14, 4  # halvings of the fine search, and of that for rivals
MIN_TRAVEL = 1.5  # noise spans; a joint or coordinate that moves less stands still
NOISE_WINDOW, NOISE_READINGS = 0.5, 60  # s and readings from which noise is estimated, at least
# Two steps of white noise that share a reading have the correlation -1/2, in the joints as in the
# pose. So a regression of one on the other explains 1 + 2 / 4 times as much by chance.
SHARED_READINGS = 1.5
MAX_CHANCE = 1e-9  # probability that pure noise looks like this; a live collector tests often
N_PARTS = 10  # parts of the motion with equal information on the delay, which vote on it
N_RIVALS = 8  # delays at which the speeds are most alike that are compared
CONFIDENCE = 0.95  # of the interval of an offset
MIN_PARTS = 5  # with fewer parts, no delay is estimated
AGREEMENT = 0.8  # share of the parts that must rule out any other delay ...
CLEAR_RATIO = 100.0  # ... unless it leaves so many times more: few moves cannot agree on all parts


@dataclass(frozen=True)
class Offset:
    """How much later (s) poses are stamped than joint states.

    `sigma` (s) is its standard deviation. With 95 % confidence, the true delay differs by at most
    `margin` (s). `jitter` (s) is the standard deviation of the stamps from regular ones.
    """

    delay: float
    sigma: float
    margin: float
    jitter: float = 0.0


def align_clocks(recording: Recording) -> Recording:
    """Return the recording with poses on the joints' clock, with a note if the clocks differ."""
    found = clock_offset(recording.joints, recording.pose)
    if found is None:
        return recording
    pose = dataclasses.replace(recording.pose, time=recording.pose.time - found.delay)
    warning = describe_offset(found, pose.topic, recording.joints.topic)
    return dataclasses.replace(recording, pose=pose, notes=(*recording.notes, warning))


def describe_offset(found: Offset, poses: str, joints: str) -> KeyedWarning:
    """Return the note that the clock of the `poses` was moved to that of the `joints`."""
    late = "later" if found.delay > 0 else "earlier"
    irregular = ""
    if found.jitter > MIN_ARRIVAL_JITTER_S:
        irregular = (
            f". The intervals of its stamps are irregular (sigma of a stamp {found.jitter:.2g} s): "
            "they are probably times of arrival, not of measurement. Samples at rest are not "
            "affected. With mode=continuous, this sigma times the speed is an error of each pose"
        )
    note = (
        f"{poses} was stamped {abs(found.delay):.4f} s {late} than {joints} "
        f"(+- {found.margin:.2g} s with 95 % confidence, estimated from motion): the two clocks "
        f"differ. The poses were moved to the joints' clock{irregular}"
    )
    return KeyedWarning(note, "two clocks", poses)


def clock_offset(joints: JointStream, pose: PoseStream) -> Offset | None:
    """Return the offset between two clocks; None if they agree or motion does not determine it."""
    steps = _Steps.of(joints, pose)
    if steps is None:
        return None
    at_once, early, late = (
        steps.unexplained_share(d)
        for d in (0.0, -1.2 * MAX_DRIVER_DELAY_S, 1.2 * MAX_DRIVER_DELAY_S)
    )
    if at_once <= min(early, late, MAX_UNEXPLAINED_SHARE):
        return None
    alike, compared = _find_candidate_delays(steps.joints, pose, steps)
    minima = [steps.best_near(d, N_ROUGH_HALVINGS) for d in (0.0, *alike)]
    delay = steps.best_near(min(minima, key=steps.unlikeness))
    least = steps.unexplained_share(delay)
    if abs(delay) <= MAX_DRIVER_DELAY_S or least > MAX_UNEXPLAINED_SHARE * min(at_once, 1.0):
        return None
    # A periodic motion fits a period later as well. Then the driver is late, not a second clock.
    own = minima[0]
    if abs(own) <= MAX_DRIVER_DELAY_S and least > MAX_UNEXPLAINED_SHARE * steps.unexplained_share(
        own
    ):
        return None
    if compared * steps.chance(delay) > MAX_CHANCE:
        return None
    parts = _Parts.of(steps, delay)
    beside = [delay + k * MAX_DRIVER_DELAY_S for k in (-2, -1, 1, 2)]
    rivals = [d for d in minima if abs(d - delay) > MAX_DRIVER_DELAY_S]
    if parts is None or not all(map(parts.rule_out, [*beside, *rivals])):
        return None
    return Offset(delay, *parts.uncertainty(), measure_jitter(pose.time))


def require_overlap(
    pose: PoseStream,
    joints: JointStream,
    streams: Sequence[Raw],
    times: Sequence[NDArray[np.int64]],
    start: int,
    said: list[str],
) -> PoseStream:
    """Return poses that overlap the joint states; BagError if they were never recorded together.

    Poses on another clock are moved to the joints' by the order of reception; the motion tells the
    offset more accurately later. A clock that is ten seconds off also overlaps, after ten seconds:
    no message is delivered so late.
    """
    overlap = joints.time[0] <= pose.time[-1] and pose.time[0] <= joints.time[-1]
    delay = _delay_by_reception(streams, times, overlap)
    if overlap and delay is None:
        return pose
    if delay is None:
        spans = [
            f"{s.topic} from {s.time[0] + start * 1e-9:.3f} to {s.time[-1] + start * 1e-9:.3f} s"
            for s in (joints, pose)
        ]
        raise BagError(
            f"the streams never overlap: {spans[0]}, {spans[1]}. Their clocks differ, "
            "or one device was off. Record both together, or read by log time "
            "(stamps='log')."
        )
    words = (
        f"{pose.topic} was stamped {abs(delay):.1f} s {'later' if delay > 0 else 'earlier'} than "
        f"{joints.topic} (by the order of reception): the two clocks differ. The poses were moved "
        "to the joints' clock"
    )
    said.append(KeyedWarning(words, "two clocks by reception", pose.topic))
    return dataclasses.replace(pose, time=pose.time - delay)


def _delay_by_reception(
    streams: Sequence[Raw], times: Sequence[NDArray[np.int64]], overlap: bool
) -> float | None:
    """Return how much later (s) poses are stamped than the joint states received before and after
    them; None if too few poses were received between two joint states.

    If the streams overlap, also None unless most poses agree on a delay that is longer than the
    delivery of a message takes."""
    logs = [np.array(raw.log, np.int64) for raw in streams]
    order = np.argsort(logs[0], kind="stable")
    after = np.searchsorted(logs[0][order], logs[1])
    among = (after > 0) & (after < len(order))
    early, late = (times[0][order[after[among] - k]] for k in (1, 0))
    close = np.abs(late - early) <= MAX_STAMP_JUMP_NS
    if close.sum() < MIN_AGREEING_MESSAGES:
        return None
    delays = times[1][among][close] - early[close] - (late[close] - early[close]) // 2
    delay = float(np.median(delays))
    received, stamped = (max(float(np.ptp(ns)), 1.0) for ns in (logs[0], times[0]))
    waited = abs(delay) * received / stamped  # on the receiver's clock
    spread = float(np.median(np.abs(delays - delay)))
    if overlap and not (waited > MAX_STAMP_JUMP_NS > spread):
        return None
    return 1e-9 * delay


def measure_jitter(time: Array) -> float:
    """Measure the standard deviation (s) of stamps (n,) from regular ones, by their intervals; lost
    messages do not count."""
    from scipy.stats import median_abs_deviation

    return float(median_abs_deviation(np.diff(time), scale="normal") / np.sqrt(2))


@dataclass(frozen=True)
class _Steps:
    """Steps `y` (n, k) of the measured coordinates of the pose from times `begin` to `end` (n,),
    and the joints that move."""

    joints: JointStream
    begin: Array
    end: Array
    y: Array
    period: float

    @classmethod
    def of(cls, joints: JointStream, pose: PoseStream) -> _Steps | None:
        if len(joints.time) < MIN_STEPS or len(pose.time) < MIN_STEPS:
            return None
        moving = _moving(joints.time, joints.position)
        if not moving.any():
            return None
        gaps = np.diff(pose.time)
        period = float(np.median(gaps))
        shown = pose.measured[:, :3].any(axis=0)  # a planar robot has no third coordinate
        placed = bool(shown.any())
        told = np.flatnonzero(shown) if placed else np.arange(3, 6)
        known = np.asarray(pose.measured[:, told].all(axis=1))
        seen = pose.position[:, shown] if placed else pose.rotation.reshape(-1, 9)
        if not _moving(pose.time[known], seen[known]).any():
            return None
        near = known[1:] & known[:-1] & (gaps > 0) & (gaps < 1.5 * max(period, 1e-9))
        at = np.flatnonzero(near)
        if len(at) < MIN_STEPS:
            return None
        at = at[np.unique(np.linspace(0, len(at) - 1, MAX_STEPS).astype(int))]
        if placed:
            y = seen[at + 1] - seen[at]
        else:
            y = rotation_vector(pose.rotation[at + 1] @ pose.rotation[at].transpose(0, 2, 1))
        joints = dataclasses.replace(joints, position=joints.position[:, moving])
        return cls(joints, pose.time[at], pose.time[at + 1], y, period)

    def is_covered(self, delay: float) -> Bools:
        """Mark the steps (n,) at which joint states `delay` earlier were recorded."""
        t = self.joints.time
        return np.asarray((self.begin - delay >= t[0]) & (self.end - delay <= t[-1]))

    def is_enough(self, used: Bools) -> bool:
        return bool(used.sum() >= max(MIN_STEPS, 0.5 * len(used)))

    def make_columns(self, delay: float, used: Bools, products: bool = True) -> Array:
        """Return the joints' steps `delay` earlier, and their products with the joints (n, m)."""
        t, readings = self.joints.time, self.joints.position
        before, after = (
            np.stack([np.interp(w[used] - delay, t, q) for q in readings.T], axis=1)
            for w in (self.begin, self.end)
        )
        dq, q = after - before, (after + before) / 2
        if not products:
            return dq
        q = (q - readings.mean(axis=0)) / np.maximum(readings.std(axis=0), 1e-12)
        return np.hstack([dq, (dq[:, :, None] * q[:, None, :]).reshape(len(dq), -1)])

    def squares_left(self, delay: float, used: Bools, products: bool = True) -> Array:
        """Return the squares (n,) that the joints' steps do not explain: all of the steps that are
        not `used`, because both streams were recorded at the same time."""
        left = np.sum(self.y**2, axis=1)
        X, y = self.make_columns(delay, used, products), self.y[used]
        left[used] = np.sum((y - X @ _regress(X, y)) ** 2, axis=1)
        return left

    def explain(self, delay: float, products: bool = True) -> _Explained:
        """Fit the steps by the joints' steps `delay` earlier."""
        used = self.is_covered(delay)
        if not self.is_enough(used):
            return TOO_FEW
        y, terms = self.y[used], self.joints.position.shape[1]
        squares = y.T @ y
        # If one coordinate is much noisier than the others, it is the only one that counts.
        independent = np.trace(squares) ** 2 / max(np.sum(squares**2), 1e-300)
        left = float(np.sum(self.squares_left(delay, used, products)[used]))
        total = float(np.sum(y**2))
        terms += products * terms**2
        return _Explained(left, total, int(used.sum()), terms, float(independent))

    def unexplained_share(self, delay: float) -> float:
        """Return the share of squares that the joint steps `delay` earlier do not explain."""
        return self.explain(delay).unexplained

    def unlikeness(self, delay: float) -> float:
        """Return a measure by which to choose among separate delays.

        A dozen equal moves have too few shapes for the products: they explain any of the moves by
        any other. The joints' steps alone do not.
        """
        used = self.is_covered(delay)
        if not self.is_enough(used):
            return np.inf
        both = (np.sum(self.squares_left(delay, used, products)) for products in (True, False))
        return float(np.prod(list(both)))

    def best_near(self, delay: float, halvings: int = N_HALVINGS) -> float:
        """Return the delay near this one that explains most of the steps."""
        width, share = max(self.period, MAX_DRIVER_DELAY_S), self.unexplained_share(delay)
        for _ in range(halvings):
            for other in (delay - width, delay + width):
                if (left := self.unexplained_share(other)) < share:
                    delay, share = other, left
                    break
            width /= 2
        return delay

    def chance(self, delay: float) -> float:
        """Return the probability that noise is explained as well as the steps at this delay."""
        return self.explain(delay).chance


@dataclass(frozen=True)
class _Parts:
    """The parts of the motion that vote on a delay.

    `columns` (n, m) explain the steps `y` (n, k) of `used` steps at the delay. `slope` (n, k) is
    the derivative of what they explain by the delay, and `part` (n,) the part of each step.
    """

    steps: _Steps
    delay: float
    used: Bools
    columns: Array
    y: Array
    slope: Array
    part: NDArray[np.int64]

    @classmethod
    def of(cls, steps: _Steps, delay: float) -> _Parts | None:
        h = max(steps.period, steps.joints.period) / 2
        used = steps.is_covered(delay - h) & steps.is_covered(delay + h)
        X, y = steps.make_columns(delay, used), steps.y[used]
        later, earlier = (steps.make_columns(d, used) for d in (delay + h, delay - h))
        slope = (later - earlier) @ _regress(X, y) / (2 * h)
        told = np.cumsum(np.sum((slope - X @ _regress(X, slope)) ** 2, axis=1))
        share = np.minimum(N_PARTS * told / max(told[-1], 1e-300), N_PARTS - 1).astype(np.int64)
        kept, part = np.unique(share, return_inverse=True)
        return cls(steps, delay, used, X, y, slope, part) if len(kept) >= MIN_PARTS else None

    def uncertainty(self) -> tuple[float, float]:
        """Return the standard deviation of the delay and its margin, s."""
        from scipy.special import stdtrit

        shifts, n = list[float](), int(self.part.max()) + 1
        for k in range(n):
            X, y, slope = (rows[self.part != k] for rows in (self.columns, self.y, self.slope))
            y, slope = (rows - X @ _regress(X, rows) for rows in (y, slope))
            shifts.append(float(np.sum(y * slope) / np.sum(slope**2)))
        sigma = float(np.sqrt((n - 1) * np.var(shifts)))
        return sigma, float(stdtrit(n - 1, (1 + CONFIDENCE) / 2)) * sigma

    def rule_out(self, rival: float) -> bool:
        """Whether the parts agree that the delay explains the steps better than a rival does."""
        covered = self.steps.is_covered(rival)
        if not self.steps.is_enough(covered):
            return True

        def agree(products: bool) -> bool:
            theirs = self.steps.squares_left(rival, covered, products)[self.used]
            ours = self.steps.squares_left(self.delay, self.used, products)[self.used]
            votes = np.bincount(self.part, theirs - ours) > 0
            agreed = np.sum(votes) >= AGREEMENT * len(votes)
            return bool(agreed or theirs.sum() > CLEAR_RATIO * ours.sum())

        return agree(products=True) or agree(products=False)


def _regress(X: Array, y: Array) -> Array:
    """Return the coefficients (m, k) by which columns (n, m) explain y (n, k)."""
    size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    X = X / size
    return (
        np.linalg.solve(X.T @ X + RIDGE_REGULARISATION * np.eye(len(size)), X.T @ y) / size[:, None]
    )


@dataclass(frozen=True)
class _Explained:
    """Result of a fit: the squares `left` of `total`, with `terms` fitted numbers per coordinate.

    `coordinates` (1 to 3) is the number of independent coordinates of equal size to which the steps
    are equivalent.
    """

    left: float
    total: float
    steps: int
    terms: int
    coordinates: float

    @property
    def spare(self) -> int:
        """Degrees of freedom of each coordinate: steps minus terms."""
        return self.steps - self.terms

    @property
    def unexplained(self) -> float:
        """Share of the mean square that is left, corrected for the number of terms."""
        if self.spare <= 0:
            return np.inf
        return self.left / self.spare / max(self.total / self.steps, 1e-300)

    @property
    def chance(self) -> float:
        """Probability (F-test) that as many terms leave as little of white noise."""
        from scipy.special import betainc

        if self.spare <= 0:
            return 1.0
        taken = max(self.total - self.left, 0.0) / self.terms
        ratio = taken / max(self.left / self.spare, 1e-300) / SHARED_READINGS
        fitted, rest = self.coordinates * self.terms, self.coordinates * self.spare
        return float(betainc(rest / 2, fitted / 2, rest / (rest + fitted * ratio)))


TOO_FEW = _Explained(np.inf, 1.0, 0, 0, 1.0)


def _moving(time: Array, values: Array) -> Bools:
    """Mark the columns (n,) that move further than noise and the device's steps would."""
    if len(time) < MIN_STEPS:
        return np.zeros(values.shape[1], dtype=bool)
    window = max(NOISE_WINDOW, NOISE_READINGS * float(np.median(np.diff(time))))
    noise = noise_span(jitter(time, values, window), values)
    return np.asarray(np.ptp(values, axis=0) > MIN_TRAVEL * noise)


def _find_candidate_delays(
    joints: JointStream, pose: PoseStream, steps: _Steps
) -> tuple[list[float], int]:
    """Return separate delays with the most similar speeds, and how many delays were tried."""
    dt = max(
        steps.period,
        joints.period,
        max(np.ptp(joints.time), np.ptp(pose.time)) / MAX_COARSE_SAMPLES,
    )
    ours = _speed(joints.time, joints.position / np.maximum(joints.position.std(axis=0), 1e-12), dt)
    shown = pose.measured[:, :3].all(axis=0)
    seen = pose.position[:, shown] if shown.any() else pose.quaternion
    theirs = _speed(pose.time, seen, dt)
    n = len(ours) + len(theirs)
    both = np.fft.irfft(np.fft.rfft(theirs, n) * np.conj(np.fft.rfft(ours, n)), n)
    found, reach = list[float](), max(1, round(MAX_DRIVER_DELAY_S / dt))
    peaks = np.where((both >= np.roll(both, 1)) & (both >= np.roll(both, -1)), both, -np.inf)
    for _ in range(N_RIVALS):
        k = int(np.argmax(peaks))
        peaks[np.arange(k - reach, k + reach + 1) % n] = -np.inf
        k = k if k < len(theirs) else k - n
        found.append(k * dt + float(pose.time[0] - joints.time[0]))
    return found, n


def _speed(time: Array, values: Array, dt: float) -> Array:
    """Return the speed on a regular raster from the first reading on, minus its mean."""
    raster = np.arange(time[0], time[-1], dt)
    even = np.stack([np.interp(raster, time, column) for column in values.T], axis=1)
    speed = np.linalg.norm(np.diff(even, axis=0), axis=1)
    speed = np.minimum(speed, np.quantile(speed, 0.98))  # one jump must not drown the rest
    return np.asarray(speed - speed.mean())
