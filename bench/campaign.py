"""Whole campaigns of virtual robots: is the verdict right, and what do chosen poses save?

    python bench/campaign.py [--seeds 5] [--robots delta stewart argos linear_delta] [--plans]
    python bench/campaign.py --pairs [--seeds 5]

Each robot is built, and its hidden effects are drawn, by a seed; nothing of it is known to the
campaign. A run is right where it ends by itself with the name of all that was hidden, and no other;
alike where it ends by itself and says that poses do not tell what was hidden from others; in doubt
where all its poses are used up, and the truth is among what it names then; else wrong.

`--plans` measures the same robots at poses drawn at random, on a grid and by a D-optimal plan,
until they come to the right verdict, too, and eight more change nothing. `--pairs` hides one of two
effects that look alike.
"""

import argparse
import sys
import tempfile
import time
from bisect import bisect_left
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
from campaign_cells import SimulatedCell, model_of

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.campaign import Campaign, Goal
from parallel_cal.campaign.judging import DONE, Question, judged
from parallel_cal.campaign.trajectory import through
from parallel_cal.campaign.way import Guard
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.planning.plan import plan
from parallel_cal.planning.posepool import make_pool, usable
from parallel_cal.recordings.joining import joined
from parallel_cal.virtual.kinds import KINDS, kinds_of

ROBOTS = ("delta", "stewart", "argos", "linear_delta")
MOST, BATCH, FEWEST = 100, 8, 16
WORDS = RIGHT, ALIKE, DOUBT, WRONG = "right", "alike", "in doubt", "WRONG"
# It takes an hour of creeping until it can be seen, and a campaign of virtual robots a minute.
NOT_DRAWN = {"creep"}
# Two kinds that look alike, the robots in which they do, and whether they need a slow day.
PAIRS = (
    ("warmth", "creep", ("delta", "stewart"), True),
    ("eccentricity", "gain", ("argos",), False),
    ("backlash", "wind_up", ("delta", "linear_delta"), False),
)


class SlowDay(SimulatedCell):
    """A sample takes half a minute, in which the air warms, too: what comes with the one comes with
    the other."""

    def sample(self, go_on):
        warmer = self.cell.now.temperature + 0.05
        self.cell.change(lost_target=True, temperature=warmer)  # what nobody sees costs nothing
        self._read(self.cell.advance(self.cell.time + 30.0))
        self.cell.change(lost_target=False)
        return super().sample(go_on)


def hidden(robot, number, seed):
    """Names of the kinds of physics that a robot has."""
    rng = np.random.default_rng([seed, 77, number])
    may = [name for name in kinds_of(robot) if name not in NOT_DRAWN]
    return [str(name) for name in rng.choice(may, number, replace=False)]


def told(names, outcome, last):
    """RIGHT, ALIKE, DOUBT or WRONG: what a campaign's end and its last judgement say of what is
    hidden."""
    wanted = {KINDS[name].effect for name in names}
    if last is None or len(last.effects) != len(wanted) or last.verdict == "unexplained":
        return WRONG
    if wanted == {*last.effects} and outcome.success and not last.doubt:
        return RIGHT
    if last.doubt and wanted <= {*last.effects, *last.doubt}:
        return ALIKE if outcome.success else DOUBT
    return WRONG


def campaign(cell, seed):
    """How one campaign ended, its last judgement (None where there was none), and what it took."""
    begin, goal = time.monotonic(), Goal(MOST, payload=1.0, warmer=4.0, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        one = Campaign(folder, dump_model(model_of(cell.cell.robot)), goal, cell)
        outcome = one.run()
        one.close()
    return outcome, next(reversed(one.judgements), None), time.monotonic() - begin


def given_poses(kind, model, seed):
    """MOST joints of one of the usual ways to choose poses."""
    rng = np.random.default_rng([seed, 5])
    if kind == "D-optimal":
        found = plan(model, MOST // 2, criterion="D", pool=400, seed=seed).poses
        return np.tile(found.joints, (2, 1))
    if kind == "random":
        return make_pool(model, 3 * MOST, rng, symmetric=False).poses.joints[:MOST]
    m = model.mechanism
    n = len(m.controlled)
    side = int(np.ceil(MOST ** (1 / n)))
    axes = [np.linspace(a, b, side) for a, b in zip(m.workspace.low, m.workspace.high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, n)
    found = Kinematics(model).inverse(*m.poses(places))
    joints = found.joints[usable(model, found)]
    return joints[rng.permutation(len(joints))][:MOST]


def by_plan(kind, robot, names, seed):
    """After how many poses of a usual plan the verdict is right, and eight more leave it so; MOST
    where it never is. Who is right once is taken to stay so."""
    model, cell = model_of(robot), SimulatedCell(robot, seed, names)
    guard, samples, poses = Guard.of(model), [], given_poses(kind, model, seed)
    wanted = sorted(KINDS[name].effect for name in names)

    def knows(n):
        for k, joints in enumerate(poses[len(samples) : n], len(samples)):
            # Somebody changes load and warmth now and then.
            now = {"payload": float(k // 10 % 2), "temperature": 22.0 + 4.0 * (k // 20 % 2)}
            cell.ask("", now, lambda: None)
            cell.move(through(guard.way(cell.joints(), [joints]), model.mechanism), lambda: None)
            samples.append(cell.sample(lambda: None).dataset)
        data = joined(samples[:n], [1] * len(samples[:n]))
        try:
            found = judged(Question(dump_model(model)), data, np.zeros(len(data), bool))
        except ParallelCalError:
            return False
        return found.verdict in DONE and sorted(found.effects) == wanted and not found.doubt

    counts = range(FEWEST, len(poses) + 1, BATCH)
    first = bisect_left(counts, True, key=knows)
    return min(counts[first] + BATCH, MOST) if first < len(counts) else MOST


def shown(word, robot, seed, names, outcome, last, seconds):
    """One campaign's line."""
    line = f"{word:8} {robot} {seed} {'+'.join(names) or 'none'}: "
    if last is None:
        return line + outcome.message
    line += f"{last.verdict} {'+'.join(last.effects) or 'nothing'}"
    line += f" (doubt {', '.join(last.doubt)})" if last.doubt else ""
    return line + f", {outcome.samples} poses, {seconds:.0f} s"


def study(asked):
    """Campaigns of the robots asked for, with nothing, one and two effects hidden."""
    ends, poses, instead = defaultdict(Counter), defaultdict(list), defaultdict(list)
    for seed in range(asked.first, asked.first + asked.seeds):
        for robot in asked.robots:
            for number in (0, 1, 2):
                names = hidden(robot, number, seed)
                outcome, last, seconds = campaign(SimulatedCell(robot, seed, names), seed)
                word = told(names, outcome, last)
                ends[robot, number][word] += 1
                poses[robot, number].append(outcome.samples)
                line = shown(word, robot, seed, names, outcome, last, seconds)
                if asked.plans and word == RIGHT:
                    for kind in ("random", "grid", "D-optimal"):
                        n = by_plan(kind, robot, names, seed)
                        instead[kind, number].append((outcome.samples, n))
                        line += f", {kind} {n}"
                print(line, flush=True)
    print()
    for (robot, number), found in sorted(ends.items()):
        counts = ", ".join(f"{word} {found[word]}" for word in WORDS)
        print(f"{robot:12} {number} hidden: {counts}, median {np.median(poses[robot, number]):.0f}")
    for (kind, number), both in sorted(instead.items()):
        own, other = np.median(both, axis=0)
        print(f"{kind:10} {number} hidden: {other:.0f}, the campaign {own:.0f} ({own / other:.0%})")


def pairs(asked):
    """Campaigns of robots that hide one of two effects that look alike."""
    ends = defaultdict(Counter)
    for one, other, robots, slow in PAIRS:
        for seed in range(asked.first, asked.first + asked.seeds):
            for name in (one, other):
                robot = robots[seed % len(robots)]
                cell = (SlowDay if slow else SimulatedCell)(robot, seed, [name])
                outcome, last, seconds = campaign(cell, seed)
                word = told([name], outcome, last)
                ends[one, other][word] += 1
                print(shown(word, robot, seed, [name], outcome, last, seconds), flush=True)
    print()
    for (one, other), found in ends.items():
        counts = ", ".join(f"{word} {found[word]}" for word in WORDS)
        print(f"{one} or {other}: {counts}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", nargs="*", default=ROBOTS)
    parser.add_argument("--plans", action="store_true")
    parser.add_argument("--pairs", action="store_true")
    asked = parser.parse_args()
    (pairs if asked.pairs else study)(asked)


if __name__ == "__main__":
    main()
