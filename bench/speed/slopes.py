"""How the time of a fit grows with samples and free parameters, and that of a diagnosis with the
catalogue: slopes of the logarithms, 1 where twice as much takes twice as long."""

from __future__ import annotations

import numpy as np
from datasets import measured
from rich.console import Console
from rich.table import Table

from bench.speed.timing import processor_each
from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr

SAMPLES = (50, 100, 200, 400, 800)
FREE = (6, 12, 24, 42)
EFFECTS = (5, 10, 20, 40)


def over_samples(n: int) -> float:
    """Seconds of fit() on n poses."""
    model, data = new_model("delta54", vr.TABLE_5_12), measured(0, n_poses=n)
    return processor_each(lambda: fit(model, data), least=3, repeats=3)


def over_parameters(n: int) -> float:
    """Seconds of fit() of the first n free parameters on 94 samples."""
    model, data = new_model("delta54", vr.TABLE_5_12), measured(0)
    kept = np.flatnonzero(~np.asarray(model.fixed))[:n]
    free = [model.table.names[i] for i in kept]
    return processor_each(lambda: fit(model, data, free=free), least=3, repeats=3)


def over_catalogue(n: int) -> float:
    """Seconds of a diagnosis that looks for n effects on 94 samples."""
    model, data = new_model("delta54", vr.TABLE_5_12), measured(0)
    # In a random order: effects whose names are close are often alike, and take equally long.
    names = np.random.default_rng(0).permutation(list_effects_to_test(model))[:n].tolist()
    return processor_each(lambda: diagnose(model, data, effects=names), least=1, repeats=2)


def main() -> None:
    table = Table("what", "of", "ms", "slope", "of the last two", title="How time grows")
    studies = (
        ("fit() over samples", over_samples, SAMPLES),
        ("fit() over free parameters", over_parameters, FREE),
        ("diagnosis over the catalogue", over_catalogue, EFFECTS),
    )
    for name, study, sizes in studies:
        seconds = [study(n) for n in sizes]
        logs = np.log(sizes), np.log(seconds)
        slope, last = np.polyfit(*logs, 1)[0], np.diff(logs[1])[-1] / np.diff(logs[0])[-1]
        times = " ".join(f"{1e3 * s:.3g}" for s in seconds)
        table.add_row(name, " ".join(map(str, sizes)), times, f"{slope:.2f}", f"{last:.2f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
