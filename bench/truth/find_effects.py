"""How often a diagnosis is right: nothing hidden, one effect, two, and things nobody catalogued.

Robots, sessions, physics and noise come from the independent virtual robot; every draw has its
own poses. Usage: `python -m bench.truth.find_effects [draws] [kind ...]`, on all cores, or with
`--scheduler tcp://...` on a Dask cluster whose workers have PYTHONPATH=.:test/helpers.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import virtual_findings as vf
from findings import clean, hiding

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.fleet.cluster import cluster, run_each
from parallel_cal.model.model import new_model

SIZE, LARGE = 0.6, 1.5  # sigmas of the residual, of a single effect and of uncatalogued ones


@dataclass(frozen=True)
class Drawn:
    """What the diagnosis of one draw says: verdict, names of the effects, those that it would take
    as well, and the error at poses left out over the noise's."""

    verdict: str
    effects: tuple[str, ...]
    called: frozenset[str]
    over_noise: float

    def right(self, kind: str) -> bool:
        return bool(self.called & set(vf.KINDS[kind].names))


def draw(hidden: tuple[str, ...], seed: int) -> Drawn:
    """A robot that hides kinds of the catalogue, one that is in none, or nothing."""
    if not hidden:
        data = clean(seed)
    elif hidden[0] in vf.OUTSIDE:
        data, _ = hiding([vf.Kind((), vf.OUTSIDE[hidden[0]], 0.5e-3)], LARGE, seed)
    else:
        data, _ = hiding([vf.KINDS[name] for name in hidden], SIZE, seed)
    found = diagnose(new_model("delta54"), data)
    called = {n for name in found.effects for n in (name, *found.swaps.get(name, []))}
    return Drawn(found.verdict.word, found.effects, frozenset(called), _over_noise(found))


def _over_noise(found: Diagnosis) -> float:
    """Held-out RMS over the noise floor, the geometric mean of position and orientation."""
    after, floor = found.best.fitted.held_out.summary, found.best.fitted.noise_floor
    ratios = [after.rms(k) / floor.rms(k) for k in ("position", "orientation")]
    return float(np.exp(np.mean(np.log(ratios))))


def told(hidden: tuple[str, ...], found: list[Drawn]) -> str:
    """How often the draws of a study are right."""
    n, verdicts = len(found), dict(Counter(d.verdict for d in found))
    if not hidden:
        return f"proposes an effect in {sum(bool(d.effects) for d in found)} of {n}; {verdicts}"
    if hidden[0] in vf.OUTSIDE:
        names = dict(Counter(name for d in found for name in d.effects))
        return f"explained in {verdicts.get('explained', 0)} of {n}; {verdicts}; {names}"
    right = sum(all(d.right(kind) for kind in hidden) for d in found)
    if len(hidden) == 2:
        return f"both in {right} of {n}; {verdicts}"
    ratios = [d.over_noise for d in found]
    return (
        f"right in {right} of {n}; held-out RMS / that without anything hidden: median "
        f"{np.median(ratios):.3f}, 95 % {np.quantile(ratios, 0.95):.3f}; {verdicts}"
    )


def studies(draws: int) -> Iterator[tuple[str, tuple[str, ...], int]]:
    """Name, what is hidden, how many draws."""
    yield "nothing hidden", (), draws
    yield from ((name, (name,), draws) for name in vf.KINDS)
    yield from ((f"{a} and {b}", (a, b), max(draws // 5, 1)) for a, b in combinations(vf.KINDS, 2))
    yield from ((name, (name,), draws) for name in vf.OUTSIDE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("draws", type=int, nargs="?", default=20)
    parser.add_argument("kind", nargs="*")
    parser.add_argument("--scheduler", help="a Dask cluster's address; none: this machine's cores")
    asked = parser.parse_args()
    wanted = [one for one in studies(asked.draws) if not asked.kind or one[0] in asked.kind]
    calls = [(hidden, seed) for _, hidden, draws in wanted for seed in range(draws)]
    found: dict[tuple[tuple[str, ...], int], Drawn] = {}
    with cluster(asked.scheduler, None) as client:
        for k, drawn in run_each(client, draw, calls):
            found[calls[k]] = drawn
            done = [one for one in wanted if all((one[1], s) in found for s in range(one[2]))]
            for name, hidden, draws in done:
                print(
                    f"{name}: {told(hidden, [found[hidden, s] for s in range(draws)])}", flush=True
                )
                wanted.remove((name, hidden, draws))


if __name__ == "__main__":
    main()
