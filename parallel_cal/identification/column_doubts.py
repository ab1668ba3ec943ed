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

from parallel_cal.base.units import ANGLES, MM
from parallel_cal.identification.conventions import Convention, list_conventions
from parallel_cal.identification.couplings import Coupling, list_couplings
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.identification.thresholds import (
    MAX_GUESS_SAMPLES,
    MAX_GUESS_SHARE,
    MAX_GUESSES_REFINED,
    MAX_JOINTS_IN_ANY_ORDER,
    MAX_JOINTS_OF_ANY_SIGN,
    MIN_GUESS_ERROR_RATIO,
    MIN_PLACEMENT_POSES,
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
# What a left-handed frame does to positions. Where orientations are in the same frame, one of these
# stands for all: a rotation of the device makes the others of it.
MIRRORS = {
    "z has the other sign": np.diag([1.0, 1.0, -1.0]),
    "y has the other sign": np.diag([1.0, -1.0, 1.0]),
    "x has the other sign": np.diag([-1.0, 1.0, 1.0]),
    "x and y are exchanged": np.eye(3)[[1, 0, 2]],
    "x and z are exchanged": np.eye(3)[[2, 1, 0]],
    "y and z are exchanged": np.eye(3)[[0, 2, 1]],
}


PLACE = np.arange(6) < 3  # the coordinates of a pose that are its position


@dataclass(frozen=True)
class Guess:
    """What samples mean: the reading of each joint is `factor` times that in the column of joint
    `column`, plus `zero` (rad), or that of a `coupling`; positions are multiplied by
    `length`; orientations are of another `convention`; the poses are `inverted`: those of the base
    seen by the platform; the frame of the device is left-handed by one of MIRRORS, `mirror`, for
    positions, and for orientations if `turns_mirrored`. `scale` describes factors of a unit."""

    column: tuple[int, ...]
    factor: tuple[float, ...]
    zero: tuple[float, ...]
    scale: str = ""
    coupling: Coupling | None = None
    length: float = 1.0
    convention: Convention | None = None
    inverted: bool = False
    mirror: str = ""
    turns_mirrored: bool = False

    @classmethod
    def as_given(cls, joints: int) -> Guess:
        return cls(tuple(range(joints)), (1.0,) * joints, (0.0,) * joints)

    @property
    def keeps_joints(self) -> bool:
        """Whether the joint readings mean what they were taken for."""
        given = Guess.as_given(len(self.column))
        return (self.column, self.factor, self.zero, self.coupling) == (
            *(given.column, given.factor, given.zero),
            None,
        )

    def read_joints(self, q: Array) -> Array:
        """Return the joint readings (N, nq) that were meant."""
        meant = q[:, self.column] * np.array(self.factor) + np.array(self.zero)
        return np.asarray(meant if self.coupling is None else self.coupling.apply(meant))

    def read_poses(self, there: DevicePoses, F: Array | None) -> DevicePoses:
        """Return the poses that were meant; `F` is the rotation of the device that the positions
        show, None if they show none."""
        r, R, measured = there.seen_r, there.seen_R, there.measured
        if self.convention is not None:
            R = self.convention.choose(there, F)
        if self.inverted:
            R = R.transpose(0, 2, 1)
            r = -np.einsum("nij,nj->ni", R, r)
            measured = measured & (there.turned[:, None] | ~PLACE)
        if self.mirror:
            mirror = MIRRORS[self.mirror]
            r, R = r @ mirror, mirror @ R @ mirror if self.turns_mirrored else R
        return replace(there, seen_r=self.length * r, seen_R=R, measured=measured)

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
        if self.coupling is not None:
            parts.append(self.coupling.describe(names))
        if self.length != 1:
            parts.append(f"the positions are in {LENGTHS[self.length]} (column map: unit)")
        if self.convention is not None:
            parts.append(self.convention.words)
        if self.inverted:
            parts.append(
                "the poses are inverse, those of {B} seen by {P} (invert them: position -R^T r, "
                "rotation R^T)"
            )
        if self.mirror:
            parts.append(
                LEFT_HANDED
                if self.turns_mirrored
                else f"the positions, but not the orientations, are left-handed: {self.mirror}"
            )
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
        shown = observations.measured[:, n : n + 6].any(axis=1)
        far_off = bool(np.sum(shown) >= MIN_SCALE_SAMPLES)
    else:
        sizes = there.compute_median_errors(there.frames)
        far_off = bool((sizes > MIN_UNREGISTERED_ERROR_RATIO * there.expected).any())
    if not (far_off or suspected):
        return ""
    some = np.unique(np.linspace(0, len(observations) - 1, MAX_GUESS_SAMPLES).astype(int))
    few = observations.select(some)
    fitting, before = _find_fitting_guesses(model, few)
    if not fitting:
        return ""
    if min(poses.compute_median_error(poses.frames) for _, poses in fitting) >= most:
        return ""
    low, high = np.array(model.mechanism.joint_limits, float).T

    def preference(one: tuple[Guess, DevicePoses]) -> tuple[float, float]:
        """Of guesses that the poses do not decide between, prefer readings inside the limits, and a
        device that need not be turned."""
        guess, poses = one
        q = guess.read_joints(few.x[:, :n])
        outside = float(np.mean((q < low) | (q > high)))
        return outside, poses.compute_median_error(poses.now)

    guess, poses = min(fitting, key=preference)
    others = [one for one, _ in fitting if one.convention or one.mirror]
    meant = ", or if ".join(dict.fromkeys(one.describe(model.joints) for one in (guess, *others)))
    smaller = ""
    if np.isfinite(before):
        ratio = before / poses.compute_median_error(poses.frames)
        position, turned_by = poses.compute_median_errors(poses.frames)
        left = [f"{position / MM:.3g} mm"] if poses.placed.any() else []
        if poses.turned.any() and poses.turns:
            left.append(f"{turned_by / poses.length / ANGLES['arcmin']:.3g} arcmin")
        smaller = (
            f": the errors are then {ratio:.0f} times smaller ({', '.join(left)} before a fit)"
        )
    return (
        f"{source or 'samples'}: the joint readings do not fit the measured poses, wherever the "
        f"device stands. They fit if {meant}{smaller}. Correct this where "
        "the samples are recorded or imported"
    )


def _find_fitting_guesses(
    model: Model, few: Observations
) -> tuple[list[tuple[Guess, DevicePoses]], float]:
    """Return the guesses that fit clearly better than what was given and as well as the best, with
    their poses; and the error of what was given."""
    n = len(model.joints)
    placed, turned = (
        bool(few.measured[:, part].any()) for part in (slice(n, n + 3), slice(n + 3, None))
    )
    given = _read_joints(model, few, Guess.as_given(n))
    F = None  # the rotation of the device that positions show, whatever orientations mean
    if given is not None and given.placed.sum() >= MIN_PLACEMENT_POSES:
        F = replace(given, measured=given.measured & PLACE).frames.F
    guesses = [
        (guess, guess.read_poses(poses, F))
        for guess in _list_guesses(model, placed, turned)
        if (poses := given if guess.keeps_joints else _read_joints(model, few, guess))
    ]
    guesses.sort(key=lambda one: one[1].compute_closed_form_error())
    best = guesses[:MAX_GUESSES_REFINED]
    errors = [poses.compute_median_error(poses.frames) for _, poses in best]
    before = np.inf if given is None else given.compute_median_error(given.frames)
    turned_alone = (replace(poses, measured=poses.measured & ~PLACE) for _, poses in best)
    fitting = [
        (guess, poses)
        for (guess, poses), turns, error in zip(best, turned_alone, errors, strict=True)
        if error * MIN_GUESS_ERROR_RATIO < before
        and error < SAME_GUESS_ERROR_RATIO * min(errors)
        and poses.find_unexplained_share() < MAX_GUESS_SHARE
        and (
            # Where the platform turns, the orientations must be explained, too.
            not (poses.tilts and poses.turned.any())
            or turns.find_unexplained_share() < MAX_GUESS_SHARE
        )
    ]
    return fitting, before


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
        yield replace(given, mirror="z has the other sign", turns_mirrored=True)
        yield from (replace(given, mirror=words) for words in MIRRORS if turned)
    if turned and max(model.mechanism.moved) >= 3:
        yield from (replace(given, convention=one) for one in list_conventions())
        if placed:
            yield replace(given, inverted=True)
    yield from (replace(given, coupling=one) for one in list_couplings(units))


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


def _read_joints(model: Model, observations: Observations, guess: Guess) -> DevicePoses | None:
    """Return the poses with the joint readings that a guess means; None if the robot cannot be
    there."""
    x, n = observations.x.copy(), len(model.joints)
    x[:, :n] = guess.read_joints(x[:, :n])
    there = DevicePoses.of(model, replace(observations, x=x), quick=True)
    # Where more joints than freedoms contradict each other a little, many solutions take longer.
    has_more_joints = len(model.joints) > len(model.mechanism.moves)
    least = MIN_QUICK_SHARE if has_more_joints else MIN_REACHED_SHARE
    # Fewer different poses can be matched to any readings.
    if there is None or there.poses < MIN_PLACEMENT_POSES:
        return None
    if np.mean(there.placed | there.turned) < least:
        return None
    return there
