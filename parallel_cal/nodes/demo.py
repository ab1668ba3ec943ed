"""The whole way in half a minute: collect, identify, find what is missing, use the better model."""

from __future__ import annotations

import json as json_format
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.demo_story import UNITS, Story
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.nodes.demo_nodes import DemoNodes

REPOSITORY = Path(__file__).resolve().parents[2]
BAG = REPOSITORY / "bags" / "delta_clean"
HIDDEN = REPOSITORY / "bags" / "delta_backlash"
PRESET = REPOSITORY / "config" / "delta_mockup_nominal.yaml"
APART = 8  # one pose in so many: the fit never sees it, and the served model is judged by it
HOLD_OUT = 0.25
WITHIN_NOISE = 1.5  # a mean over some ten poses scatters by that much


def main(
    json: bool = False, bag: str | Path | None = None, rate: float = 20.0, keep: bool = False
) -> int:
    """Calibrate the virtual Delta robot through both nodes; exit status 0 or 1.

    `bag` replaces the recording, and nothing more is then looked for; `rate` is how fast it is
    played, `keep` leaves the new model file and the nodes' logs where they are.
    """
    with ExitStack() as stack:
        interrupted = _told_to_end(stack)
        folder = Path(tempfile.mkdtemp(prefix="parallel_cal_demo_"))
        if not keep:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            begin, hidden = time.monotonic(), None if bag else HIDDEN
            bag = Path(bag or BAG)
            model_file, story = _prepared([bag, *filter(None, [hidden])], folder), Story(json, keep)
            with _nodes(model_file, bag.parent, interrupted) as nodes, story:
                document = _calibrate(nodes, bag, rate, story) | {"model_file": str(model_file)}
                story.calibrated(document)
                if hidden:
                    document["hidden"] = _find_missing(nodes, hidden, story)
            document["seconds"] = time.monotonic() - begin
            story.end(document)
        except (ParallelCalError, KeyboardInterrupt) as error:
            console.error(str(error) or "interrupted; nothing is left running")
            return 1
    if json:
        console.emit(document)
    return 0


def _told_to_end(stack: ExitStack) -> Callable[[], bool]:
    """Whether SIGINT or SIGTERM came, while the stack is open.

    What a signal's handler raises may be swallowed, in a destructor for example: it only notes.
    """
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        before = signal.signal(number, lambda number, frame: asked.append(number))
        stack.callback(signal.signal, number, before)
    return lambda: bool(asked)


def _prepared(bags: Sequence[Path], folder: Path) -> Path:
    """A copy of the nominal model; the demo never changes the repository."""
    for path in (*bags, PRESET):
        if not path.exists():
            raise ParallelCalError(
                f"{path}: not there. The demo needs a clone of the repository: its bags/ and "
                "config/ are not part of the installed package"
            )
    return Path(shutil.copy(PRESET, folder / "robot.yaml"))


def _nodes(model_file: Path, bags: Path, interrupted: Callable[[], bool]) -> DemoNodes:
    try:
        from parallel_cal.nodes.demo_nodes import DemoNodes
    except ImportError as error:
        raise ParallelCalError(
            f"ROS 2 is missing ({error}): run 'make demo', or install the extra 'ros' and msg_defs"
        ) from None
    return DemoNodes(model_file, bags, interrupted)


def _calibrate(nodes: DemoNodes, bag: Path, rate: float, story: Story) -> dict[str, Any]:
    """Collect a recording, identify on it, and ask the robot's node before and after.

    ParallelCalError where a step fails, KeyboardInterrupt where it waits and is interrupted.
    """
    old = nodes.hash_served()
    status = nodes.collect(bag, _messages(bag), rate, story.progress)
    samples, joints = nodes.samples()
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
    before = nodes.answers(apart, joints).miss()
    story.missed("before", before)
    nodes.remove(apart)
    result = nodes.identify(HOLD_OUT, story.progress)
    fit = json_format.loads(result.json)
    story.identified(fit)
    seconds = nodes.wait_until_served(result.hash)
    story.served(nodes.model_file, result.hash, seconds)
    after = nodes.answers(apart, joints).miss()
    story.missed("after", after)
    noise = fit["noise_floor"]
    return {
        "samples": counted,
        "kept_apart": {"before": before, "after": after},
        "improvement": {k: before[f"{k}_mean"] / after[f"{k}_mean"] for k in UNITS},
        "at_noise": fit["chi2_per_dof"] <= fit["chi2_band"][1]
        and all(after[f"{k}_mean"] <= WITHIN_NOISE * noise[f"{k}_mean"] for k in UNITS),
        "held_out": fit["held_out"],
        "noise_floor": noise,
        "chi2_per_dof": fit["chi2_per_dof"],
        "warnings": fit["warnings"],
        "hash_before": old,
        "hash": result.hash,
        "served": after["model_hash"],
    }


def _find_missing(nodes: DemoNodes, bag: Path, story: Story) -> dict[str, Any]:
    """Diagnose another recording of the robot, add what is missing, ask the robot's node again."""
    nodes.load(bag)
    samples, joints = nodes.samples()
    apart = kept_apart(samples)
    story.loaded(bag.name, len(samples), len(apart))
    before = nodes.answers(apart, joints).miss()
    story.missed("before", before)
    nodes.remove(apart)
    result = nodes.diagnose(HOLD_OUT, story.progress)
    story.diagnosed(result.message)
    effects = json_format.loads(result.json)["effects"]
    if not effects:
        raise ParallelCalError(f"{bag}: the diagnosis names no effect: {result.message}")
    added = nodes.add_effect(effects[0])
    story.added(effects[0], nodes.wait_until_served(added.hash))
    after = nodes.answers(apart, joints).miss()
    story.missed("after", after)
    return {
        "recording": bag.name,
        "verdict": result.verdict,
        "effects": effects,
        "kept_apart": {"before": before, "after": after},
        "hash": added.hash,
    }


def _messages(bag: Path) -> int:
    """Joint readings and poses in a recording."""
    from parallel_cal.recordings.bag import list_topics

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
