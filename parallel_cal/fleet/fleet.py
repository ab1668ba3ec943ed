"""Judge every recording of every robot of a fleet, and resume where an earlier run stopped."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.files import write_atomically
from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.fleet.cluster import check_extra_installed, cluster, results
from parallel_cal.fleet.findings import Findings, findings
from parallel_cal.fleet.jobs import FleetError, FleetOptions, Job, jobs_of
from parallel_cal.fleet.judging import Page, Row, sort_recordings
from parallel_cal.fleet.rows import Rows
from parallel_cal.fleet.tolerances import next_robot
from parallel_cal.identification.drift_estimate import Session, pool_drifts
from parallel_cal.identification.drift_rate import DriftRate
from parallel_cal.identification.evidence import Evidence
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect


@dataclass(frozen=True)
class Fleet:
    """The rows of a fleet by robot and recording, its findings, and the model with which to start
    the next robot's calibration; the last two are None for fewer than four robots. `drift` is None
    if no robot has two recordings at known times."""

    rows: tuple[Row, ...]
    findings: Findings | None = None
    next_robot: Model | None = None
    drift: DriftRate | None = None

    @property
    def failed(self) -> list[Row]:
        return [row for row in self.rows if row["reason"]]

    @property
    def judged(self) -> list[Row]:
        return [row for row in self.rows if not row["reason"]]

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal fleet`."""
        return {
            "robots": len({row["robot"] for row in self.rows}),
            "recordings": len(self.rows),
            "findings": to_json_value(self.findings),
            "drift": None if self.drift is None else self.drift.document(),
            "failed": [
                {k: row[k] for k in ("robot", "recording", "reason")} for row in self.failed
            ],
        }


def judge(
    robots: Path,
    folder: Path,
    asked: FleetOptions | None = None,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    page: Page | None = None,
    progress: Progress | None = None,
    on_row: Callable[[Row], None] | None = None,
) -> Fleet:
    """Judge the recordings of a folder or list of robots, and write the results to a folder.

    Runs on the Dask cluster at `scheduler` if one is given. Recordings that were judged before are
    not judged again, unless they failed. Raises ModelError for an unknown effect, and FleetError if
    the run cannot start or continue; finished rows are kept.
    """
    check_extra_installed()
    asked, jobs = asked or FleetOptions(), jobs_of(robots)
    for name in (*asked.effects, *asked.also):
        load_effect(name)
    if robots.is_dir() and any(job.data.is_relative_to(folder.resolve()) for job in jobs):
        raise FleetError(f"{folder} contains recordings; expected a folder for the results only")
    store = Rows(folder)
    report = progress or ignore_progress
    with store.lock():
        inputs = {job.hash_inputs(asked): job for job in jobs}
        done = {key: row for key in inputs if (row := store.load(key))}
        left = [(job, key) for key, job in inputs.items() if key not in done]
        report("recordings", len(done) / len(jobs))
        try:
            if left:
                with cluster(scheduler, workers) as client:
                    for row, shown in results(client, left, asked, page):
                        store.keep(row, shown)
                        done[row["inputs"]] = row
                        report("recordings", len(done) / len(jobs))
                        if on_row:
                            on_row(row)
        finally:  # write what is finished, whatever ended the run
            rows = tuple(done[key] for key in inputs if key in done)
            store.gather(rows)
        store.forget_others(inputs)
        fleet = _make_fleet(rows, jobs)
        write_atomically(folder / "fleet.json", json.dumps(fleet.document(), allow_nan=False))
        if fleet.next_robot is not None:
            write_model(fleet.next_robot, folder / "next_robot.yaml")
    return fleet


def _make_fleet(rows: tuple[Row, ...], jobs: Sequence[Job]) -> Fleet:
    """Compare the robots of the most frequent mechanism."""
    judged = {(row["robot"], row["recording"]): row for row in rows if not row["reason"]}
    if not judged:
        return Fleet(rows)
    kind = Counter(row["mechanism"] for row in judged.values()).most_common(1)[0][0]
    drawn = next(
        job
        for job in jobs
        if (row := judged.get((job.robot, job.recording))) and row["mechanism"] == kind
    )
    drawing = read_model(drawn.model)
    found = findings(rows, drawing)
    drift = pool_drifts(_list_sessions(judged.values(), kind), drawing)
    following = next_robot(drawing, found) if found else None
    if following is not None and drift is not None:
        entry = {"step": "fleet_drift", **drift.document()}
        following = replace(following, history=(*following.history, entry))
    return Fleet(rows, found, following, drift)


def _list_sessions(rows: Iterable[Row], mechanism: str) -> list[list[Session]]:
    """List what each robot's recordings at known times tell about its parameters."""
    own = (row for row in rows if row["mechanism"] == mechanism and row["time"] is not None)
    return [
        [Session(row["time"], Evidence.from_document(row["evidence"])) for row in each]
        for each in sort_recordings(own).values()
    ]
