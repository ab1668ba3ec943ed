"""The model in use, exchanged whole or not at all; the file watch; what the streams remember."""

import os
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import ModelFileError, SolveError
from parallel_cal.kinematics.all_solutions import inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.file.modelfile import model_hash, read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins
from parallel_cal.model.structure import _cached_structure
from parallel_cal.nodes.file_watch import DEBOUNCE, FileWatch
from parallel_cal.nodes.model_server import ModelServer, ServedModel, self_test
from parallel_cal.nodes.stream_memory import DirectionTracker, Memory, joints_for

CONFIG = Path(__file__).parents[2] / "config"
NOMINAL, IDENTIFIED = CONFIG / "delta_mockup_nominal.yaml", CONFIG / "delta_mockup_identified.yaml"
JOINTS = np.array([0.5, 0.55, 0.6])


@pytest.fixture
def server():
    reports = []
    server = ModelServer(reports.append)
    server.reports = reports
    assert server.load(NOMINAL, "startup").ok
    yield server
    server.wait_until_compiled(60)


def spoilt(path, old, new):
    text = IDENTIFIED.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def test_a_good_file_is_in_use_with_the_hash_of_its_text(server):
    server.load(IDENTIFIED, "service")
    assert server.current.hash == model_hash(IDENTIFIED.read_text())
    expected = Kinematics(read_model(IDENTIFIED)).direct(JOINTS)
    assert (server.current.kinematics.direct(JOINTS).position == expected.position).all()


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("mechanism: delta54", "mechanism: delta55", "delta55"),
        ("value: 0.075902", "value: .nan", "D_x"),
        ("value: 0.075902", "value: 75.902", "D_x"),
        ("noise:", "nose:", "nose"),
        ("0.14], high: [0.06, 0.06, 0.26]", "0.54], high: [0.06, 0.06, 0.56]", "self-test"),
    ],
)
def test_a_bad_file_changes_nothing_and_the_reason_is_reported(server, tmp_path, old, new, word):
    before = server.current
    attempt = server.load(spoilt(tmp_path / "bad.yaml", old, new), "watch")
    assert not attempt.ok
    assert word in attempt.reason
    assert "bad.yaml" in attempt.reason
    assert server.reports[-1] == server.last == attempt
    assert server.current.hash == before.hash
    assert server.current.model is before.model


def test_missing_binary_and_unnamed_files_are_reasons_not_exceptions(server, tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "none.yaml", tmp_path / "binary.yaml", tmp_path, ""):
        assert not server.load(path, "service").ok
    assert server.current.path == str(NOMINAL)


def test_the_same_content_again_keeps_the_model_and_is_reported(server):
    model = server.current.model
    attempt = server.load(NOMINAL, "service")
    assert attempt.ok
    assert "same content" in attempt.reason
    assert server.current.model is model
    assert len(server.reports) == 2


def test_a_file_with_other_values_uses_what_was_derived_for_the_mechanism_before(server, tmp_path):
    """Deriving it again left 0.55 MB with each of 200 reloads."""
    model, path = read_model(NOMINAL), tmp_path / "robot.yaml"
    before = server.current.model
    for k in range(3):
        write_model(model.with_values(model.values + 1e-6 * (k + 1)), path)
        assert server.load(path, "service").ok
        assert server.current.model.structure is before.structure
        assert np.array_equal(server.current.model.values, read_model(path).values)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("low: -0.52", "low: -0.42"),
        ("nominal: 0.076,", "nominal: 0.0761,"),
        ("low: [-0.06", "low: [-0.05"),
    ],
)
def test_a_file_with_another_mechanism_is_used_with_its_own(server, tmp_path, old, new):
    text, path = NOMINAL.read_text(), tmp_path / "robot.yaml"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert server.load(path, "service").ok
    here, read = server.current.model.mechanism, read_model(path).mechanism
    assert (here.joint_limits, here.workspace) == (read.joint_limits, read.workspace)
    assert tuple(here.parameters) == tuple(read.parameters)


def test_compiled_code_takes_over_and_gives_the_very_same_numbers(server):
    slow = Kinematics(read_model(NOMINAL))
    server.wait_until_compiled(60)
    fast = server.current.kinematics
    assert server.current.hash == model_hash(NOMINAL.read_text())
    for q in np.random.default_rng(1).uniform(0.2, 0.9, (50, 3)):
        assert (fast.direct(q).position == slow.direct(q).position).all()


def test_a_late_compilation_does_not_bring_an_old_model_back(server):
    old = server.current
    server.load(IDENTIFIED, "service")
    server._compile(old)
    assert server.current.hash == model_hash(IDENTIFIED.read_text())


@pytest.mark.parametrize(
    "name", [n for n in list_plugins("mechanisms") if n not in ("serial", "chain")]
)
def test_every_mechanism_passes_its_self_test(name):
    self_test(Kinematics(new_model(name)))


def test_the_self_test_sees_a_direct_problem_that_does_not_lead_back(monkeypatch):
    kinematics = Kinematics(new_model("delta24"))
    inverse = kinematics.inverse
    monkeypatch.setattr(
        kinematics,
        "inverse",
        lambda *a, **k: (s := inverse(*a, **k)) and replace(s, joints=s.joints + 1e-6),
    )
    with pytest.raises(ModelFileError, match="misses"):
        self_test(kinematics)


# ------------------------------------------------------------------ the file watch


class CountedWatch(FileWatch):
    """Counts its looks."""

    looks = 0

    def _has_settled_change(self):
        self.looks += 1
        return super()._has_settled_change()


def unseen(changed, watch):
    """Whether the watch has looked three times more, and seen nothing."""
    enough = watch.looks + 3
    while watch.looks <= enough:
        time.sleep(DEBOUNCE / 10)
    return not changed.acquire(blocking=False)


@pytest.fixture
def watched(tmp_path):
    """A watched file in a folder of its own; what counts its changes; its watch."""
    file, changed = tmp_path / "here" / "robot.yaml", threading.Semaphore(0)
    file.parent.mkdir()
    shutil.copy(NOMINAL, file)
    watch = CountedWatch(changed.release)
    watch.watch(file)
    yield file, changed, watch
    watch.stop()


def seen(changed):
    return changed.acquire(timeout=60)


def point(link, to):
    """Point a link elsewhere in one step, as a deployment does."""
    link.with_name("new").symlink_to(to)
    os.replace(link.with_name("new"), link)


def test_a_file_replaced_atomically_is_seen_once(watched):
    file, changed, watch = watched
    write_model(read_model(IDENTIFIED), file)
    assert seen(changed)
    assert unseen(changed, watch)


def test_a_file_written_in_place_or_removed_and_made_again_is_seen(watched):
    file, changed, _ = watched
    file.write_text(IDENTIFIED.read_text())
    assert seen(changed)
    file.unlink()
    shutil.copy(NOMINAL, file)
    assert seen(changed)


def test_a_folder_that_is_gone_and_made_anew_and_everything_after_it_is_seen(watched):
    file, changed, watch = watched
    shutil.rmtree(file.parent)
    assert seen(changed)
    assert unseen(changed, watch)
    file.parent.mkdir()
    shutil.copy(IDENTIFIED, file)
    assert seen(changed)
    shutil.copy(NOMINAL, file)
    assert seen(changed)


def test_reading_it_and_writing_its_neighbours_is_not_a_change(watched):
    file, changed, watch = watched
    file.read_text()
    (file.parent / "other.yaml").write_text("x")
    assert unseen(changed, watch)


@pytest.mark.parametrize("linked", ["robot.yaml", "."])
def test_a_linked_file_or_folder_pointed_elsewhere_is_a_change_and_is_watched_there(
    tmp_path, watched, linked
):
    file, changed, watch = watched
    other = tmp_path / "there" / "robot.yaml"
    other.parent.mkdir()
    shutil.copy(IDENTIFIED, other)
    link = tmp_path / "link"
    link.symlink_to(file.parent / linked)
    watch.watch(link / "robot.yaml" if linked == "." else link)
    point(link, other.parent / linked)
    assert seen(changed)
    shutil.copy(NOMINAL, other)
    assert seen(changed)


def test_a_file_whose_folder_is_yet_to_come_is_seen_when_it_comes(tmp_path, watched):
    _, changed, watch = watched
    file = tmp_path / "later" / "robot.yaml"
    watch.watch(file)
    file.parent.mkdir()
    shutil.copy(NOMINAL, file)
    assert seen(changed)


def test_a_file_is_not_watched_when_watching_is_off(watched):
    file, changed, watch = watched
    watch.watch(None)
    shutil.copy(IDENTIFIED, file)
    assert unseen(changed, watch)


# ------------------------------------------------------------------ what the streams remember


def test_the_direction_is_that_of_the_last_motion_beyond_the_threshold():
    tracker, found = DirectionTracker(1.0), []
    for value in (0.0, 0.5, 2.0, 1.5, 1.2, 0.9, 1.5, 3.0):
        tracker.follow({"a": value})
        found.append(tracker.direction.get("a", 0.0))
    assert found == [0, 0, 1, 1, 1, -1, -1, 1]


def test_noise_on_a_slow_motion_does_not_turn_it_round():
    tracker, rng = DirectionTracker(5e-4), np.random.default_rng(0)
    for value in np.linspace(0, 0.1, 1000) + rng.normal(0, 1e-4, 1000):
        tracker.follow({"a": value})
    assert tracker.direction == {"a": 1.0}


def served(model):
    return ServedModel(model, Kinematics(model), "", "")


def test_a_target_is_reached_on_the_branch_the_robot_is_on():
    model = new_model("delta24")
    kinematics, memory = Kinematics(model), Memory(1e-4)
    model.mechanism.joint_limits = ((-2 * np.pi, 2 * np.pi),) * 3
    position = np.array([0.01, 0.02, 0.2])
    home = kinematics.inverse(position)
    other = next(s for s in inverse_all(model, position) if s.joints[0] > 1.5)
    memory.on_joint_state(model, other.joints, 0.0, None)
    found = joints_for(served(model), memory, position + 0.001, None)
    assert np.abs(found.joints - other.joints).max() < 0.1
    memory.on_joint_state(model, home.joints, 0.0, None)
    found = joints_for(served(model), memory, position + 0.001, None)
    assert np.abs(found.joints - home.joints).max() < 0.1


def test_a_target_beyond_reach_or_limits_is_refused():
    model, memory = new_model("delta24"), Memory(1e-4)
    with pytest.raises(SolveError, match="unreachable"):
        joints_for(served(model), memory, np.array([0.0, 0.0, 0.9]), None)
    model.mechanism.joint_limits = ((0.0, 0.1),) * 3
    q = Kinematics(model).inverse(np.array([0.0, 0.0, 0.2])).joints[2]
    words = rf"^outside limits \(.*; joint3 at {q:.4f} rad, allowed from 0\.0000 to 0\.1000\)$"
    with pytest.raises(SolveError, match=words):
        joints_for(served(model), memory, np.array([0.0, 0.0, 0.2]), None)


def test_a_target_is_approached_from_where_the_robot_is():
    model = new_model("delta24", effects=["backlash"])
    model = model.with_values(
        np.where(["width" in n for n in model.table.names], 1e-2, model.values)
    )
    kinematics, memory = Kinematics(model), Memory(1e-4)
    for q in (0.3, 0.5):  # it comes from below and must go down again
        memory.on_joint_state(model, np.full(3, q), 0.0, None)
    target = kinematics.direct(np.full(3, 0.4)).position
    found = joints_for(served(model), memory, target, None)
    downwards = {f"direction.{j}": -1.0 for j in model.joints}
    expected = kinematics.inverse(target, at=downwards)
    assert expected.status == Status.CONVERGED
    assert (found.joints == expected.joints).all()
    assert found.joints[0] < 0.4


def test_missing_conditions_of_the_model_are_listed():
    model = new_model("delta24", effects=["backlash"])
    memory = Memory(1e-4)
    assert memory.unheard(model) == [f"direction.{j}" for j in model.joints]
    memory.on_joint_state(model, np.zeros(3), 0.0, None)
    memory.on_joint_state(model, np.ones(3), 1.0, None)
    assert memory.unheard(model) == []
    assert memory.conditions(model) == {f"direction.{j}": 1.0 for j in model.joints}
    assert memory.heard["velocity.joint1"] == 1.0


def test_only_a_driver_that_sends_velocities_makes_accelerations_known():
    model = new_model("delta24", effects=["acceleration_lag"])
    memory, unknown = Memory(1e-4), [f"acceleration.{j}" for j in model.joints]
    memory.on_joint_state(model, np.zeros(3), 0.0, np.zeros(3))
    assert memory.unheard(model) == unknown
    memory.on_joint_state(model, np.ones(3), 0.5, np.array([1.0, -2.0, 0.0]))
    expected = dict(zip(unknown, (2.0, -4.0, 0.0), strict=True))
    assert memory.conditions(model) == expected
    memory.on_joint_state(model, np.ones(3), 1.0, None)
    assert memory.unheard(model) == unknown


def test_files_that_differ_in_their_values_leave_no_further_equations_behind(tmp_path):
    made, model, served = _cached_structure.cache_info, read_model(IDENTIFIED), ModelServer()

    def serve(value):
        write_model(model.with_values(np.append(value, model.values[1:])), tmp_path / "robot.yaml")
        assert served.load(tmp_path / "robot.yaml", "watch").ok
        served.wait_until_compiled(60)

    serve(model.values[0])
    before = made().misses
    for k in range(1, 4):
        serve(model.values[0] + 1e-6 * k)
    assert served.current.model.values[0] == pytest.approx(model.values[0] + 3e-6, abs=1e-12)
    assert made().misses == before
