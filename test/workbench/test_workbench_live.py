"""The workbench beside running nodes: a robot's samples as they come, its model exchanged."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

from ros_helpers import NodeProcess
from workbench_page import LONG, Served, opened, until

from parallel_cal.diagnosis.comparison import compare
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.nodes.client import use_private_domain
from parallel_cal.nodes.watch import Watch
from parallel_cal.recordings.bag import list_topics
from parallel_cal.recordings.simulate import simulate
from parallel_cal.recordings.writer import write_bag
from parallel_cal.session.session import Session

MODEL, BAG = Path("config/delta_mockup_nominal.yaml"), Path("bags/delta_backlash")
pytestmark = [pytest.mark.ros, pytest.mark.wide]


def nodes_on(folder, name="_node"):
    """Process ids of nodes that serve a model in a folder."""
    found = subprocess.run(
        ["pgrep", "-f", f"{name} import main.*{folder}"],
        capture_output=True,
        text=True,
        check=False,
    )
    return [int(pid) for pid in found.stdout.split()]


def live(page):
    """The card of the nodes; the first screen has a button for the next step, too."""
    return page.get_by_role("region", name="Live")


def test_the_loop_on_nodes_that_the_workbench_starts(tmp_path):
    use_private_domain()
    with opened() as browser:
        served = Served(
            "--ros", MODEL, "--session", tmp_path / "s", "--hold-out", 0.5, "--namespace", "cell"
        )
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 1000})
            page.set_default_timeout(1000 * LONG)
            page.goto(served.url)
            page.get_by_text("No samples yet").wait_for()
            page.locator("#served").get_by_text("the model of this state").wait_for()
            replay = NodeProcess("replay_node", tmp_path, "/cell", bag=str(BAG), rate=6.0)
            page.locator("#live-error").get_by_text("mean").wait_for()
            page.locator("#collected").get_by_text("94 samples").wait_for()
            assert replay.ended() == 0
            live(page).get_by_role("button", name="Take samples").click()
            page.get_by_text("Where it fails").wait_for()
            page.get_by_role("button", name="Fit", exact=True).click()
            page.locator("#verdict").get_by_text("explained, not yet in the model").wait_for()
            page.get_by_role("button", name="add backlash", exact=True).click()
            page.locator("#verdict-words").get_by_text("down to the noise").wait_for()
            page.locator("#served").get_by_text("another model than that of this state").wait_for()
            page.get_by_role("button", name="Save", exact=True).click()
            page.locator("#served").get_by_text("(backlash)").wait_for()
            page.locator("#served").get_by_text("the model of this state").wait_for()
            page.get_by_role("spinbutton", name="poses", exact=True).fill("8")
            page.get_by_role("button", name="Plan", exact=True).click()
            page.get_by_role("figure", name="planned and measured poses").wait_for()
            page.get_by_role("button", name="Send to the robot").click()
            page.locator("#sent").get_by_text("pose 1: sent").wait_for()
            assert len(nodes_on(tmp_path)) == 2
            (calibration,) = nodes_on(tmp_path, "calibration_node")
            os.kill(calibration, signal.SIGKILL)
            page.locator("#trouble").get_by_text("calibration_node was ended by SIGKILL").wait_for()
            assert len(Session(tmp_path / "s").dataset) >= 90
        finally:
            served.end(signal.SIGTERM)
    assert nodes_on(tmp_path) == []  # what was started is ended


@pytest.mark.slow
def test_a_campaign_is_started_paused_and_stopped_on_the_page(tmp_path):
    use_private_domain()
    file = tmp_path / "robot.yaml"
    cell = NodeProcess(
        "virtual_cell_node",
        tmp_path,
        "/cell",
        robot="delta",
        seed=2,
        rate=4.0,
        model_file=str(file),
    )
    until(file.exists, "the nominal model")
    with opened() as browser:
        served = Served("--ros", file, "--session", tmp_path / "s", "--namespace", "cell")
        try:
            page = browser.new_page(viewport={"width": 1280, "height": 1000})
            page.set_default_timeout(1000 * LONG)
            page.goto(served.url)
            campaign = page.locator("#campaign")
            campaign.get_by_text("done: idle").wait_for()
            page.get_by_label("maximum poses").fill("40")
            page.get_by_role("button", name="Calibrate", exact=True).click()
            campaign.get_by_text(re.compile("[1-9] poses")).wait_for()
            assert page.get_by_role("button", name="Calibrate", exact=True).is_hidden()
            page.get_by_role("button", name="Pause").click()
            campaign.get_by_text("paused").wait_for()
            page.reload()  # whoever comes later sees the same
            campaign.get_by_text("paused").wait_for()
            page.get_by_role("button", name="Resume").click()
            campaign.get_by_text(re.compile("moving|sampling|planning|judging")).wait_for()
            page.get_by_role("button", name="Stop").click()
            campaign.get_by_text(re.compile("^stopped: .*Take samples")).wait_for()
            live(page).get_by_role("button", name="Take samples").click()
            page.get_by_text("Where it fails").wait_for()
            assert len(Session(tmp_path / "s").samples) >= 1
        finally:
            served.end(signal.SIGTERM)
            assert cell.end() == 0


def test_messages_of_nodes_are_gathered_and_silence_is_reported(tmp_path):
    model, bag = read_model(MODEL), tmp_path / "bag"
    off = np.random.default_rng(1).standard_normal(len(model.values)) * model.table.tolerance
    session = simulate(model.with_values(model.values + off * ~model.fixed), 12, 1)
    write_bag(session, bag)
    namespace = use_private_domain()
    watch, nodes = Watch(namespace), []
    try:
        until(lambda: len(watch.snapshot()["trouble"]) == 2, "nobody is there")
        assert watch.model_file(patience=0.1) == ""
        nodes += [
            NodeProcess(name, tmp_path, namespace, model_file=str(MODEL.resolve()))
            for name in ("kinematics_node", "calibration_node")
        ]
        until(lambda: not watch.snapshot()["trouble"], "both are heard")
        assert watch.model_file() == str(MODEL.resolve())
        # On a busy machine a replay may find the watch late, and a best-effort subscription has
        # missed what was published before.
        until(lambda: watch._measured, "the topic of the measured pose")
        topics = [topic.name.lstrip("/") for topic in list_topics(bag)[0]]
        names = [watch._node.resolve_topic_name(topic) for topic in topics]
        listeners = sum(watch._node.count_subscribers(name) for name in names)
        awaited = {"wait_for_subscribers": listeners, "patience": 120.0}
        replay = NodeProcess("replay_node", tmp_path, namespace, bag=str(bag), rate=4.0, **awaited)
        nodes.append(replay)
        until(lambda: watch.snapshot()["errors"], "a measured pose beside a predicted one")

        def joint_states():
            streams = [s for s in watch.snapshot()["streams"] if s["node"] == "kinematics_node"]
            return next((s for s in streams if s["what"] == "joint_states"), {})

        # While the bag plays: once it has ended, the stream is silent.
        until(lambda: joint_states().get("level") in ("ok", "warn"), "a healthy stream")
        until(lambda: watch.snapshot()["samples"].get("samples") == 12, "every sample")
        assert replay.ended() == 0
        told = watch.snapshot()
        typical = sorted(error for _, error in told["errors"])[len(told["errors"]) // 2]
        expected = compare(model, session.dataset()).errors.summary.position_rms
        assert 0.5 * expected < typical < 2 * expected
        assert int(joint_states()["received"]) > 500  # the rest is skipped on a busy computer
        with pytest.raises(Exception, match="allowed_folders"):
            watch.save_samples(Path("/dev/shm/elsewhere.json"))
        for node in nodes:
            assert node.end() == 0  # whether it has ended by itself or not
        until(lambda: "silent" in " ".join(watch.snapshot()["trouble"]), "they are missed")
    finally:
        print(watch.snapshot())
        watch.close()
        for node in nodes:
            node.end()


def test_without_nodes_and_without_a_model_there_is_nothing_to_open(tmp_path, capsys):
    use_private_domain()
    code = "import sys; from parallel_cal.cli.main import main; main(sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", code, "workbench", "--ros", "--no-open"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "no model: give MODEL.yaml to start the nodes on" in done.stderr
