"""The numbers of effects that are scanned, refined where the posterior is highest, and weighed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.causes.effects import (
    MIN_SCANNED,
    compute_effect_columns,
    extend,
    find_new_parameters,
    list_own_numbers,
    yield_columns,
)
from parallel_cal.identification.observations import conditions
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import EFFECT, LOG_ODDS, Block
from parallel_cal.posterior.evidence import SIZES, UNKNOWN, Choice, Evidence
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import NO_RIVAL, WeighedSetting

MAX_STEPS = 8
SMALL_GAIN = 1e-3  # of the logarithm: a number is sought no further for less
# Shares of the distance of two scanned values: over which a derivative is taken, and the last digit
# that the best value between them keeps.
DERIVED_OVER, KEPT_DIGITS = 1e-4, 1e-4


@dataclass(frozen=True)
class Fitted:
    """An effect with one setting as a `block` beside other causes, which are taken out, and its
    `columns` (n, p) with them."""

    columns: np.ndarray
    block: Block
    beside: Evidence

    @cached_property
    def log_p_by_size(self) -> np.ndarray:
        """The log posterior (sizes,), less that of the other causes."""
        return self.beside.weigh(self.block.alone)[0]

    @property
    def log_p(self) -> float:
        """The log posterior at the likeliest size, less that of the other causes."""
        return float(self.log_p_by_size.max())

    @cached_property
    def chosen(self) -> Evidence:
        """The evidence at the likeliest size."""
        likeliest = int(np.argmax(self.log_p_by_size))
        return replace(self.beside, chosen=(Choice(self.block, 0, likeliest),))

    @cached_property
    def covariance(self) -> np.ndarray:
        """The covariance (p, p) of the parameters of the effect after the measurement, in
        tolerances, if the variance of the noise is 1."""
        T, squares = self.block.turns[0], self.block.squares[0]
        size = SIZES[self.chosen.chosen[0].size]
        return np.asarray((T * (size**2 / (1 + size**2 * squares))) @ T.T)

    @cached_property
    def amplitudes(self) -> np.ndarray:
        """The parameters (p,) of the effect that are likeliest, in tolerances."""
        return np.asarray(self.covariance @ (self.block.columns[0].T @ self.block.residual))

    def step(
        self, V: np.ndarray, volume: np.ndarray, widths: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """The step of numbers to the peak beside the amplitudes, if a number changes the residual
        by a column of V (n, k) and half the logarithm of the determinant by `volume` (k,), and is
        known to its `widths` (k,); and by how much the log posterior grows."""
        noise, left = self.chosen.noise_variance, self.chosen.take_out(V)
        N = left.T @ left + noise * np.diag((2 / widths) ** 2)
        g = left.T @ self.chosen.take_out(self.block.residual) - noise * volume
        step = np.linalg.solve(N, g)
        return step, float(g @ step) / (2 * noise)


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
        plain = extend(self.scene.model, self.block.name)
        return plain, conditions(plain, self.scene.dataset)

    def at(self, values: Mapping[str, float]) -> Block:
        """The effect with one setting, and the usual sizes of the best."""
        columns = self._columns(values).astype(np.float32)
        more = self._make(self.scene.residual, columns, values)
        return self.block if more is None else replace(more, scanned=self.scanned)

    @property
    def scanned(self) -> Block:
        """The block of the settings that were scanned, in which joints do not differ."""
        return self.block.scanned or self.block

    def _make(
        self, residual: np.ndarray, columns: np.ndarray, values: Mapping[str, float]
    ) -> Block | None:
        """A block of the columns of one setting."""
        root = self.block.usual[self.best.setting]
        log_prior, tried = self.scanned.price(len(self.list_own(values)))
        given = self.block.name, EFFECT, log_prior, [values], tried
        return Block.of_projected(residual, [columns], [root], *given)

    def _columns(
        self, values: Mapping[str, float], which: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """The columns of these parameters of one setting that the geometry cannot imitate."""
        plain, a = self._plain
        made = compute_effect_columns(self.scene, plain, values, a, which=which)
        return self.scene.project_off_geometry(made)

    @cached_property
    def _outside(self) -> tuple[np.ndarray, Evidence]:
        """The residual without the other causes, and the evidence of one more beside them."""
        return self.beside.take_out(self.scene.residual), self.beside.outside

    def fit(self, values: Mapping[str, float]) -> Fitted | None:
        """The effect with one setting beside the other causes; None if these imitate it."""
        residual, alone = self._outside
        columns = self._columns(values)
        block = self._make(residual, self.beside.take_out(columns), values)
        return None if block is None else Fitted(columns, block, alone)

    def weigh(self, values: Mapping[str, float]) -> float:
        """The log posterior of the effect with one setting, at its likeliest size, less that of the
        other causes."""
        fitted = self.fit(values)
        return self._outside[1].log_p if fitted is None else fitted.log_p

    def neighbours(self, setting: Mapping[str, float], key: str) -> list[float]:
        """The scanned values of one number, with all others as the setting has them, in order;
        none if they are too few to look between them."""
        number, own = self.number_of(key), self.list_own(setting)
        others = {(k, v) for k, v in setting.items() if k != number and k not in own}
        if load_effect(self.block.name).is_of_one_joint(number):
            others = set()  # each joint is scanned alone
        alike = (one for one in self.scanned.settings if others <= one.items())
        values = sorted({one[number] for one in alike if number in one})
        return values if len(values) >= MIN_SCANNED else []

    def number_of(self, key: str) -> str:
        """The number that was scanned, of one that a joint may have of its own."""
        own = self.scanned.own
        return own.name if own and key.endswith(f".{own.name}") else key

    def list_own(self, setting: Mapping[str, float]) -> list[str]:
        """The numbers of a setting that joints have of their own."""
        return [key for key in setting if key != self.number_of(key)]

    def find_peak(
        self, start: Mapping[str, float], keys: Sequence[str], least: float = -np.inf
    ) -> tuple[float, dict[str, float]]:
        """The log posterior at the likeliest values of some numbers, each between the scanned ones
        on both sides of its start, and the setting with them; values that are not likely to reach
        the log posterior `least` are not sought further.

        The amplitudes are eliminated (variable projection: Golub & Pereyra, Inverse Problems 19,
        2003): a step of the numbers is that of Gauss and Newton beside all amplitudes.
        """
        brackets = [find_bracket(self.neighbours(start, key), start[key]) for key in keys]
        low, high = np.array(brackets).reshape(-1, 2).T
        first = self.fit(start)
        if first is None or not keys:
            return self.weigh(start), dict(start)
        now, setting = first, dict(start)
        for key, bracket in zip(keys, brackets, strict=True):  # there may be a peak on each side
            for end in bracket:
                other = {**setting, key: (start[key] + end) / 2}
                if likelier := self._fit_likelier(other, now):
                    now, setting = likelier, other
        for _ in range(MAX_STEPS):
            step, gain = self._step(now, setting, dict(zip(keys, high - low, strict=True)))
            if gain < SMALL_GAIN or now.log_p + gain < least:
                break
            at = np.array([setting[key] for key in keys])
            for shorter in (1.0, 0.5, 0.25, 0.125):
                tried = np.clip(at + shorter * step, low, high)
                other = {**setting, **dict(zip(keys, tried.tolist(), strict=True))}
                if likelier := self._fit_likelier(other, now):
                    break
            else:
                break
            now, setting = likelier, other
        found = dict(setting)
        for key, (lowest, highest) in zip(keys, brackets, strict=True):
            # Further digits are not known, and a person copies the number.
            decimals = -int(np.floor(np.log10(KEPT_DIGITS * (highest - lowest))))
            found[key] = min(max(round(setting[key], decimals), lowest), highest)
        after = first.log_p if found == start else self.weigh(found)
        return (after, found) if after > first.log_p else (first.log_p, dict(start))

    def _fit_likelier(self, values: Mapping[str, float], than: Fitted) -> Fitted | None:
        """The effect with one setting, if it is likelier than with another one."""
        fitted = self.fit(values)
        return fitted if fitted is not None and fitted.log_p > than.log_p else None

    def _step(
        self, now: Fitted, setting: Mapping[str, float], widths: Mapping[str, float]
    ) -> tuple[np.ndarray, float]:
        """The step of some numbers to the peak, and how much the log posterior gains by it, as far
        as the residual is linear in them; `widths` are those within which they are sought."""
        V, volume = np.empty((len(now.columns), len(widths))), np.empty(len(widths))
        by_column = self.beside.take_out(now.block.columns[0] @ now.covariance)
        for i, (key, width) in enumerate(widths.items()):
            mine, step = self._find_columns(key, setting), DERIVED_OVER * width
            more = self._columns({**setting, key: setting[key] + step}, mine)
            change = (more - now.columns[:, mine]) / step
            V[:, i], volume[i] = change @ now.amplitudes[mine], np.sum(by_column[:, mine] * change)
        return now.step(self.beside.take_out(V), volume, np.array([*widths.values()]))

    def _find_columns(self, key: str, setting: Mapping[str, float]) -> np.ndarray | slice:
        """The columns of a setting that change with one of its numbers."""
        own = self.scanned.own
        if own is None or self.number_of(key) != own.name:
            return slice(None)
        if key != own.name:
            return own.columns[key.removesuffix(f".{own.name}")]
        apart = self.list_own(setting)
        common = [own.columns[j] for j in own.columns if f"{j}.{own.name}" not in apart]
        return np.concatenate(common)

    def is_peak_at_multiple(self, setting: Mapping[str, float], other: Mapping[str, float]) -> bool:
        """Whether another setting is the peak that `refine` finds at a multiple of a setting."""
        return any(
            low <= other[key] <= high
            for multiple in load_effect(self.block.name).multiples(setting)
            for key, value in multiple.items()
            if key in other  # else it is the number of another joint
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
        """The best choice with its continuous numbers refined between their scanned neighbours, or
        near multiples of them, where the posterior is highest."""
        scanned_setting = self.block.settings[self.best.setting]
        effect, setting = load_effect(self.block.name), dict(scanned_setting)
        refined = [*self.list_refined(scanned_setting)]
        reached, near = self.find_peak(setting, refined)
        setting = near
        for key in refined:
            number = self.number_of(key)
            multiples = effect.multiples({**setting, number: setting[key]})
            starts = ({**setting, key: one[number]} for one in multiples)
            others = [self.find_peak(start, [key], reached - NO_RIVAL) for start in starts]
            peaks = [(reached, setting), *others]
            reached = max(value for value, _ in peaks)
            # The last of those that fit as well as the best.
            setting = [found for value, found in peaks if value > reached - EQUAL_EVIDENCE][-1]
        if setting != near:  # each was far from its peak beside the others as they were
            _, setting = self.find_peak(setting, refined)
        setting = self._share_numbers(setting)
        if setting == scanned_setting:
            return self.best
        more = self.at(setting)
        return Choice(more, 0, int(np.argmax(self.beside.weigh(more.alone)[0])))

    def _share_numbers(self, setting: dict[str, float]) -> dict[str, float]:
        """The setting with fewer numbers of single joints, as long as that is likelier: such a
        joint has the common one, or all others have its own."""
        while own := self.list_own(setting):
            rests = [{k: v for k, v in setting.items() if k != key} for key in own]
            rests += [
                {**rest, self.number_of(key): setting[key]}
                for key, rest in zip(own, tuple(rests), strict=True)
            ]
            likeliest = max(rests, key=self.weigh)
            if self.weigh(likeliest) <= self.weigh(setting):
                break
            setting = likeliest
        return setting

    def weigh_peak(
        self, start: Mapping[str, float]
    ) -> tuple[float, Mapping[str, float], Mapping[str, float]]:
        """The log posterior of the peak about a setting, its height times its width, and the
        setting there with its standard deviations."""
        setting = dict(start)
        refined = self.list_refined(start)
        _, setting = self.find_peak(setting, [*refined])
        sigma, widest = self.compute_sigma(setting), {k: np.ptp(v) for k, v in refined.items()}
        # Of the values that were scanned, so many share the evidence of one peak.
        width = sum(
            np.log(sigma.get(key, widest[key]) / np.diff(values).min())
            for key, values in refined.items()
        )
        fitted = self.fit(setting)
        height = np.logaddexp.reduce(fitted.log_p_by_size) if fitted else self._outside[1].log_p
        return float(height + width), setting, sigma

    def compute_sigma(self, refined: Mapping[str, float]) -> dict[str, float]:
        """The standard deviation of each number that was refined: one of them away, the logarithm
        of the posterior is lower by a half."""
        sigma = {}
        for key, scanned in self.list_refined(refined).items():
            step = float(np.diff(scanned).min()) / 20
            near = [self.weigh({**refined, key: refined[key] + away}) for away in (-step, 0, step)]
            bend = float(2 * near[1] - near[0] - near[2]) / step**2
            if bend > 0:
                sigma[key] = bend**-0.5
        return sigma


def refine_setting(scene: Scene, beside: Evidence, best: Choice) -> Choice:
    """The choice of an effect with its continuous settings refined; of another cause, itself."""
    if best.block.kind != EFFECT or not best.block.settings[best.setting]:
        return best
    return Scan(scene, beside, best).refine()


def renew(scene: Scene, block: Block, found: Choice) -> Block:
    """The block of a cause, with the numbers that were found about another scene."""
    if found.block.scanned is None:
        return block
    scan = Scan(scene, _beside_nothing(scene), Choice(block, 0, 1))
    return scan.at(found.block.settings[found.setting])


def _beside_nothing(scene: Scene) -> Evidence:
    return Evidence(float(scene.residual @ scene.residual), scene.dof, UNKNOWN)


def choose_setting(
    scene: Scene, name: str, settings: Sequence[Mapping[str, float]], apart: bool = False
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """The likeliest of the scanned settings of an effect beside no other cause, refined if the
    effect is likelier than none, with the standard deviations of the refined numbers. With `apart`,
    joints may have numbers of their own."""
    plain = extend(scene.model, name)
    each = yield_columns(scene, plain, settings)
    stated = plain.with_settings(name, settings[0])
    new = find_new_parameters(scene.model, stated)
    own = list_own_numbers(stated, new, settings) if apart else None
    block = Block.of(scene, name, EFFECT, LOG_ODDS, each, settings, own=own)
    if block is None:  # the geometry imitates it
        return settings[0], {}
    nothing = _beside_nothing(scene)
    [ranked] = nothing.rank(block.alone)
    if ranked.log_p <= nothing.log_p:
        return settings[ranked.best.setting], {}
    ranked = nothing.let_joints_differ(ranked)
    peaks = [Scan(scene, nothing, one).refine() for one in (ranked.best, *ranked.rivals)]
    best = max(peaks, key=lambda one: nothing.weigh(one.block.alone).max())
    refined = best.block.settings[best.setting]
    return refined, Scan(scene, nothing, best).compute_sigma(refined)


def weigh_settings(scene: Scene, beside: Evidence, found: Choice) -> list[WeighedSetting]:
    """The settings of an effect that was found beside other causes, the likeliest first: of numbers
    that are refined, one for each peak of the posterior."""
    block = found.block.scanned or found.block
    weights = beside.weigh(block.alone)
    log_p = np.logaddexp.reduce(weights, axis=1)
    keys = [frozenset(one.items()) for one in block.settings]
    likeliest = {keys[i]: int(i) for i in np.argsort(log_p) if keys[i]}
    # How high the peak may be of which a setting shows the rest.
    highest = [beside.highest(one) for one in log_p]
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
    if apart := _find_apart(scene, beside, found):
        peaks.append(Scan(scene, beside, apart).weigh_peak(apart.block.settings[0]))
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
    logs = np.array([weight for weight, *_ in peaks]) - EQUAL_EVIDENCE * np.array(doubted)
    p = np.exp(logs - np.logaddexp.reduce(logs))
    return [WeighedSetting(peaks[i][1], float(p[i]), peaks[i][2]) for i in np.argsort(-p)]


def _find_apart(scene: Scene, beside: Evidence, found: Choice) -> Choice | None:
    """The likeliest choice of an effect with numbers that joints have of their own, refined: what
    was found, if joints differ in it; None if one number for all is likelier."""
    scan = Scan(scene, beside, found)
    if scan.list_own(found.block.settings[found.setting]):
        return found
    ranked = beside.rank_one(scan.scanned)
    scans = [Scan(scene, beside, one) for one in (ranked.best, *ranked.rivals)]
    refined = [one.refine() for one in scans if one.block.scanned is not None]
    apart = [one for one in refined if scan.list_own(one.block.settings[0])]
    return max(apart, key=lambda one: beside.weigh(one.block.alone).max(), default=None)


def find_bracket(scanned: Sequence[float], value: float) -> tuple[float, float]:
    """The scanned values on both sides of the one that is next to a value."""
    at = int(np.argmin(np.abs(np.array(scanned) - value)))
    return scanned[max(at - 1, 0)], scanned[min(at + 1, len(scanned) - 1)]
