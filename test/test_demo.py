"""The demo tells the truth and leaves nothing behind."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from parallel_cal.nodes import demo

REPOSITORY = Path(__file__).parents[1]


def start(*arguments, **environment):
    call = f"main({', '.join(arguments)})"
    code = f"import sys; from parallel_cal.nodes.demo import main; sys.exit({call})"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )


def children(pid):
    """Process ids of the nodes that a demo started."""
    try:
        return [int(c) for c in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []


def wait_until(condition, what, patience=60):
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.02)


@pytest.mark.wide
@pytest.mark.ros
def test_the_demo_brings_the_served_model_to_the_noise_and_finds_what_is_missing_later(tmp_path):
    demo_process = start("json=True", "keep=True", TMPDIR=str(tmp_path))
    out, err = demo_process.communicate(timeout=300)
    assert demo_process.returncode == 0, err
    document = json.loads(out)
    assert document["samples"]["collected"] == 94
    assert document["samples"]["dropped"] == 0
    assert 8 <= document["samples"]["kept_apart"] <= 16
    before, after = (document["kept_apart"][k] for k in ("before", "after"))
    assert before["position_mean"] > 500e-6
    assert after["position_mean"] < 1.5 * document["noise_floor"]["position_mean"]
    assert document["at_noise"]
    assert after["model_hash"] == document["hash"] != before["model_hash"]
    assert Path(document["model_file"]).exists()
    hidden = document["hidden"]
    assert (hidden["verdict"], hidden["effects"]) == ("explained", ["backlash"])
    before, after = (hidden["kept_apart"][k] for k in ("before", "after"))
    assert before["position_mean"] > 30e-6
    assert after["position_mean"] < 0.85 * before["position_mean"]
    assert before["model_hash"] == document["hash"] != hidden["hash"] == after["model_hash"]


@pytest.mark.ros
def test_an_interrupted_demo_leaves_no_process_and_no_file(tmp_path):
    demo_process = start(TMPDIR=str(tmp_path))
    wait_until(lambda: len(children(demo_process.pid)) == 3, "three nodes")
    nodes = children(demo_process.pid)
    demo_process.send_signal(signal.SIGINT)
    _, err = demo_process.communicate(timeout=60)
    assert demo_process.returncode == 1
    assert "interrupted" in err
    assert "Traceback" not in err
    # The system takes a moment to clear away a process whose parent has gone.
    wait_until(lambda: not any(Path(f"/proc/{p}").exists() for p in nodes), "the nodes' end")
    assert list(tmp_path.glob("parallel_cal_demo_*")) == []


def test_without_the_recordings_the_demo_says_what_is_missing(capsys):
    assert demo.main(bag="no/such/bag") == 1
    out, err = capsys.readouterr()
    assert "no/such/bag" in err
    assert "clone" in err
    assert err.count("\n") == 1
    assert "Traceback" not in out + err


def test_without_ros_the_demo_says_so(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "parallel_cal.nodes.demo_nodes", None)
    assert demo.main() == 1
    assert "ROS 2 is missing" in capsys.readouterr().err


def test_all_visits_of_a_pose_are_kept_apart_together():
    samples = [SimpleNamespace(id=i, replicate_of=-1) for i in range(1, 21)]
    samples += [SimpleNamespace(id=i + 20, replicate_of=i) for i in range(1, 21)]
    apart = {s.id for s in demo.kept_apart(samples)}
    assert len(apart) == 4
    assert {i + 20 for i in apart if i <= 20} == {i for i in apart if i > 20}
