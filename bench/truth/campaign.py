"""Whole campaigns of virtual robots: is the verdict right, and what do chosen poses save?

    python -m bench.truth.campaign [--seeds 5] [--robots delta stewart argos linear_delta]
                             [--plans random grid D-optimal]
    python -m bench.truth.campaign --pairs [--seeds 5]

Each robot is built, and its hidden effects are drawn, by a seed; nothing of it is known to the
campaign. A run is right where it ends by itself with the name of all that was hidden, and no other;
alike where it ends by itself and says that poses do not tell what was hidden from others; in doubt
where all its poses are used up, and the truth is among what it names then; else wrong.

`--plans` lets the same robots calibrate themselves at poses of usual plans, too: poses that no fit
sees, load and warmth, judgements and the end are the same, only that all other poses were drawn at
random, taken from a grid or planned D-optimally before. `--pairs` hides one of two effects that
look alike. All cores work, or with `--scheduler tcp://...` a Dask cluster, whose workers have
PYTHONPATH=.:test/helpers.
"""

import argparse
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import cycle

import numpy as np
from campaign_cells import SimulatedCell, model_of

from parallel_cal.campaign.campaign import Campaign
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.judging import judge_samples
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.targets import first_targets
from parallel_cal.fleet.cluster import cluster, run_each
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.planning.plan import plan
from parallel_cal.planning.posepool import find_usable_poses, make_pool
from parallel_cal.virtual.kinds import KINDS, kinds_of

ROBOTS = ("delta", "stewart", "argos", "linear_delta")
MOST = 100
PLANS = ("random", "grid", "D-optimal")
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


class ByPlan:
    """Does a campaign's work, but goes to given joints (., nq) instead of what it chose."""

    def __init__(self, poses):
        self._poses = cycle(poses.tolist())  # some may be left out

    def instead(self, one):
        return one if one.unseen else replace(one, joints=tuple(next(self._poses)), via=())

    def __call__(self, function, *given):
        found = function(*given)
        if function is judge_samples:
            found = replace(found, targets=tuple(map(self.instead, found.targets)))
        return found


def campaign(cell, seed, plan=None):
    """How one campaign ended, its last judgement, and what it took."""
    begin, goal = time.monotonic(), Goal(MOST, payload=2.0, warmer=10.0, reach=2.0, seed=seed)
    model, given = model_of(cell.cell.robot), {"work": plan} if plan else {}
    with tempfile.TemporaryDirectory() as folder:
        one = Campaign(folder, dump_model(model), goal, cell, **given)
        if plan:
            one._add_targets([*map(plan.instead, first_targets(Guard.of(model), MOST, seed))])
        outcome = one.run()
        one.close()
    last = one.judgements[-1] if one.judgements else None
    return outcome, last, time.monotonic() - begin


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
    joints = found.joints[find_usable_poses(model, found)]
    return joints[rng.permutation(len(joints))][:MOST]


def by_plan(kind, robot, names, seed):
    """After how many poses of a usual plan a campaign ends with the right verdict; MOST where it
    never does."""
    plan = ByPlan(given_poses(kind, model_of(robot), seed))
    outcome, last, _ = campaign(SimulatedCell(robot, seed, names), seed, plan)
    return outcome.samples if told(names, outcome, last) == RIGHT else MOST


def shown(word, robot, seed, names, outcome, last, seconds):
    """One campaign's line."""
    line = f"{word:8} {robot} {seed} {'+'.join(names) or 'none'}: "
    if last is None:
        return line + outcome.message
    line += f"{last.verdict} {'+'.join(last.effects) or 'nothing'}"
    line += f" (doubt {', '.join(last.doubt)})" if last.doubt else ""
    return line + f", {outcome.samples} poses, {seconds:.0f} s"


def hunted(robot, seed, names, slow=False, plans=()):
    """A campaign's word, its samples, its line, and by way of plans how many poses they took."""
    cell = (SlowDay if slow else SimulatedCell)(robot, seed, names)
    outcome, last, seconds = campaign(cell, seed)
    word = told(names, outcome, last)
    line = shown(word, robot, seed, names, outcome, last, seconds)
    kinds = plans if word == RIGHT else ()
    instead = {kind: by_plan(kind, robot, names, seed) for kind in kinds}
    line = ", ".join([line, *(f"{kind} {n}" for kind, n in instead.items())])
    return word, outcome.samples, line, instead


def all_of(asked, calls):
    """Number and answer of each campaign as it ends, on all cores or on a cluster."""
    with cluster(asked.scheduler, None) as client:
        for k, answer in run_each(client, hunted, calls):
            print(answer[2], flush=True)
            yield k, answer
    print()


def study(asked):
    """Campaigns of the robots asked for, with nothing, one and two effects hidden."""
    ends, poses, instead = defaultdict(Counter), defaultdict(list), defaultdict(list)
    seeds = range(asked.first, asked.first + asked.seeds)
    runs = [(r, number, seed) for seed in seeds for r in asked.robots for number in (0, 1, 2)]
    calls = [(r, seed, hidden(r, number, seed), False, asked.plans) for r, number, seed in runs]
    for k, (word, samples, _, others) in all_of(asked, calls):
        robot, number, _ = runs[k]
        ends[robot, number][word] += 1
        poses[robot, number].append(samples)
        for kind, n in others.items():
            for group in (f"{number} hidden", "all", *(["1 or 2 hidden"] if number else [])):
                instead[kind, group].append((samples, n))
    for (robot, number), found in sorted(ends.items()):
        counts = ", ".join(f"{word} {found[word]}" for word in WORDS)
        print(f"{robot:12} {number} hidden: {counts}, median {np.median(poses[robot, number]):.0f}")
    for (kind, group), both in sorted(instead.items()):
        own, other = np.median(both, axis=0)
        print(f"{kind:10} {group}: {other:.0f}, the campaign {own:.0f} ({own / other:.0%})")


def pairs(asked):
    """Campaigns of robots that hide one of two effects that look alike."""
    ends, seeds = defaultdict(Counter), range(asked.first, asked.first + asked.seeds)
    runs = [
        ((one, other), (robots[seed % len(robots)], seed, [name], slow))
        for one, other, robots, slow in PAIRS
        for seed in seeds
        for name in (one, other)
    ]
    for k, (word, *_) in all_of(asked, [call for _, call in runs]):
        ends[runs[k][0]][word] += 1
    for (one, other), found in ends.items():
        counts = ", ".join(f"{word} {found[word]}" for word in WORDS)
        print(f"{one} or {other}: {counts}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", nargs="*", default=ROBOTS)
    parser.add_argument("--plans", nargs="*", choices=PLANS, default=())
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--scheduler", help="a Dask cluster's address; none: this machine's cores")
    asked = parser.parse_args()
    (pairs if asked.pairs else study)(asked)


if __name__ == "__main__":
    main()
