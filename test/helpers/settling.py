"""Two effects that a first session cannot tell, and a second one measured as it was planned."""

from dataclasses import dataclass, replace

import findings
import numpy as np
import virtual_effects_hidden as hidden
import virtual_findings as vf
import virtual_sessions as days

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr

TURNS_OVER = 20e-3  # rad, of a wind-up


@dataclass(frozen=True)
class Doubt:
    """Two effects that a session under `air` cannot tell: by name, how a size and a draw make
    them, and a first size; `size` in sigmas of the residual."""

    kinds: dict
    size: float
    air: object = days.wandering
    noise: vr.Noise = vr.THESIS_NOISE


DOUBTS = {
    "eccentricity/gain": Doubt(
        {
            "encoder_eccentricity": (vf.KINDS["eccentricity"].make, 3e-3),
            "encoder_gain": (lambda s, rng: ve.WrongPitch(vf.three(s, rng)), 3e-3),
        },
        0.4,
        noise=vf.FINE,
    ),
    "thermal/drift": Doubt(
        {
            "thermal_expansion": (lambda s, rng: hidden.ThermalGrowth(s, s, s), 10e-6),
            "base_drift": (vf.KINDS["base drift"].make, 0.05e-6),
        },
        0.4,
        lambda t: 18 + 0.003 * np.asarray(t),
        vf.FINE,
    ),
    "backlash/hysteresis": Doubt(
        {
            "backlash": (vf.KINDS["backlash"].make, 0.3e-3),
            "hysteresis": (lambda s, rng: ve.WindUp(vf.widths(s, rng), TURNS_OVER), 0.2e-3),
        },
        0.8,
    ),
}


def session(doubt, seed):
    day = replace(vf.session(seed), air=doubt.air)
    at = day.at(day.arrive + day.dwell / 2)
    load = np.full(len(at.time), 0.2)
    every = np.arange(len(at.time))
    return day, findings.driven(day.reading, day.home, every, at.time, at.temperature, load)


def sized(doubt, name, seed):
    """The effect, as large as the doubt wants it."""
    make, size = doubt.kinds[name]
    day, at = session(doubt, seed)
    for _ in range(2):
        effect = make(size, np.random.default_rng(seed))
        still = findings.seen(day.reading, at, [effect], findings.quiet(), seed)
        still |= {"pose_index": day.pose_index, "home": day.home}
        result = fit(new_model("delta54"), findings.dataset(still, doubt.noise), hold_out=0)
        size *= doubt.size / float(np.sqrt(result.estimate.chi2_per_dof))
    return make(size, np.random.default_rng(seed))


def settled(doubt, seed):
    """What becomes of a draw: before and after measuring what was planned."""
    names = list(doubt.kinds)
    truth = names[seed % 2]
    effect = sized(doubt, truth, seed)
    day, at = session(doubt, seed)
    samples = findings.seen(day.reading, at, [effect], doubt.noise, seed)
    samples |= {"pose_index": day.pose_index, "home": day.home}
    first = diagnose(new_model("delta54"), findings.dataset(samples, doubt.noise), effects=names)
    plan = first.measure_next.plan
    if plan is None:
        return word(first, truth), word(first, truth)
    more = findings.continued(samples, plan, [effect], doubt.noise, seed)
    then = diagnose(new_model("delta54"), findings.dataset(more, doubt.noise), effects=names)
    return word(first, truth), f"{word(then, truth)} with {len(plan.poses)} poses"


def word(found, truth):
    called = {n for name in found.effects for n in (name, *found.swaps.get(name, []))}
    if truth not in called:
        return "wrong" if called else "nothing found"
    return "in doubt" if called > {truth} else "settled"
