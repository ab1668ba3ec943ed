"""After how many samples does a campaign name the right cause beside its lookalikes?

    python -m bench.truth.decide [--first 911] [--seeds 2]

Of each robot that hides one effect that others imitate: how it ended (see `bench.truth.campaign`),
after how many samples, after how many of them the hidden effect alone was named for the rest of the
campaign, and the processor time. PYTHONPATH needs test/helpers.
"""

import argparse
import tempfile
import time

from campaign_cells import SimulatedCell, model_of

from bench.truth.campaign import MOST, told
from parallel_cal.campaign.campaign import Campaign
from parallel_cal.campaign.goal import Goal
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.virtual.kinds import KINDS

SESSIONS = (  # robot, what it hides, kg that may be attached
    ("delta", "backlash", 0.0),
    ("linear_delta", "backlash", 0.0),
    ("stewart", "backlash", 0.0),
    ("argos", "backlash", 0.0),
    ("argos", "gain", 0.0),
    ("delta", "soft_frame", 2.0),
    ("delta", "wind_up", 0.0),
)


def find_when_named(judgements, effect):
    """The number of samples from which on only this effect was named; None if never."""
    when = None
    for one in reversed(judgements):
        if one.effects != (effect,) or one.doubt:
            break
        when = one.samples
    return when


def run(robot, kind, payload, seed):
    """Run one campaign; return how it ended, its samples, and when it was sure."""
    begin = time.process_time()
    goal = Goal(MOST, payload=payload, reach=2.0, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        cell = SimulatedCell(robot, seed, [kind])
        one = Campaign(folder, dump_model(model_of(robot)), goal, cell)
        outcome = one.run()
        one.close()
    last = one.judgements[-1] if one.judgements else None
    word = told([kind], outcome, last)
    when = find_when_named(one.judgements, KINDS[kind].effect)
    spent = time.process_time() - begin
    print(f"{robot} {seed} {kind}: {word}, named after {when} of {outcome.samples}, {spent:.0f} s")
    return word, outcome.samples, when


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=911)
    parser.add_argument("--seeds", type=int, default=2)
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    found = [run(*session, seed) for seed in seeds for session in SESSIONS]
    named = sum(when is not None for *_, when in found)
    print(f"{len(found)} sessions: {named} named, {sum(n for _, n, _ in found)} samples")


if __name__ == "__main__":
    main()
