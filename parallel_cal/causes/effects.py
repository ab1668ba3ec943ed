"""The effects of the catalogue as blocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.diagnosis.catalogue import (
    collect_recorded_values,
    compute_effect_columns,
    find_missing_conditions,
)
from parallel_cal.identification.observations import conditions
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import EFFECT, Block
from parallel_cal.posterior.evidence import Choice, Evidence
from parallel_cal.posterior.scene import Scene

LOG_PRIOR = np.log(1 / 30)
MIN_SCANNED = 3  # values of a setting, to refine it between them


def list_effect_blocks(scene: Scene, names: Iterable[str]) -> list[Block]:
    """One block for each effect that the samples can show, with the settings that it scans."""
    found = []
    for name in names:
        effect, mechanism = load_effect(name), scene.model.mechanism
        if effect.applies(mechanism) or effect.widens:
            continue
        if effect.of_device and not effect.reads and not scene.shows_pose:
            continue
        try:
            plain = scene.model.with_effect(name)
        except ModelError:
            continue
        if plain.mechanism is not mechanism or find_missing_conditions(plain, scene.dataset):
            continue
        settings = list(effect.scan(mechanism, collect_recorded_values(scene.dataset)))
        if not settings:
            continue
        a = conditions(plain, scene.dataset)
        columns = [compute_effect_columns(scene, plain, one, a, True) for one in settings]
        block = Block.of(scene, name, EFFECT, LOG_PRIOR, columns, settings)
        if block is not None:
            found.append(block)
    return found


def refine_setting(scene: Scene, beside: Evidence, best: Choice) -> Choice:
    """The choice of an effect with its continuous settings refined between their scanned
    neighbours, each in turn, where the evidence is highest."""
    from scipy.optimize import minimize_scalar

    block = best.block
    if block.kind != EFFECT or not load_effect(block.name).refines:
        return best
    plain = scene.model.with_effect(block.name)
    a, setting = conditions(plain, scene.dataset), dict(block.settings[best.setting])

    def refined(values: Mapping[str, float]) -> Block:
        columns = compute_effect_columns(scene, plain, values, a)
        return block.with_setting(scene, columns, values)

    def cost(values: Mapping[str, float]) -> float:
        one = refined(values)
        return -float(beside.at_setting(one, len(one.settings) - 1).max())

    for key in setting:
        others = setting.items() - {(key, setting[key])}
        scanned = sorted({one[key] for one in block.settings if others <= one.items()})
        if len(scanned) < MIN_SCANNED:
            continue
        at = int(np.argmin(np.abs(np.array(scanned) - setting[key])))
        low, high = scanned[max(at - 1, 0)], scanned[min(at + 1, len(scanned) - 1)]
        optimum = minimize_scalar(
            lambda value, key=key: cost({**setting, key: value}),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-3 * (high - low)},
        )
        if optimum.fun < cost(setting):
            setting[key] = float(optimum.x)
    if setting == block.settings[best.setting]:
        return best
    more = refined(setting)
    last = len(more.settings) - 1
    return Choice(more, last, int(np.argmax(beside.at_setting(more, last))))
