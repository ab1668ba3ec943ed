"""Make homotopy_start.json, the platform with 40 known poses at which every homotopy begins.

One pose of a random complex platform is known by construction: choose the pose, compute the
lengths. Tracking it along loops in the space of platforms permutes the poses of the platform
(monodromy) and so finds the others. The search stops at the 40 that exist.

Run it with `python -m parallel_cal.kinematics.solvers._homotopy_start`.
"""

from __future__ import annotations

import json

import numpy as np

from parallel_cal.kinematics.solvers._platform import N_GENERIC_POSES, START
from parallel_cal.kinematics.solvers._quadrics import (
    MAX_CERTIFIED_ALPHA,
    Tracker,
    alpha,
    find_distinct,
    normalise,
    refine,
)
from parallel_cal.kinematics.solvers._study import quadrics

SEED = 1996
LOOPS = 60


def random_platform(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw complex C and B (6, 3) of size one, centred like every target, and one zero (8,)."""
    C, B = (_complex_normal(rng, 6, 3) for _ in range(2))
    C, B = C - C.mean(axis=0), B - B.mean(axis=0)
    zero = _complex_normal(rng, 8)
    e, g = zero[:4], zero[4:]
    zero[4:] = g - e * (e @ g) / (e @ e)
    return C / np.sqrt(6), B / np.sqrt(6), zero


def squares_through(C: np.ndarray, B: np.ndarray, zero: np.ndarray) -> np.ndarray:
    """Compute the squared lengths (6,) of the rods from C to B at a pose."""
    M = quadrics(C, B, np.zeros(6))
    return (zero @ M[:6] @ zero) / (zero[:4] @ zero[:4])


def all_zeros(M: np.ndarray, zero: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Find the zeros of M from one of them, by loops through other platforms."""
    found = normalise(zero[None])
    for _ in range(LOOPS):
        C, B, elsewhere = random_platform(rng)
        other = quadrics(C, B, squares_through(C, B, elsewhere))
        there, back = (complex(np.exp(2j * np.pi * rng.random())) for _ in range(2))
        X, first = Tracker(M, other, there, 1e-6)(found)
        X, second = Tracker(other, M, back, 1e-6)(X[first])
        found = np.concatenate([found, refine(X[second], M)])
        found = found[find_distinct(found)]
        if len(found) >= N_GENERIC_POSES:
            break
    return found


def main() -> None:
    rng = np.random.default_rng(SEED)
    C, B, zero = random_platform(rng)
    squares = squares_through(C, B, zero)
    M = quadrics(C, B, squares)
    zeros = all_zeros(M, zero, rng)
    certain = alpha(zeros, M)[0] < MAX_CERTIFIED_ALPHA
    if len(zeros) != N_GENERIC_POSES or not certain.all():
        raise SystemExit(f"{len(zeros)} zeros found, {certain.sum()} of them certain: expected 40")
    arrays = {"C": C, "B": B, "squares": squares, "zeros": zeros}
    pairs = {name: np.stack([a.real, a.imag], -1).tolist() for name, a in arrays.items()}
    provenance = (
        "parallel_cal/kinematics/solvers/_homotopy_start.py; complex numbers as [real, imaginary]"
    )
    START.write_text(json.dumps({"made_by": provenance, "seed": SEED, **pairs}) + "\n")


def _complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)


if __name__ == "__main__":
    main()
