"""Simulate a session of a random robot, with or without an effect, and run the real diagnosis."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import Any
from zlib import crc32

import numpy as np

from parallel_cal import __version__
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.base.threads import single_threaded
from parallel_cal.causes.effects import collect_recorded_values, find_new_parameters
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.fleet.jobs import CASADI_LOCK, check_version, reason
from parallel_cal.identification.options import FitOptions
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import fingerprint
from parallel_cal.study.tolerance import draw_values, find_varying_parameters, model_of

FAILED: dict[str, Any] = {"error": None, "effects": [], "swaps": {}, "verdict": ""}


@dataclass(frozen=True)
class Question:
    """The inputs that all sessions share: the model file's text with its noise, the samples of an
    error-free session, the fit's options, the user's own effects to test, the seed."""

    model: str
    planned: Dataset
    options: FitOptions = field(default_factory=FitOptions)
    also: tuple[str, ...] = ()
    seed: int = 0
    version: str = __version__

    def hash_inputs(self) -> str:
        """Return the sha256 of everything that determines a session except the planted effect."""
        digest = hashlib.sha256(fingerprint(self.planned).encode())
        for name, column in sorted(self.planned.conditions.items()):
            digest.update(name.encode() + column.tobytes())
        digest.update(repr((self.model, self.options, self.also, self.seed, self.version)).encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class PlantedEffect:
    """An effect (empty: none) and its `size`, the rms of its coefficients in tolerances.

    `number` selects the random draw of robot, noise and coefficients, which does not depend on the
    size."""

    effect: str
    size: float
    number: int

    def rng(self, question: Question) -> np.random.Generator:
        return np.random.default_rng([question.seed, crc32(self.effect.encode()), self.number])


def plant_effect(
    model: Model, one: PlantedEffect, planned: Dataset, rng: np.random.Generator
) -> tuple[Model, np.ndarray]:
    """Add an effect to a model with random coefficients; return the model and the mask of its new
    coefficients. Unknown settings are drawn from those that the diagnosis would try."""
    settings = list(load_effect(one.effect).scan(model.mechanism, collect_recorded_values(planned)))
    extended = model.with_effect(one.effect, settings[rng.integers(len(settings))])
    new, table = find_new_parameters(model, extended), extended.table
    low, high = (np.array([getattr(p, side) for p in table])[new] for side in ("low", "high"))
    nominal, tolerance = table.nominal[new], table.tolerance[new]
    draw = rng.standard_normal(int(new.sum()))
    draw = np.where(low >= nominal, abs(draw), draw)
    draw *= one.size / np.sqrt(np.mean(draw**2))
    values = extended.values.copy()
    values[new] = np.clip(nominal + tolerance * draw, low, high)
    return extended.with_values(values), new


def simulate_session(question: Question, one: PlantedEffect) -> tuple[Dataset, float]:
    """Simulate a session; return its samples and the rms change of the measured poses by the effect
    (m; rad if no position is measured)."""
    model, planned, rng = model_of(question.model), question.planned, one.rng(question)
    geometry = find_varying_parameters(model) & ~model.fixed
    geometry &= np.array([p.group != "effect" for p in model.table])
    robot = model.with_values(draw_values(model.table, model.values, geometry, rng))
    has = plant_effect(robot, one, planned, rng)[0] if one.effect else robot
    q, shown = _solve_true_poses(has, robot, planned)
    without = Kinematics(robot).direct(q, planned.conditions)  # with the same joints
    change = shown.position - without.position
    if not planned.measured[:, :3].any():
        change = rotation_vector(shown.rotation @ without.rotation.transpose(0, 2, 1))
    rms = float(np.sqrt(np.nanmean(np.sum(change**2, axis=1))))
    noise, n = model.noise, len(planned)
    joint_sigma = model.joint_noise
    sigma = np.repeat([noise.position or 0.0, noise.orientation or 0.0], 3)
    error = sigma * rng.standard_normal((n, 6))
    kept = shown.solved
    dataset = Dataset.from_arrays(
        model.joints,
        (q + np.nan_to_num(joint_sigma) * rng.standard_normal(q.shape))[kept],
        (shown.position + error[:, :3])[kept],
        (rotation_matrix(error[:, 3:]) @ shown.rotation)[kept],
        measured=(planned.measured & (sigma > 0))[kept],
        pose_cov=np.diag(sigma**2),
        joint_sigma=None if np.isnan(joint_sigma).any() else joint_sigma,
        conditions={name: column[kept] for name, column in planned.conditions.items()},
        pose_id=planned.pose_id[kept],
        source=planned.source,
    )
    return replace(dataset, sha256=fingerprint(dataset)), rms


def _solve_true_poses(has: Model, robot: Model, planned: Dataset) -> tuple[np.ndarray, Solutions]:
    """Return a robot's joints, and the poses that a device without noise measures.

    The joints of a redundantly actuated robot (more closure equations than degrees of freedom)
    must be consistent, so they follow from the poses by inverse kinematics."""
    q, kinematics = planned.q, Kinematics(has)
    if has.structure.equations > len(has.mechanism.moves):
        pose = Kinematics(robot).direct(q)
        q = kinematics.inverse(pose.position, pose.rotation, planned.conditions).joints
    return q, kinematics.direct(q, planned.conditions)


def diagnose_session(question: Question, one: PlantedEffect) -> dict[str, Any]:
    """Simulate and diagnose a session; return the result as a JSON document with the `reason` of
    any failure.

    Raises FleetError if another version is requested than this worker has.
    """
    check_version(question.version)
    row = {"inputs": question.hash_inputs(), **vars(one)}
    with CASADI_LOCK, single_threaded():
        try:
            dataset, rms = simulate_session(question, one)
            found = diagnose(
                model_of(question.model), dataset, also=question.also, options=question.options
            )
        except Exception as error:
            return row | FAILED | {"reason": reason(error)}
    return to_json_value(
        row
        | {
            "error": rms,
            "effects": found.effects,
            "swaps": found.swaps,
            "verdict": found.verdict.word,
            "reason": "",
        }
    )
