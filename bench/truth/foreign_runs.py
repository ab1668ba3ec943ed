"""Campaigns at the cell of foreign_cell.py: do they name its backlash, and nothing else?

    python -m bench.truth.foreign_runs [--runs 3] [--busy 2] [--speed 2.5] [KEY=VALUE ...]

Each run starts the cell, a calibration_node and a campaign, with `--busy` loops beside them that
only use the processor. KEY=VALUE are parameters of the cell, such as `slip_after=60`. One line a
run: the verdict, the widths found (um), the rms position error (um) before and after at poses that
nobody measured, the number of poses, and how often the campaign waited for unprocessed poses. The
exit status is 1 if a run named another effect than backlash.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from parallel_cal_msgs.action import Calibrate
from parallel_cal_msgs.msg import CalibrationStatus
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import Model, Noise, new_model
from parallel_cal.nodes.client import Client, Process, use_private_domain

CELL = Path(__file__).with_name("foreign_cell.py")
RIGHT = {"backlash"}  # the effects that this robot has
LIMITS = (0.1, 1.0)  # m/s and m/s^2 of each leg
MAX_MINUTES = 30.0  # of one campaign
START_TIMEOUT_S = 120.0  # of the cell, beside busy loops
N_TRUE_POSES = 100  # poses at which the true error is computed

Array = np.ndarray


def nominal_model() -> Model:
    """The robot as drawn, with what its owner knows of its drives and instruments."""
    model = replace(new_model("stewart42"), noise=Noise(1e-6, 5e-6, 20e-6))
    model.mechanism.joint_rates = (LIMITS,) * 6
    return model


@dataclass
class Run:
    """One campaign: its verdict, the model before and after, and what went on."""

    verdict: str = ""
    message: str = ""
    effects: list[str] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)
    before: float = np.nan
    after: float = np.nan
    poses: int = 0
    seconds: float = 0.0
    reasons: Counter[str] = field(default_factory=Counter)  # what it said, without numbers
    truth: dict[str, Any] = field(default_factory=dict)

    @property
    def false_effects(self) -> list[str]:
        return sorted(set(self.effects) - RIGHT)


@contextmanager
def busy_loops(n: int) -> Iterator[None]:
    """n processes that use a processor each."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(n)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


class ForeignCell:
    """The cell, a calibration_node with the model as drawn, and its owner as a client."""

    def __init__(self, folder: Path, values: Sequence[str] = ()):
        """Start all of it in a folder; `values` are parameters of the cell, as KEY=VALUE."""
        self.folder, namespace = folder, use_private_domain()
        self.model_file, self.better = folder / "robot.yaml", folder / "better.yaml"
        write_model(nominal_model(), self.model_file)
        self._truth, self._begin = folder / "truth.json", time.monotonic()
        arguments = ["-r", f"__ns:={namespace}", "-p", f"truth:={self._truth}"]
        for value in values:
            arguments += ["-p", value.replace("=", ":=", 1)]
        with (folder / "cell.log").open("w") as log:
            self._cell = subprocess.Popen(
                [sys.executable, str(CELL), "--ros-args", *arguments], stdout=log, stderr=log
            )
        given = {"model_file": str(self.model_file), "journal_folder": str(folder / "journal")}
        self.node = Process("calibration_node", folder, namespace, **given)
        self.client = Client("owner", namespace, [self.node])
        self._status = self.client.subscribe_latest(
            CalibrationStatus, "calibration_node/session_status"
        )
        try:
            self.client.wait(
                lambda: self.client.count_publishers("joint_states") > 0,
                "the cell",
                START_TIMEOUT_S,
            )
        except BaseException:
            self.end()
            raise

    def calibrate(self, **goal: Any) -> Run:
        """Run a campaign, or continue one that stopped early, and tell how it ended."""
        run = Run()
        goal = {"output_file": str(self.better), "minutes": MAX_MINUTES} | goal

        def hear(feedback: Any) -> None:
            return

        handle = self.client.send_goal(Calibrate, "calibration_node/calibrate", hear, **goal)
        done, last = handle.get_result_async(), ""

        def has_ended() -> bool:
            nonlocal last
            if self._status and self._status[0].reason != last:
                status, last = self._status[0], self._status[0].reason
                run.reasons[re.sub(r"\d[\d.e-]*", "N", last)] += 1
                with (self.folder / "status.log").open("a") as log:
                    seconds = time.monotonic() - self._begin
                    log.write(f"{seconds:8.1f} {status.state} {status.poses} {last}\n")
            return bool(done.done())

        self.client.wait(has_ended, "the end of the campaign", 60 * (goal["minutes"] + 10))
        result = done.result().result
        run.verdict, run.message = result.verdict, result.message
        run.poses = self._status[0].poses if self._status else 0
        return run

    def end(self) -> dict[str, Any]:
        """End all of it; return what was true and what happened in the cell."""
        self.client.close()
        self.node.end()
        self._cell.send_signal(signal.SIGINT)
        self._cell.wait(20)
        return dict(json.loads(self._truth.read_text()))


def run_campaign(folder: Path, values: Sequence[str], minutes: float) -> Run:
    """Run one campaign at the cell with these parameters, and compare its model with the truth."""
    begin, cell = time.monotonic(), ForeignCell(folder, values)
    run, truth = Run(), dict[str, Any]()
    try:
        run = cell.calibrate(minutes=minutes)
    finally:
        truth = cell.end()
    run.seconds, run.truth = time.monotonic() - begin, truth
    run.before = true_error(nominal_model(), truth)
    if cell.better.exists():
        found = read_model(cell.better)
        run.effects = [effect.name for effect in found.effects]
        if "backlash" in run.effects:
            run.widths = [found.value(f"backlash.{leg}.width") for leg in found.joints]
        run.after = true_error(found, truth)
    return run


def true_error(model: Model, truth: dict[str, Any]) -> float:
    """Rms position error (m) in the workspace, after the best rigid motions of both frames.

    A tracker in a frame of its own determines neither the base's frame nor the platform's.
    """
    rng = np.random.default_rng(12)
    platform, base = np.array(truth["platform"]), np.array(truth["base"])
    low, high = np.array(model.mechanism.workspace.low), np.array(model.mechanism.workspace.high)
    poses = 0.5 * (low + high) + 0.45 * (high - low) * rng.uniform(-1, 1, (N_TRUE_POSES, 6))
    r, turns = poses[:, :3], Rotation.from_rotvec(poses[:, 3:])
    arms = np.einsum("nij,kj->nki", turns.as_matrix(), platform)
    legs = np.linalg.norm(r[:, None] + arms - base, axis=2) - np.array(truth["zero"])
    direction = rng.choice([-1.0, 1.0], legs.shape)
    joints = legs + direction * np.array(truth["play"]) / 2
    at = {f"direction.{leg}": direction[:, i] for i, leg in enumerate(model.joints)}
    found = Kinematics(model.robot()).direct(joints, at)

    def errors(x: Array) -> Array:
        turn, tool = Rotation.from_rotvec(x[3:6]), x[6:9]
        moved = x[:3] + turn.apply(found.position + np.einsum("nij,j->ni", found.rotation, tool))
        return np.asarray((moved - r).ravel())

    best = least_squares(errors, np.zeros(9), x_scale=1e-3)
    return float(np.sqrt(np.mean(np.sum(best.fun.reshape(-1, 3) ** 2, axis=1))))


def describe(run: Run) -> str:
    """Return the line of a run; lengths in um."""
    widths = " ".join(f"{1e6 * width:.1f}" for width in run.widths) or "none"
    false = ", ".join(run.false_effects) or "none"
    out, silence = 1e6 * run.truth["outside_limits"], run.truth["silence"]
    waits = sum(n for reason, n in run.reasons.items() if "not processed" in reason)
    return (
        f"{run.verdict or 'no verdict'}; false {false}; widths {widths}; "
        f"error {1e6 * run.before:.0f} to {1e6 * run.after:.2f}; {run.poses} poses in "
        f"{run.seconds:.0f} s; outside limits {out:.0f}; "
        f"the cell was silent for up to {silence:.1f} s; {waits} waits for unprocessed poses; "
        f"{run.message}"
    )


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--runs", type=int, default=3)
    arguments.add_argument("--busy", type=int, default=0, help="loops that use the processor")
    arguments.add_argument("--speed", type=float, default=1.0, help="of the cell's clock")
    arguments.add_argument("--seed", type=int, default=0, help="of the first run")
    arguments.add_argument("--minutes", type=float, default=MAX_MINUTES, help="of one campaign")
    arguments.add_argument("--keep", type=Path, help="folder that keeps the files of all runs")
    arguments.add_argument("values", nargs="*", help="parameters of the cell: KEY=VALUE")
    given = arguments.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends the cell and the node, too
    wrong = 0
    for k in range(given.seed, given.seed + given.runs):
        with tempfile.TemporaryDirectory() as temporary, busy_loops(given.busy):
            folder = given.keep / f"run{k}" if given.keep else Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            values = [f"seed={k}", f"speed={given.speed}", *given.values]
            run = run_campaign(folder, values, given.minutes)
        wrong += bool(run.false_effects)
        print(f"seed {k}, load {os.getloadavg()[0]:.1f}: {describe(run)}", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
