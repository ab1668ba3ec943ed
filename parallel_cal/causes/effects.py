"""The effects of the catalogue as blocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.causes.unknown_laws import LOG_PRIOR
from parallel_cal.identification.observations import conditions
from parallel_cal.model.effect import parse_part
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import list_plugins, load_effect
from parallel_cal.posterior.blocks import EFFECT, LOG_ODDS, Block
from parallel_cal.posterior.evidence import Choice, Evidence
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.recordings.dataset import Dataset

MIN_SCANNED = 3  # values of a setting, to refine it between them
# Places, drivers and forms among which `discover` finds a law: what was found must pay for them.
FORMS = 24_000
EQUAL_EVIDENCE = 4.5  # of the logarithm, three sigmas: two settings fit as well


def list_effect_blocks(
    scene: Scene, names: Sequence[str], known: Mapping[str, Mapping[str, float]]
) -> list[Block]:
    """One block for each effect that the samples can show, with the settings that it scans, or
    those that are known."""
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
        tried = len(settings)
        settings = [known[name]] if known.get(name) else settings
        a = conditions(plain, scene.dataset)
        each = [compute_effect_columns(scene, plain, one, a, True) for one in settings]
        prior = LOG_PRIOR - np.log(FORMS) if effect.found_in_data else LOG_ODDS
        block = Block.of(scene, name, EFFECT, prior, each, settings, tried)
        if block is not None:
            found.append(block)
    return found


def widen(scene: Scene, names: Iterable[str]) -> tuple[Scene, list[Block]]:
    """The scene on the rows of a larger mechanism with the block of its further parameters, if one
    of the effects is a larger mechanism; else the same scene and no block."""
    for name in names:
        effect = load_effect(name)
        if not effect.widens or effect.applies(scene.model.mechanism):
            continue
        wider, further = widen_scene(scene, scene.model.with_effect(name))
        block = Block.of(wider, name, EFFECT, LOG_ODDS, [further])
        return wider, [] if block is None else [block]
    return scene, []


def widen_scene(scene: Scene, wide: Model) -> tuple[Scene, np.ndarray]:
    """The scene of a larger mechanism, on the rows of its own closure, with the columns (n, k) of
    its further parameters."""
    new = find_new_parameters(scene.model, wide)
    observations = replace(scene.observations, a=conditions(wide, scene.dataset))
    free = ~np.asarray(wide.fixed) & ~new
    wider = Scene.of(wide, scene.dataset, observations, free, scene.shared)
    return wider, columns(wide, wider, new)


def refine_setting(scene: Scene, beside: Evidence, best: Choice) -> Choice:
    """The choice of an effect with its continuous settings refined between their scanned
    neighbours, each in turn, where the evidence is highest."""
    from scipy.optimize import minimize_scalar

    block = best.block
    if block.kind != EFFECT or not block.settings[best.setting]:
        return best
    effect = load_effect(block.name)
    if not effect.refines:
        return best
    plain = scene.model.with_effect(block.name)
    a, setting = conditions(plain, scene.dataset), dict(block.settings[best.setting])

    def refined(values: Mapping[str, float]) -> Block:
        own = [compute_effect_columns(scene, plain, values, a)]
        more = Block.of(scene, block.name, EFFECT, block.log_prior, own, [values], block.tried)
        return block if more is None else more

    def cost(values: Mapping[str, float]) -> float:
        return -float(beside.weigh(refined(values).alone).max())

    def find_best(key: str, start: Mapping[str, float]) -> dict[str, float]:
        """The best value of one number between the neighbours of its start in the scan."""
        at = int(np.argmin(np.abs(np.array(scanned) - start[key])))
        low, high = scanned[max(at - 1, 0)], scanned[min(at + 1, len(scanned) - 1)]
        optimum = minimize_scalar(
            lambda value: cost({**start, key: value}),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-3 * (high - low)},
        )
        found = {**start, key: float(optimum.x)}
        return found if optimum.fun < cost(start) else dict(start)

    for key in setting:
        others = setting.items() - {(key, setting[key])}
        scanned = sorted({one[key] for one in block.settings if others <= one.items()})
        if len(scanned) < MIN_SCANNED:
            continue
        starts = (setting, *({**setting, **one} for one in effect.multiples(setting)))
        peaks = [(cost(peak), peak) for peak in (find_best(key, start) for start in starts)]
        least = min(peaks, key=lambda one: one[0])[0]
        # The last of those that fit as well as the best.
        setting = [peak for value, peak in peaks if value < least + EQUAL_EVIDENCE][-1]
    if setting == block.settings[best.setting]:
        return best
    more = refined(setting)
    return Choice(more, 0, int(np.argmax(beside.weigh(more.alone)[0])))


def list_effects_to_test(
    model: Model, also: Iterable[str] = (), only: Iterable[str] = ()
) -> list[str]:
    """Effects to test: the shelf's, or `only` these, and a user's own by Python path (`also`).

    ModelError for one of the user's own whose file is wrong: asked for, it is not left out.
    """
    own, has = list(also), {effect.name for effect in model.effects}
    for name in own:
        if name not in has and not load_effect(name).applies(model.mechanism):
            model.with_effect(name)
    wanted = dict.fromkeys([*(list(only) or list_plugins("effects")), *own])
    return [name for name in wanted if name not in has]


def compute_effect_columns(
    scene: Scene, plain: Model, settings: Mapping[str, float], a: np.ndarray, share: bool = False
) -> np.ndarray:
    """Columns of a model's last effect with these settings, under the recorded conditions a (N,
    n_conditions); see `columns` for `share`."""
    extended = plain.with_settings(plain.effects[-1].name, settings)
    return columns(extended, scene, find_new_parameters(scene.model, extended), a, share)


def find_new_parameters(before: Model, after: Model) -> np.ndarray:
    """Mask of the free parameters that `after` has and `before` has not, or holds fixed."""
    old = {n for n, fixed in zip(before.table.names, before.fixed, strict=True) if not fixed}
    return np.array([n not in old for n in after.table.names]) & ~np.asarray(after.fixed)


def find_missing_conditions(model: Model, dataset: Dataset) -> tuple[str, ...]:
    """Conditions, without their joints, that a model needs and the data lack."""
    lacking = (c for c in model.conditions if c not in dataset.conditions)
    return tuple(dict.fromkeys(c if parse_part(c) else c.split(".")[0] for c in lacking))


def collect_recorded_values(dataset: Dataset) -> dict[str, np.ndarray]:
    """Conditions and joint readings by name, (N,) each."""
    return {**dataset.conditions, **dict(zip(dataset.joint_names, dataset.q.T, strict=True))}
