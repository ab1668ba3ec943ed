"""A fleet of virtual robots on one process, on more of them, and on a Dask cluster whose worker and
whose scheduler are killed: equal to the last bit, how fast, how much memory, what is found.

Usage: `python -m bench.speed.fleet --robots 200 --recordings 3` (by hand: an hour).
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated

import fleets
import typer
import virtual_fleet as vf
from clusters import Cluster, cluster
from rich.console import Console
from rich.table import Table

from parallel_cal.fleet.findings import Findings
from parallel_cal.fleet.fleet import Fleet, judge
from parallel_cal.fleet.jobs import FleetError, FleetOptions
from parallel_cal.fleet.rows import Row

MEGABYTE = 1 << 20


class Watched:
    """Memory of a cluster's workers as rows come, and what dies on the way."""

    def __init__(self, workers: Cluster, kill_at: int):
        self.workers, self.kill_at, self.done = workers, kill_at, 0
        self.memory: list[float] = []

    def __call__(self, row: Row) -> None:
        import psutil

        alive = [p for p in self.workers.workers if p.poll() is None]
        self.memory.append(max(psutil.Process(p.pid).memory_info().rss for p in alive) / MEGABYTE)
        self.done += 1
        if self.done == self.kill_at:
            self.workers.kill(alive[0])
        if self.done == 2 * self.kill_at:
            self.workers.kill(self.workers.scheduler)


def on_cluster(
    listed: Path, folder: Path, asked: FleetOptions, robots: int
) -> tuple[Fleet, list[float]]:
    """Three workers; one is killed after a quarter, the scheduler after a half; then all again."""
    with tempfile.TemporaryDirectory() as first, cluster(first, 3, nanny=False) as workers:
        watched = Watched(workers, max(1, robots // 4))
        try:
            judge(listed, folder, asked, scheduler=workers.address, on_row=watched)
        except FleetError as error:
            Console().print(f"the scheduler was killed: {error}")
    with tempfile.TemporaryDirectory() as second, cluster(second, 3, nanny=False) as workers:
        again = Watched(workers, -1)
        return judge(
            listed, folder, asked, scheduler=workers.address, on_row=again
        ), watched.memory + again.memory


def main(
    robots: Annotated[int, typer.Option(min=4)] = 12,
    recordings: Annotated[int, typer.Option(min=1)] = 3,
    poses: int = 40,
    workers: int = 2,
    one: Annotated[bool, typer.Option(help="a run on one process, too")] = True,
    effect: Annotated[list[str] | None, typer.Option(help="only these; none: all")] = None,
) -> None:
    asked = FleetOptions(effects=tuple(effect or ()))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        members = vf.drawn(robots)
        listed = fleets.written(folder / "robots", members, recordings, n_poses=poses)
        table = Table("where", "time, s", "recordings a minute", "rows as the first", title="Fleet")
        first, found = b"", None
        for n in [*([1] if one else []), workers]:
            begin = time.perf_counter()
            found = judge(listed, folder / f"on{n}", asked, workers=n)
            seconds = time.perf_counter() - begin
            rows = (folder / f"on{n}" / "rows.parquet").read_bytes()
            first = first or rows
            _add(table, f"{n} processes here", seconds, len(found.rows), rows == first)
        begin = time.perf_counter()
        there, memory = on_cluster(listed, folder / "there", asked, robots * recordings)
        rows = (folder / "there" / "rows.parquet").read_bytes()
        seconds = time.perf_counter() - begin
        _add(table, "cluster of 3, twice killed", seconds, len(there.rows), rows == first)
    console = Console(width=110)
    console.print(table)
    third = len(memory) // 3
    console.print(
        f"largest worker: {max(memory[:third]):.0f} MB in the first third, "
        f"{max(memory[-third:]):.0f} MB in the last"
    )
    if there.findings:
        show(there.findings, console)


def _add(table: Table, name: str, seconds: float, rows: int, equal: bool) -> None:
    table.add_row(name, f"{seconds:.0f}", f"{60 * rows / seconds:.1f}", "yes" if equal else "NO")


def show(found: Findings, console: Console) -> None:
    """What was planted beside what was found."""
    for effect in found.effects:
        named = ", ".join(effect.robots[:3])
        console.print(f"{effect.name}: {effect.kind}, {len(effect.robots)} robots ({named}, ...)")
    for one in found.outlying:
        console.print(
            f"{one.robot}: {one.name} by {1e3 * one.size:.2f} mm; 1 has its arm 2 mm longer"
        )
    for one in found.changed:
        console.print(f"{one.robot}: {one.name} from {one.before} to {one.after}; none changes so")
    for drift in found.drifts:
        rate = 1e6 * vf.DAY * drift.rate
        console.print(f"{drift.robot}: {drift.name} by {rate:.1f} um a day; 3 sinks by 8")
    true = {one.name: vf.SPREAD[one.name.split(".")[1]] for one in found.parameters}
    held = [one.low < true[one.name] < one.high for one in found.parameters]
    console.print(f"{sum(held)} of {len(held)} spreads inside their 95 % interval")


if __name__ == "__main__":
    typer.run(main)
