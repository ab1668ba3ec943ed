"""Recognise joint readings in the wrong columns, of the wrong sign or from a zero far away.

Such readings fit no pose that the robot can reach, and a fit then moves the geometry far from the
drawing. The readings that were meant are found by trial: each guess is judged by the error of the
poses after a registration of the device, with the geometry as it is.
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


@dataclass(frozen=True)
class Guess:
    """The reading of each joint is `sign` times that in the column of joint `column`, plus `zero`
    (rad)."""

    column: tuple[int, ...]
    sign: tuple[int, ...]
    zero: tuple[float, ...]

    @classmethod
    def as_given(cls, joints: int) -> Guess:
        return cls(tuple(range(joints)), (1,) * joints, (0.0,) * joints)

    def apply(self, q: np.ndarray) -> np.ndarray:
        """Return the readings (N, nq) that were meant."""
        return np.asarray(q[:, self.column] * np.array(self.sign) + np.array(self.zero))

    def describe(self, names: Sequence[str]) -> str:
        """Describe the readings that were meant, with the entries of a column map."""
        parts = []
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
    model: Model, observations: Observations, there: DevicePoses | None, source: str
) -> str:
    """Explain which other readings fit the poses, if those given do not; empty if none do.

    `there` are the poses of the observations.
    """
    n = len(model.joints)
    if there is None:  # the robot cannot be there
        shown = observations.measured[:, n:].any(axis=1)
        far_off = bool(np.sum(shown) >= MIN_SCALE_SAMPLES)
    else:
        sizes = there.compute_median_errors(there.frames)
        far_off = bool((sizes > MIN_UNREGISTERED_ERROR_RATIO * there.expected).any())
    if not far_off:
        return ""
    some = np.unique(np.linspace(0, len(observations) - 1, MAX_GUESS_SAMPLES).astype(int))
    few = observations.select(some)
    guesses = [
        (guess, poses) for guess in _list_guesses(model) if (poses := _read(model, few, guess))
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
    # Of guesses that a turn of the device makes equal, choose the one that needs no turn.
    guess, poses = min(fitting, key=lambda one: one[1].compute_median_error(one[1].now))
    smaller = ""
    if np.isfinite(before):
        ratio = before / poses.compute_median_error(poses.frames)
        smaller = f": the errors are then {ratio:.0f} times smaller"
    return (
        f"{source or 'samples'}: the joint readings do not fit the measured poses, wherever the "
        f"device stands. They fit if {guess.describe(model.joints)}{smaller}. Correct the columns "
        "or the signs where the samples are recorded or imported"
    )


def _list_guesses(model: Model) -> Iterator[Guess]:
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
    x, n = observations.x.copy(), len(model.joints)
    x[:, :n] = guess.apply(x[:, :n])
    there = DevicePoses.of(model, replace(observations, x=x), quick=True)
    if there is None or np.mean(there.placed | there.turned) < MIN_REACHED_SHARE:
        return None
    return there
