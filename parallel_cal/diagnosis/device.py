"""Robot or device? Find effects of one side that an error of the other side could imitate.

Residuals show what is missing, but not on which side of the measurement. The sum over all causes
decides: with the effects that are to be added, how probable is it that the robot (or the device)
has one of them, and not an error of the other side in its place? The other side of the robot are
the effects of the device, each as large as the device's certificate lets it be, and any smooth
field of position; the other side of the device are flaws of the joints, and a deflection that goes
with the payload, which no device knows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.diagnosis.thresholds import CREDIBLE
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import EFFECT, FIELD, LAW, Block, Stack
from parallel_cal.posterior.evidence import Choice, Evidence
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import Sum


def find_doubtful_effects(scene: Scene, chosen: Sequence[Candidate]) -> list[str]:
    """Names of the effects among `chosen` that the other side may cause: beside the others, it is
    not CREDIBLE that it does not, nor is it CREDIBLE among all sets of causes that they are there.

    Errors of the device that change with time compete as drift, where causes are searched.
    """
    names = [one.name for one in chosen]
    device = [name for name in list_effects_to_test(scene.model) if load_effect(name).of_device]
    other_side = {LAW if load_effect(name).of_device else FIELD for name in names}
    settings = {one.name: one.settings for one in chosen}
    causes = Causes.of(scene, list(dict.fromkeys([*names, *device])), settings, other_side)
    known = {block.name: block for block in causes.blocks}
    made = causes.sum
    best = made.choose([known[name] for name in names if name in known])
    doubtful = []
    for k, one in enumerate(best):
        rest = made.evidence(best[:k] + best[k + 1 :], made.nu)
        other = [b for b in causes.blocks if b.name not in names and _is_other_side(one.block, b)]
        if other and _compute_probability(made, rest, one, other) > 1 - CREDIBLE:
            doubtful.append(one.block.name)
    if not doubtful:
        return []
    # What else is missing, and not added yet, may be what the other side seems to cause.
    among_all = Causes.of(scene, list_effects_to_test(scene.model)).sum.search().probability
    return [name for name in doubtful if among_all.get(name, 0.0) < CREDIBLE]


def _compute_probability(made: Sum, rest: Evidence, one: Choice, other: Sequence[Block]) -> float:
    """Probability that beside the rest there is an error of the other side in the place of a cause.

    The robot may have it while the device errs, too. An error of the device that the model learns
    must be the whole error: what a law of the robot adds to it would be taken from it.
    """
    from scipy.special import expit

    both, stacks = made.evidence((*rest.chosen, one), made.nu), Stack.of_alike(other)

    def rank(beside: Evidence) -> list[float]:
        return [ranked.log_p for stack in stacks for ranked in beside.rank(stack)]

    blamed = np.logaddexp.reduce(rank(rest))
    if blamed < rest.log_p:  # the other side explains nothing
        return 0.0
    cleared = [rest.log_p, both.log_p]
    if not load_effect(one.block.name).of_device:
        cleared += rank(both)
    return float(expit(blamed - np.logaddexp.reduce(cleared)))


def _is_other_side(one: Block, other: Block) -> bool:
    """Whether one cause is of the robot and the other of the device, and lasts."""
    effect = load_effect(one.name)
    if other.kind == EFFECT:
        against = load_effect(other.name)
        return against.of_device and not against.needs and not effect.of_device
    if effect.of_device:
        return not effect.needs and other.kind == LAW
    return other.kind == FIELD
