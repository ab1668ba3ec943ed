"""The region of the samples that a model was identified from. Beyond it a model may be wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.units import MM
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model

REGION_MARGIN = 0.1  # of a range: a model still holds so far outside it
MIN_REGION_MARGIN = 0.01  # of the largest range: for coordinates that hardly change
SHOWN = {"m": ("mm", 1 / MM), "rad": ("mrad", 1e3)}


@dataclass(frozen=True)
class IdentifiedRegion:
    """Ranges (low, high) of the samples of a fit, by name: controlled coordinates of the position
    (m), empty if the robot controls none, joints (rad or m), and the conditions on which laws that
    were found in data depend."""

    position: Mapping[str, tuple[float, float]]
    joints: Mapping[str, tuple[float, float]]
    joint_units: tuple[str, ...]
    conditions: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of_samples(
        cls, model: Model, joints: np.ndarray, position: np.ndarray, conditions: np.ndarray
    ) -> IdentifiedRegion:
        """The region of joint readings (N, nq), positions (N, 3), NaN if unknown, and the model's
        conditions (N, n_conditions)."""
        axes = [k for k in range(3) if POSE[k] in model.mechanism.controls]
        known = position[np.isfinite(position).all(axis=1)]
        return cls(
            {POSE[k]: _range(known[:, k]) for k in axes} if len(known) else {},
            {name: _range(joints[:, i]) for i, name in enumerate(model.joints)},
            tuple(model.mechanism.joint_units),
            {
                name: _range(conditions[:, model.conditions.index(name)])
                for name in list_law_conditions(model)
            },
        )

    @classmethod
    def of_model(cls, model: Model) -> IdentifiedRegion | None:
        """The region in which a model was identified: of its last fit of all parameters, and of the
        partial ones after it. None if its history states none."""
        found: IdentifiedRegion | None = None
        for entry in model.history:
            if not isinstance(region := entry.get("region"), Mapping):
                continue
            own = cls._read(region, model)
            found = own if found is None or "refit" not in entry else found._joined_with(own)
        return found

    @classmethod
    def _read(cls, region: Mapping[str, Any], model: Model) -> IdentifiedRegion:
        """Read a history entry; ranges that cannot be read are missing."""

        def ranges(key: str, names: tuple[str, ...]) -> dict[str, tuple[float, float]]:
            stated = region.get(key)
            pairs = stated if isinstance(stated, Mapping) else {}
            return {
                name: (float(pair[0]), float(pair[1]))
                for name in names
                if isinstance(pair := pairs.get(name), (list, tuple))
                and len(pair) == 2
                and all(isinstance(v, (int, float)) for v in pair)
            }

        units = tuple(model.mechanism.joint_units)
        laws = ranges("conditions", list_law_conditions(model))
        return cls(ranges("position", POSE[:3]), ranges("joints", model.joints), units, laws)

    def _joined_with(self, other: IdentifiedRegion) -> IdentifiedRegion:
        def joined(
            one: Mapping[str, tuple[float, float]], two: Mapping[str, tuple[float, float]]
        ) -> dict[str, tuple[float, float]]:
            both = ((name, one[name], two[name]) for name in one if name in two)
            return {name: (min(a[0], b[0]), max(a[1], b[1])) for name, a, b in both}

        position = joined(self.position, other.position)
        conditions = joined(self.conditions, other.conditions)
        return IdentifiedRegion(
            position, joined(self.joints, other.joints), self.joint_units, conditions
        )

    def document(self) -> dict[str, Any]:
        """Its entry in the history of a model, SI; six digits."""
        parts = {"position": self.position, "joints": self.joints, "conditions": self.conditions}
        return {
            key: {name: [float(f"{v:.6g}") for v in pair] for name, pair in part.items()}
            for key, part in parts.items()
            if part
        }

    @cached_property
    def _ranges(self) -> tuple[tuple[int, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Indices of the coordinates that decide (position, else joints), low, high and margin."""
        names = POSE[:3] if self.position else tuple(self.joints)
        part = self.position or self.joints
        low, high = np.array([part[name] for name in names if name in part]).reshape(-1, 2).T
        span = high - low
        margin = np.maximum(REGION_MARGIN * span, MIN_REGION_MARGIN * span.max(initial=0.0))
        return tuple(i for i, name in enumerate(names) if name in part), low, high, margin

    def compute_excess(self, joints: np.ndarray, position: np.ndarray) -> np.ndarray:
        """How far (N,) poses lie outside the region, in the unit of the coordinate that is furthest
        outside; 0 within the margin, and for an unknown pose."""
        which, low, high, margin = self._ranges
        values = np.atleast_2d(position if self.position else joints)[:, list(which)]
        away = np.maximum(np.maximum(low - values, values - high), 0.0)
        away = np.nan_to_num(np.where(away > margin, away, 0.0))
        return np.asarray(away.max(axis=1, initial=0.0))

    @property
    def description(self) -> str:
        """`x -60..60, y -60..60, z 140..260 mm`."""
        part = self.position or self.joints
        units = ["m"] * len(part) if self.position else self.joint_units
        words = []
        for unit in dict.fromkeys(units):
            name, factor = SHOWN.get(unit, (unit, 1.0))
            own = (
                f"{key} {factor * low:.0f}..{factor * high:.0f}"
                for (key, (low, high)), its in zip(part.items(), units, strict=True)
                if its == unit
            )
            words.append(f"{', '.join(own)} {name}")
        return ", ".join(words)

    def describe_excess(self, excess: np.ndarray, what: str = "poses") -> str:
        """Say how many of the poses are outside, and how far; empty if none is."""
        outside = int((excess > 0).sum())
        if not outside:
            return ""
        units = ["m"] if self.position else list(dict.fromkeys(self.joint_units))
        far = ""
        if len(units) == 1:
            name, factor = SHOWN.get(units[0], (units[0], 1.0))
            far = f", by up to {factor * excess.max():.3g} {name}"
        return (
            f"{outside} of {len(excess)} {what} are outside the region in which the model was "
            f"identified ({self.description}){far}: an effect that helps inside may be wrong there"
        )


def list_law_conditions(model: Model) -> tuple[str, ...]:
    """The conditions on which the model's laws that were found in data depend."""
    needed = (
        name
        for effect in model.effects
        if effect.found_in_data
        for name in effect.conditions(model.mechanism)
    )
    return tuple(dict.fromkeys(needed))


def describe_untested_conditions(
    model: Model, rows: np.ndarray, region: IdentifiedRegion | None = None
) -> str:
    """Say which conditions (N, n_conditions) are beyond those in which the model's laws that were
    found in data were tested; empty if none is. A law is proven nowhere else. The region is by
    default read from the model's history."""
    region = region or IdentifiedRegion.of_model(model)
    if region is None:
        return ""
    words = []
    for name, (low, high) in region.conditions.items():
        values = rows[:, model.conditions.index(name)]
        margin = REGION_MARGIN * (high - low)
        beyond = values[(values < low - margin) | (values > high + margin)]
        if len(beyond):
            unit = CONDITIONS[name.split(".")[0]][0]
            far = beyond[np.argmax(np.maximum(low - beyond, beyond - high))]
            words.append(f"{name} {far:.4g} (tested {low:.4g}..{high:.4g} {unit})")
    if not words:
        return ""
    laws = ", ".join(effect.name for effect in model.effects if effect.found_in_data)
    return (
        f"{', '.join(words)}: beyond the conditions in which {laws} was found in data; the law may "
        "be wrong there. State the conditions of use, or measure there and identify again"
    )


def describe_workspace_excess(model: Model, region: IdentifiedRegion | None = None) -> str:
    """Say how far the workspace exceeds a region, by default the one in which the model was
    identified. Empty if it does not, or if region or workspace have no positions."""
    region, mechanism = region or IdentifiedRegion.of_model(model), model.mechanism
    axes = [k for k, name in enumerate(POSE[:3]) if name in mechanism.controls]
    if region is None or not region.position or not axes:
        return ""
    sides = np.tile(np.array(mechanism.home.position, dtype=float), (2, 1))
    own = [mechanism.controls.index(POSE[k]) for k in axes]
    for row, box in enumerate((mechanism.workspace.low, mechanism.workspace.high)):
        sides[row, axes] = [box[i] for i in own]
    excess = region.compute_excess(np.zeros((2, 0)), sides)
    if not excess.any():
        return ""
    return (
        f"the workspace exceeds the region in which the model was identified "
        f"({region.description}) by up to {excess.max() / MM:.3g} mm: an effect that helps inside "
        "may be wrong there; measure there, too"
    )


def _range(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())
