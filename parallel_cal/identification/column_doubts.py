"""Recognise joint readings in the wrong columns, of the wrong sign or from a zero far away, and
positions or orientations of another unit or convention.

Such samples show no pose that the robot can reach, and a fit then moves the geometry far from the
drawing. What was meant is found by trial: each guess is judged by the error of the poses after a
registration of the device, with the geometry as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np

from parallel_cal.identification.observations import Observations
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.identification.thresholds import (
    MAX_GUESS_SAMPLES,
    MAX_GUESSES_REFINED,
    MAX_JOINTS_IN_ANY_ORDER,
    MAX_JOINTS_OF_ANY_SIGN,
    MIN_GUESS_ERROR_RATIO,
    MIN_REACHED_SHARE,
    MIN_SCALE_SAMPLES,
    MIN_UNREGISTERED_ERROR_RATIO,
    SAME_GUESS_ERROR_RATIO,
)
from parallel_cal.model.model import Model

QUARTER_TURNS = (0.5 * np.pi, -0.5 * np.pi, np.pi)
# Conventions of three angles, about fixed axes (small letters) or about rotated ones, and which
# mistake takes the first for the second. Another pair is one of these: xyz of three angles is ZYX
# of the reversed ones.
OTHER_KIND = "about rotated instead of fixed axes, or the reverse (column map: capitals in axes)"
REVERSED = "in the reverse order (column map: columns)"
AXES = {
    ("xyz", "XYZ"): OTHER_KIND,
    ("XYZ", "xyz"): OTHER_KIND,
    ("xyz", "ZYX"): REVERSED,
    ("XYZ", "zyx"): REVERSED,
    ("xyz", "zyx"): f"{REVERSED}, and {OTHER_KIND}",
    ("XYZ", "ZYX"): f"{REVERSED}, and {OTHER_KIND}",
}
LENGTHS = (1e3, 1e-3, 10.0, 0.1, 25.4, 1 / 25.4)  # mm stated as m, cm or inches, and the reverse


@dataclass(frozen=True)
class Guess:
    """What samples mean: the reading of each joint is `sign` times that in the column of joint
    `column`, plus `zero` (rad). The angles of the orientation are about the second ones of `axes`
    in place of the first, or the rotation is `inverse`. Positions are multiplied by `length`."""

    column: tuple[int, ...]
    sign: tuple[int, ...]
    zero: tuple[float, ...]
    axes: tuple[str, str] | None = None
    inverse: bool = False
    length: float = 1.0

    @classmethod
    def as_given(cls, joints: int) -> Guess:
        return cls(tuple(range(joints)), (1,) * joints, (0.0,) * joints)

    def apply(self, x: np.ndarray) -> np.ndarray:
        """Return the configurations (N, nq + 12) that were meant."""
        from scipy.spatial.transform import Rotation

        x, n = x.copy(), len(self.column)
        x[:, :n] = x[:, self.column] * np.array(self.sign) + np.array(self.zero)
        x[:, n : n + 3] *= self.length
        R = x[:, n + 3 :].reshape(-1, 3, 3)
        if self.inverse:
            R = R.transpose(0, 2, 1)
        if self.axes:
            given, meant = self.axes
            angles = Rotation.from_matrix(R).as_euler(given)
            R = Rotation.from_euler(meant, angles).as_matrix()
        x[:, n + 3 :] = R.reshape(-1, 9)
        return x

    def describe(self, names: Sequence[str]) -> str:
        """Describe what was meant, with the entries of a column map."""
        parts = []
        if self.length != 1:
            parts.append(f"the positions are multiplied by {self.length:.4g} (column map: unit)")
        if self.inverse:
            parts.append("the rotations are those of the device seen by the target (invert them)")
        if self.axes:
            parts.append(f"the angles are {AXES[self.axes]}")
        if moved := [i for i, k in enumerate(self.column) if i != k]:
            pairs = [f"{names[i]} is in the column of {names[self.column[i]]}" for i in moved]
            parts.append(" and ".join(pairs))
        if turned := [names[i] for i, sign in enumerate(self.sign) if sign < 0]:
            verb = "has" if len(turned) == 1 else "have"
            entry = f"{turned[0]}: {{column: ..., factor: -1}}"
            parts.append(f"{', '.join(turned)} {verb} the other sign (column map: {entry})")
        for name, zero in zip(names, self.zero, strict=True):
            if zero:
                angle = f"{np.degrees(zero):g} deg"
                entry = f"{name}: {{column: ..., offset: {angle}}}"
                parts.append(f"{angle} are added to {name} (column map: {entry})")
        return " and ".join(parts)


def doubt_columns(
    model: Model,
    observations: Observations,
    there: DevicePoses | None,
    source: str,
    suspected: bool = False,
) -> str:
    """Explain with which other readings or orientations the samples fit the robot, if they do not
    as they are; empty if none do.

    `there` are the poses of the observations. If the samples are not `suspected`, because a fit to
    them failed, their errors must exceed what the tolerances explain.
    """
    n = len(model.joints)
    if there is None:  # the robot cannot be there
        shown = observations.measured[:, n:].any(axis=1)
        far_off = bool(np.sum(shown) >= MIN_SCALE_SAMPLES)
    else:
        sizes = there.compute_median_errors(there.frames)
        far_off = bool((sizes > MIN_UNREGISTERED_ERROR_RATIO * there.expected).any())
    if not (far_off or suspected):
        return ""
    some = np.unique(np.linspace(0, len(observations) - 1, MAX_GUESS_SAMPLES).astype(int))
    few = observations.select(some)
    placed, turned = (
        bool(few.measured[:, part].all(axis=1).any())
        for part in (slice(n, n + 3), slice(n + 3, None))
    )
    guesses = [
        (guess, poses)
        for guess in _list_guesses(model, placed, turned)
        if (poses := _read(model, few, guess))
    ]
    guesses.sort(key=lambda one: one[1].compute_median_error(one[1].closed_form_frames()))
    best = guesses[:MAX_GUESSES_REFINED]
    errors = [poses.compute_median_error(poses.frames) for _, poses in best]
    given = _read(model, few, Guess.as_given(n))
    before = np.inf if given is None else given.compute_median_error(given.frames)
    fitting = [
        one
        for one, error in zip(best, errors, strict=True)
        if error * MIN_GUESS_ERROR_RATIO < before and error < SAME_GUESS_ERROR_RATIO * min(errors)
    ]
    if not fitting:
        return ""
    low, high = np.array(model.mechanism.joint_limits, float).T

    def preference(one: tuple[Guess, DevicePoses]) -> tuple[float, float]:
        """Of guesses that the poses do not decide between, prefer readings inside the limits, and a
        device that need not be turned."""
        guess, poses = one
        q = guess.apply(few.x)[:, :n]
        outside = float(np.mean((q < low) | (q > high)))
        return outside, poses.compute_median_error(poses.now)

    guess, poses = min(fitting, key=preference)
    smaller = ""
    if np.isfinite(before):
        ratio = before / poses.compute_median_error(poses.frames)
        smaller = f": the errors are then {ratio:.0f} times smaller"
    return (
        f"{source or 'samples'}: the joint readings do not fit the measured poses, wherever the "
        f"device stands. They fit if {guess.describe(model.joints)}{smaller}. Correct this where "
        "the samples are recorded or imported"
    )


def _list_guesses(model: Model, placed: bool, turned: bool) -> Iterator[Guess]:
    """Yield what may be wrong; positions are measured if `placed`, orientations if `turned`."""
    joints = len(model.joints)
    given = Guess.as_given(joints)
    if joints <= MAX_JOINTS_OF_ANY_SIGN:
        signs = list(product((1, -1), repeat=joints))[1:]
    else:
        one = 1 - 2 * np.eye(joints, dtype=int)
        signs = [tuple(row) for row in (*one.tolist(), [-1] * joints)]
    yield from (replace(given, sign=sign) for sign in signs)
    yield from (replace(given, column=order) for order in _list_orders(joints))
    for i, unit in enumerate(model.mechanism.joint_units):
        for turn in QUARTER_TURNS if unit == "rad" else ():
            yield replace(given, zero=tuple(turn if k == i else 0.0 for k in range(joints)))
    yield from (replace(given, length=factor) for factor in LENGTHS if placed)
    if turned and max(model.mechanism.moved) >= 3:
        yield replace(given, inverse=True)
        yield from (replace(given, axes=pair) for pair in AXES)


def _list_orders(joints: int) -> list[tuple[int, ...]]:
    """List every order of a few joints; of many, two exchanged ones, and counts that begin at
    another joint or go the other way round."""
    if joints <= MAX_JOINTS_IN_ANY_ORDER:
        return list(permutations(range(joints)))[1:]
    as_given = list(range(joints))
    found = [tuple(np.roll(as_given, k).tolist()) for k in range(1, joints)]
    found += [tuple(np.roll(as_given[::-1], k).tolist()) for k in range(joints)]
    for i, k in combinations(range(joints), 2):
        order = list(as_given)
        order[i], order[k] = k, i
        found.append(tuple(order))
    return found


def _read(model: Model, observations: Observations, guess: Guess) -> DevicePoses | None:
    """Return the poses with the readings that a guess means; None if the robot cannot be there."""
    meant = replace(observations, x=guess.apply(observations.x))
    there = DevicePoses.of(model, meant, quick=True)
    if there is None or np.mean(there.placed | there.turned) < MIN_REACHED_SHARE:
        return None
    return there
