"""The demo tells the truth, and leaves what it found."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest import mock

import pytest
from waits import children, wait_until

from parallel_cal.model.file.modelfile import model_hash, read_model
from parallel_cal.nodes import demo
from parallel_cal.session.session import Session
from parallel_cal.virtual.kinds import kinds_of

REPOSITORY = Path(__file__).parents[2]


def start(**environment):
    code = "import sys; from parallel_cal.nodes.demo import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )


@pytest.mark.wide
@pytest.mark.ros
def test_the_demo_finds_what_is_hidden_and_stops_at_the_noise(tmp_path, monkeypatch, capsys):
    """The robot calibrates itself through the real nodes, and what it lacks is in its file."""
    calibrate = pytest.importorskip("parallel_cal.nodes.calibrate")
    states, results, run = set(), [], calibrate.Calibration.run

    def run_recorded(self, hear, *given, **goal):
        def hear_recorded(status):
            states.add(status.state)
            hear(status)

        results.append(run(self, hear_recorded, *given, **goal))
        return results[0]

    monkeypatch.setattr(calibrate.Calibration, "run", run_recorded)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with mock.patch.dict(os.environ):  # the demo enters a ROS domain of its own
        assert demo.main(json=True, effect="backlash", seed=2) == 0
    [result], document = results, json.loads(capsys.readouterr().out)
    assert result.success, result.message
    assert result.verdict == "explained"
    assert states >= {"planning", "moving", "sampling", "asking", "judging", "done"}
    assert (document["hidden"], document["effects"]) == ("backlash", ["backlash"])
    assert document["success"]
    first, last = document["curve"][0], document["curve"][-1]
    assert first["poses"] == 0
    assert last["poses"] == document["poses"] <= demo.POSES
    assert last["error_unseen"] < 2 * 29e-6 < 10 * first["error_unseen"]
    (file,) = tmp_path.glob("*/robot.yaml")
    assert model_hash(file.read_text()) == document["hash"]
    assert [effect.name for effect in read_model(file).effects] == ["backlash"]
    found = Session(Path(document["folder"])).model
    assert [effect.name for effect in found.effects] == ["backlash"]


@pytest.mark.ros
def test_an_interrupted_demo_leaves_no_process_and_no_file(tmp_path):
    demo_process = start(TMPDIR=str(tmp_path))

    def up():
        return len(children(demo_process.pid)) == 3 or demo_process.poll() is not None

    wait_until(up, "three nodes")
    nodes = children(demo_process.pid)
    assert len(nodes) == 3, demo_process.communicate()[1]
    demo_process.send_signal(signal.SIGINT)
    _, err = demo_process.communicate(timeout=60)
    assert demo_process.returncode == 1
    assert "interrupted" in err
    assert "Traceback" not in err
    # The system takes a moment to clear away a process whose parent has gone.
    wait_until(lambda: not any(Path(f"/proc/{p}").exists() for p in nodes), "the nodes' end")
    assert list(tmp_path.glob("parallel_cal_demo_*")) == []


def test_the_demo_hides_what_its_robot_may_have():
    assert set(demo.HIDDEN) <= set(kinds_of("delta"))


def test_without_ros_the_demo_says_so(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "parallel_cal.nodes.calibrate", None)
    assert demo.main() == 1
    assert "ROS 2 is missing" in capsys.readouterr().err
