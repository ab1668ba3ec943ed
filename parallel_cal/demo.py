"""The whole way in half a minute: collect, identify, write, and the robot uses the better model."""

from __future__ import annotations

import json as json_format
import math
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parallel_cal.commands import console
from parallel_cal.errors import ParallelCalError

if TYPE_CHECKING:
    from parallel_cal.nodes.demo_session import DemoSession

REPOSITORY = Path(__file__).resolve().parents[1]
BAG = REPOSITORY / "bags" / "delta_clean"
PRESET = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
APART = (
    8  # every eighth pose is kept apart: the fit never sees it, the served model is judged by it
)
HOLD_OUT = 0.25
WITHIN_NOISE = 1.5  # a mean over some ten poses scatters by that much
UNITS = {"position": ("um", 1e6), "orientation": ("arcmin", 60 * 180 / math.pi)}


def main(
    json: bool = False, bag: str | Path | None = None, rate: float = 20.0, keep: bool = False
) -> int:
    """Calibrate the virtual Delta robot through both nodes; exit status 0 or 1.

    `bag` replaces the recording, `rate` is how fast it is played, `keep` leaves the new model
    file and the nodes' logs where they are.
    """
    # a terminated demo ends its nodes, too
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="parallel_cal_demo_"))
        if not keep:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            document = run(Path(bag) if bag else BAG, rate, folder, Story(json, keep))
        except (ParallelCalError, KeyboardInterrupt) as error:
            console.error(str(error) or "interrupted; nothing is left running")
            return 1
    if json:
        console.emit(document)
    return 0


def run(bag: Path, rate: float, folder: Path, story: Story) -> dict[str, Any]:
    """The demo's steps; its document. ParallelCalError where one fails."""
    begin, model_file = time.monotonic(), _prepared(bag, folder)
    with _session(model_file) as session, story:
        document = _steps(session, bag, rate, model_file, story)
    document["seconds"] = time.monotonic() - begin
    story.end(document)
    return document


def _prepared(bag: Path, folder: Path) -> Path:
    """A copy of the nominal model; the demo never changes the repository."""
    for path in (bag, PRESET):
        if not path.exists():
            raise ParallelCalError(
                f"{path}: not there. The demo needs a clone of the repository: its bags/ and "
                "config/ are not part of the installed package"
            )
    return Path(shutil.copy(PRESET, folder / "robot.yaml"))


def _session(model_file: Path) -> DemoSession:
    try:
        from parallel_cal.nodes.demo_session import DemoSession
    except ImportError as error:
        raise ParallelCalError(
            f"ROS 2 is missing ({error}): run 'make demo', or install the extra 'ros' and msg_defs"
        ) from None
    return DemoSession(model_file)


def _steps(
    session: DemoSession, bag: Path, rate: float, model_file: Path, story: Story
) -> dict[str, Any]:
    old = session.hash_served()
    status = session.collect(bag, _messages(bag), rate, story.progress)
    samples, joints = session.samples()
    if not samples:
        raise ParallelCalError(f"{bag}: no samples: {status.last_event}")
    apart = kept_apart(samples)
    counted = {
        "collected": len(samples),
        "kept_apart": len(apart),
        "joint_states": status.joint_states_received,
        "poses": status.poses_received,
        "dropped": status.dropped,
    }
    story.collected(counted)
    before = session.miss(apart, joints)
    story.missed("before", before)
    session.remove(apart)
    result = session.identify(HOLD_OUT, story.progress)
    fit = json_format.loads(result.json)
    story.identified(fit)
    seconds = session.wait_until_served(result.hash)
    story.served(model_file, result.hash, seconds)
    after = session.miss(apart, joints)
    story.missed("after", after)
    return _document(counted, before, after, fit, model_file, old, result.hash)


def _messages(bag: Path) -> int:
    """Joint readings and poses in a recording."""
    from parallel_cal.bag import list_topics

    counts = {topic.name.strip("/"): topic.count for topic in list_topics(bag)[0]}
    missing = [name for name in ("joint_states", "measured_pose") if not counts.get(name)]
    if missing:
        raise ParallelCalError(f"{bag}: no messages on {', '.join(missing)}")
    return counts["joint_states"] + counts["measured_pose"]


def kept_apart(samples: Sequence[Any]) -> list[Any]:
    """The samples of every eighth pose, all visits of it."""
    pose = {s.id: s.id if s.replicate_of < 0 else s.replicate_of for s in samples}
    chosen = set(list(dict.fromkeys(pose.values()))[APART // 2 :: APART])
    return [s for s in samples if pose[s.id] in chosen]


def _document(
    counted: Mapping[str, int],
    before: Mapping[str, Any],
    after: Mapping[str, Any],
    fit: Mapping[str, Any],
    model_file: Path,
    old: str,
    new: str,
) -> dict[str, Any]:
    noise = fit["noise_floor"]
    return {
        "samples": dict(counted),
        "kept_apart": {"before": dict(before), "after": dict(after)},
        "improvement": {k: before[f"{k}_mean"] / after[f"{k}_mean"] for k in UNITS},
        "at_noise": fit["chi2_per_dof"] <= fit["chi2_band"][1]
        and all(after[f"{k}_mean"] <= WITHIN_NOISE * noise[f"{k}_mean"] for k in UNITS),
        "held_out": fit["held_out"],
        "noise_floor": noise,
        "chi2_per_dof": fit["chi2_per_dof"],
        "warnings": fit["warnings"],
        "model_file": str(model_file),
        "hash_before": old,
        "hash": new,
        "served": after["model_hash"],
    }


class Story:
    """What the demo tells on the way, for people; silent for --json."""

    def __init__(self, silent: bool, keep: bool):
        from rich.console import Console

        # progress is for those who look on, and never part of the answer
        self._out = Console(quiet=silent, highlight=False, soft_wrap=True)
        self._status = Console(stderr=True, quiet=silent or not sys.stderr.isatty()).status("")
        self._left = f"nothing is left running, the files are {'kept' if keep else 'removed'}"

    def __enter__(self) -> None:
        self._say("[bold]A Delta robot misses its targets. By how much, and what helps?[/]")
        self._say("[dim]virtual robot, bags/README.md; everything below runs through ROS 2[/]\n")

    def __exit__(self, *_: object) -> None:
        self._status.stop()

    def _say(self, text: str) -> None:
        self._status.stop()
        self._out.print(text)

    def progress(self, stage: str, fraction: float) -> None:
        self._status.update(f"{stage} {100 * min(fraction, 1.0):.0f} %")
        self._status.start()

    def collected(self, counted: Mapping[str, int]) -> None:
        self._line(
            "collected",
            f"{counted['collected']} samples of {counted['joint_states']} joint readings and "
            f"{counted['poses']} poses, {counted['dropped']} dropped",
        )
        self._line("", f"{counted['kept_apart']} of them are kept apart: the fit never sees them")

    def missed(self, when: str, errors: Mapping[str, Any]) -> None:
        position, orientation = (_readable(kind, errors) for kind in UNITS)
        self._line(when, f"kinematics_node is off by {position} and {orientation} there")

    def identified(self, fit: Mapping[str, Any]) -> None:
        self._line(
            "identified",
            f"{fit['free']} parameters from {fit['samples']} samples, "
            f"chi2/dof {fit['chi2_per_dof']:.2f} (1: only noise is left)",
        )

    def served(self, path: Path, hash: str, seconds: float) -> None:
        self._line("written", str(path))
        self._line("", f"sha256 {hash}")
        self._line("served", f"kinematics_node took the file over within {seconds + 0.05:.1f} s")

    def _line(self, what: str, text: str) -> None:
        self._say(f"[cyan]{what:10}[/]  {text}")

    def end(self, document: Mapping[str, Any]) -> None:
        self._say("")
        self._out.print(_table(document))
        if document["at_noise"]:
            verdict = "[bold green]What is left is no more than the measurements' noise.[/]"
        else:
            verdict = "[bold yellow]More than noise is left: an effect is missing.[/]"
        self._say(f"\n{verdict}")
        self._say(f"[dim]{document['seconds']:.0f} s in all; {self._left}.[/]")


def _readable(kind: str, errors: Mapping[str, Any]) -> str:
    unit, factor = UNITS[kind]
    digits = 1 if kind == "position" else 2
    return f"{errors[f'{kind}_mean'] * factor:.{digits}f} {unit}"


def _table(document: Mapping[str, Any]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("mean, unseen poses")
    for name in ("before", "after", "noise alone", "better by"):
        table.add_column(name, justify="right")
    apart, noise = document["kept_apart"], document["noise_floor"]
    for kind in UNITS:
        cells = [_readable(kind, errors) for errors in (apart["before"], apart["after"], noise)]
        table.add_row(kind, *cells, f"{document['improvement'][kind]:.0f}x")
    return table
