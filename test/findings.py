"""Datasets with hidden physics of a known size in sigmas of the residual."""

from __future__ import annotations

import numpy as np
import virtual_findings as vf
import virtual_robot as vr
from datasets import JOINTS, quiet

from parallel_cal.identification.fit import fit
from parallel_cal.model.model import Model, new_model
from parallel_cal.recordings.dataset import Dataset


def dataset(samples, noise):
    """Samples of a virtual session as a Dataset, with every condition recorded."""
    n, cov = len(samples["q"]), np.zeros((6, 6))
    cov[range(6), range(6)] = [noise.position**2] * 3 + [noise.orientation**2] * 3
    ways = np.diff(samples["q"], axis=0, prepend=samples["home"][None])
    conditions = {
        **{f"direction.{j}": samples["direction"][:, i] for i, j in enumerate(JOINTS)},
        **{f"travel.{j}": travel(ways[:, i]) for i, j in enumerate(JOINTS)},
        **{name: samples[name] for name in ("time", "temperature", "payload")},
    }
    return Dataset.from_arrays(
        JOINTS, samples["q"], samples["r"], samples["R"], measured=np.ones((n, 6), dtype=bool),
        pose_cov=cov, joint_sigma=[noise.joint] * 3, conditions=conditions,
        pose_id=samples["pose_index"], source="virtual robot",
    )  # fmt: skip


def travel(ways):
    """Signed way since the joint last turned back."""
    out = np.zeros(len(ways))
    for k, way in enumerate(ways):
        out[k] = way + (out[k - 1] if k and way * out[k - 1] > 0 else 0.0)
    return out


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
    """A dataset of 150 samples that hides one effect of each kind at the wanted size."""
    day = vf.session(seed)
    noise = noise or min((k.noise for k in kinds), key=lambda n: n.position)
    effects = [sized(k.make, k.size, wanted, day, noise, seed) for k in kinds]
    return dataset(vf.samples(day, effects, noise, seed), noise), effects


def clean(seed, noise=vr.THESIS_NOISE):
    return dataset(vf.samples(vf.session(seed), [], noise, seed), noise)
