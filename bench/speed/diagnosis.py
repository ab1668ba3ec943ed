"""How long a diagnosis takes beside one identification: processor time, a fresh process a case.

150 poses of the independent virtual robot, a recording in motion, both with 42 free parameters,
and 1000 poses of a virtual arm; the whole catalogue. Phases are those that a diagnosis reports
while it runs.
Usage: `python -m bench.speed.diagnosis`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import virtual_arm as va
import virtual_findings as vf
from arms import nominal, seen
from findings import clean, hiding
from rich.console import Console
from rich.table import Table

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.loading import load_dataset

ROOT = Path(__file__).resolve().parents[2]


def nothing_hidden() -> Any:
    return new_model("delta54"), clean(0)


def two_effects() -> Any:
    kinds = [vf.KINDS["backlash"], vf.KINDS["joint compliance"]]
    return new_model("delta54"), hiding(kinds, 1.0, 0)[0]


def in_motion() -> Any:
    model = read_model(ROOT / "config" / "delta_mockup_nominal.yaml")
    bag = ROOT / "bags" / "delta_latency"
    return model, load_dataset(bag, joints=model.joints, mode="continuous")


def arm_of_six_joints() -> Any:
    """A thousand poses of a UR5-like arm, one of its encoders off-centre."""
    arm = va.arm("ur5", 1, hidden=(va.Play(1, eccentric=3e-4),))
    return nominal("ur5"), seen(va.session(arm, 1000, 0, va.Tracker()))


CASES = (nothing_hidden, two_effects, in_motion, arm_of_six_joints)


class Phases:
    """Seconds of the processor from each reported stage to the next, by the stage's first word."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self._stage, self._since = "", time.process_time()

    def __call__(self, stage: str, fraction: float) -> None:
        now = time.process_time()
        self.spent[self._stage] += now - self._since  # type: ignore[assignment]
        self._stage, self._since = stage.split()[0], now

    def words(self) -> str:
        self("done", 1.0)
        return ", ".join(f"{stage} {s:.2f}" for stage, s in self.spent.items() if stage)


def seconds(call: Callable[[], Any]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin


def measured(case: Callable[[], Any]) -> list[str]:
    """A row: one identification, the first diagnosis (functions built) and a later one."""
    model, dataset = case()
    fit(model, dataset)
    one = min(seconds(lambda: fit(model, dataset)) for _ in range(3))
    first = seconds(lambda: diagnose(model, dataset))
    phases = Phases()
    later = seconds(lambda: diagnose(model, dataset, progress=phases))
    row = [case.__name__.replace("_", " "), str(len(dataset)), f"{one:.2f}", f"{first:.2f}"]
    return [*row, f"{later:.2f}", f"{first / one:.0f}", f"{later / one:.0f}", phases.words()]


def main() -> None:
    table = Table(
        "data",
        "samples",
        "fit, s",
        "first, s",
        "later, s",
        "first / fit",
        "later / fit",
        "later, by phase, s",
        title="Diagnosis with the whole catalogue",
    )
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for row in pool.imap(measured, CASES):
            table.add_row(*row)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
