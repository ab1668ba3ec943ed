"""The effects of the catalogue as blocks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.causes.unknown_laws import LOG_PRIOR
from parallel_cal.identification.observations import conditions
from parallel_cal.model.effect import Effect, parse_part
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import list_plugins, load_effect
from parallel_cal.posterior.blocks import EFFECT, LOG_ODDS, Block, OwnNumbers
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.recordings.dataset import Dataset

MIN_SCANNED = 3  # values of a setting, to refine it between them
# Places, drivers and forms among which `discover` finds a law: what was found must pay for them.
FORMS = 24_000
SPREAD = 0.01  # of equal parts that are alike, in usual sizes
DIGITS = 6  # of a scanned number, which a person copies


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
            plain = extend(scene.model, name)
        except ModelError:
            continue
        if plain.mechanism is not mechanism or find_missing_conditions(plain, scene.dataset):
            continue
        settings = scan_settings(scene, effect)
        if not settings:
            continue
        tried = scanned = len(settings)
        settings = [known[name]] if known.get(name) else settings
        each = yield_columns(scene, plain, settings)
        larger = [*effect.other_kinds(mechanism).values()]
        # Geometry that is fitted freely and plausible excludes a number that is grossly wrong.
        if effect.mistaken > 1 and scene.sizes is not None:
            larger.append(effect.mistaken)
        stated = plain.with_settings(name, settings[0])  # what is stated is no coefficient
        new = find_new_parameters(scene.model, stated)
        own = np.eye(new.sum())
        roots = [own, *(size * own for size in larger)]
        if effect.alike:
            roots.append(_share_among_parts(stated, new))
            tried *= 2
        # In one joint alone, as a law may be; a wave of any number would follow a dent there.
        joints = _find_own_columns(stated, new) if scanned == 1 else {}
        in_one = [own[:, columns] for columns in joints.values()]
        usual = [root for root in roots for _ in settings]
        settings = len(roots) * settings
        if effect.alone and not (known.get(name) or scene.model.has_effect(name)):
            patterns = [f"{name}.{one}" for one in effect.alone]
            own_names = np.array(stated.table.names)[new]
            apart = own[:, [any(fnmatchcase(n, one) for one in patterns) for n in own_names]]
            if apart.size:  # not each machine has them: a drum has no pitch that changes
                settings, tried, usual = [*settings, {}], tried + 1, [*usual, apart]
        prior = LOG_PRIOR - np.log(FORMS) if effect.found_in_data else LOG_ODDS
        numbers = list_own_numbers(stated, new, settings)
        usual, settings = [*usual, *in_one], [*settings, *len(in_one) * settings[:1]]
        given = prior, each, settings, tried, usual, numbers, len(in_one)
        block = Block.of(scene, name, EFFECT, *given)
        if block is not None:
            found.append(block)
    return found


def list_own_numbers(
    model: Model, new: np.ndarray, settings: Sequence[Mapping[str, float]]
) -> OwnNumbers | None:
    """The scanned number of a model's last effect that joints may have of their own, with the new
    parameters of each joint; None if there is none, or not more than one joint."""
    effect = model.effects[-1]
    if not effect.each or sum(effect.each in one for one in settings) < MIN_SCANNED:
        return None
    columns = _find_own_columns(model, new)
    return OwnNumbers(effect.each, columns) if columns else None


def _find_own_columns(model: Model, new: np.ndarray) -> dict[str, np.ndarray]:
    """Which of the new parameters of a model's last effect each joint has, for those that have
    any; none if not more than one joint has."""
    names = np.array(model.table.names)[new]
    start = f"{model.effects[-1].name}."
    columns = {
        joint: np.flatnonzero([name.startswith(f"{start}{joint}.") for name in names])
        for joint in model.mechanism.joints
    }
    columns = {joint: own for joint, own in columns.items() if own.size}
    return columns if len(columns) > 1 else {}


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
    wider = Scene.of(wide, scene.dataset, observations, free, scene.shared, scene.within)
    return wider, columns(wide, wider, new)


def scan_settings(scene: Scene, effect: Effect) -> list[Mapping[str, float]]:
    """The settings of an effect that its `scan` proposes, rounded where a number is continuous, but
    not beyond the ends of the scan: these may be physical bounds. Of an effect that the model has,
    those that one of its joints may have of its own; none if a prior knows its coefficients."""
    found = list(effect.scan(scene.model.mechanism, collect_recorded_values(scene.dataset)))
    if not effect.refines:
        return found
    each = defaultdict[str, list[float]](list)
    for one in found:
        for key, value in one.items():
            each[key].append(value)
    ends = {key: (min(values), max(values)) for key, values in each.items()}

    def shorten(key: str, value: float) -> float:
        low, high = ends[key]
        return min(max(float(f"{value:.{DIGITS}g}"), low), high)

    found = [{key: shorten(key, value) for key, value in one.items()} for one in found]
    if not scene.model.has_effect(effect.name):
        return found
    numbers = [one[effect.each] for one in found if effect.each in one and scene.within is None]
    joints = scene.model.collect_own_constants(effect)
    return [{f"{joint}.{effect.each}": number} for joint in joints for number in numbers]


def extend(model: Model, name: str) -> Model:
    """The model with an effect at its end, whose coefficients are zero. If the model has it, its
    joints keep their numbers, and one of them may be given its own."""
    if not model.has_effect(name):
        return model.with_effect(name)
    numbers = {
        one.removeprefix(f"{name}."): value
        for one, value, is_one in zip(
            model.table.names, model.values.tolist(), model.settings_of(name), strict=True
        )
        if is_one
    }
    return model.without_effect(name).with_effect(name).with_settings(name, numbers)


def list_effects_to_test(
    model: Model, also: Iterable[str] = (), only: Iterable[str] = ()
) -> list[str]:
    """Effects to test: the shelf's, or `only` these, and a user's own by Python path (`also`).

    ModelError for one of the user's own whose file is wrong, and if none of `only` applies.
    """
    own, asked, has = list(also), list(only), {effect.name for effect in model.effects}
    for name in own:
        if name not in has and not load_effect(name).applies(model.mechanism):
            model.with_effect(name)
    if asked and all(load_effect(name).applies(model.mechanism) for name in asked):
        model.with_effect(asked[0])
    wanted = dict.fromkeys([*(asked or list_plugins("effects")), *own])
    return [
        name for name in wanted if name not in has or model.collect_own_constants(load_effect(name))
    ]


def compute_effect_columns(
    scene: Scene,
    plain: Model,
    settings: Mapping[str, float],
    a: np.ndarray,
    share: bool = False,
    which: np.ndarray | slice = slice(None),
) -> np.ndarray:
    """Columns of a model's last effect with these settings, of all its new parameters or of
    `which`, under the recorded conditions a (N, n_conditions); see `columns` for `share`."""
    extended = plain.with_settings(plain.effects[-1].name, settings)
    some = np.zeros(len(extended.table), dtype=bool)
    some[np.flatnonzero(find_new_parameters(scene.model, extended))[which]] = True
    return columns(extended, scene, some, a, share)


def yield_columns(
    scene: Scene, plain: Model, settings: Iterable[Mapping[str, float]]
) -> Iterator[np.ndarray]:
    """Yield the columns of a model's last effect with each of these settings."""
    a = conditions(plain, scene.dataset)
    return (compute_effect_columns(scene, plain, one, a, True) for one in settings)


def find_new_parameters(before: Model, after: Model) -> np.ndarray:
    """Mask of the free parameters that `after` has and `before` has not, or holds fixed; and of
    those of a joint that has another number there in an effect of both."""
    free = {n for n, fixed in zip(before.table.names, before.fixed, strict=True) if not fixed}
    renewed = tuple(
        f"{effect.name}.{joint}."
        for effect in before.effects
        for joint, value in before.collect_own_constants(effect).items()
        if after.collect_own_constants(effect).get(joint, value) != value
    )
    old = {n for n in free if not n.startswith(renewed)}
    return np.array([n not in old for n in after.table.names]) & ~np.asarray(after.fixed)


def _share_among_parts(model: Model, new: np.ndarray) -> np.ndarray:
    """A root (k, k) of the covariance of the new parameters of a model's last effect, in usual
    sizes, where equal parts are alike in them."""
    effect = model.effects[-1]
    root = np.eye(new.sum())
    for pattern in effect.alike:
        same = np.flatnonzero(model.table.matching([f"{effect.name}.{pattern}"])[new])
        covariance = (1 - SPREAD**2) + SPREAD**2 * np.eye(len(same))
        root[np.ix_(same, same)] = np.linalg.cholesky(covariance)
    return root


def find_missing_conditions(model: Model, dataset: Dataset) -> tuple[str, ...]:
    """Conditions, without their joints, that a model needs and the data lack."""
    lacking = (c for c in model.conditions if c not in dataset.conditions)
    return tuple(dict.fromkeys(c if parse_part(c) else c.split(".")[0] for c in lacking))


def collect_recorded_values(dataset: Dataset) -> dict[str, np.ndarray]:
    """Conditions and joint readings by name, (N,) each."""
    return {**dataset.conditions, **dict(zip(dataset.joint_names, dataset.q.T, strict=True))}
