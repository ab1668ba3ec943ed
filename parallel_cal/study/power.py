"""Determine which effects, of which size, a session would find: by prediction and simulation."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import append_lines, json_lines, open_locked
from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.causes.effects import list_effect_blocks, list_effects_to_test, widen
from parallel_cal.diagnosis.catalogue import Candidate, candidate
from parallel_cal.diagnosis.thresholds import CREDIBLE
from parallel_cal.fleet.cluster import (
    KILLED_WORKER_REASON,
    check_extra_installed,
    cluster,
    run_each,
)
from parallel_cal.fleet.jobs import FleetError
from parallel_cal.identification.fit import fit
from parallel_cal.posterior.blocks import Block
from parallel_cal.posterior.evidence import STATED, Evidence
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.study.session import (
    PlantedEffect,
    Question,
    diagnose_session,
    plant_effect,
    simulate_session,
)
from parallel_cal.study.tolerance import model_of

Row = dict[str, Any]  # the JSON document of a session, by `diagnose_session`
HALF, MOSTLY = 0.5, 0.9
SIZE_RATIO = 2**0.5  # of a size to the next smaller one
MAX_SIZE = 5.0  # tolerances rms: larger sizes are not tried
MIN_SIZE_RATIO = 1 / 8  # of the predicted size: smaller sizes are not tried
DRAWS = 40  # of an effect's coefficients and of noise, for the prediction
LOG_SIZES, LOG_SIZE_STEP = (-8.0, 8.0), 0.01  # among which a predicted size is found
CLEAN_RATIO = 2  # sessions without any effect, per session with an effect of one size
MAX_SESSIONS_BYTES = 64 << 20  # a larger file of finished sessions is not read


@dataclass(frozen=True)
class SizeResult:
    """The sessions with an effect of one size.

    `found` is how many name the effect, or an effect that it cannot be distinguished from. `called`
    counts the effects that the others name. `error` is the rms change of the measured poses by the
    effect (m or rad)."""

    size: float
    sessions: int
    found: int
    called: Mapping[str, int]
    error: float

    @property
    def share(self) -> float:
        return self.found / self.sessions


@dataclass(frozen=True)
class Detectable:
    """The sizes of an effect (rms of its coefficients, in tolerances) that sessions detect.

    `predicted` are the sizes that the evidence of a diagnosis should show in 50 % and 90 % of
    sessions, `tried` the results of simulated sessions. `reason` says why the effect cannot be
    detected; `applies` is False if the robot's model cannot have it. `number` is one of its
    coefficients, with unit and tolerance."""

    effect: str
    reason: str = ""
    number: str = ""
    unit: str = "1"
    tolerance: float = 0.0
    predicted: tuple[float, float] = (np.nan, np.nan)
    tried: tuple[SizeResult, ...] = ()
    applies: bool = True

    def smallest(self, share: float) -> SizeResult | None:
        """Return the smallest size that at least this share of sessions finds, if they find all
        larger sizes as well."""
        good = None
        for one in reversed(self.tried):
            if one.share < share:
                break
            good = one
        return good

    @property
    def error_by_size(self) -> float:
        """The rms change of the measured poses per tolerance of size (m or rad)."""
        return (
            float(np.mean([one.error / one.size for one in self.tried])) if self.tried else np.nan
        )

    def document(self) -> dict[str, Any]:
        half, mostly = (self.smallest(share) for share in (HALF, MOSTLY))
        return {
            "effect": self.effect,
            "reason": self.reason,
            "number": self.number,
            "unit": self.unit,
            "tolerance": self.tolerance,
            "predicted": {"in_50": self.predicted[0], "in_90": self.predicted[1]},
            "found_in_50": half and half.size,
            "found_in_90": mostly and mostly.size,
            "error_by_size": self.error_by_size,
            "tried": [vars(one) for one in self.tried],
        }


@dataclass(frozen=True)
class Power:
    """The effects that sessions at these poses find, sorted by the smallest detectable pose error;
    the false alarms of sessions without any effect."""

    question: Question
    effects: tuple[Detectable, ...]
    clean: int
    false_alarms: Mapping[str, int]
    failed: tuple[Row, ...] = ()

    @property
    def sessions(self) -> int:
        """The number of diagnosed sessions."""
        return self.clean + sum(size.sessions for one in self.effects for size in one.tried)

    @property
    def kind(self) -> str:
        """The kind of the errors: position, if it is measured."""
        return "position" if self.question.planned.measured[:, :3].any() else "orientation"

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal study power`; SI, sizes in tolerances."""
        model = model_of(self.question.model)
        return {
            "mechanism": model.mechanism.name,
            "poses": len(self.question.planned),
            "noise": vars(model.noise),
            "seed": self.question.seed,
            "error_kind": self.kind,
            "effects": [one.document() for one in self.effects],
            "sessions": self.sessions,
            "clean_sessions": self.clean,
            "false_alarms": dict(self.false_alarms),
            "failed": [
                {k: row[k] for k in ("effect", "size", "number", "reason")} for row in self.failed
            ],
        }


def power(
    question: Question,
    effects: Sequence[str] = (),
    sessions: int = 10,
    *,
    folder: Path,
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Power:
    """Determine which `effects` of the catalogue (empty: all, and the user's own) sessions find.

    Sizes are tried upwards from the predicted one until 90 % of the sessions find the effect, and
    downwards until fewer than half do, by factors of SIZE_RATIO. Sessions stored in `folder` are
    not simulated again. Raises FleetError if the study cannot start or continue.
    """
    check_extra_installed()
    report = progress or ignore_progress
    own = PlantedEffect("", 0.0, 0)
    with single_threaded():
        base = fit(model_of(question.model), simulate_session(question, own)[0], question.options)
        scene = Scene.of(base.model, base.dataset, base.observations, base.free, within=base.prior)
        names = list_effects_to_test(model_of(question.model), question.also)
        names = [name for name in names if not base.model.has_effect(name)]
        if unknown := [name for name in effects if name not in names]:
            raise ModelError(
                f"effect '{unknown[0]}' does not exist, or the model already has it; "
                f"available effects: {', '.join(names)}"
            )
        catalogue = [candidate(scene, name) for name in names]
        wanted = effects or names
        all_of = [predict_detectability(question, one) for one in catalogue if one.name in wanted]
    clean = [PlantedEffect("", 0.0, k) for k in range(CLEAN_RATIO * sessions)]
    needed = dict.fromkeys(clean)
    with _Sessions(folder, question) as store, cluster(scheduler, workers) as client:
        while True:
            left = [one for one in needed if one not in store.rows]
            report("sessions", 1 - len(left) / len(needed))
            for done, (k, row) in enumerate(
                run_each(client, diagnose_session, [(question, o) for o in left])
            ):
                if row is None:
                    raise FleetError(
                        f"a session with {left[k].effect or 'nothing'}: {KILLED_WORKER_REASON}"
                    )
                store.keep(row)
                report("sessions", 1 - (len(left) - done - 1) / len(needed))
            rows = [store.rows[one] for one in needed]
            tried = {one.effect: _summarise_sizes(one.effect, rows) for one in all_of}
            more = [
                PlantedEffect(one.effect, size, k)
                for one in all_of
                if not one.reason
                for size in next_sizes(one.predicted[1], tried[one.effect])
                for k in range(sessions)
            ]
            if not more:
                break
            needed |= dict.fromkeys(more)
    found = [replace(one, tried=tried[one.effect]) for one in all_of]
    found.sort(key=lambda one: 0.0 if one.reason else -1 / (one.predicted[1] * one.error_by_size))
    false = Counter(name for row in rows if not row["effect"] for name in row["effects"])
    failed = tuple(row for row in rows if row["reason"])
    return Power(question, tuple(found), len(clean), false, failed)


def next_sizes(first: float, tried: Sequence[SizeResult]) -> list[float]:
    """Return the sizes to try next: the predicted one first, then a larger one, a smaller one, or
    both, as long as the sizes tried do not suffice."""
    first = min(first, MAX_SIZE)
    if not tried:
        return [_rounded(first)]
    low, high = tried[0], tried[-1]
    sizes = [_rounded(high.size * SIZE_RATIO)] if high.share < MOSTLY else []
    sizes += [_rounded(low.size / SIZE_RATIO)] if low.share >= HALF else []
    return [size for size in sizes if MIN_SIZE_RATIO * first <= size <= MAX_SIZE * SIZE_RATIO]


def _rounded(size: float) -> float:
    return float(f"{size:.3g}")


def _summarise_sizes(effect: str, rows: Sequence[Row]) -> tuple[SizeResult, ...]:
    """Summarise the sessions with an effect by size."""
    by_size: dict[float, list[Row]] = {}
    for row in rows:
        if row["effect"] == effect:
            by_size.setdefault(row["size"], []).append(row)
    results = []
    for size, some in sorted(by_size.items()):
        found = sum(_is_found(row) for row in some)
        called = Counter(name for row in some if not _is_found(row) for name in row["effects"])
        errors = [row["error"] for row in some if row["error"] is not None]
        rms = float(np.sqrt(np.mean(np.square(errors)))) if errors else np.nan
        results.append(SizeResult(size, len(some), found, called, rms))
    return tuple(results)


def _is_found(row: Row) -> bool:
    """Whether a session names its effect, or one that cannot be distinguished from it."""
    named = row["effects"]
    return any(row["effect"] in (name, *row["swaps"].get(name, ())) for name in named)


def predict_detectability(question: Question, one: Candidate) -> Detectable:
    """Predict the sizes at which 50 % and 90 % of sessions give CREDIBLE probability to an effect,
    as against no cause at all.

    For drawn coefficients e and noise z, the residual of size s is r = s (1 - B B^T) J e + z, with
    the geometry's B; s is the least for which the evidence of the effect is enough."""
    if not one.testable or one.scene is None:
        return Detectable(one.name, one.reason, applies=one.applies)
    model, (scene, blocks) = model_of(question.model), widen(one.scene, [one.name])
    [block] = blocks or list_effect_blocks(scene, [one.name], {})
    rng = np.random.default_rng([question.seed, DRAWS])
    sizes = np.empty(DRAWS)
    for k in range(DRAWS):
        planted = PlantedEffect(one.name, 1.0, k)
        has, new = plant_effect(model, planted, question.planned, planted.rng(question))
        # The columns are linearised about a model whose new coefficients are zero.
        without = has.with_values(np.where(new, has.table.nominal, has.values))
        J = scene.project_off_geometry(columns(without, scene, new))
        e = (has.values - has.table.nominal)[new] / has.table.tolerance[new]
        noise = scene.project_off_geometry(rng.standard_normal(len(scene.residual)))
        sizes[k] = _find_least_size(block, scene.dof, J @ e, noise)
    number = has.table[int(np.flatnonzero(new)[0])]
    half, mostly = np.quantile(sizes, [HALF, MOSTLY])
    return Detectable(
        one.name,
        "",
        number.name.removeprefix(f"{one.name}."),
        number.unit,
        float(number.tolerance),
        (float(half), float(mostly)),
    )


def _find_least_size(block: Block, dof: int, signal: np.ndarray, noise: np.ndarray) -> float:
    """The least size at which a signal (n,) in this noise is more likely than not this cause."""
    each = [block.at(i) for i in range(len(block.columns))]
    of_signal, of_noise = (np.array([r @ B for B in each]) for r in (signal, noise))

    def is_named(log_size: float) -> bool:
        size = np.exp(log_size)
        r = size * signal + noise
        nothing = Evidence(float(r @ r), dof, STATED)
        seen = replace(block, onto=size * of_signal + of_noise)
        [found] = nothing.rank(seen.alone)
        return found.log_p - nothing.log_p > np.log(CREDIBLE / (1 - CREDIBLE))

    low, high = LOG_SIZES
    while high - low > LOG_SIZE_STEP:
        middle = (low + high) / 2
        low, high = (low, middle) if is_named(middle) else (middle, high)
    return float(np.exp(high))


class _Sessions:
    """The sessions of a question that a folder stores, one per line of `sessions.jsonl`."""

    def __init__(self, folder: Path, question: Question):
        folder.mkdir(parents=True, exist_ok=True)
        path, self._inputs = folder / "sessions.jsonl", question.hash_inputs()
        file = open_locked(path)
        if file is None:
            raise FleetError(f"{folder}: another run is writing study results there")
        self._file, self.rows = file, dict[PlantedEffect, Row]()
        for row in json_lines(path, MAX_SESSIONS_BYTES):
            if row.get("inputs") == self._inputs:
                self._take(row)

    def __enter__(self) -> _Sessions:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def keep(self, row: Row) -> None:
        append_lines(self._file, [json.dumps(row, allow_nan=False)])
        self._take(row)

    def _take(self, row: Row) -> None:
        self.rows[PlantedEffect(row["effect"], row["size"], row["number"])] = row
