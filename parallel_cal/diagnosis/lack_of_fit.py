"""Test residuals for structure, and map their smooth part."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.statistics import bonferroni_minimum, morans_i, runs_test
from parallel_cal.diagnosis.thresholds import (
    LENGTHS,
    LEVELS,
    MAX_MAP_POSES,
    MIN_VARIATION_RATIO,
    ROUGHNESS,
)
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import DESCRIPTIVE
from parallel_cal.recordings.replicates import average_groups


@dataclass(frozen=True)
class LackOfFit:
    """p-values of similar neighbours (`moran`) and of too few changes of sign (`runs`), by the
    order of the samples; `map` describes the smooth part of the residuals, without a cause."""

    moran: dict[str, tuple[float, float]]
    runs: dict[str, float]
    map: SmoothMap

    @property
    def p_value(self) -> float:
        """The smallest p-value, corrected for the number of tests."""
        return bonferroni_minimum([p for _, p in self.moran.values()] + list(self.runs.values()))

    @property
    def has_structure(self) -> bool:
        return self.p_value < SIGNIFICANCE_LEVEL

    def document(self) -> dict[str, Any]:
        return {
            "p_value": self.p_value,
            "found": self.has_structure,
            "moran": {k: {"I": i, "p_value": p} for k, (i, p) in self.moran.items()},
            "runs": dict(self.runs),
            **self.map.document(),
        }


@dataclass(frozen=True)
class SmoothMap:
    """A smooth field fitted to the position (or orientation) residuals over the workspace.

    length (m or rad) over which it changes; size: rms of the smooth part (m or rad); share of the
    variance at held-out poses that it predicts; places (M, 3), field (M, 3).
    """

    kind: str
    length: float
    size: float
    share: float
    places: np.ndarray
    field: np.ndarray

    def __repr__(self) -> str:
        return f"SmoothMap({self.kind}, {len(self.places)} places, size {self.size:.3g})"

    def document(self) -> dict[str, Any]:
        drawn = self.share > 0
        return {
            "kind": self.kind,
            "length_scale": self.length if drawn else None,
            "size": self.size if drawn else 0.0,
            "share_predicted": self.share,
            "note": "describes the residuals that no effect explains; it is not a physical effect",
        }


def lack_of_fit(scene: Scene, field: Field) -> LackOfFit:
    """Tests over workspace and joint space, along time, every joint and every condition."""
    n, z = len(scene.model.joints), field.noise_units
    joints, places = scene.x[:, :n], scene.x[:, n : n + 3]
    group = scene.observations.group
    moran = {"joint space": morans_i(z, joints, group)}
    if (spread_out := find_varying_coordinates(scene)[n:]).any():
        moran["workspace"] = morans_i(z, places[:, spread_out], group)
    varied = z[:, np.any(z != 0, axis=0)]
    runs = {name: runs_test(varied[order]) for name, order in iterate_sample_orders(scene)}
    return LackOfFit(moran, runs, smooth_map(scene, field))


def iterate_sample_orders(scene: Scene) -> Iterator[tuple[str, np.ndarray]]:
    """Iterate over sample orders to test: by time, each joint, and each varying condition."""
    for name, values in regressors(scene):
        if not name.startswith("direction.") and len(np.unique(values)) > LEVELS:
            yield name, np.argsort(values, kind="stable")


def regressors(scene: Scene) -> Iterator[tuple[str, np.ndarray]]:
    """What residuals may depend on (N,), poses as predicted: time, joints, place, conditions."""
    if "time" in scene.dataset.conditions:  # the order of samples is none
        yield "time", np.asarray(scene.dataset.time)
    for k in np.flatnonzero(find_varying_coordinates(scene)):
        yield [*scene.model.joints, *"xyz"][k], scene.x[:, k]
    for name, values in scene.dataset.conditions.items():
        varies = len(values) and np.isfinite(values).all() and np.ptp(values) > 0
        if varies and not name.startswith(DESCRIPTIVE):
            yield name, np.asarray(values)


def find_varying_coordinates(scene: Scene) -> np.ndarray:
    """Mask (nq + 3,) of the joints and x, y, z that vary by more than the residuals. Touches on a
    plate are all at one height, and the predicted height there is the residual again."""
    n, varied = len(scene.model.joints), np.ptp(scene.x[:, : len(scene.model.joints) + 3], axis=0)
    if np.isfinite(scene.length_residuals).any():
        scatter = np.nanstd(scene.length_residuals)
        varied[n:][scene.x[:, n : n + 3].std(axis=0) < MIN_VARIATION_RATIO * scatter] = 0.0
    return np.asarray(varied > 1e-9)


def smooth_map(scene: Scene, field: Field) -> SmoothMap:
    """Fit a Gaussian process with the length scale that predicts held-out poses best.

    f = K (K + s^2 I)^-1 e with K = exp(-d^2 / 2 l^2). Holding one pose out costs one division: e_i
    - f_-i = (A e)_i / A_ii with A = (K + s^2 I)^-1.
    """
    n = len(scene.model.joints)
    position, group = field.kind == "position", scene.observations.group
    e = average_groups(field.vectors, group)
    coordinates = scene.x[:, n : n + 3] if position else scene.x[:, :n]
    places = average_groups(coordinates, group)
    thinned = (
        np.unique(np.linspace(0, len(e) - 1, MAX_MAP_POSES).astype(int))
        if len(e) > MAX_MAP_POSES
        else ...
    )
    e, places = e[thinned], places[thinned]
    spread = np.maximum(places.std(axis=0), 1e-12)
    apart = np.sum(((places[:, None] - places[None]) / spread) ** 2, axis=2)
    fits = []
    for length, noise in product(LENGTHS, ROUGHNESS):
        K = np.exp(-apart / (2 * length**2))
        A = np.linalg.inv(K + noise * np.eye(len(K)))
        unseen = (A @ e) / np.diag(A)[:, None]
        share = 1 - float(np.sum(unseen**2)) / max(float(np.sum(e**2)), 1e-300)
        fits.append((share, length, K @ (A @ e)))
    best = max(fits, key=lambda fit: fit[0])
    share, length, smooth = best if e.any() else (0.0, *best[1:])
    metres = length * float(np.sqrt(np.mean(spread**2)))
    size = float(np.sqrt(np.mean(np.sum(smooth**2, axis=1))))
    kind = "position" if position else "orientation"
    return SmoothMap(kind, metres, size, max(share, 0.0), places, smooth)
