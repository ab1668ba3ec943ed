"""How many solutions `--all` lists for drawn robots, counted by other means.

A hexapod has up to 40 poses for its lengths, a Delta up to 8 joint positions for its pose. Each
robot is drawn by its number. All that is listed must close the robot by the formulas of this file.
For a hexapod, Newton's method in NumPy starts from 300 random poses: each of its ends must be
listed. For a Delta, the angles of each arm are the real zeros of a quadratic in tan(angle / 2), and
the count is the product over the arms. Every robot is kept as a line of docs/solution_counts.jsonl,
and one that stands there is not run again. Usage: `python -m bench.truth.solution_counts
[--robots N] [--minutes M]`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from hexapod_ends import find_ends

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics.all_solutions import direct_all, inverse_all
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

STUDY = Path(__file__).resolve().parents[2] / "docs" / "solution_counts.jsonl"
SEED = 5103
STARTS = 300
CLOSED_M = 1e-9  # m by which a listed solution may miss a rod
SAME = 1e-6  # m and rad: two solutions that are nearer are one


@dataclass(frozen=True)
class Count:
    """A robot: solutions listed, whether the program calls them all, those that the other means
    found, those of them that are not listed, and listed ones that do not close the robot."""

    robot: str
    number: int
    listed: int
    complete: bool
    counted: int
    missed: int
    open: int


def count_hexapod(number: int) -> Count:
    """Draw feet and heads in cubes of 0.6 m and lengths that fit one pose, and list all poses."""
    rng = np.random.default_rng([SEED, number])
    feet, heads = rng.uniform(-0.3, 0.3, (2, 6, 3))
    names = [f"leg{i + 1}.{point}_{axis}" for point in "CB" for i in range(6) for axis in "xyz"]
    points = np.ravel([feet, heads]).tolist()
    model = new_model("stewart42", dict(zip(names, points, strict=True)))
    turn = rotation_matrix(rng.normal(size=3))
    length = np.linalg.norm([0.1, -0.1, 0.5] + heads @ turn.T - feet, axis=1)
    zero = np.array([model.value(f"leg{i + 1}.L0") for i in range(6)])
    found = direct_all(model, length - zero)
    legs = found.position[:, None] + heads @ found.rotation.swapaxes(1, 2) - feet
    gaps = np.abs(np.linalg.norm(legs, axis=-1) - length).max(axis=1)
    r, R = find_ends(feet, heads, length, rng, STARTS)
    apart = np.abs(r[:, None] - found.position).max(axis=-1)
    apart += np.abs(R[:, None] - found.rotation).max(axis=(-1, -2))
    unlisted = int((apart.min(axis=1) > SAME).sum())
    reached = int((apart.min(axis=0) < SAME).sum())
    wrong = int((gaps > CLOSED_M).sum())
    return Count("hexapod", number, len(found), bool(found.complete), reached, unlisted, wrong)


def count_delta(number: int) -> Count:
    """Draw a Delta and a point, which it may not reach, and list all joint positions."""
    rng = np.random.default_rng([SEED, number])
    base, platform, arm, rod = rng.uniform((0.08, 0.02, 0.1, 0.3), (0.15, 0.04, 0.15, 0.4))
    mechanism = load_mechanism("delta24", base=base, platform=platform, arm=arm, rod=rod)
    model, sizes = new_model(mechanism), (base, platform, arm, rod)
    x, y = rng.uniform(-0.15, 0.15, 2)
    point = np.array([x, y, np.sign(mechanism.home.position[2]) * rng.uniform(0.1, 0.4)])
    found = inverse_all(model, point)
    listed = found[found.residual < CLOSED_M]  # also outside of the limits of the joints
    angles = [_arm_angles(k, point, *sizes) for k in range(3)]
    counted = int(np.prod([len(one) for one in angles]))
    missing = counted - len(_distinct(listed)) if counted > len(listed) else 0
    wrong = sum(  # angles of joints that no arm can have
        min((abs(np.angle(np.exp(1j * (q - a)))) for a in found_angles), default=9.0) > SAME
        for joints in listed.joints
        for q, found_angles in zip(joints, angles, strict=True)
    )
    return Count("delta", number, len(listed), bool(found.complete), counted, missing, int(wrong))


def _distinct(found: Solutions) -> set[tuple[float, ...]]:
    return {tuple(np.round(np.exp(1j * q), 6).view(float)) for q in found.joints}


def _arm_angles(
    k: int, point: np.ndarray, base: float, platform: float, arm: float, rod: float
) -> np.ndarray:
    """Return the angles (rad) of an arm whose elbow is a rod away from the platform's joint: of the
    real zeros t = tan(angle / 2) of a quadratic."""
    around = 2 * np.pi * k / 3
    out = np.array([np.cos(around), np.sin(around), 0.0])
    away = point + platform * out - base * out  # from the hinge to the joint of the platform
    # |arm (cos(angle) out + sin(angle) z) - away| = rod
    a, b = away @ out, away[2]
    c = (away @ away + arm**2 - rod**2) / (2 * arm)
    zeros = np.roots([-a - c, 2 * b, a - c])
    return 2 * np.arctan(zeros[np.abs(zeros.imag) < 1e-9].real)


def read_study() -> list[Count]:
    """Read the robots that were counted."""
    lines = STUDY.read_text().splitlines() if STUDY.exists() else []
    return [Count(**json.loads(line)) for line in lines]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--minutes", type=float, default=20.0)
    given = parser.parse_args()
    done = {(one.robot, one.number) for one in read_study()}
    end = time.monotonic() + 60 * given.minutes
    for number in range(given.robots):
        for robot, count in (("delta", count_delta), ("hexapod", count_hexapod)):
            if (robot, number) in done or time.monotonic() > end:
                continue
            with STUDY.open("a") as file:
                file.write(json.dumps(asdict(count(number))) + "\n")
    for robot in ("hexapod", "delta"):
        own = [one for one in read_study() if one.robot == robot]
        print(f"{robot}: {len(own)} robots, {sum(one.complete for one in own)} complete")
        print("  listed:", dict(sorted(Counter(one.listed for one in own).items())))
        print(
            f"  counted by the other means: {sum(one.counted for one in own)} of "
            f"{sum(one.listed for one in own)} listed; missed {sum(one.missed for one in own)}, "
            f"open {sum(one.open for one in own)}"
        )


if __name__ == "__main__":
    main()
