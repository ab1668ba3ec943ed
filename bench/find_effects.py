"""How often a diagnosis is right: nothing hidden, one effect, two, and things nobody catalogued.

Robots, sessions, physics and noise come from the independent virtual robot; every draw has its
own poses. Usage: `PYTHONPATH=. python bench/find_effects.py [draws] [kind ...]`.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

import virtual_findings as vf
from findings import clean, hiding

from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

SIZE, LARGE = 0.6, 1.5  # sigmas of the residual, of a single effect and of uncatalogued ones


def none_hidden(draws: int) -> str:
    found = [_diagnosed(clean(seed)) for seed in range(draws)]
    verdicts = Counter(d.verdict.word for d in found)
    proposed = sum(bool(d.effects) for d in found)
    return f"proposes an effect in {proposed} of {draws}; {dict(verdicts)}"


def one(kind: vf.Kind, draws: int) -> str:
    right, ratios, verdicts = 0, [], Counter[str]()
    for seed in range(draws):
        data, _ = hiding([kind], SIZE, seed)
        found = _diagnosed(data)
        right += bool(found.effects) and _called(found, kind)
        verdicts[found.verdict.word] += 1
        ratios.append(_over_noise(found))
    return (
        f"right in {right} of {draws}; held-out RMS / that without anything hidden: median "
        f"{np.median(ratios):.3f}, 95 % {np.quantile(ratios, 0.95):.3f}; {dict(verdicts)}"
    )


def two(first: vf.Kind, second: vf.Kind, draws: int) -> str:
    both, verdicts = 0, Counter[str]()
    for seed in range(draws):
        data, _ = hiding([first, second], SIZE, seed)
        found = _diagnosed(data)
        both += _called(found, first) and _called(found, second)
        verdicts[found.verdict.word] += 1
    return f"both in {both} of {draws}; {dict(verdicts)}"


def uncatalogued(make: Callable[..., vr.Effect], draws: int) -> str:
    verdicts, names = Counter[str](), Counter[str]()
    for seed in range(draws):
        found = _diagnosed(hiding([vf.Kind((), make, 0.5e-3)], LARGE, seed)[0])
        verdicts[found.verdict.word] += 1
        names.update(found.effects)
    return f"explained in {verdicts['explained']} of {draws}; {dict(verdicts)}; {dict(names)}"


def _diagnosed(data: Dataset) -> Diagnosis:
    return diagnose(new_model("delta54"), data)


def _called(found: Diagnosis, kind: vf.Kind) -> bool:
    """Whether one of the effects found, or what it is said to be confused with, is the one."""
    called = {n for name in found.effects for n in (name, *found.swaps.get(name, []))}
    return bool(called & set(kind.names))


def _over_noise(found: Diagnosis) -> float:
    """Held-out RMS over the noise floor, the geometric mean of position and orientation."""
    after, floor = found.best.fitted.held_out.summary, found.best.fitted.noise
    ratios = [after.rms(k) / floor.rms(k) for k in ("position", "orientation")]
    return float(np.exp(np.mean(np.log(ratios))))


def studies(draws: int) -> Iterator[tuple[str, Callable[[], str]]]:
    yield "nothing hidden", lambda: none_hidden(draws)
    for name, kind in vf.KINDS.items():
        yield name, lambda kind=kind: one(kind, draws)
    for a, b in combinations(vf.KINDS, 2):
        yield f"{a} and {b}", lambda a=a, b=b: two(vf.KINDS[a], vf.KINDS[b], max(draws // 5, 1))
    for name, make in vf.OUTSIDE.items():
        yield name, lambda make=make: uncatalogued(make, draws)


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    wanted = sys.argv[2:]
    for name, study in studies(draws):
        if not wanted or name in wanted:
            print(f"{name}: {study()}", flush=True)


if __name__ == "__main__":
    main()
