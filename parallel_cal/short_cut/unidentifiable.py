"""What a set of loops does not see of a Delta, in words (section 5.4.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.identification.observability import combination
from parallel_cal.identification.thresholds import RELATIVE_RANK
from parallel_cal.model.model import Model
from parallel_cal.model.words import direction_in_words
from parallel_cal.short_cut.loop import POINTS, RODS, Loop, compute_parts


def blind_spots(loops: Sequence[Loop], robot: Model, J: np.ndarray) -> tuple[str, ...]:
    """Directions that the loops' whitened Jacobian J (n, n_free) does not see, by name."""
    free = ~robot.fixed
    scaled = J * robot.table.tolerance[free]
    floor = RELATIVE_RANK * _largest(scaled)
    words, blind = [], _null(scaled, floor)
    for what, move in _moves(loops, robot).items():
        lost = move @ _null(scaled @ move, floor)
        if lost.shape[1]:
            count = lost.shape[1]
            words.append(f"{what} ({count} direction{'s' if count > 1 else ''})")
            # An orthonormal basis of those blind directions that are square to the lost ones.
            left, sizes, _ = np.linalg.svd(blind - lost @ (np.linalg.pinv(lost) @ blind))
            blind = left[:, : int(np.sum(sizes > 0.5))]
    names = [n for n, f in zip(robot.table.names, free, strict=True) if f]
    return (*words, *(direction_in_words(combination(d, names), robot.table) for d in blind.T))


def _moves(loops: Sequence[Loop], robot: Model) -> dict[str, np.ndarray]:
    """Directions (n_free, k), in tolerances, that these loops might not see."""
    free = ~robot.fixed
    parts, by_p = compute_parts(robot, robot.values)
    by_p = by_p[:, free] * robot.table.tolerance[free]
    points, lengths = parts[:POINTS].reshape(-1, 3), np.zeros(len(RODS))
    rigid = [np.cross(axis, points) for axis in np.eye(3)]
    rigid += [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
    rods = [("rod", k) for k in RODS if k not in {loop.rod for loop in loops}]
    balls = [("ball", k) for k in RODS if k not in {b for k in loops for b in (k.one, k.other)}]
    moves = {
        "the platform's bars, which are in no loop": _null(by_p, 1e-9 * _largest(by_p)),
        "where the robot stands in {B}": _find_moving_parameters(
            by_p, np.column_stack([np.append(move, lengths) for move in rigid])
        ),
        "the robot's size, as no length is known": _find_moving_parameters(by_p, parts[:, None]),
    }
    return moves | {
        f"{kind} {number}, which is in no loop": _find_moving_parameters(
            by_p, _part_moves(kind, number)
        )
        for kind, number in rods + balls
    }


def _part_moves(kind: str, number: str) -> np.ndarray:
    """Unit changes (m, k) of one rod's length or of one ball's points."""
    owner = np.append(np.arange(POINTS) // 3 % len(RODS), np.arange(len(RODS)))
    is_rod = np.arange(len(owner)) >= POINTS
    own = (owner == RODS.index(number)) & (is_rod == (kind == "rod"))
    return np.eye(len(owner))[:, own]


def _largest(M: np.ndarray) -> float:
    return float(np.linalg.norm(M, 2))


def _null(M: np.ndarray, floor: float) -> np.ndarray:
    """Orthonormal directions (n, k) that M (m, n) shrinks below `floor`."""
    _, sizes, directions = np.linalg.svd(M)
    return directions[int(np.sum(sizes > floor)) :].T


def _find_moving_parameters(by_p: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Orthonormal directions of the parameters that move the parts within `moved` (m, k)."""
    steps = np.linalg.lstsq(by_p, moved, rcond=1e-9)[0]
    missed = moved - by_p @ steps
    return np.linalg.qr(steps @ _null(missed, 1e-6 * _largest(moved)))[0]
