"""A fleet: every recording of every robot judged, resumed where it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parallel_cal.fleet.cluster import cluster, need_extra, results
from parallel_cal.fleet.jobs import Asked, jobs_of
from parallel_cal.fleet.judging import Page, Row
from parallel_cal.fleet.rows import Rows

Progress = Callable[[int, int, Row | None], None]  # how many are done, of how many, the last one


@dataclass(frozen=True)
class Fleet:
    """The rows of a fleet, by robot and recording."""

    rows: tuple[Row, ...]

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
            "failed": [
                {k: row[k] for k in ("robot", "recording", "reason")} for row in self.failed
            ],
        }


def judge(
    robots: Path,
    folder: Path,
    asked: Asked | None = None,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    page: Page | None = None,
    progress: Progress | None = None,
) -> Fleet:
    """Judge the recordings of a folder or list of robots into a folder, on a Dask cluster where a
    `scheduler` is given; what is there already is not done again, unless it failed.

    FleetError where it cannot begin, or not go on; rows that were done are kept.
    """
    need_extra()
    asked, jobs, store = asked or Asked(), jobs_of(robots), Rows(folder)
    report = progress or (lambda done, of, row: None)
    with store.alone():
        inputs = {job.inputs(asked): job for job in jobs}
        done = {key: row for key in inputs if (row := store.known(key))}
        left = [(job, key) for key, job in inputs.items() if key not in done]
        report(len(done), len(jobs), None)
        try:
            if left:
                with cluster(scheduler, workers) as client:
                    for row, _ in results(client, left, asked, page):
                        store.keep(row)
                        done[row["inputs"]] = row
                        report(len(done), len(jobs), row)
        finally:  # what was done is there, however it ends
            rows = tuple(done[key] for key in inputs if key in done)
            store.gather(rows)
        store.forget_others(inputs)
    return Fleet(rows)
