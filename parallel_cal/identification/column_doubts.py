"""Recognise joint readings in the wrong columns, of the wrong sign or from a zero far away, and
positions or orientations of another unit or convention.

Such samples show no pose that the robot can reach, and a fit then moves the geometry far from the
drawing. What was meant is found by trial: each guess is judged by the error of the poses after a
registration of the device, with the geometry as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, permutations, product
from math import factorial
from typing import Any

import numpy as np

from parallel_cal.base.units import ANGLES, MM
from parallel_cal.identification.conventions import Convention, list_conventions
from parallel_cal.identification.couplings import list_couplings
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.identification.thresholds import (
    MAX_GUESS_SAMPLES,
    MAX_GUESS_SHARE,
    MAX_GUESSES_OF_A_KIND,
    MAX_GUESSES_REFINED,
    MAX_USED_SHARE,
    MIN_FRAME_POSES,
    MIN_GUESS_ERROR_RATIO,
    MIN_QUICK_SHARE,
    MIN_REACHED_SHARE,
    MIN_SCALE_SAMPLES,
    MIN_UNREGISTERED_ERROR_RATIO,
    MOST_READINGS,
    SAME_GUESS_ERROR_RATIO,
)
from parallel_cal.model.model import Model

Array = np.ndarray

Fitting = tuple[list[tuple["Guess", DevicePoses]], float]

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
    """One thing that samples may mean, in `words` with the entries of a column map.

    `joints` returns the joint readings (N, nq) that were meant. `poses` returns the poses that were
    meant, given the rotation of the device that the positions show (None if they show none).
    Without these, readings or poses mean what they were taken for.
    """

    words: str
    joints: Callable[[Array], Array] | None = None
    poses: Callable[[DevicePoses, Array | None], DevicePoses] | None = None


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
    if words := _doubt_size(model, observations, source):
        return words
    if there is None:  # the robot cannot be there
        shown = observations.measured[:, n : n + 6].any(axis=1)
        far_off = bool(np.sum(shown) >= MIN_SCALE_SAMPLES)
    else:
        sizes = there.compute_median_errors(there.frames)
        far_off = bool((sizes > MIN_UNREGISTERED_ERROR_RATIO * there.expected).any())
    if not (far_off or suspected):
        return ""
    few = observations.select(_choose_some(observations))
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
        q = few.x[:, :n] if guess.joints is None else guess.joints(few.x[:, :n])
        outside = float(np.mean((q < low) | (q > high)))
        return outside, poses.compute_median_error(poses.now)

    guess, poses = min(fitting, key=preference)
    others = [one for one, _ in fitting if one.poses is not None]
    meant = ", or if ".join(dict.fromkeys(one.words for one in (guess, *others)))
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


def _doubt_size(model: Model, observations: Observations, source: str) -> str:
    """Explain that joint readings and positions are a thousand times too small; empty if they are
    not.

    Wrong by the same factor, they do not contradict each other. But they span less than a
    thousandth of their ranges, and a thousand times as large they are poses of the robot.
    """
    mechanism, n = model.mechanism, len(model.joints)
    own = [i for i in mechanism.controlled if i < 3]
    shown = observations.measured[:, [n + i for i in own]].all(axis=1)
    sliding = [i for i, unit in enumerate(mechanism.joint_units) if unit == "m"]
    low, high = np.array(mechanism.joint_limits, float)[sliding].T
    if not own or np.sum(shown) < MIN_SCALE_SAMPLES or not np.isfinite(high - low).any():
        return ""
    box = mechanism.workspace
    sides = np.subtract(box.high, box.low)[: len(own)]  # positions come before turns
    tail = (1 - MOST_READINGS) / 2
    read = observations.x[shown][:, [*sliding, *(n + i for i in own)]]
    first, middle, last = np.quantile(read, [tail, 0.5, 1 - tail], axis=0)
    used = float(np.max((last - first) / np.maximum(np.append(high - low, sides), 1e-12)))
    meant_readings, margin = middle[: len(sliding)] / MM, (high - low) / 2
    outside = (meant_readings < low - margin) | (meant_readings > high + margin)
    if used > MM * MAX_USED_SHARE or outside.any():
        return ""
    [guess] = _guess_lengths(model)
    meant = _read_joints(model, observations.select(_choose_some(observations)), guess.joints)
    if meant is None or guess.poses is None:
        return ""
    if guess.poses(meant, None).find_unexplained_share() >= MAX_GUESS_SHARE:
        return ""
    return (
        f"{source or 'samples'}: joints and positions span at most {100 * used:.2g} % of their "
        f"ranges in the model file. They are poses of the robot if {guess.words}. Correct this "
        "where the samples are recorded or imported, or use --force (in Python: insist) if the "
        "robot moved so little"
    )


def _choose_some(observations: Observations) -> Array:
    """Return the indices of samples by which guesses are judged."""
    return np.unique(np.linspace(0, len(observations) - 1, MAX_GUESS_SAMPLES).astype(int))


_known: dict[tuple[Any, ...], Fitting] = {}  # of the samples that were doubted last


def _find_fitting_guesses(model: Model, few: Observations) -> Fitting:
    """Return the guesses that fit clearly better than what was given and as well as the best, with
    their poses; and the error of what was given. A fit asks before it begins, and again if it
    fails: hundreds of guesses are judged once."""
    numbers = few.x, few.S, few.measured, few.a, few.group, model.values, model.table.tolerance
    key = model.structure, *(part.tobytes() for part in (*numbers, np.asarray(model.fixed)))
    found = _known.get(key)
    if found is None:
        found = _judge_guesses(model, few)
        _known.clear()
        _known[key] = found
    return found


def _judge_guesses(model: Model, few: Observations) -> Fitting:
    n = len(model.joints)
    placed, turned = (
        bool(few.measured[:, part].any()) for part in (slice(n, n + 3), slice(n + 3, None))
    )
    given = _read_joints(model, few)
    F = None  # the rotation of the device that positions show, whatever orientations mean
    if given is not None and given.placed.sum() >= MIN_FRAME_POSES:
        F = replace(given, measured=given.measured & PLACE).frames.F
    guesses = [
        (guess, poses if guess.poses is None else guess.poses(poses, F))
        for guess in (
            *_guess_joints(model),
            *_guess_poses(model, placed, turned),
            *(_guess_lengths(model) if placed else ()),
        )
        if (poses := given if guess.joints is None else _read_joints(model, few, guess.joints))
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


def _guess_joints(model: Model) -> Iterator[Guess]:
    """Yield what may be wrong with the readings of joints."""
    names, units = model.joints, model.mechanism.joint_units
    n = len(names)
    each = [tuple(-1.0 if i == k else 1.0 for i in range(n)) for k in range(n)]
    every = list(product((1.0, -1.0), repeat=n))[1:] if 2**n <= MAX_GUESSES_OF_A_KIND else []
    for signs in every or (*each, (-1.0,) * n):
        turned = [name for name, sign in zip(names, signs, strict=True) if sign < 0]
        has = "has" if len(turned) == 1 else "have"
        entry = f"(column map: {turned[0]}: {{column: ..., factor: -1}})"
        words = f"{', '.join(turned)} {has} the other sign {entry}"
        yield Guess(words, partial(np.multiply, np.array(signs)))
    for order in _list_orders(n):
        moved = [(names[i], names[k]) for i, k in enumerate(order) if i != k]
        own, columns = map(", ".join, zip(*moved, strict=True))
        words = f"{own} are in the columns of {columns}"
        yield Guess(words, partial(np.take, indices=order, axis=1))
    for unit in sorted(set(units)):
        for factor, meant in SCALES[unit].items():
            factors = np.where(np.array(units) == unit, factor, 1.0)
            words = f"the joints are in {meant} (column map: unit)"
            yield Guess(words, partial(np.multiply, factors))
    for name, unit, one in zip(names, units, np.eye(n), strict=True):
        for turn in QUARTER_TURNS if unit == "rad" else ():
            angle = f"{np.degrees(turn):g} deg"
            entry = f"(column map: {name}: {{column: ..., offset: {angle}}})"
            yield Guess(f"{angle} are added to {name} {entry}", partial(np.add, turn * one))
    for coupling in list_couplings(units):
        yield Guess(coupling.describe(names), coupling.apply)


def _guess_poses(model: Model, placed: bool, turned: bool) -> Iterator[Guess]:
    """Yield what may be wrong with positions, if they are measured (`placed`), and with
    orientations, if they are (`turned`)."""

    def mirror_poses(
        mirror: Array, turns: bool, there: DevicePoses, F: Array | None
    ) -> DevicePoses:
        turn = mirror @ there.seen_R @ mirror if turns else there.seen_R
        return replace(there, seen_r=there.seen_r @ mirror, seen_R=turn)

    def read_orientations(
        convention: Convention, there: DevicePoses, F: Array | None
    ) -> DevicePoses:
        return replace(there, seen_R=convention.choose(there, F))

    def invert_poses(there: DevicePoses, F: Array | None) -> DevicePoses:
        R = there.seen_R.transpose(0, 2, 1)
        r = -np.einsum("nij,nj->ni", R, there.seen_r)
        measured = there.measured & (there.turned[:, None] | ~PLACE)
        return replace(there, seen_r=r, seen_R=R, measured=measured)

    if placed:
        for factor, unit in LENGTHS.items():
            words = f"the positions are in {unit} (column map: unit)"
            yield Guess(words, poses=partial(_scale_positions, factor))
        words = "the frame of the device is left-handed (two of its axes are exchanged)"
        yield Guess(words, poses=partial(mirror_poses, np.diag([1.0, 1.0, -1.0]), True))
        for exchanged, mirror in MIRRORS.items() if turned else ():
            words = f"the positions, but not the orientations, are left-handed: {exchanged}"
            yield Guess(words, poses=partial(mirror_poses, mirror, False))
    if turned and max(model.mechanism.moved) >= 3:
        for convention in list_conventions():
            yield Guess(convention.words, poses=partial(read_orientations, convention))
        if placed:
            words = "the poses are inverse, those of {B} seen by {P} (invert them: position -R^T r,"
            yield Guess(f"{words} rotation R^T)", poses=invert_poses)


def _scale_positions(factor: float, there: DevicePoses, F: Array | None) -> DevicePoses:
    return replace(there, seen_r=factor * there.seen_r)


def _guess_lengths(model: Model) -> Iterator[Guess]:
    """Yield that the lengths of joints and positions alike are too small, if joints are lengths.

    Lengths that are too large are refused before (readings.py), and smaller ones have smaller
    errors whatever they mean.
    """
    sliding = np.array(model.mechanism.joint_units) == "m"
    if sliding.any():
        yield Guess(
            "joints and positions are in m, not mm (column map: unit)",
            joints=partial(np.multiply, np.where(sliding, 1 / MM, 1.0)),
            poses=partial(_scale_positions, 1 / MM),
        )


def _list_orders(joints: int) -> list[tuple[int, ...]]:
    """List every order of a few joints; of many, two exchanged ones, and counts that begin at
    another joint or go the other way round."""
    if factorial(joints) <= MAX_GUESSES_OF_A_KIND:
        return list(permutations(range(joints)))[1:]
    as_given = list(range(joints))
    found = [tuple(np.roll(as_given, k).tolist()) for k in range(1, joints)]
    found += [tuple(np.roll(as_given[::-1], k).tolist()) for k in range(joints)]
    for i, k in combinations(range(joints), 2):
        order = list(as_given)
        order[i], order[k] = k, i
        found.append(tuple(order))
    return found


def _read_joints(
    model: Model, observations: Observations, read: Callable[[Array], Array] | None = None
) -> DevicePoses | None:
    """Return the poses with the joint readings that were meant; None if the robot cannot be
    there."""
    x, n = observations.x.copy(), len(model.joints)
    if read is not None:
        x[:, :n] = read(x[:, :n])
    there = DevicePoses.of(model, replace(observations, x=x), quick=True)
    # Where more joints than freedoms contradict each other a little, many solutions take longer.
    has_more_joints = len(model.joints) > len(model.mechanism.moves)
    least = MIN_QUICK_SHARE if has_more_joints else MIN_REACHED_SHARE
    # Fewer different poses can be matched to any readings.
    if there is None or there.poses < MIN_FRAME_POSES:
        return None
    if np.mean(there.placed | there.turned) < least:
        return None
    return there
