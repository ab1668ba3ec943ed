"""Datasets with hidden physics of a known size in sigmas of the residual."""

from __future__ import annotations

from copy import deepcopy
from functools import cache

import numpy as np
import virtual_findings as vf
from datasets import JOINTS, quiet

from parallel_cal.identification.fit import fit
from parallel_cal.model.model import Model, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr


def dataset(samples, noise):
    """Samples of a virtual session as a Dataset, with every condition recorded."""
    n, cov = len(samples["q"]), np.zeros((6, 6))
    cov[range(6), range(6)] = [noise.position**2] * 3 + [noise.orientation**2] * 3
    ways = np.diff(samples["q"], axis=0, prepend=samples["home"][None])
    come = samples.get("travel", np.column_stack([travel(way) for way in ways.T]))
    conditions = {
        **{f"direction.{j}": samples["direction"][:, i] for i, j in enumerate(JOINTS)},
        **{f"travel.{j}": come[:, i] for i, j in enumerate(JOINTS)},
        **{name: samples[name] for name in ("time", "temperature", "payload")},
    }
    return Dataset.from_arrays(
        JOINTS,
        samples["q"],
        samples["r"],
        samples["R"],
        measured=np.ones((n, 6), dtype=bool),
        pose_cov=cov,
        joint_sigma=[noise.joint] * 3,
        conditions=conditions,
        pose_id=samples["pose_index"],
        source="virtual robot",
    )


def travel(ways):
    """Signed way since the joint last turned back."""
    out = np.zeros(len(ways))
    for k, way in enumerate(ways):
        out[k] = way + (out[k - 1] if k and way * out[k - 1] > 0 else 0.0)
    return out


def driven(stations, home, keep, time, air, load):
    """The circumstances of the samples `keep` of a robot that goes from station to station, joint
    readings (n, nq): what each joint did is told from these alone."""
    ways = np.diff(stations, axis=0, prepend=home[None])
    since = np.column_stack([travel(w) for w in ways.T])[keep]
    still = np.zeros_like(since)
    return ve.Visit(time, air, load, np.sign(since), since, still, np.zeros(len(time)))


def continued(samples, plan, effects, noise, seed):
    """Samples of a session, and behind them those of its planned poses, driven in their order on
    the virtual robot; the hall is half a kelvin off what was planned."""
    poses = plan.poses
    stops = [[s.joints for s in (*p.by_way_of, p)] for p in poses]
    stations = np.array([q for one in stops for q in one])
    keep = np.cumsum([len(one) for one in stops]) - 1
    step, begin = 10.0, samples["time"][-1] + 600
    asked = {k: np.array([p.conditions.get(k, np.nan) for p in poses]) for k in AMBIENT}
    time = np.where(np.isnan(asked["time"]), begin + step * np.arange(len(poses)), asked["time"])
    air = np.where(np.isnan(asked["temperature"]), 20.0, asked["temperature"])
    air += 0.5 * np.sin(time / 100)
    load = np.where(np.isnan(asked["payload"]), 0.2, asked["payload"])
    at = driven(stations, samples["q"][-1], keep, time, air, load)
    for k, joint in enumerate(JOINTS):
        for kind, own in (("direction", at.direction), ("travel", at.travel)):
            wanted = [p.conditions.get(f"{kind}.{joint}", own[i, k]) for i, p in enumerate(poses)]
            np.testing.assert_allclose(own[:, k], wanted, atol=1e-6)
    new = seen(stations[keep], at, effects, noise, [seed, 11])
    new["pose_index"] = samples["pose_index"].max() + 1 + np.arange(len(poses))
    joined = {k: np.concatenate([samples[k], new[k]]) for k in new}
    return joined | {"home": samples["home"]}


AMBIENT = ("time", "temperature", "payload")


def seen(reading, at, effects, noise, seed):
    """What is measured at joint readings (n, nq) under these circumstances."""
    _, r, R = vr.truth(vr.MOCK_UP, effects, reading, at)
    q_error, r_error, w_error = noise.draw(np.random.default_rng(seed), len(r))
    return {"q": reading + q_error, "r": r + r_error, "R": vr.turn(w_error) @ R} | vars(at)


def size_in_sigmas(effect, day, noise, model: Model | None = None) -> float:
    """Rms residual, in noise units, that the geometry leaves of an effect without any noise."""
    still = vf.samples(day, [effect], quiet(), seed=0)
    found = fit(model or new_model("delta54"), dataset(still, noise), hold_out=0)
    return float(np.sqrt(found.estimate.chi2_per_dof))


def sized(make, first, wanted, day, noise, seed):
    """An effect of the wanted size in sigmas: what it leaves grows in proportion."""
    size = first
    for _ in range(2):
        size *= wanted / size_in_sigmas(make(size, np.random.default_rng(seed)), day, noise)
    return make(size, np.random.default_rng(seed))


def hiding(kinds, wanted, seed, noise=None):
    """A dataset of 150 samples that hides one effect of each kind at the wanted size: a copy of
    what was drawn first, since the effect is sized by several fits."""
    return deepcopy(_drawn(tuple(kinds), wanted, seed, noise))


@cache
def _drawn(kinds, wanted, seed, noise):
    day = vf.session(seed)
    noise = noise or min((k.noise for k in kinds), key=lambda n: n.position)
    effects = [sized(k.make, k.size, wanted, day, noise, seed) for k in kinds]
    return dataset(vf.samples(day, effects, noise, seed), noise), effects


def clean(seed, noise=vr.THESIS_NOISE):
    return dataset(vf.samples(vf.session(seed), [], noise, seed), noise)
