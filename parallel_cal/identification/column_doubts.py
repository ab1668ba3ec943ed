"""Recognise joint readings in the wrong columns, of the wrong sign or from a zero far away, and
positions or orientations of another unit or convention.

Such samples show no pose that the robot can reach, and a fit then moves the geometry far from the
drawing. What was meant is found by trial: each guess is judged by the error of the poses after a
registration of the device, with the geometry as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np

from parallel_cal.identification.observations import Observations
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.identification.thresholds import (
    MAX_GUESS_SAMPLES,
    MAX_GUESS_SHARE,
    MAX_GUESSES_REFINED,
    MAX_JOINTS_IN_ANY_ORDER,
    MAX_JOINTS_OF_ANY_SIGN,
    MIN_GUESS_ERROR_RATIO,
    MIN_QUICK_SHARE,
    MIN_REACHED_SHARE,
    MIN_SCALE_SAMPLES,
    MIN_UNREGISTERED_ERROR_RATIO,
    SAME_GUESS_ERROR_RATIO,
)
from parallel_cal.model.model import Model

Array = np.ndarray

QUARTER_TURNS = (0.5 * np.pi, -0.5 * np.pi, np.pi)
LENGTHS = {  # factors to positions
    1e3: "m, not mm",
    1e-3: "mm, not m",
    10.0: "cm, not mm",
    0.1: "mm, not cm",
    25.4: "inches, not mm",
    1 / 25.4: "mm, not inches",
}
SCALES = {  # factors to the readings of all joints with a unit
    "rad": {np.degrees(1.0): "rad, not deg", np.radians(1.0): "deg, not rad"},
    "m": {1e3: "m, not mm", 1e-3: "mm, not m"},
}
MIRROR = np.diag([1.0, 1.0, -1.0])


def _euler(given: str, meant: str, factor: float = 1.0) -> Callable[[Array], Array]:
    """Return what reads the angles of rotations about the axes `given` as those about `meant`."""

    def turn(R: Array) -> Array:
        from scipy.spatial.transform import Rotation

        angles = Rotation.from_matrix(R).as_euler(given)
        return np.asarray(Rotation.from_euler(meant, factor * angles).as_matrix())

    return turn


def _scalar_first(R: Array) -> Array:
    """Read quaternions that were taken for x y z w as w x y z."""
    from scipy.spatial.transform import Rotation

    return np.asarray(
        Rotation.from_quat(Rotation.from_matrix(R).as_quat()[:, [1, 2, 3, 0]]).as_matrix()
    )


OTHER_AXES = (
    "about rotated, not fixed axes, or the reverse (axes: XYZ in place of xyz, or the reverse)"
)
REVERSED = "in the reverse order"
IN_RAD = "in rad, not deg"
# What orientations may mean. xyz of three angles is ZYX of the reversed ones, so that these pairs
# include all others. Angles in deg that were taken for rad cannot be found again.
ORIENTATIONS: tuple[tuple[str, Callable[[Array], Array]], ...] = (
    ("the rotations are those of the device seen by the target", lambda R: R.transpose(0, 2, 1)),
    ("the quaternions are w x y z, not x y z w", _scalar_first),
    (f"the angles are {OTHER_AXES}", _euler("xyz", "XYZ")),
    (f"the angles are {OTHER_AXES}", _euler("XYZ", "xyz")),
    (f"the angles are {REVERSED}", _euler("xyz", "ZYX")),
    (f"the angles are {REVERSED}", _euler("XYZ", "zyx")),
    (f"the angles are {REVERSED}, and {OTHER_AXES}", _euler("xyz", "zyx")),
    (f"the angles are {REVERSED}, and {OTHER_AXES}", _euler("XYZ", "ZYX")),
    (f"the angles are {IN_RAD}", _euler("xyz", "xyz", np.degrees(1.0))),
    (f"the angles are {IN_RAD}", _euler("XYZ", "XYZ", np.degrees(1.0))),
)


@dataclass(frozen=True)
class Guess:
    """What samples mean: the reading of each joint is `factor` times that in the column of joint
    `column`, plus `zero` (rad); positions are multiplied by `length`; `orientation` is one of
    ORIENTATIONS; the frame of the device is left-handed for what is `mirrored`: positions (1), or
    orientations, too (2). `scale` describes factors of a unit."""

    column: tuple[int, ...]
    factor: tuple[float, ...]
    zero: tuple[float, ...]
    scale: str = ""
    length: float = 1.0
    orientation: int | None = None
    mirrored: int = 0

    @classmethod
    def as_given(cls, joints: int) -> Guess:
        return cls(tuple(range(joints)), (1.0,) * joints, (0.0,) * joints)

    def apply(self, x: Array) -> Array:
        """Return the configurations (N, nq + 12) that were meant."""
        x, n = x.copy(), len(self.column)
        x[:, :n] = x[:, self.column] * np.array(self.factor) + np.array(self.zero)
        R = x[:, n + 3 :].reshape(-1, 3, 3)
        if self.orientation is not None:
            R = ORIENTATIONS[self.orientation][1](R)
        if self.mirrored:
            x[:, n : n + 3] @= MIRROR
        if self.mirrored == 2:
            R = MIRROR @ R @ MIRROR
        x[:, n : n + 3] *= self.length
        x[:, n + 3 :] = R.reshape(-1, 9)
        return x

    def describe(self, names: Sequence[str]) -> str:
        """Describe what was meant, with the entries of a column map."""
        parts = []
        if moved := [i for i, k in enumerate(self.column) if i != k]:
            columns = ", ".join(names[self.column[i]] for i in moved)
            parts.append(f"{', '.join(names[i] for i in moved)} are in the columns of {columns}")
        if self.scale:
            parts.append(f"the joints are in {self.scale} (column map: unit)")
        elif turned := [names[i] for i, factor in enumerate(self.factor) if factor < 0]:
            verb = "has" if len(turned) == 1 else "have"
            entry = f"{turned[0]}: {{column: ..., factor: -1}}"
            parts.append(f"{', '.join(turned)} {verb} the other sign (column map: {entry})")
        for name, zero in zip(names, self.zero, strict=True):
            if zero:
                angle = f"{np.degrees(zero):g} deg"
                entry = f"{name}: {{column: ..., offset: {angle}}}"
                parts.append(f"{angle} are added to {name} (column map: {entry})")
        if self.length != 1:
            parts.append(f"the positions are in {LENGTHS[self.length]} (column map: unit)")
        if self.orientation is not None:
            parts.append(ORIENTATIONS[self.orientation][0])
        if self.mirrored:
            parts.append(LEFT_HANDED)
        return " and ".join(parts)


LEFT_HANDED = "the frame of the device is left-handed (two of its axes are exchanged)"


def doubt_columns(
    model: Model,
    observations: Observations,
    there: DevicePoses | None,
    source: str,
    suspected: bool = False,
    most: float = np.inf,
) -> str:
    """Explain with which other readings or orientations the samples fit the robot, if they do not
    as they are; empty if none do.

    `there` are the poses of the observations. If the samples are not `suspected`, because a fit to
    them failed, their errors must exceed what the tolerances explain. Other readings must leave a
    median error below `most` (m).
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
        (guess, poses)
        for (guess, poses), error in zip(best, errors, strict=True)
        if error * MIN_GUESS_ERROR_RATIO < before
        and error < SAME_GUESS_ERROR_RATIO * min(errors)
        and poses.find_unexplained_share() < MAX_GUESS_SHARE
    ]
    if not fitting:
        return ""
    if min(poses.compute_median_error(poses.frames) for _, poses in fitting) >= most:
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
    meant = guess.describe(model.joints)
    if not guess.mirrored and any(one.mirrored for one, _ in fitting):
        meant += f", or if {LEFT_HANDED}"
    smaller = ""
    if np.isfinite(before):
        ratio = before / poses.compute_median_error(poses.frames)
        smaller = f": the errors are then {ratio:.0f} times smaller"
    return (
        f"{source or 'samples'}: the joint readings do not fit the measured poses, wherever the "
        f"device stands. They fit if {meant}{smaller}. Correct this where "
        "the samples are recorded or imported"
    )


def _list_guesses(model: Model, placed: bool, turned: bool) -> Iterator[Guess]:
    """Yield what may be wrong; positions are measured if `placed`, orientations if `turned`."""
    joints, units = len(model.joints), model.mechanism.joint_units
    given = Guess.as_given(joints)
    if joints <= MAX_JOINTS_OF_ANY_SIGN:
        signs = list(product((1.0, -1.0), repeat=joints))[1:]
    else:
        one = 1 - 2 * np.eye(joints)
        signs = [tuple(row) for row in (*one.tolist(), [-1.0] * joints)]
    yield from (replace(given, factor=sign) for sign in signs)
    yield from (replace(given, column=order) for order in _list_orders(joints))
    for unit in sorted(set(units)):
        for factor, words in SCALES[unit].items():
            factors = tuple(factor if own == unit else 1.0 for own in units)
            yield replace(given, factor=factors, scale=words)
    for i, unit in enumerate(units):
        for turn in QUARTER_TURNS if unit == "rad" else ():
            yield replace(given, zero=tuple(turn if k == i else 0.0 for k in range(joints)))
    if placed:
        yield from (replace(given, length=factor) for factor in LENGTHS)
        yield from (replace(given, mirrored=kind) for kind in ((1, 2) if turned else (1,)))
    if turned and max(model.mechanism.moved) >= 3:
        yield from (replace(given, orientation=k) for k in range(len(ORIENTATIONS)))


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
    # Where more joints than freedoms contradict each other a little, many solutions take longer.
    has_more_joints = len(model.joints) > len(model.mechanism.moves)
    least = MIN_QUICK_SHARE if has_more_joints else MIN_REACHED_SHARE
    if there is None or np.mean(there.placed | there.turned) < least:
        return None
    return there
