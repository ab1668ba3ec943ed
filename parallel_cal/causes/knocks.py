"""Single samples that were disturbed alone, as if somebody knocked the device."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from parallel_cal.posterior.blocks import KNOCK, LOG_ODDS, Block
from parallel_cal.posterior.evidence import SIZES, Choice
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset

# What a knock usually moves, in sigmas: from a third of it to thirty times as much is tried.
USUAL_SIGMAS = 30.0
# Samples that are tried at a time. Half of them gives the same samples, in one round more.
SUSPECTS = 8
# Of the samples: if more were disturbed, the noise has heavy tails, or the model fails in places.
MAX_KNOCKED_SHARE = 0.05
MIN_DETERMINED = 1e-9  # of a row that the other samples predict: less is rounding


def list_knock_blocks(scene: Scene, count: int, chosen: Sequence[Choice] = ()) -> list[Block]:
    """One block for each of the samples without which the residual falls most beside the chosen
    causes: such a sample shows anything. One in `count` samples was disturbed, with the odds of a
    cause.

    A sample that does not state from which sides its joints came is wrong for every effect
    that depends on them. A sample of a continuous motion is not disturbed alone.
    """
    dataset = scene.dataset
    if dataset.mode == "continuous":
        return []
    sideless = find_sideless_samples(dataset)
    without = np.flatnonzero(np.isin(dataset.numbers, list(sideless)))[:SUSPECTS]
    furthest = np.argsort(-compute_falls(scene, chosen))[:SUSPECTS]
    found = []
    for i in np.union1d(furthest, without).tolist():
        number = int(dataset.numbers[i])
        prior = 0.0 if number in sideless else LOG_ODDS - np.log(count)
        # Any change of the rows of this sample that say anything: (n, informative).
        informative, setting = int(scene.informative[i]), {"sample": number}
        rows = np.zeros((len(scene.x), scene.rows, informative))
        rows[i] = USUAL_SIGMAS * np.linalg.svd(scene.whitener[i])[0][:, :informative]
        columns = rows.reshape(len(scene.residual), informative)
        found.append(Block.of(scene, f"sample {number}", KNOCK, prior, [columns], [setting]))
    return [block for block in found if block is not None]


def compute_falls(scene: Scene, chosen: Sequence[Choice] = ()) -> np.ndarray:
    """How much the sum of squares r' S^-1 r of a residual falls without each of its samples (N,),
    beside the geometry and the chosen causes.

    With e = S^-1 r and P_i the block of a sample in S^-1, both off the geometry, it falls by
    e_i' P_i^-1 e_i.
    """
    parts = [SIZES[one.size] * one.block.at(one.setting) for one in chosen]
    C = np.hstack([np.zeros((len(scene.residual), 0)), *parts])
    Z = np.linalg.solve(np.linalg.cholesky(np.eye(C.shape[1]) + C.T @ C), C.T).T
    e = scene.by_sample(scene.residual - Z @ (Z.T @ scene.residual))
    taken = scene.by_sample(np.hstack([scene.basis, Z]))
    P = (1 + MIN_DETERMINED) * np.eye(scene.rows) - taken @ taken.transpose(0, 2, 1)
    return np.asarray(np.einsum("nr,nr->n", e, np.linalg.solve(P, e[:, :, None])[:, :, 0]))


def find_sideless_samples(dataset: Dataset) -> set[int]:
    """Return the numbers of the samples without sides, such as the first row of a table; none if
    no sample has any."""
    sides = [column for name, column in dataset.conditions.items() if name.startswith("direction.")]
    if not np.any(sides):
        return set()
    return set(dataset.numbers[~np.any(sides, axis=0)].tolist())


def are_few(samples: Collection[int], dataset: Dataset) -> bool:
    """Whether so many samples may be excluded without being asked."""
    return len(samples) <= max(1, MAX_KNOCKED_SHARE * len(dataset))
