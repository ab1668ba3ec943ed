"""Find the frames of device and target for which two sets of poses are nearest to each other.

Measured and predicted poses differ by the frames: r + R t = F r' + f, R T = F R'. A linear start
and a descent over rotations find them (Kabsch's problem with an unknown target; AX = YB).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from parallel_cal.base.rotation import (
    nearest_rotation,
    rotation_matrix,
    rotation_vector,
    turns_from_mean,
)
from parallel_cal.identification.thresholds import (
    MIN_OUTLIER_RATIO,
    NEWTON_STEP,
    ROUNDING,
)
from parallel_cal.model.mechanism import POSE, list_shown_displacements

STEPS = 60
# Poses with the same measured coordinates from which the starts descend: more only cost time.
MAX_POSES_OF_SEARCH = 2000
Array = np.ndarray


@dataclass(frozen=True)
class Frames:
    """{B} -> {device} (f, F) and {P} -> {target} (t, T): positions (3,) m, rotations (3, 3)."""

    f: Array
    F: Array
    t: Array
    T: Array

    def see(self, r: Array, R: Array) -> tuple[Array, Array]:
        """The poses (N, 3), (N, 3, 3) of the target in the frame of the device, of {P} in {B}."""
        return (r + R @ self.t - self.f) @ self.F, self.F.T @ R @ self.T

    def to_base(self, r: Array) -> Array:
        """Positions (N, 3) in the frame of the device, in {B}."""
        return r @ self.F.T + self.f

    def describe_move(self, other: Frames) -> str:
        """`its device stands 812.3 mm and 12.30 deg, its target 0.1 mm`, seen by this device."""
        shift = 1e3 * np.linalg.norm(other.f - self.f)
        angle = np.degrees(np.linalg.norm(rotation_vector(self.F.T @ other.F)))
        target = 1e3 * np.linalg.norm(other.t - self.t)
        return f"its device stands {shift:.1f} mm and {angle:.2f} deg, its target {target:.1f} mm"

    def moved(self, step: Array) -> Frames:
        """After a small step (12,) of f, F (a left turn), t, T (a left turn)."""
        F, T = rotation_matrix(step[3:6]) @ self.F, rotation_matrix(step[9:]) @ self.T
        return Frames(self.f + step[:3], F, self.t + step[6:9], T)


IDENTITY_FRAMES = Frames(np.zeros(3), np.eye(3), np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class PosePairs:
    """Poses r (N, 3), R (N, 3, 3) of {P} in {B}, and these poses as `seen` from a device's frame.

    `measured` (N, 6) marks the coordinates x y z rx ry rz that were seen, in axes of the device.
    Angles are multiplied by `length`. `target_is_free` is whether the position of the target on
    the platform is to be found. `moves` are the coordinates in which the robot moves. `now` are
    the frames from which a search starts.
    """

    r: Array
    R: Array
    seen_r: Array
    seen_R: Array
    measured: Array
    length: float
    target_is_free: bool
    moves: tuple[str, ...] = POSE
    now: Frames = IDENTITY_FRAMES

    @property
    def placed(self) -> Array:
        """Mask (N,) of the samples of which a coordinate of the position was measured."""
        return np.asarray(self.measured[:, :3].any(axis=1))

    @property
    def turned(self) -> Array:
        """Mask (N,) of the samples of which a coordinate of the orientation was measured."""
        return np.asarray(self.measured[:, 3:].any(axis=1))

    @property
    def turns(self) -> bool:
        """Whether the platform can turn."""
        return any(c.startswith("r") for c in self.moves)

    @cached_property
    def _hidden(self) -> tuple[str, ...]:
        """Coordinates in {B} of the device's frame that no sample shows."""
        if self._fully_placed.sum() >= 3:
            return ()
        frame = POSE if set(POSE[:3]) & set(self.moves) else POSE[3:]
        return tuple(c for c in frame if c not in list_shown_displacements(self.moves))

    @property
    def _fully_placed(self) -> Array:
        return np.asarray(self.measured[:, :3].all(axis=1))

    @property
    def _fully_turned(self) -> Array:
        return np.asarray(self.measured[:, 3:].all(axis=1))

    @cached_property
    def frames(self) -> Frames:
        """The frames that minimise the distance of measured and predicted poses; the last step
        ignores poses that are far off."""
        best = self.find_frames()
        return self.descend(best, self.find_near(best))

    def find_frames(self, device: bool = True, target: bool = True) -> Frames:
        """The frames with the smallest median error; the `device` or the `target` may be known to
        be where it is `now`. Of many poses, a part selects the start; all of them are fitted."""
        f, F, t, T = vars(self.now).values()
        kept = ({} if device else {"f": f, "F": F}) | ({} if target else {"t": t, "T": T})
        free, few = np.repeat([device, target], 6), self._select_few()
        starts = (replace(start, **kept) for start in few._starts())
        ends = [few.descend(start, np.arange(len(few.r)), free) for start in starts]
        best = min(ends, key=few.compute_median_error)
        return best if few is self else self.descend(best, np.arange(len(self.r)), free)

    def _select_few(self) -> PosePairs:
        """Of each set of measured coordinates at most MAX_POSES_OF_SEARCH poses, evenly spread."""
        if len(self.r) <= MAX_POSES_OF_SEARCH:
            return self
        _, kinds = np.unique(self.measured, axis=0, return_inverse=True)
        parts = [np.flatnonzero(kinds.ravel() == k) for k in range(kinds.max() + 1)]
        steps = [np.linspace(0, len(k) - 1, min(len(k), MAX_POSES_OF_SEARCH)) for k in parts]
        chosen = np.concatenate([k[at.astype(int)] for k, at in zip(parts, steps, strict=True)])
        few = np.sort(chosen)
        return PosePairs(
            self.r[few],
            self.R[few],
            self.seen_r[few],
            self.seen_R[few],
            self.measured[few],
            self.length,
            self.target_is_free,
            self.moves,
            self.now,
        )

    def find_near(self, frames: Frames) -> Array:
        """Indices of the measured poses without those that are far off with these frames."""
        sizes = self._sizes(frames)
        near = sizes <= MIN_OUTLIER_RATIO * np.median(sizes[self._used])
        return np.flatnonzero(near & self._used)

    def count_free(self, frames: Frames, free: Array) -> int:
        """How many of the coordinates that are `free` the poses determine."""
        return int(np.linalg.matrix_rank((self._jacobian(frames) * free).reshape(-1, 12)))

    def compute_errors(self, frames: Frames) -> Array:
        """Errors of the measured coordinates (rows,): of positions (m), and of orientations times
        length."""
        return np.asarray(self._residual(frames)[self.measured])

    def compute_rms(self, frames: Frames) -> float:
        """Rms error of the positions (m), or of the orientations (rad) if no position was
        measured."""
        errors = self._residual(frames)
        kept = errors[self.placed, :3] if self.placed.any() else errors[self.turned, 3:]
        scale = 1.0 if self.placed.any() else self.length
        return float(np.sqrt(np.mean(np.sum(kept**2, axis=1)))) / scale

    @property
    def _target_turn_is_free(self) -> bool:
        """Whether the orientations tell how the target is turned: on a platform that never turns,
        only if the positions tell how the device's frame is turned."""
        return self.turns or int(self.placed.sum()) >= 3

    def find_target_turn(self, F: Array, used: Array) -> Array:
        """Rotation of the target on the platform that fits the orientations of the `used` poses."""
        R, seen = self.R[used], self.seen_R[used]
        return nearest_rotation((R.transpose(0, 2, 1) @ F @ seen).sum(axis=0))

    @property
    def _used(self) -> Array:
        return np.asarray(self.placed | self.turned)

    def compute_median_errors(self, frames: Frames) -> Array:
        """Median (2,) of position, and of length times orientation; 0 where not measured."""
        sizes = np.linalg.norm(self._residual(frames).reshape(-1, 2, 3), axis=2)
        masks = (self.placed, self.turned)
        return np.array([np.median(sizes[k, i]) if k.any() else 0.0 for i, k in enumerate(masks)])

    def find_unexplained_share(self) -> float:
        """Return the rms error of the registered positions, or of the orientations without any,
        divided by how far they scatter (rms); 0 if nothing moved."""
        if self.placed.any():
            seen = self.seen_r[self.placed]
            spread = float(np.sqrt(np.mean(np.sum((seen - seen.mean(axis=0)) ** 2, axis=1))))
        else:
            away = turns_from_mean(self.seen_R[self.turned])
            spread = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
        return self.compute_rms(self.frames) / spread if spread > 0 else 0.0

    def compute_closed_form_error(self) -> float:
        """Median distance of the poses (m) with the best of the frames from which `frames`
        descends."""
        return min(map(self.compute_median_error, self._starts()))

    def compute_median_error(self, frames: Frames) -> float:
        """Median distance of the poses (m), with orientations times length."""
        return float(np.median(self._sizes(frames)[self._used]))

    def _sizes(self, frames: Frames) -> Array:
        """Norms (N,) of `_residual`."""
        return np.asarray(np.linalg.norm(self._residual(frames), axis=1))

    def _residual(self, frames: Frames) -> Array:
        """(N, 6) in axes of the device: position (m), then orientation times length; zero where not
        measured."""
        r, R, seen_r, seen_R = self._filled
        away = np.zeros((len(r), 6))
        away[:, :3] = (seen_r @ frames.F.T + frames.f - r - R @ frames.t) @ frames.F
        if self._counted[:, 3:].any():
            turn = rotation_vector(frames.F @ seen_R @ (R @ frames.T).transpose(0, 2, 1))
            away[:, 3:] = self.length * turn @ frames.F
        return np.where(self._counted, away, 0.0)

    @cached_property
    def _filled(self) -> tuple[Array, ...]:
        """r, R and the seen ones, with zeros in the place of what is not known."""
        return tuple(map(np.nan_to_num, (self.r, self.R, self.seen_r, self.seen_R)))

    @cached_property
    def _counted(self) -> Array:
        """Mask (N, 6) of the measured coordinates of poses that are known."""
        r, R, seen_r, seen_R = (
            np.isfinite(one).reshape(len(one), -1).all(axis=1)
            for one in (self.r, self.R, self.seen_r, self.seen_R)
        )
        known = np.repeat(np.column_stack([r & R & seen_r, R & seen_R]), 3, axis=1)
        return np.asarray(self.measured & known)

    def descend(self, frames: Frames, used: Array, free: Array | None = None) -> Frames:
        """Gauss-Newton over the frames, or over those of their 12 coordinates that are `free`;
        directions that no pose determines stay unchanged."""
        for _ in range(STEPS):
            step = self._step(frames, used, np.ones(12) if free is None else free)
            frames = frames.moved(np.clip(step, -1, 1))
            if np.abs(step).max() < NEWTON_STEP:
                break
        return frames

    def _step(self, frames: Frames, used: Array, free: Array) -> Array:
        """The step (12,) of Gauss-Newton over the coordinates that are `free`."""
        J = (self._jacobian(frames)[used] * free).reshape(-1, 12)
        residual = self._residual(frames)[used].ravel()
        return np.asarray(-np.linalg.lstsq(J, residual, rcond=ROUNDING)[0])

    @cached_property
    def _free(self) -> Array:
        """Mask (12,) of the coordinates of f, F, t, T that the measured coordinates show."""
        axes = "xyz"
        frame = [c not in self._hidden for c in POSE]
        turns = [c for c in self.moves if c.startswith("r")]
        # A turn about an axis does not move the points on it.
        target = [self.target_is_free and any(c[1] != axis for c in turns) for axis in axes]
        seen = list_shown_displacements(turns)
        everything = not self.turns or self._fully_turned.any()
        turn = [self._target_turn_is_free and (everything or f"r{axis}" in seen) for axis in axes]
        return np.array([*frame, *target, *turn])

    def _jacobian(self, frames: Frames) -> Array:
        """d residual / d (f, F, t, T): (N, 6, 12)."""
        r, R = self._filled[:2]
        J, FR = np.zeros((len(r), 6, 12)), frames.F.T @ R
        J[:, :3, :3] = frames.F.T
        x, y, z = (r + R @ frames.t - frames.f).T
        # With v = r + R t - f, the columns of [v]x are those of w -> v x w.
        cross = np.zeros((len(r), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = z, -y, x
        J[:, :3, 3:6] = frames.F.T @ (cross - cross.transpose(0, 2, 1))
        J[:, :3, 6:9] = -FR
        J[:, 3:, 3:6] = self.length * frames.F.T
        J[:, 3:, 9:] = -self.length * FR
        return np.asarray(J * (self.measured[:, :, None] * self._free))

    def _starts(self) -> list[Frames]:
        """Starts of the descent: the frames of the model; frames from positions, with the target of
        the model and with an unknown one; frames from orientations."""
        starts = [self.now]
        if self.placed.sum() >= 3:
            starts.append(self._from_positions(self.now.t))
            if self.target_is_free and self._fully_placed.sum() >= 3:
                # Solve M r' + f = r + R t for the 15 numbers of M, f and t, with M any matrix.
                ours, theirs, R = (a[self._fully_placed] for a in (self.r, self.seen_r, self.R))
                A = np.zeros((len(ours), 3, 15))
                for i in range(3):
                    A[:, i, 3 * i : 3 * i + 3] = theirs
                A[:, :, 9:12], A[:, :, 12:] = np.eye(3), -R
                found = np.linalg.lstsq(A.reshape(-1, 15), ours.ravel(), rcond=ROUNDING)
                starts.append(self._from_positions(found[0][12:]))
        if self.turns and self._fully_turned.sum() >= 3:
            R, seen = self.R[self._fully_turned], self.seen_R[self._fully_turned]
            # The sum of tr(F R' T^T R^T) is vec(F)^T K vec(T): the singular vectors of the largest
            # singular value of K maximise it.
            K = np.einsum("nac,nbd->abcd", R, seen).reshape(9, 9)
            left = np.linalg.svd(K)[0]
            for sign in (1, -1):
                F = nearest_rotation(sign * left[:, 0].reshape(3, 3))
                starts.append(self._complete_frames(F))
        return starts

    def _from_positions(self, t: Array) -> Frames:
        """Frames with Kabsch's rotation for a target at t in {P}, from the measured coordinates."""
        ours = (self.r + self.R @ t)[self.placed]
        theirs = np.where(self.measured[:, :3], self.seen_r, np.nan)[self.placed]
        with warnings.catch_warnings(action="ignore"):  # of a coordinate that was never measured
            theirs = np.nan_to_num(theirs - np.nanmean(theirs, axis=0))
        H = (ours - ours.mean(axis=0)).T @ theirs
        # Points on a line leave a turn about it open: it stays as the model has it.
        U, sizes, V = np.linalg.svd(H)
        unknown = sizes <= ROUNDING * sizes[0]
        P, Q = U[:, unknown] @ U[:, unknown].T, V[unknown].T @ V[unknown]
        open_turn = ROUNDING * sizes[0] * (P @ self.now.F @ Q)
        return self._complete_frames(nearest_rotation(H + open_turn), t)

    def _complete_frames(self, F: Array, t: Array | None = None) -> Frames:
        """Complete the frames for a given F (and t): the positions are linear in f and t."""
        T = np.eye(3)
        if self.turned.any() and self._target_turn_is_free:
            T = self.find_target_turn(F, self.turned)
        start = Frames(self.now.f, F, self.now.t if t is None else t, T)
        free = np.repeat([True, False, t is None, False], 3)
        return start.moved(self._step(start, self.placed, free))
