"""Whole campaigns of virtual robots: is the verdict right, and what do chosen poses save?

    python bench/campaign.py [--seeds 5] [--robots delta stewart argos linear_delta] [--plans]

Each robot is built, and its hidden effects are drawn, by a seed; nothing of it is known to the
campaign. `--plans` measures the same robots at poses drawn at random, on a grid and by a D-optimal
plan, as many at a time, until they come to the verdict that the campaign has come to.
"""

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
from campaign_cells import SimulatedCell, model_of

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.campaign import Campaign, Goal
from parallel_cal.campaign.judging import Question, judged
from parallel_cal.campaign.trajectory import through
from parallel_cal.campaign.way import Guard
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.planning.plan import plan
from parallel_cal.planning.posepool import make_pool, usable
from parallel_cal.recordings.joining import joined
from parallel_cal.virtual.kinds import KINDS, kinds_of

ROBOTS = ("delta", "stewart", "argos", "linear_delta")
MOST, BATCH = 100, 8
# It takes an hour of creeping until it can be seen, and a campaign of virtual robots a minute.
NOT_DRAWN = {"creep"}


def hidden(robot, number, seed):
    """Names of the kinds of physics that a robot has."""
    rng = np.random.default_rng([seed, 77, number])
    may = [name for name in kinds_of(robot) if name not in NOT_DRAWN]
    return [str(name) for name in rng.choice(may, number, replace=False)]


def right(names, effects, doubt):
    """Whether what was found is what was hidden; a family's name is one of its members'."""
    wanted = [set(KINDS[name].names) for name in names]
    if len(effects) != len(wanted):
        return False
    return all(any(one & {effect, *doubt} for effect in effects) for one in wanted)


def campaign(robot, names, seed):
    """The judgements of one campaign, and how long it took."""
    cell, begin = SimulatedCell(robot, seed, names), time.monotonic()
    goal = Goal(MOST, payload=1.0, warmer=4.0, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        one = Campaign(folder, dump_model(model_of(robot)), goal, cell)
        outcome = one.run()
        one.close()
    return outcome, one.judgements, time.monotonic() - begin


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


def by_plan(kind, robot, names, seed, wanted):
    """After how many poses of a usual plan the verdict, and what it names, are the campaign's."""
    model, cell = model_of(robot), SimulatedCell(robot, seed, names)
    guard, samples = Guard.of(model), []
    rng = np.random.default_rng(seed)
    for k, joints in enumerate(given_poses(kind, model, seed)):
        if k % 20 == 10:  # somebody changes load and warmth now and then
            cell.ask("", {"payload": float(rng.choice([0.0, 1.0]))}, lambda: None)
            cell.ask("", {"temperature": float(rng.choice([22.0, 26.0]))}, lambda: None)
        cell.move(through(guard.way(cell.joints(), [joints]), model.mechanism), lambda: None)
        samples.append(cell.sample(lambda: None).dataset)
        if len(samples) < 16 or len(samples) % BATCH:
            continue
        data = joined(samples, [1] * len(samples))
        try:
            found = judged(Question(dump_model(model)), data, np.zeros(len(data), bool))
        except ParallelCalError:
            continue
        if found.verdict == wanted.verdict and right(names, found.effects, found.doubt):
            return len(samples)
    return MOST


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--robots", nargs="*", default=ROBOTS)
    parser.add_argument("--plans", action="store_true")
    asked = parser.parse_args()
    good, poses, instead = defaultdict(list), defaultdict(list), defaultdict(list)
    for seed in range(asked.first, asked.first + asked.seeds):
        for robot in asked.robots:
            for number in (0, 1, 2):
                names = hidden(robot, number, seed)
                outcome, judgements, seconds = campaign(robot, names, seed)
                if not judgements:
                    print(f"{robot} {seed} {names}: {outcome.message}", flush=True)
                    good[robot, number].append(False)
                    continue
                last = judgements[-1]
                ok = outcome.success and right(names, last.effects, last.doubt)
                good[robot, number].append(ok)
                poses[robot, number].append(outcome.samples)
                line = f"{robot} {seed} {'+'.join(names) or 'none'}: {last.verdict}"
                line += f" {'+'.join(last.effects) or 'nothing'}"
                line += f" (doubt {', '.join(last.doubt)})" if last.doubt else ""
                line += f", {outcome.samples} poses, {seconds:.0f} s"
                if asked.plans and ok:
                    for kind in ("random", "grid", "D-optimal"):
                        n = by_plan(kind, robot, names, seed, last)
                        instead[kind].append((outcome.samples, n))
                        line += f", {kind} {n}"
                print(f"{'right' if ok else 'WRONG'} {line}", flush=True)
    print()
    for (robot, number), them in sorted(good.items()):
        print(
            f"{robot:12} {number} hidden: right {sum(them)}/{len(them)}, "
            f"median {np.median(poses[robot, number] or [np.nan]):.0f} poses"
        )
    for kind, pairs in instead.items():
        own, other = np.median(np.array(pairs), axis=0)
        print(f"{kind:10} median {other:.0f} poses, the campaign {own:.0f} ({own / other:.0%})")


if __name__ == "__main__":
    main()
