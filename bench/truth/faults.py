"""Faults by the thousand, one row each: load, faults, lost, hung, crashed, time.

    python -m bench.truth.faults [--share 0.1] [ROW ...]

`lost` are samples or messages that were announced and are gone, or answers that are wrong; `hung`
what gave no answer in its time; `crashed` processes that ended by themselves. Anything but 0 in
these is a failure, and the exit status 1. `--share` does a part of each load.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.worker import TimeBudgetExceeded, Worker, WorkError
from parallel_cal.model.file.modelfile import model_hash, parse_model, read_model, write_model
from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.journal import Journal, read_journal
from parallel_cal.recordings.loading import load_dataset

ROOT = Path(__file__).parents[2]
BAG, MODEL = ROOT / "bags" / "delta_clean", ROOT / "config" / "delta_mockup_nominal.yaml"
PATIENCE = 200.0  # s; what takes longer hangs. A busy computer needs 20 s to start a process
END_TIMEOUT_S = 2.0  # s that a node may take to end after SIGTERM on an idle machine
IDLE = 0.1  # share of the machine that other work may take, and it is called idle


@dataclass(frozen=True)
class Row:
    """What came of a row; `faults` tells what was done, `refused` how many were told so."""

    load: int = 0
    faults: str = ""
    lost: int = 0
    hung: int = 0
    crashed: int = 0


# ---------------------------------------------------------------------- files, in a worker


def outcome_of(kind: str, path: str) -> str:
    """`read`, or `refused` by an error of ours; anything else is raised, and is a crash."""
    try:
        {"bag": load_dataset, "samples": load_dataset, "model": read_model}[kind](path)
    except ParallelCalError:
        return "refused"
    return "read"


def files(kind: str, n: int, mutant: Callable[[int], str]) -> Row:
    """n files, each read in a process with limits to time and memory."""
    from bench.truth.faults import outcome_of  # by a name that the worker knows, too

    worker, found = Worker(2048), {"read": 0, "refused": 0, "hung": 0, "crashed": 0}
    for i in range(n):
        try:
            what = worker.work(outcome_of, kind, mutant(i), seconds=PATIENCE)
        except TimeBudgetExceeded:
            what = "hung"
        except WorkError as error:
            what = "crashed"
            sys.stderr.write(f"{kind} {i}: {error}\n")
        found[what] += 1
    worker.end()
    faults = f"{found['refused']} refused, {found['read']} read"
    return Row(n, faults, hung=found["hung"], crashed=found["crashed"])


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes changed, cut out, doubled, swapped in blocks, cut off, or digits made others."""
    data, kind = bytearray(content), int(rng.choice(6))
    a, b = sorted(rng.integers(0, len(data), 2).tolist())
    if kind == 0:
        for at in rng.integers(0, len(data), int(rng.integers(1, 20))):
            digit = 48 <= data[int(at)] < 58
            data[int(at)] = int(rng.integers(48, 58) if digit else rng.integers(256))
    elif kind == 1:
        del data[a : min(b, a + 4096)]
    elif kind == 2:
        data[a:a] = data[a : min(b, a + 4096)]
    elif kind == 3:
        size = min(b - a, len(data) - b, 4096)
        data[a : a + size], data[b : b + size] = data[b : b + size], data[a : a + size]
    elif kind == 4:
        del data[a:]
    else:
        digits = [i for i, byte in enumerate(data[:100_000]) if 48 <= byte < 58]
        for at in rng.choice(digits, 3) if digits else ():
            data[int(at)] = int(rng.integers(48, 58))
    return bytes(data)


def bags(n: int, folder: Path) -> Row:
    from parallel_cal.model.model import new_model
    from parallel_cal.recordings.simulate import simulate
    from parallel_cal.recordings.writer import write_bag

    write_bag(simulate(new_model("delta24"), poses=4, seed=0), folder / "small")
    (data,) = (folder / "small").glob("*.mcap")
    content, rng = data.read_bytes(), np.random.default_rng(1)

    def mutant(i: int) -> str:
        data.write_bytes(mutated(content, rng))
        return str(data.parent)

    return files("bag", n, mutant)


def texts(kind: str, content: bytes, suffix: str, seed: int) -> Callable[[int, Path], Row]:
    def row(n: int, folder: Path) -> Row:
        rng, path = np.random.default_rng(seed), folder / f"file{suffix}"

        def mutant(i: int) -> str:
            path.write_bytes(mutated(content, rng))
            return str(path)

        return files(kind, n, mutant)

    return row


def models(n: int, folder: Path) -> Row:
    return texts("model", MODEL.read_bytes(), ".yaml", 2)(n, folder)


def sample_files(n: int, folder: Path) -> Row:
    load_dataset(BAG).select(range(5)).to_json(folder / "five.json")
    return texts("samples", (folder / "five.json").read_bytes(), ".json", 3)(n, folder)


# ---------------------------------------------------------------------- what is on the disk


def channel_messages() -> list[tuple[str, int, Any]]:
    from test_collector import messages_of

    return messages_of(BAG)


def collecting(messages: list[Any], folder: Path, told: int) -> None:
    """A collector with its journal, as the node has them; tells how many samples are safe."""
    collector, journal = Collector(), Journal(folder, "node")
    collector.resume(journal.resume())
    for i, (channel, log, message) in enumerate(messages):
        collector.receive(channel, message, log)
        if i % 400 == 0:
            collector.refresh(log)
            journal.keep(collector.entries())
            os.write(told, len(collector).to_bytes(4, "little"))


def killed(n: int, folder: Path) -> Row:
    """kill -9 while samples are collected and while model files are written."""
    messages, rng, lost = channel_messages(), np.random.default_rng(4), 0
    for i in range(n):
        place, (read, write) = folder / f"kill{i}", os.pipe()
        pid = os.fork()
        if pid == 0:
            collecting(messages[:6000], place, write)
            os._exit(0)
        os.close(write)
        first = os.read(read, 4)
        time.sleep(float(rng.uniform(0, 1.0)))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        safe = first
        while part := os.read(read, 4):
            safe = part
        os.close(read)
        resumed = sum(len(p.ids) for p in Journal(place, "node").resume())
        lost += max(0, int.from_bytes(safe, "little") - resumed)
    return Row(n, "kill -9 while collecting", lost=lost)


def killed_writing(n: int, folder: Path) -> Row:
    """kill -9 while a model file is replaced: it is one of the two that were written."""
    path, rng, lost = folder / "m.yaml", np.random.default_rng(5), 0
    one = read_model(MODEL)
    two = one.with_values(one.values + 1e-9)
    known = {model_hash(one), model_hash(two)}
    for _ in range(n):
        write_model(one, path)
        pid = os.fork()
        if pid == 0:
            while True:
                write_model(two, path)
                write_model(one, path)
        time.sleep(float(rng.uniform(0, 0.2)))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        lost += model_hash(path.read_text()) not in known
        parse_model(path.read_text())
    return Row(n, "kill -9 while a model file is written", lost=lost)


def disk_full(n: int, folder: Path) -> Row:
    """The disk fills at a seeded byte; with room again, everything is there."""
    messages, rng, lost = channel_messages()[:6000], np.random.default_rng(6), 0
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    collector = Collector()
    for channel, log, message in messages:
        collector.receive(channel, message, log)
    collector.refresh()
    entries, limits = collector.entries(), resource.getrlimit(resource.RLIMIT_FSIZE)
    for i in range(n):
        journal = Journal(folder / f"full{i}", "node")
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(rng.integers(1, 30_000)), limits[1]))
        try:
            journal.keep(entries)
            raise AssertionError("the disk was not full")
        except OSError:
            pass
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        journal.keep(entries)
        os.close(journal._file or 0)
        again = Journal(folder / f"full{i}", "node").resume()
        lost += len(entries) - sum(len(p.ids) for p in again)
    return Row(n, "disk full at a random byte, then room", lost=lost)


def read_only(n: int, folder: Path) -> Row:
    """A folder that cannot be written: an OSError each time, and the samples stay in memory."""
    collector, hung = Collector(), 0
    collector.load(BAG)
    for _ in range(n):
        try:
            Journal(Path("/proc/journal"), "node").keep(collector.entries())
            hung += 1
        except OSError:
            pass
    return Row(n, "journal folder read-only", lost=94 - len(collector), hung=hung)


def clock_jumps(n: int, folder: Path) -> Row:
    """One wild stamp a session, at a seeded place by a seeded amount: no sample may go. In every
    other session one stream's clock is set from there on: only the dwell in which it happens."""
    import copy

    messages, rng, lost = channel_messages()[:6000], np.random.default_rng(7), 0

    def samples(stream: list[Any]) -> int:
        collector = Collector()
        for channel, log, message in stream:
            collector.receive(channel, message, log)
        collector.refresh()
        return len(collector)

    whole = samples(messages)
    for k in range(n):
        at = int(rng.integers(1000, 5000))
        by, spoilt = int(rng.choice([-3600, -5, 2, 5, 3600, 10**6])), list(messages)
        for i in range(at, len(messages) if k % 2 else at + 1):
            channel, log, message = messages[i]
            if channel == messages[at][0] and hasattr(message, "header"):
                wild = copy.deepcopy(message)
                wild.header.stamp.sec += by
                spoilt[i] = (channel, log, wild)
        lost += max(0, whole - samples(spoilt) - k % 2)
    return Row(n, "one wild stamp, or one stream's clock set", lost=lost)


# ---------------------------------------------------------------------- nodes on a domain


class Pair:
    """Both nodes as processes, a client, and joint states at 200 Hz that must all be answered."""

    def __init__(self, folder: Path, **parameters: Any):
        from parallel_cal.nodes.client import Client, Process, use_private_domain

        self.folder, self.namespace = folder, use_private_domain()
        self.model = Path(shutil.copy(MODEL, folder / "robot.yaml"))
        files = {"model_file": str(self.model), "journal_folder": str(folder / "journal")}
        self.nodes = [
            Process(
                "kinematics_node", folder, self.namespace, **parameters, model_file=str(self.model)
            ),
            Process("calibration_node", folder, self.namespace, **files),
        ]
        self.client = Client("faults", self.namespace, self.nodes)

    def process(self, node: str, **parameters: Any) -> Any:
        from parallel_cal.nodes.client import Process

        return Process(node, self.folder, self.namespace, **parameters)

    def memory(self) -> list[int]:
        """Resident MB of both."""
        status = [Path(f"/proc/{n._process.pid}/status").read_text() for n in self.nodes]
        return [int(s.split("VmRSS:")[1].split()[0]) // 1024 for s in status]

    def end(self) -> int:
        """How many crashed, or did not end in time."""
        self.client.close()
        # On a busy machine, each process gets its share of a core only.
        limit = END_TIMEOUT_S * max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
        late = 0
        for node in self.nodes:
            begin = time.monotonic()
            if node._process.poll() is None:
                node._process.send_signal(signal.SIGTERM)
            late += node._process.wait(PATIENCE) != 0 or time.monotonic() - begin > limit
        return late


def requests(n: int, folder: Path) -> Row:
    """Wild numbers, lengths, names, solvers and conditions: each gets an answer."""
    from parallel_cal_msgs.msg import Condition, JointConfiguration
    from parallel_cal_msgs.srv import ComputeFK

    pair, rng, hung, refused = Pair(folder, request_time=1.0), np.random.default_rng(8), 0, 0
    wild = np.array([0.5, np.nan, np.inf, -np.inf, 1e308, -1e-308, 9.0, 0.0])
    solvers = ["", "newton", "homotopy", "lookup_table:size=400", "os.system", "../x", "a" * 9999]
    for _ in range(n):
        rows = [
            JointConfiguration(
                positions=rng.choice(wild, int(rng.choice([3, 3, 3, 0, 7]))).tolist()
            )
            for _ in range(int(rng.choice([0, 1, 5, 200])))
        ]
        names = [[], ["joint1", "joint2", "joint3"], ["joint1"] * 3, [""], ["\u2603"] * 50]
        fields = {
            "configurations": rows,
            "joint_names": names[int(rng.choice(len(names), p=[0.6, 0.2, 0.1, 0.05, 0.05]))],
            "all_solutions": bool(rng.random() < 0.2),
            "with_covariance": bool(rng.random() < 0.2),
            "solver": str(rng.choice(solvers, p=[0.7, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05])),
            "conditions": [Condition(name="payload", value=float(rng.choice(wild)))]
            * int(rng.random() < 0.2),
        }
        asked = pair.client.ask(ComputeFK, "kinematics_node/compute_fk", **fields)
        try:
            refused += bool(pair.client.await_result(asked, "an answer", PATIENCE).message)
        except ParallelCalError as error:
            sys.stderr.write(f"request: {error}\n")
            hung += 1
    return Row(n, f"{refused} refused as a whole", hung=hung, crashed=pair.end())


def traffic(n: int, folder: Path) -> Row:
    """n s of a recorded session, played six times as fast again and again: memory stays."""
    from parallel_cal_msgs.msg import CollectionStatus

    pair = Pair(folder)
    status = pair.client.subscribe_latest(CollectionStatus, "calibration_node/collection_status")
    pair.client.wait(lambda: bool(status), "a status")
    player = pair.process("replay_node", bag=str(BAG), rate=6.0, loop=True, wait_for_subscribers=4)
    begin, sizes, seen = time.monotonic(), [], []
    while time.monotonic() - begin < n / 6.0:
        until = time.monotonic() + 1.0
        pair.client.wait(lambda until=until: time.monotonic() > until, "a second")
        sizes.append(sum(pair.memory()))
        seen.append(status[0].lost)
    player.end()
    third = len(sizes) // 3
    grown = np.median(sizes[-third:]) / np.median(sizes[third : 2 * third]) - 1
    words = f"{status[0].joint_states_received} joint states, memory {sizes[-1]} MB, {grown:+.0%}"
    return Row(n, words, lost=int(seen[-1]), crashed=pair.end() + (grown > 0.25))


PUBLISH = """
import time, rclpy, numpy as np
from sensor_msgs.msg import JointState
rclpy.init(); node = rclpy.create_node("driver", namespace="{namespace}")
states = node.create_publisher(JointState, "joint_states", 1000)
while not states.get_subscription_count(): time.sleep(0.05)
time.sleep(2); begin = time.perf_counter()
message = JointState(name=["joint1", "joint2", "joint3"])
for i in range({n} * 1000):
    time.sleep(max(0.0, begin + i * 1e-3 - time.perf_counter()))
    now = time.time_ns()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
    message.position = [0.5 + 0.1 * np.sin(0.005 * i + k) for k in range(3)]
    states.publish(message)
states.wait_for_all_acked()
"""


def stream(n: int, folder: Path) -> Row:
    """n s of joint states at 1 kHz: those that no pose was published for, and the time it took.

    On a machine that is idle otherwise at most a thousandth may be lost; under other load all that
    is must be counted, and told as WARN or ERROR.
    """
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    pair, told = Pair(folder), list[tuple[bytes, dict[str, str]]]()

    def hear(message: Any) -> None:
        for status in message.status:
            if status.name.endswith("kinematics_node: joint_states"):
                told.append((status.level, {item.key: item.value for item in status.values}))

    pair.client._node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
    code = PUBLISH.format(namespace=pair.namespace, n=n)
    before = Load.now()
    with subprocess.Popen([sys.executable, "-c", code]) as driver:
        pids = [os.getpid(), driver.pid, *(node._process.pid for node in pair.nodes)]
        own = [0.0] * len(pids)

        def ended() -> bool:
            if driver.poll() is None:
                own[:] = map(cpu_seconds, pids)
            return driver.poll() is not None

        started = [cpu_seconds(pid) for pid in pids]
        pair.client.wait(ended, "the driver", 2 * n + 60)
    others = Load.now().others(before, sum(own) - sum(started))
    known = len(told)

    def is_counted() -> bool:
        """Whether two counts in a row, both after the last message, are equal."""
        recent = [items["Events since startup"] for _, items in told[max(known, len(told) - 2) :]]
        return len(recent) == 2 and recent[0] == recent[1]

    pair.client.wait(is_counted, "the last count", PATIENCE)
    end = told[-1][1]
    came, lost, skipped = (
        int(end[f"{kind} since startup"]) for kind in ("Events", "Lost", "Skipped")
    )
    missed, uncounted = lost + skipped, max(0, 1000 * n - came - lost)
    warned = any(level != DiagnosticStatus.OK for level, _ in told)
    late = sorted(float(items["Latency p99 (ms)"]) for _, items in told)
    words = (
        f"{missed} of {1000 * n} without a pose, p99 of 10 s {np.median(late):.2f} ms, at worst "
        f"{late[-1]:.2f}; other work took {others:.0%} of the machine"
    )
    wrong = uncounted
    if missed > n and (others < IDLE or not warned):
        wrong += missed
    return Row(1000 * n, words, lost=wrong, crashed=pair.end())


@dataclass(frozen=True)
class Load:
    """CPU seconds of the whole machine that were spent, and that there were."""

    busy: float
    all: float

    @classmethod
    def now(cls) -> Load:
        ticks = [int(t) for t in Path("/proc/stat").read_text().split("\n")[0].split()[1:9]]
        second = os.sysconf("SC_CLK_TCK")
        return cls((sum(ticks) - ticks[3] - ticks[4]) / second, sum(ticks) / second)

    def others(self, before: Load, own: float) -> float:
        """The share of the machine that others took since."""
        return max(0.0, (self.busy - before.busy - own) / max(self.all - before.all, 1e-9))


def cpu_seconds(pid: int) -> float:
    """What a process has spent; 0 once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def terminated(n: int, folder: Path) -> Row:
    """SIGTERM to both nodes in the middle of a diagnosis and of a long request."""
    from parallel_cal_msgs.action import Diagnose
    from parallel_cal_msgs.msg import JointConfiguration
    from parallel_cal_msgs.srv import ComputeFK, LoadSamples

    late, longest = 0, 0.0
    for i in range(n):
        place = folder / f"end{i}"
        place.mkdir()
        pair, heard = Pair(place, request_time=600.0), list[Any]()
        samples = str(shutil.copytree(BAG, place / "bag"))
        pair.client.call(LoadSamples, "calibration_node/load_samples", path=samples)
        pair.client.send_goal(Diagnose, "calibration_node/diagnose", heard.append)
        rows = [JointConfiguration(positions=[0.5] * 3)] * 5000
        name = "kinematics_node/compute_fk"
        pair.client.ask(ComputeFK, name, configurations=rows, all_solutions=True)
        pair.client.wait(lambda heard=heard: len(heard) > 1, "the diagnosis")
        begin = time.monotonic()
        late += pair.end()
        longest = max(longest, time.monotonic() - begin)
    words = f"SIGTERM in a diagnosis and a request, both ended in {longest:.2f} s at most"
    return Row(n, words, crashed=late)


def publishers(n: int, folder: Path) -> Row:
    """Publishers that are killed in the middle of a session: the nodes go on."""
    pair, rng = Pair(folder), np.random.default_rng(9)
    for _ in range(n):
        player = pair.process("replay_node", bag=str(BAG), rate=5.0)
        wait = time.monotonic() + 2 + float(rng.uniform(0, 2))
        pair.client.wait(lambda wait=wait: time.monotonic() > wait, "a moment")
        player._process.kill()
        player._process.wait()
    hung = not answers(pair)
    return Row(n, "publishers killed", hung=hung, crashed=pair.end())


def participants(n: int, folder: Path) -> Row:
    """DDS participants that come and go, half of them killed in the middle of a request."""
    from parallel_cal_msgs.srv import ComputeFK

    from parallel_cal.nodes.client import Client

    pair = Pair(folder)
    for i in range(n):
        other = Client(f"other{i}", pair.namespace, [])
        other._node.create_client(ComputeFK, "kinematics_node/compute_fk").call_async(
            ComputeFK.Request()
        )
        other.close()
    hung = not answers(pair)
    return Row(n, "participants come and go", hung=hung, crashed=pair.end())


# ---------------------------------------------------------------------- a foreign cell


class FaultyCell:
    """The cell of bench/truth/foreign_cell.py at 2.5 times real time, with a fault."""

    def __init__(self, folder: Path, *values: str):
        from bench.truth.foreign_runs import ForeignCell

        folder.mkdir()
        self.cell = ForeignCell(folder, ["speed=2.5", *values])

    def __enter__(self) -> Any:
        return self.cell

    def __exit__(self, *given: object) -> None:
        self.cell.end()


MAX_GOALS = 3  # a campaign may stop, but must go on when the goal is sent again


def calibrate(cell: Any, poses: int, *effects: str) -> list[Any]:
    """Send a goal until there is a verdict, MAX_GOALS times at most; return all runs.

    A busy computer may give the cell itself no processor for a second: then the campaign stops,
    because nobody knows where the robot is.
    """
    runs = [cell.calibrate(poses=poses, effects=effects)]
    while not runs[-1].verdict and len(runs) < MAX_GOALS:
        sys.stderr.write(f"stopped after {runs[-1].poses} poses: {runs[-1].message}\n")
        runs.append(cell.calibrate(poses=poses, effects=effects))
    return runs


def slipped_target(n: int, folder: Path) -> Row:
    """A target that slips in the middle: the campaign ends with a verdict and a readable model."""
    wrong, poses, goals = 0, 0, 0
    for i in range(n):
        with FaultyCell(folder / f"{i}", f"seed={i}", f"slip_after={35 + 5 * i}.0") as cell:
            runs = calibrate(cell, 26, "backlash", "hysteresis", "device_bump")
            wrong += not runs[-1].verdict
            poses, goals = poses + runs[-1].poses, goals + len(runs)
            if cell.better.exists():
                read_model(cell.better)
    return Row(n, f"target slips by 0.3 mm; {poses} poses, {goals} goals", lost=wrong)


def slow_node(n: int, folder: Path) -> Row:
    """Campaigns beside twice as many busy loops as cores: no target counts as lost."""
    from bench.truth.foreign_runs import busy_loops

    wrong, waits, goals = 0, 0, 0
    loops = 2 * (os.cpu_count() or 1)
    for i in range(n):
        with busy_loops(loops), FaultyCell(folder / f"{i}", f"seed={i}") as cell:
            runs = calibrate(cell, 24, "backlash")
        reasons = [reason for run in runs for reason in run.reasons.elements()]
        waits += sum("not processed" in reason for reason in reasons)
        wrong += any("no sample at this pose" in run.message for run in runs)
        wrong += not runs[-1].verdict
        goals += len(runs)
    words = f"{loops} busy loops; {waits} waits for unprocessed poses, {goals} goals"
    return Row(n, words, lost=wrong)


def stuck_joint(n: int, folder: Path) -> Row:
    """A leg that sticks: the campaign stops and names this leg and no other."""
    rng, wrong = np.random.default_rng(10), 0
    for i in range(n):
        leg, after = int(rng.integers(1, 7)), float(rng.uniform(25.0, 40.0))
        fault = f"stuck_leg={leg}", f"stuck_after={after:.1f}"
        with FaultyCell(folder / f"{i}", f"seed={i}", *fault) as cell:
            message = cell.calibrate().message
        wrong += re.findall(r"leg\d", message) != [f"leg{leg}"]
    return Row(n, "a leg sticks; another one named counts as lost", lost=wrong)


def limit_switch(n: int, folder: Path) -> Row:
    """A leg with a limit switch in its range: named with its position, and the campaign goes on
    once the model file states that limit."""
    rng, wrong, more = np.random.default_rng(11), 0, 0
    for i in range(n):
        leg, at = int(rng.integers(1, 7)), float(rng.uniform(0.105, 0.115))
        fault = f"switch_leg={leg}", f"switch_at={at:.4f}"
        with FaultyCell(folder / f"{i}", f"seed={i}", *fault) as cell:
            first = cell.calibrate(poses=24, effects=["backlash"])
            # It is stopped on its path, or just before its end.
            named = rf"^leg{leg} (left its path \(at|was sent to \S+ m but is at) {at:.4f}"
            if not re.search(named, first.message):
                wrong += 1
                sys.stderr.write(f"limit_switch {i}: {first.message}\n")
                continue
            model = read_model(cell.model_file)
            limits = list(model.mechanism.joint_limits)
            limits[leg - 1] = (limits[leg - 1][0], round(at, 4))
            model.mechanism.joint_limits = tuple(limits)
            write_model(model, cell.model_file)
            again = calibrate(cell, 24, "backlash")[-1]
            wrong += not again.verdict
            more += again.poses - first.poses
    return Row(n, f"{more} poses measured after the limit was stated", lost=wrong)


def best_effort(n: int, folder: Path) -> Row:
    """A tracker that publishes best effort: its poses become samples."""
    from parallel_cal_msgs.msg import CollectionStatus

    lost, paired = 0, 0
    for i in range(n):
        with FaultyCell(folder / f"{i}", f"seed={i}", "best_effort=true") as cell:
            status = cell.client.subscribe_latest(
                CollectionStatus, "calibration_node/collection_status"
            )
            try:
                cell.client.wait(
                    lambda status=status: bool(status) and status[0].samples > 0, "a sample"
                )
                paired += status[0].paired
            except ParallelCalError as error:
                sys.stderr.write(f"best_effort {i}: {error}\n")
                lost += 1
    return Row(n, f"poses sent best effort, {paired} of them paired", lost=lost)


def journal_of_two(n: int, folder: Path) -> Row:
    """Two nodes of one name: the second keeps a journal of its own, and after kill -9 only that
    one is resumed while the first node runs."""
    collector, lost = Collector(), 0
    collector.load(BAG)
    entries, rng = collector.entries(), np.random.default_rng(12)
    for i in range(n):
        place, count = folder / f"two{i}", int(rng.integers(1, len(entries)))
        first = Journal(place, "node")
        first.keep(entries)
        pid = os.fork()
        if pid == 0:
            second = Journal(place, "node")
            resumed = second.resume()
            second.keep(dict(list(entries.items())[:count]))
            os.kill(os.getpid(), signal.SIGKILL if second.busy and not resumed else signal.SIGABRT)
        lost += os.waitpid(pid, 0)[1] != signal.SIGKILL
        third = Journal(place, "node")
        resumed = sum(len(part.ids) for part in third.resume())
        kept = sum(len(part.ids) for part in read_journal(first.path))
        lost += abs(resumed - count) + len(entries) - kept
        first.end("in order")
        third.end("in order")
    return Row(n, "two nodes with one journal, one killed", lost=lost)


def file_names(n: int, folder: Path) -> Row:
    """Names that no file of samples may have: refused, and nothing is written."""
    from parallel_cal_msgs.srv import LoadSamples, SaveSamples

    pair, rng, hung = Pair(folder), np.random.default_rng(13), 0
    place = folder / "journal"
    samples = str(shutil.copytree(BAG, place / "bag"))
    pair.client.call(LoadSamples, "calibration_node/load_samples", path=samples)
    (place / "notes.json").write_text("{}")
    away = Path(tempfile.mkdtemp()) / "away.json"  # not in a folder that requests may use
    (place / "link.json").symlink_to(away)
    kept = {path: path.lstat().st_mtime_ns for path in folder.rglob("*.json")}
    heads = ["", ".", "..", "../", ".config/", "/etc/", "/", "~/", "a/../../", "link.json/", "x/"]
    stems = [".bash_profile", "notes", "link", "a" * 300, "a\nb", ".", "", "\u2603", "a.sh"]
    tails = ["", ".json", ".JSON", ".json.sh", ".yaml", ".json/", ".json ", ".journal"]
    wrong = written = 0
    for _ in range(n):
        name = "".join(str(rng.choice(part)) for part in (heads, stems, tails))
        path = name if name.startswith(("/", "~")) else f"{place}/{name}"
        asked = pair.client.ask(SaveSamples, "calibration_node/save_samples", path=path)
        try:
            answer = pair.client.await_result(asked, "an answer", PATIENCE)
        except ParallelCalError as error:
            sys.stderr.write(f"file_names {path!r}: {error}\n")
            hung += 1
            continue
        real = Path(os.path.realpath(path))
        inside = real.parts[len(folder.parts) :] if real.is_relative_to(folder) else (".",)
        fits = real.suffix == ".json" and not any(part.startswith(".") for part in inside)
        written += answer.success
        if answer.success and not fits:
            sys.stderr.write(f"file_names {path!r}: {answer.message}\n")
            wrong += 1
    changed = {p for p, moment in kept.items() if p.lstat().st_mtime_ns != moment}
    strange = [p for p in folder.rglob("*") if p.name.startswith(".") or p.suffix == ".sh"]
    wrong += len(changed) + len(strange) + away.exists()
    shutil.rmtree(away.parent)
    words = f"drawn names of files; {written} may be written and were"
    return Row(n, words, lost=wrong, hung=hung)


# ---------------------------------------------------------------------- a controller's action


@contextmanager
def action_desk(folder: Path) -> Iterator[Any]:
    """The robot of action_robot.py, both nodes with its action, and a client of all."""
    from action_robot import HOME
    from parallel_cal_msgs.msg import CommandStatus
    from test_trajectory_action import Desk

    desk = Desk(folder)
    try:
        # Refused until the node knows from a joint state where the robot is.
        desk.wait(lambda: desk.go(HOME).status != CommandStatus.REFUSED, "the node")
        yield desk
    finally:
        desk.close()  # AssertionError if a node crashed


# The faults of a controller: what is done to the robot's server, and what is said of the motion.
# In the middle of a motion are those of MIDDLE; `late` and `refused` do not end in FAILED.
ACTION_FAULTS = {
    "rejected": "the controller rejected the trajectory",
    "path": "path tolerance violated (joint{joint} is off by",
    "goal": "goal tolerance violated",
    "mute": "no answer to the goal for",
    "late": "",
    "silent": "no feedback for",
    "gone": "no node provides the action",
    "refused": "",
}
MIDDLE = ("silent", "gone", "refused")
SLOW_RATE = 0.2  # of the robot's clock, so that a fault comes in the middle of a motion


def break_controller(robot: Any, fault: str, joint: int) -> None:
    """Let a fault begin; `robot.repair()` and `restore` end it."""
    robot.accepts = fault != "rejected"
    robot.stuck = joint if fault == "path" else 0
    robot.lag = 0.015 if fault == "goal" else 0.0  # rad: between the two tolerances
    robot.obeys = fault != "refused"
    if fault in ("mute", "late"):
        robot.answers.clear()
    if fault == "lost":
        robot.lose(1)
    if fault == "silent":
        robot.reports.clear()
    if fault == "gone":
        robot.server.destroy()


def restore(desk: Any, fault: str) -> None:
    desk.robot.repair()
    desk.robot.rate = 2.0
    if fault == "gone":
        desk.robot.serve()


def target_with_fault(desk: Any, fault: str, joint: int, place: Any, delay: float) -> str:
    """Send a target to a controller with a fault; return what was wrong, or nothing."""
    from action_robot import HOME
    from parallel_cal_msgs.msg import CommandStatus, MotionStatus

    ended = MotionStatus.ARRIVED, MotionStatus.FAILED
    for heard in (desk.motions, desk.robot.goals):
        heard.clear()
    if fault not in MIDDLE:
        break_controller(desk.robot, fault, joint)
    else:
        desk.robot.rate = SLOW_RATE
    if desk.go(place).status == CommandStatus.REFUSED:
        return f"refused: {desk.commands[-1].message}"
    if fault in MIDDLE:
        desk.wait(lambda: any(motion.errors for motion in desk.motions), "the motion")
        break_controller(desk.robot, fault, joint)
    if fault == "late":
        until = time.monotonic() + delay
        desk.wait(lambda: time.monotonic() > until, "a moment")
        desk.robot.answers.set()
    if fault == "refused":
        desk.stop()
        desk.wait(lambda: desk.motions[-1].source == "stop", "the trajectory that stops")
        desk.robot.rate = 2.0
    end = desk.until(*ended)
    restore(desk, fault)
    wanted = ACTION_FAULTS[fault].format(joint=joint)
    if (end.state == MotionStatus.FAILED) != bool(wanted) or wanted not in end.message:
        return f"state {end.state}: {end.message}"
    gone = float(np.linalg.norm(desk.here() - HOME))
    whole = float(np.linalg.norm(np.subtract(place, HOME)))
    # A late answer to a goal that was given up is cancelled: the robot moves a little until then.
    if gone > {"rejected": 0.01, "mute": 0.2, "refused": 0.9}.get(fault, 1.1) * whole:
        return f"the robot moved by {gone:.5f} of {whole:.5f} m"
    return ""


def go_home(desk: Any) -> str:
    """Return what kept the robot from its home, or nothing."""
    from action_robot import HOME
    from parallel_cal_msgs.msg import MotionStatus

    desk.motions.clear()  # an older one may have arrived
    desk.go(HOME)
    desk.wait(lambda: bool(desk.motions), "the motion")
    end = desk.until(MotionStatus.ARRIVED, MotionStatus.FAILED)
    return "" if end.state == MotionStatus.ARRIVED else f"on the way home: {end.message}"


def trajectory_action(n: int, folder: Path) -> Row:
    """Faults of a controller's action while kinematics_node moves the robot to targets: each
    motion must end with the reason, and the next one must arrive."""
    from action_robot import HOME

    from parallel_cal.nodes.client import NodeError

    rng, lost, hung, kills = np.random.default_rng(14), 0, 0, max(1, n // 8)
    with action_desk(folder) as desk:
        for i in range(n):
            fault, joint = list(ACTION_FAULTS)[i % len(ACTION_FAULTS)], int(rng.integers(1, 4))
            place = HOME + rng.choice([-1, 1], 3) * rng.uniform(0.02, 0.04, 3)
            delay = float(rng.uniform(0, 5))
            try:
                wrong = go_home(desk) or target_with_fault(desk, fault, joint, place, delay)
                wrong = wrong or go_home(desk)
            except NodeError as error:
                hung += 1
                sys.stderr.write(f"trajectory_action {i} {fault}: {error}\n")
                restore(desk, fault)
                continue
            if wrong:
                lost += 1
                sys.stderr.write(f"trajectory_action {i} {fault}: {wrong}\n")
        hung += killed_controllers(desk, kills)
    return Row(n + kills, f"eight faults of a controller, and {kills} kill -9", lost, hung)


def campaign_action(n: int, folder: Path) -> Row:
    """The faults of a controller in campaigns: each campaign ends with the reason and goes on with
    the next goal. A goal that is lost or answered late does not end it."""
    from parallel_cal_msgs.action import Calibrate

    from parallel_cal.nodes.client import NodeError

    rng, lost, hung, faults = np.random.default_rng(15), 0, 0, [*ACTION_FAULTS, "lost"]

    def begin(desk: Any, afresh: bool) -> tuple[Any, Any]:
        handle = desk.client.send_goal(
            Calibrate, "calibration_node/calibrate", lambda _: None, enough=1e-9, afresh=afresh
        )
        return handle, handle.get_result_async()

    def measure(desk: Any, result: Any, poses: int) -> bool:
        """Wait for poses; False if the campaign ended before."""
        ready = lambda: desk.status[0].poses >= poses and desk.status[0].state == "moving"  # noqa: E731
        desk.wait(lambda: result.done() or ready(), f"{poses} poses")
        return not result.done()

    def run(desk: Any, fault: str, joint: int, poses: int, delay: float) -> str:
        handle, result = begin(desk, afresh=True)
        if not measure(desk, result, poses):
            return str(result.result().result.message)
        break_controller(desk.robot, fault, joint)
        if fault == "refused":
            handle.cancel_goal_async()
        if fault == "late":
            until = time.monotonic() + delay
            desk.wait(lambda: time.monotonic() > until, "a moment")
            desk.robot.answers.set()
        elif fault != "lost":
            desk.wait(result.done, "the end of the campaign")
            message = result.result().result.message
            reasons = [ACTION_FAULTS[fault].format(joint=joint)]
            if fault == "silent":  # before the first feedback: some controllers never send any
                reasons.append("the controller's action has not ended its goal")
            if fault == "refused":
                desk.here()  # NodeError if it does not come to rest
            restore(desk, fault)
            if not any(reason in message for reason in reasons):
                return str(message)
            handle, result = begin(desk, afresh=False)
        # The motion that is under way at the fault may have its answer already.
        if not measure(desk, result, poses + (2 if fault == "lost" else 1)):
            return str(result.result().result.message)
        handle.cancel_goal_async()
        desk.wait(result.done, "the cancel")
        return ""

    with action_desk(folder) as desk:
        for i in range(n):
            fault, joint = faults[i % len(faults)], int(rng.integers(1, 4))
            poses, delay = int(rng.integers(1, 4)), float(rng.uniform(0, 5))
            try:
                wrong = run(desk, fault, joint, poses, delay)
            except NodeError as error:
                hung += 1
                sys.stderr.write(f"campaign_action {i} {fault}: {error}\n")
                break
            if wrong:
                lost += 1
                sys.stderr.write(f"campaign_action {i} {fault}: {wrong}\n")
            desk.robot.repair()
    return Row(n, "nine faults of a controller in campaigns", lost, hung)


def killed_controllers(desk: Any, n: int) -> int:
    """Kill the robot's process in the middle of motions; count those that nobody gave up."""
    from parallel_cal_msgs.msg import CommandStatus, MotionStatus

    from parallel_cal.nodes.client import NodeError

    desk.robot.close()
    desk.robot.close = lambda: None  # the desk closes it again
    script, space = ROOT / "test" / "helpers" / "action_robot.py", desk.client._node.get_namespace()
    hung = 0

    def moves() -> bool:
        return any(motion.errors for motion in desk.motions)

    for i in range(n):
        desk.states.clear()
        desk.motions.clear()
        with subprocess.Popen([sys.executable, str(script), space, str(SLOW_RATE / 2)]) as robot:
            try:
                desk.wait(lambda: bool(desk.states), "the robot")
                # DDS may lose an answer to a node that the server has not discovered yet.
                while not moves():
                    desk.motions.clear()
                    while desk.go((0.03, 0.02, 0.21)).status == CommandStatus.REFUSED:
                        pass
                    desk.wait(
                        lambda: moves() or bool(desk.motions and desk.motions[-1].message),
                        "the motion",
                    )
                robot.kill()
                desk.until(MotionStatus.FAILED)
            except NodeError as error:
                hung += 1
                sys.stderr.write(f"kill {i}: {error}\n")
            finally:
                robot.kill()
    return hung


def answers(pair: Pair) -> bool:
    from parallel_cal_msgs.msg import JointConfiguration
    from parallel_cal_msgs.srv import ComputeFK

    rows = [JointConfiguration(positions=[0.5] * 3)]
    try:
        found = pair.client.call(ComputeFK, "kinematics_node/compute_fk", configurations=rows)
    except ParallelCalError:
        return False
    return not found.message


ROWS: dict[str, tuple[Callable[[int, Path], Row], int]] = {
    "killed": (killed, 100),
    "killed_writing": (killed_writing, 100),
    "bags": (bags, 2000),
    "models": (models, 1000),
    "sample_files": (sample_files, 500),
    "disk_full": (disk_full, 50),
    "read_only": (read_only, 20),
    "clock_jumps": (clock_jumps, 50),
    "stream": (stream, 60),
    "terminated": (terminated, 20),
    "requests": (requests, 300),
    "publishers": (publishers, 10),
    "participants": (participants, 100),
    "traffic": (traffic, 3600),
    "slipped_target": (slipped_target, 4),
    "slow_node": (slow_node, 4),
    "stuck_joint": (stuck_joint, 12),
    "limit_switch": (limit_switch, 6),
    "best_effort": (best_effort, 6),
    "journal_of_two": (journal_of_two, 50),
    "file_names": (file_names, 300),
    "trajectory_action": (trajectory_action, 40),
    "campaign_action": (campaign_action, 18),
}


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("rows", nargs="*", help=", ".join(ROWS))
    arguments.add_argument("--share", type=float, default=1.0, help="of each load")
    given = arguments.parse_args()
    failed = False
    print(f"{'row':15} {'load':>5} {'lost':>5} {'hung':>5} {'crashed':>7} {'s':>6}  faults")
    for name in given.rows or ROWS:
        make, load = ROWS[name]
        with tempfile.TemporaryDirectory() as folder:
            begin = time.monotonic()
            row = make(max(1, round(load * given.share)), Path(folder))
            seconds = time.monotonic() - begin
        row = replace(row, lost=int(row.lost), hung=int(row.hung), crashed=int(row.crashed))
        failed |= bool(row.lost or row.hung or row.crashed)
        print(
            f"{name:15} {row.load:5} {row.lost:5} {row.hung:5} {row.crashed:7} {seconds:6.0f}  "
            f"{row.faults}",
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
