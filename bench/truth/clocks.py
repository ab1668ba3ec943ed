"""How often the stated interval of the offset between two clocks contains the true offset.

Four virtual robots make ten moves with rests between them. The clock of their tracker is off by
60 ms to 12 days, poses come at 10 to 100 Hz and joint states at 50 to 200 Hz. Each look estimates
the offset from what was recorded so far, as a node does while the robot moves: half of the looks
fall into the first three moves.

    python -m bench.truth.clocks [LOOKS]
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.campaign.trajectory import trapezoid
from parallel_cal.recordings.clocks import Offset, clock_offset
from parallel_cal.recordings.recording import JointStream, PoseStream
from parallel_cal.virtual.cell import Cell, Messages
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.tracker import Tracker

REACH = {"delta": 0.35, "stewart": 0.04, "argos": 0.2, "linear_delta": 0.06}  # rad or m from home
MOVES, LOOKS_EACH = 10, 10
Look = tuple[str, float, "Offset | None"]


def looks(seed: int) -> Iterator[Look]:
    """Yield the robot, the true offset (s) and the estimate at each look at one session."""
    rng = np.random.default_rng([seed, 7])
    robot = tuple(REACH)[seed % len(REACH)]
    pose_rate, joint_rate = rng.choice([10.0, 20.0, 50.0, 100.0]), rng.choice([50.0, 100.0, 200.0])
    offset = float(rng.choice([-1, 1]) * 10 ** rng.uniform(np.log10(0.06), 6))
    tracker = Tracker(period=1 / pose_rate, begin=float(rng.uniform(0, 1 / pose_rate)))
    machine = MACHINES[robot]
    cell = Cell(robot, seed, (), 1.0, tracker, 1 / joint_rate, 0.0)
    home, limits = np.asarray(machine.make_nominal().home_joints, float), machine.limits
    velocity, acceleration = (np.full(len(home), v) for v in (limits.velocity, limits.acceleration))
    parts, ends, here = [cell.advance(2.0)], [], home
    for _ in range(MOVES):
        there = home + rng.uniform(-REACH[robot], REACH[robot], len(home))
        move = trapezoid(here, there, velocity, acceleration)
        cell.follow(move.time, move.positions, move.velocities)
        try:
            parts.append(cell.advance(cell.time + move.seconds + float(rng.uniform(0.8, 1.6))))
        except ValueError:  # the robot cannot reach this place
            break
        ends.append(cell.time)
        here = there
    if not ends:
        return
    messages, half = Messages.concatenate(parts), LOOKS_EACH // 2
    early = rng.uniform(2.1, ends[min(2, len(ends) - 1)], half)
    for until in (*early, *rng.uniform(2.1, ends[-1], LOOKS_EACH - half)):
        streams = record(messages, offset, float(until), machine.sees_position)
        yield robot, offset, clock_offset(*streams)


def record(
    messages: Messages, offset: float, until: float, sees_position: bool
) -> tuple[JointStream, PoseStream]:
    """Return the streams up to a time (s), with the poses on the other clock."""
    joints, poses = messages.time <= until, messages.stamp <= until
    q, n = messages.q[joints], int(poses.sum())
    names = tuple(f"joint{i + 1}" for i in range(q.shape[1]))
    measured = np.ones((n, 6), bool)
    measured[:, :3] = sees_position
    return (
        JointStream("joints", names, messages.time[joints], q, np.full(q.shape, np.nan)),
        PoseStream(
            "poses",
            "base",
            messages.stamp[poses] + offset,
            messages.r[poses],
            matrix_to_quaternion(messages.R[poses]),
            measured,
            np.full((n, 6, 6), np.nan),
        ),
    )


def main() -> None:
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    found, seed = defaultdict[str, list[Look]](list), 0
    while sum(map(len, found.values())) < wanted:
        for look in looks(seed):
            found[look[0]].append(look)
        seed += 1
    found["all"] = [look for name in REACH for look in found[name]]
    print("| robot | looks | offset stated | in the interval | median margin | largest error |")
    print("|---|--:|--:|--:|--:|--:|")
    for robot, all_looks in found.items():
        stated = [(abs(o.delay - true), o.margin) for _, true, o in all_looks if o is not None]
        error, margin = np.array(stated).T
        share = float(np.mean(error <= margin))
        print(
            f"| {robot} | {len(all_looks)} | {len(stated)} | {100 * share:.1f} % | "
            f"{1e3 * np.median(margin):.2f} ms | {1e3 * error.max():.2f} ms |"
        )


if __name__ == "__main__":
    main()
