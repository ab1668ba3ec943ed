"""The effects of the catalogue as blocks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.base.errors import ModelError
from parallel_cal.causes.unknown_laws import LOG_PRIOR
from parallel_cal.identification.observations import conditions
from parallel_cal.model.effect import Effect, parse_part
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import list_plugins, load_effect
from parallel_cal.posterior.blocks import EFFECT, LOG_ODDS, Block
from parallel_cal.posterior.evidence import UNKNOWN, Choice, Evidence
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.posterior.search import NO_RIVAL, SCAN_LOSS, WeighedSetting
from parallel_cal.recordings.dataset import Dataset

MIN_SCANNED = 3  # values of a setting, to refine it between them
# Places, drivers and forms among which `discover` finds a law: what was found must pay for them.
FORMS = 24_000
# Shares of the distance of two scanned values: to which the best value between them is sought, and
# the last digit that it keeps.
REFINED_TO, KEPT_DIGITS = 1e-3, 1e-4
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
            plain = scene.model.with_effect(name)
        except ModelError:
            continue
        if plain.mechanism is not mechanism or find_missing_conditions(plain, scene.dataset):
            continue
        settings = scan_settings(scene, effect)
        if not settings:
            continue
        tried = len(settings)
        settings = [known[name]] if known.get(name) else settings
        each = _yield_columns(scene, plain, settings)
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
        usual = [root for root in roots for _ in settings]
        settings = len(roots) * settings
        if effect.alone and not known.get(name):
            patterns = [f"{name}.{one}" for one in effect.alone]
            own_names = np.array(stated.table.names)[new]
            apart = own[:, [any(fnmatchcase(n, one) for one in patterns) for n in own_names]]
            if apart.size:  # not each machine has them: a drum has no pitch that changes
                settings, tried, usual = [*settings, {}], tried + 1, [*usual, apart]
        prior = LOG_PRIOR - np.log(FORMS) if effect.found_in_data else LOG_ODDS
        block = Block.of(scene, name, EFFECT, prior, each, settings, tried, usual)
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
    wider = Scene.of(wide, scene.dataset, observations, free, scene.shared, scene.within)
    return wider, columns(wide, wider, new)


@dataclass(frozen=True)
class Scan:
    """The settings of one effect, weighed beside other causes: those that were scanned, as its
    block has them, of which `best` is the likeliest, and others between them."""

    scene: Scene
    beside: Evidence
    best: Choice

    @property
    def block(self) -> Block:
        return self.best.block

    @cached_property
    def _plain(self) -> tuple[Model, np.ndarray]:
        """The model with the effect, and its conditions."""
        plain = self.scene.model.with_effect(self.block.name)
        return plain, conditions(plain, self.scene.dataset)

    def at(self, values: Mapping[str, float]) -> Block:
        """The effect with one setting, and the usual sizes of the best."""
        (plain, a), block = self._plain, self.block
        root = block.usual[self.best.setting]
        own = [compute_effect_columns(self.scene, plain, values, a)]
        prior, tried = block.log_prior, block.tried
        more = Block.of(self.scene, block.name, EFFECT, prior, own, [values], tried, [root])
        return block if more is None else more

    def weigh(self, values: Mapping[str, float]) -> float:
        """The log posterior of the effect with one setting, at its likeliest size."""
        return float(self.beside.weigh(self.at(values).alone).max())

    def neighbours(self, setting: Mapping[str, float], key: str) -> list[float]:
        """The scanned values of one number, with all others as the setting has them, in order;
        none if they are too few to look between them."""
        others = setting.items() - {(key, setting[key])}
        values = sorted({one[key] for one in self.block.settings if others <= one.items() and one})
        return values if len(values) >= MIN_SCANNED else []

    def find_best(
        self, key: str, scanned: Sequence[float], start: Mapping[str, float]
    ) -> tuple[float, dict[str, float]]:
        """The log posterior at the best value of one number between the scanned ones on both sides
        of its start, and the setting with it."""
        from scipy.optimize import minimize_scalar

        low, high = find_bracket(scanned, start[key])
        optimum = minimize_scalar(
            lambda value: -self.weigh({**start, key: value}),
            bounds=(low, high),
            method="bounded",
            options={"xatol": REFINED_TO * (high - low)},
        )
        # Further digits are not known, and a person copies the number.
        decimals = -int(np.floor(np.log10(KEPT_DIGITS * (high - low))))
        found = {**start, key: min(max(round(float(optimum.x), decimals), low), high)}
        after, before = self.weigh(found), self.weigh(start)
        return (after, found) if after > before else (before, dict(start))

    def is_peak_at_multiple(self, setting: Mapping[str, float], other: Mapping[str, float]) -> bool:
        """Whether another setting is the peak that `refine` finds at a multiple of a setting."""
        return any(
            low <= other[key] <= high
            for multiple in load_effect(self.block.name).multiples(setting)
            for key, value in multiple.items()
            for low, high in [find_bracket(self.neighbours(self.block.settings[0], key), value)]
        )

    def has_likelier_neighbour(self, log_p: Callable[[Mapping[str, float]], float]) -> bool:
        """Whether one of the next scanned values of a number is likelier than the best setting."""
        setting = self.block.settings[self.best.setting]
        for key, scanned in self.list_refined(setting).items():
            near = find_bracket(scanned, setting[key])
            if any(log_p({**setting, key: value}) > log_p(setting) for value in near):
                return True
        return False

    def list_refined(self, setting: Mapping[str, float]) -> dict[str, list[float]]:
        """The continuous numbers of a scanned setting, with their scanned values."""
        if not load_effect(self.block.name).refines:
            return {}
        near = {key: self.neighbours(setting, key) for key in setting}
        return {key: scanned for key, scanned in near.items() if scanned}

    def refine(self) -> Choice:
        """The best choice with its continuous numbers refined between their scanned neighbours,
        each in turn, where the posterior is highest."""
        scanned_setting = self.block.settings[self.best.setting]
        effect, setting = load_effect(self.block.name), dict(scanned_setting)
        for key, scanned in self.list_refined(scanned_setting).items():
            starts = (setting, *({**setting, **one} for one in effect.multiples(setting)))
            peaks = [self.find_best(key, scanned, start) for start in starts]
            most = max(value for value, _ in peaks)
            # The last of those that fit as well as the best.
            setting = [found for value, found in peaks if value > most - EQUAL_EVIDENCE][-1]
        if setting == scanned_setting:
            return self.best
        more = self.at(setting)
        return Choice(more, 0, int(np.argmax(self.beside.weigh(more.alone)[0])))

    def weigh_peak(
        self, start: Mapping[str, float]
    ) -> tuple[float, Mapping[str, float], Mapping[str, float]]:
        """The log posterior of the peak about a setting, its height times its width, and the
        setting there with its standard deviations."""
        setting = dict(start)
        refined = self.list_refined(self.block.settings[self.best.setting])
        for key, scanned in refined.items():
            _, setting = self.find_best(key, scanned, setting)
        sigma, widest = self.compute_sigma(setting), {k: np.ptp(v) for k, v in refined.items()}
        width = sum(np.log(sigma.get(key, widest[key])) for key in refined)
        height = np.logaddexp.reduce(self.beside.weigh(self.at(setting).alone), axis=None)
        return float(height + width), setting, sigma

    def compute_sigma(self, refined: Mapping[str, float]) -> dict[str, float]:
        """The standard deviation of each number that was refined from the best scanned setting: one
        of them away, the logarithm of the posterior is lower by a half."""
        sigma = {}
        for key, scanned in self.list_refined(self.block.settings[self.best.setting]).items():
            step = float(np.diff(scanned).min()) / 20
            near = [self.weigh({**refined, key: refined[key] + away}) for away in (-step, 0, step)]
            bend = float(2 * near[1] - near[0] - near[2]) / step**2
            if bend > 0:
                sigma[key] = bend**-0.5
        return sigma


def find_bracket(scanned: Sequence[float], value: float) -> tuple[float, float]:
    """The scanned values on both sides of the one that is next to a value."""
    at = int(np.argmin(np.abs(np.array(scanned) - value)))
    return scanned[max(at - 1, 0)], scanned[min(at + 1, len(scanned) - 1)]


def weigh_settings(scene: Scene, beside: Evidence, block: Block) -> list[WeighedSetting]:
    """The settings of an effect beside other causes, the likeliest first: of numbers that are
    refined, one for each peak of the posterior."""
    weights = beside.weigh(block.alone)
    log_p = np.logaddexp.reduce(weights, axis=1)
    keys = [frozenset(one.items()) for one in block.settings]
    likeliest = {keys[i]: int(i) for i in np.argsort(log_p) if keys[i]}
    # How high the peak may be of which a setting shows the rest.
    highest = log_p + SCAN_LOSS / (1 - SCAN_LOSS) * np.maximum(log_p - beside.log_p, 0.0)
    scans = {
        i: Scan(scene, beside, Choice(block, i, int(np.argmax(weights[i]))))
        for i in likeliest.values()
    }
    top = max(scans, key=log_p.__getitem__)
    best = scans[top]
    peaks = [
        scan.weigh_peak(block.settings[i])
        for i, scan in scans.items()
        if highest[i] > log_p[top] - NO_RIVAL
        and not scan.has_likelier_neighbour(
            lambda setting: log_p[likeliest[frozenset(setting.items())]]
        )
    ]
    for _, setting, _ in tuple(peaks):
        for multiple in load_effect(block.name).multiples(setting):
            if not any(best.is_peak_at_multiple(setting, other) for _, other, _ in peaks):
                peaks.append(best.weigh_peak({**setting, **multiple}))
    # Where a multiple fits as well, take the multiple.
    doubted = [
        any(
            other > own - EQUAL_EVIDENCE and best.is_peak_at_multiple(setting, multiple)
            for other, multiple, _ in peaks
        )
        for own, setting, _ in peaks
    ]
    found = np.array([weight for weight, *_ in peaks]) - EQUAL_EVIDENCE * np.array(doubted)
    p = np.exp(found - np.logaddexp.reduce(found))
    return [WeighedSetting(peaks[i][1], float(p[i]), peaks[i][2]) for i in np.argsort(-p)]


def refine_setting(scene: Scene, beside: Evidence, best: Choice) -> Choice:
    """The choice of an effect with its continuous settings refined; of another cause, itself."""
    if best.block.kind != EFFECT or not best.block.settings[best.setting]:
        return best
    return Scan(scene, beside, best).refine()


def scan_settings(scene: Scene, effect: Effect) -> list[Mapping[str, float]]:
    """The settings of an effect that its `scan` proposes, rounded where a number is continuous, but
    not beyond the ends of the scan: these may be physical bounds."""
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

    return [{key: shorten(key, value) for key, value in one.items()} for one in found]


def choose_setting(
    scene: Scene, name: str, settings: Sequence[Mapping[str, float]]
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """The likeliest of the scanned settings of an effect beside no other cause, refined if the
    effect is likelier than none, with the standard deviations of the refined numbers."""
    plain = scene.model.with_effect(name)
    each = _yield_columns(scene, plain, settings)
    block = Block.of(scene, name, EFFECT, LOG_ODDS, each, settings)
    if block is None:  # the geometry imitates it
        return settings[0], {}
    nothing = Evidence(float(scene.residual @ scene.residual), scene.dof, UNKNOWN)
    [ranked] = nothing.rank(block.alone)
    if ranked.log_p <= nothing.log_p:
        return settings[ranked.best.setting], {}
    scan = Scan(scene, nothing, ranked.best)
    best = scan.refine()
    refined = best.block.settings[best.setting]
    return refined, scan.compute_sigma(refined)


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
    return [name for name in wanted if name not in has]


def compute_effect_columns(
    scene: Scene, plain: Model, settings: Mapping[str, float], a: np.ndarray, share: bool = False
) -> np.ndarray:
    """Columns of a model's last effect with these settings, under the recorded conditions a (N,
    n_conditions); see `columns` for `share`."""
    extended = plain.with_settings(plain.effects[-1].name, settings)
    return columns(extended, scene, find_new_parameters(scene.model, extended), a, share)


def _yield_columns(
    scene: Scene, plain: Model, settings: Iterable[Mapping[str, float]]
) -> Iterator[np.ndarray]:
    """Yield the columns of a model's last effect with each of these settings."""
    a = conditions(plain, scene.dataset)
    return (compute_effect_columns(scene, plain, one, a, True) for one in settings)


def find_new_parameters(before: Model, after: Model) -> np.ndarray:
    """Mask of the free parameters that `after` has and `before` has not, or holds fixed."""
    old = {n for n, fixed in zip(before.table.names, before.fixed, strict=True) if not fixed}
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
