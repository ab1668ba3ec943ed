"""The exported C: compiled strictly, with sanitizers, and held against Python's answers."""

import ctypes
import re
import shutil
import subprocess
from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import chains
import numpy as np
import pytest
from distant_poses import distant_poses
from marks import as_slow, keep
from test_redundant_loops import hinged_wrist

from parallel_cal.base.errors import ModelError
from parallel_cal.cli.main import main
from parallel_cal.exporting.export import export
from parallel_cal.exporting.targets._vectors import MIN_LIMIT, _limits
from parallel_cal.exporting.targets.c import files
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.drive import Drive
from parallel_cal.model.file.modelfile import model_hash, read_model, write_model
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.nodes.stream_memory import DirectionTracker
from parallel_cal.recordings.travel import travel

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")

WARNINGS = "-Wall -Wextra -Wconversion -Wsign-conversion -Wpedantic -Wshadow -Werror".split()
STRICT = ["gcc", "-std=c99", *WARNINGS]
STRICT_CPP = ["-std=c++17", "-fno-exceptions", "-fno-rtti", *WARNINGS]
SANITIZERS = ["-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover"]
EFFECTS = {
    "delta54": ("encoder_eccentricity", "backlash", "thermal_expansion"),
    "stewart42": ("strut_rotation", "hysteresis", "screw_pitch_error"),
    "argos27": ("backlash", "encoder_second_harmonic", "joint_compliance"),
    "linear_delta": ("rod_compliance", "encoder_gain", "acceleration_lag"),
}
WITH_EFFECTS = ("delta54", "stewart42", "argos27")
ROBOTS = [
    "delta54",
    "cable",
    pytest.param("chain", marks=pytest.mark.wide),
    *map(as_slow, ("argos27", "linear_delta", "stewart42")),
]


def test_a_robot_whose_controlled_turn_the_code_would_lose_is_refused():
    """A palletizer turns about z only, so that nothing has to be restored."""
    wrist = hinged_wrist(16, controls=["x", "y", "rz"])
    with pytest.raises(ModelError, match=r"two others by up to .* rad: this"):
        files(wrist)
    assert "palletizer.c" in files(new_model("palletizer"), poses=2)


@cache
def robot(name):
    """A robot off its nominal, with effects that are felt. The chain is an ankle, whose passive
    coordinates and a part of whose rotation are unknown."""
    mechanism = load_mechanism("chain", **chains.ankle()) if name == "chain" else name
    model = new_model(mechanism, effects=EFFECTS.get(name, ()))
    table, rng = model.table, np.random.default_rng(1)
    off = table.nominal + 0.5 * table.tolerance * rng.standard_normal(len(table))
    return model.with_values(np.where(model.fixed, table.nominal, off))


def run(words, folder):
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def folder(name, poses=1000):
    """What was exported, its check compiled strictly and with sanitizers, and a library."""
    return _folder(name, poses)


@cache  # which would keep (name) and (name, 1000) apart
def _folder(name, poses):
    kept = TemporaryDirectory(prefix="exported")
    export(robot(name), f"c:poses={poses}", kept.name)
    source = [f"{name}_check.c", f"{name}.c"]
    run([*STRICT, *SANITIZERS, *source, "-o", "check", "-lm"], kept.name)
    return kept


@cache
def library(name, *, nominal):
    """The library of a robot. The optimiser needs half a minute for the elastic rods of one."""
    if nominal:
        kept = f"{folder('delta54').name}/nominal_{name}"
        export(new_model(name), "c:poses=2", kept)
    else:
        kept = folder(name).name
    level = "-O0" if name == "linear_delta" else "-O1"
    run([*STRICT, level, "-fPIC", "-c", f"{name}.c", "-o", "robot.o"], kept)
    run(["gcc", "-shared", "robot.o", "-o", "robot.so", "-lm"], kept)
    return ctypes.CDLL(f"{kept}/robot.so")


def differences(name, poses=1000):
    words = run(["./check", f"{name}_vectors.csv"], folder(name, poses).name).split()
    return dict(zip(words[::2], map(float, words[1::2]), strict=True))


def vector_lines(name):
    return Path(folder(name).name, f"{name}_vectors.csv").read_text().splitlines()


@pytest.mark.parametrize("name", ROBOTS)
def test_it_compiles_strictly_and_agrees_with_python(name):
    found = differences(name)
    assert found["rows"] == 2000
    assert found["other_status"] == 0
    assert max(found[part] for part in ("joints", "position", "rotation")) < 1e-12


# Eight lines hold a platform with six freedoms, from crossed corners as in a suspended crane.
ANCHORS = [[3 * x, 2.2 * y, 3.2] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)) for _ in "ab"]
CORNERS = [
    [-0.4 * x, 0.3 * y * side, 0.25 * side]
    for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    for side in (1, -1)
]


@cache
def platform_on_lines():
    model = new_model(
        load_mechanism("stewart42", base=ANCHORS, platform=CORNERS, height=1.2, tolerance=0.005)
    )
    off = 0.5 * model.table.tolerance * np.random.default_rng(1).standard_normal(len(model.table))
    return model.with_values(model.table.nominal + off)


def test_a_platform_on_eight_lines_agrees_with_python_within_the_limit_of_its_conditioning(
    tmp_path,
):
    export(platform_on_lines(), "c:poses=300,name=crane", tmp_path)
    run([*STRICT, *SANITIZERS, "crane_check.c", "crane.c", "-o", "check", "-lm"], tmp_path)
    words = run(["./check", "crane_vectors.csv"], tmp_path).split()
    found = dict(zip(words[::2], map(float, words[1::2]), strict=True))
    assert found["rows"] == 600
    assert found["beyond_limit"] == 0
    # Readings that disagree by 0.01 mm leave a flat minimum; the Delta's limit is 1e-12.
    assert 1e-12 <= found["least_limit"] <= found["largest_limit"] < 1e-6
    moved = Path(tmp_path, "crane_vectors.csv").read_text().splitlines()[:-2]
    cells = moved[-1].split(",")
    x = 2 + 8
    cells[x] = repr(float(cells[x]) + 2 * float(cells[-1]))
    (tmp_path / "other.csv").write_text("\n".join([*moved[:-1], ",".join(cells)]))
    done = subprocess.run(["./check", "other.csv"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert "beyond_limit 1" in done.stdout


@pytest.mark.wide
def test_redundant_loops_that_are_open_are_out_of_reach_in_c_too(tmp_path):
    """The squares of the gaps have extrema where the loops are open by centimetres. The elbow is as
    far from the rocker's axis as the law of cosines of the sphere says; coupler and rocker reach it
    between the difference and the sum of their angles."""
    given, (motor, elbow, ball, hinge) = chains.spherical_four_bar()
    model = chains.make_chain(given)
    export(model, "c:poses=20,name=four", tmp_path)
    run([*STRICT, "-O0", "-shared", "-fPIC", "four.c", "-o", "four.so", "-lm"], tmp_path)
    solve = ctypes.CDLL(f"{tmp_path}/four.so").four_direct
    readings = np.linspace(-1.05, 0.5, 80)  # farther ones are too far for a start at home

    def angle(a, b):
        return np.arccos(a @ b)

    normals = [np.cross(motor, axis) for axis in (elbow, hinge)]
    between = np.arctan2(np.cross(*normals) @ motor, normals[0] @ normals[1]) - readings
    sines = np.sin(angle(motor, elbow)) * np.sin(angle(motor, hinge))
    apart = np.arccos((motor @ elbow) * (motor @ hinge) + sines * np.cos(between))
    coupler, rocker = angle(elbow, ball), angle(ball, hinge)
    margin = np.minimum(apart - abs(coupler - rocker), coupler + rocker - apart)
    found = Kinematics(model).direct(readings[:, None])
    size = ctypes.c_double * (13 + len(model.mechanism.passive))
    for q, python, reachable in zip(readings, found, margin, strict=True):
        answer, residual = size(), ctypes.c_double()
        status = solve(ctypes.byref(ctypes.c_double(q)), None, None, answer, ctypes.byref(residual))
        assert status == python.status
        if reachable < -0.1:  # ten tolerances of the ball's place are 0.0625 rad
            assert status == Status.UNREACHABLE
        if status == Status.CONVERGED:
            np.testing.assert_allclose(answer[1:4], python.position, atol=1e-12)
            np.testing.assert_allclose(answer[13:], python.passive, atol=1e-12)
        assert residual.value == pytest.approx(float(python.residual), abs=1e-12)
    assert min(np.sum(margin < -0.1), np.sum(found.ok)) > 20


def test_the_headers_state_how_the_angles_of_motors_convert(tmp_path):
    model = platform_on_lines()
    mechanism = model.mechanism
    drives = (Drive("spool", radius=0.05, gear=10.0), Drive("screw", per_rev=-0.004))
    mechanism = copy(mechanism)
    mechanism.drives = (*drives, *[None] * 6)
    driven = replace(model, mechanism=mechanism)
    for target, header in (("c", "crane.h"), ("cpp", "crane.hpp")):
        export(driven, f"{target}:poses=20,name=crane", tmp_path)
        text = (tmp_path / header).read_text()
        factors = re.findall(r"(leg\d) \[m\] = (\S+) \* angle of the motor \[rad\], a (\w+)", text)
        assert [(joint, kind) for joint, _, kind in factors] == [
            ("leg1", "spool"),
            ("leg2", "screw"),
        ]
        assert [float(f) for _, f, _ in factors] == [0.05 / 10, -0.004 / (2 * np.pi)]
        assert " leg8 [m]\n" in text
    run([*STRICT, "crane_check.c", "crane.c", "-o", "check", "-lm"], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", [p if isinstance(p, str) else p.values[0] for p in ROBOTS])
def test_it_agrees_with_python_over_many_poses(name):
    poses = 100_000 if name == "delta54" else 20_000
    found = differences(name, poses)
    assert found["rows"] == 2 * poses
    assert found["other_status"] == 0
    assert max(found[part] for part in ("joints", "position", "rotation")) < 1e-12


def test_what_is_ascribed_to_the_device_is_named_as_not_exported(tmp_path):
    model = new_model("delta54").with_effect("backlash").with_effect("device_axes")
    done = export(model, "c:poses=20,name=delta", tmp_path)
    assert any(remark.startswith("not exported: device_axes. ") for remark in done.remarks)
    header = (tmp_path / "delta.h").read_text()
    assert "delta54, backlash" in header
    assert "device_axes" not in header


@pytest.mark.parametrize("name", ROBOTS)
def test_the_vectors_hold_unreachable_and_invalid_problems_too(name):
    lines = vector_lines(name)[1:]
    statuses = np.array([line.split(",")[:2] for line in lines], int)
    for problem in (0, 1):
        assert np.mean(statuses[statuses[:, 0] == problem, 1] == Status.CONVERGED) > 0.9
        assert Status.INVALID_INPUT in statuses[statuses[:, 0] == problem, 1]
    if name not in ("argos27", "cable", "chain"):  # which reach wherever is asked
        assert {Status.UNREACHABLE, Status.OUTSIDE_LIMITS} & set(statuses[:, 1].tolist())


def test_a_singular_problem_without_a_solution_warns_of_nothing():
    kinematics = Kinematics(new_model("delta24"))
    found = kinematics.inverse([[9.0, 0.0, 0.0]])
    assert not found.ok.any()
    with np.errstate(all="raise"):
        assert _limits(kinematics.inverse_problem, found, np.zeros(1)) == [MIN_LIMIT]


def test_the_check_fails_where_a_number_differs(tmp_path):
    kept = folder("cable").name
    head, first, *rest = vector_lines("cable")[:500]
    words = rest[-1].split(",")
    words[2] = repr(float(words[2]) + 1e-9)
    (tmp_path / "other.csv").write_text("\n".join([head, first, *rest[:-1], ",".join(words)]))
    done = subprocess.run([f"{kept}/check", str(tmp_path / "other.csv")], capture_output=True)
    assert done.returncode == 1
    assert b"joints 1e-09" in done.stdout
    assert b"beyond_limit 1" in done.stdout


@pytest.mark.parametrize("name", ROBOTS)
def test_the_object_has_no_state_and_only_its_own_names(name):
    library(name, nominal=False)
    symbols = [line.split()[-2:] for line in run(["nm", "robot.o"], folder(name).name).splitlines()]
    assert not [s for s in symbols if s[0] in "dDbBC"]
    public = {symbol for kind, symbol in symbols if kind == "T"}
    own = (
        *("direct", "inverse", "direct_capped", "inverse_capped"),
        *("jacobian", "inverse_jacobian", "jacobian_rate"),
        *("motion_begin", "motion_follow", "motion_conditions"),
    )
    constants = {symbol for kind, symbol in symbols if kind == "R"}
    numbers = ("low", "high", "velocity", "acceleration", "names")
    expected = {f"{name}_joint_{number}" for number in numbers}
    assert constants == expected | {f"{name}_home", f"{name}_model_hash"}
    assert public == {f"{name}_{function}" for function in own}
    outside = {symbol for kind, symbol in symbols if kind == "U"}
    allowed = {"memcpy", "memset", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
    mathematics = set(
        "sin cos tan sqrt atan2 asin acos fabs fmax fmin floor rint sincos tanh".split()
    )
    assert outside <= allowed | mathematics


# ------------------------------------------------------------------ called from elsewhere


def structure(model):
    n, double = len(model.joints), ctypes.c_double
    members = [("joints", double * n), ("position", double * 3), ("rotation", double * 9)]
    passive = len(model.mechanism.passive)
    members += [("passive", double * passive)] if passive else []
    return type("configuration", (ctypes.Structure,), {"_fields_": members})


def numbers(values):
    flat = np.ravel(values).astype(float)
    return (ctypes.c_double * len(flat))(*flat)


class Exported:
    """The functions of a library with arrays in and out."""

    def __init__(self, name, nominal=False):
        self.model = new_model(name) if nominal else robot(name)
        self._name, self._library = name, library(name, nominal=nominal)
        self.kind = structure(self.model)

    def _call(self, function, *arguments):
        return getattr(self._library, f"{self._name}_{function}")(*arguments)

    def direct(self, q, at=None, start=None):
        answer, left = self.kind(), ctypes.c_double()
        begin = ctypes.byref(start) if start is not None else None
        status = self._call(
            "direct",
            numbers(q),
            at and numbers(at),
            begin,
            ctypes.byref(answer),
            ctypes.byref(left),
        )
        return status, answer

    def inverse(self, r, R=None, at=None, start=None):
        answer = self.kind()
        begin = ctypes.byref(start) if start is not None else None
        turned = None if R is None else numbers(R)
        status = self._call(
            "inverse", numbers(r), turned, at and numbers(at), begin, ctypes.byref(answer), None
        )
        return status, answer

    def capped(self, function, steps, *given, start=None):
        answer = self.kind()
        begin = ctypes.byref(start) if start is not None else None
        arrays = [None if part is None else numbers(part) for part in given]
        status = self._call(
            f"{function}_capped", *arrays, None, begin, steps, ctypes.byref(answer), None
        )
        return status, answer

    def constant(self, name, kind):
        return kind.in_dll(self._library, f"{self._name}_{name}")

    def jacobian_rate(self, answer, velocity):
        n = len(self.model.joints)
        found = (ctypes.c_double * (6 * n))()
        moving = numbers(velocity)
        assert self._call("jacobian_rate", ctypes.byref(answer), None, moving, found) == 0
        return np.array(found).reshape(6, n)

    def jacobian(self, answer, function="jacobian"):
        found = (ctypes.c_double * (6 * len(self.model.joints)))()
        assert self._call(function, ctypes.byref(answer), None, found) == 0
        return np.array(found)


@pytest.mark.parametrize("name", ROBOTS)
def test_conditions_that_are_not_given_are_neutral(name):
    exported, model = Exported(name), robot(name)
    q = np.array(model.mechanism.home.joints) + 0.01
    status, answer = exported.direct(q)
    assert status == 0
    np.testing.assert_allclose(answer.position[:], Kinematics(model).direct(q).position, atol=1e-13)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_warm_start_from_the_answer_before_follows_the_branch(name):
    exported, model = Exported(name), robot(name)
    kinematics = Kinematics(model)
    r, R = poses_in_workspace(model.mechanism, 2, np.random.default_rng(3))
    along = kinematics.inverse(np.linspace(*r, 50), np.broadcast_to(R[0], (50, 3, 3)))
    path = along.joints[along.ok]
    assert len(path) > 40
    _, begin = exported.direct(path[0])
    for q in path:
        status, begin = exported.direct(q, start=begin)
        assert status == 0
        one = kinematics.direct(q)
        np.testing.assert_allclose(begin.position[:], one.position, atol=1e-12)
        status, back = exported.inverse(begin.position[:], begin.rotation[:], start=begin)
        assert status == 0
        np.testing.assert_allclose(back.joints[:], q, atol=1e-11)


@pytest.mark.parametrize("name", ROBOTS)
def test_jacobians_are_the_differences_of_pythons_answers(name):
    exported, model = Exported(name), robot(name)
    kinematics, n = Kinematics(model), len(model.joints)
    r, R = poses_in_workspace(model.mechanism, 1, np.random.default_rng(4))
    q = kinematics.inverse(r[0], R[0]).joints
    _, answer = exported.direct(q)
    step = 1e-6 * np.eye(n)
    ahead, back = (kinematics.direct(q + sign * step).configuration for sign in (1, -1))
    expected = ahead.change_from(back)[:, n : n + 6].T / 2e-6
    found = exported.jacobian(answer).reshape(6, n)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    controlled = model.mechanism.controlled
    both = exported.jacobian(answer, "inverse_jacobian").reshape(n, 6)
    assert not np.delete(both, controlled, axis=1).any()
    if len(controlled) == n:
        np.testing.assert_allclose(both[:, controlled] @ found[controlled], np.eye(n), atol=1e-8)
    else:  # four lines hold three coordinates
        there = found[controlled] @ both[:, controlled]
        np.testing.assert_allclose(there, np.eye(len(controlled)), atol=1e-8)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_rate_of_the_jacobian_is_its_difference_along_the_motion(name):
    exported, model = Exported(name), robot(name)
    n, rng = len(model.joints), np.random.default_rng(5)
    r, R = poses_in_workspace(model.mechanism, 1, rng)
    q = Kinematics(model).inverse(r[0], R[0]).joints
    # Joints of a redundant robot cannot move independently: take a motion of its platform.
    _, answer = exported.direct(q)
    ways = exported.jacobian(answer, "inverse_jacobian").reshape(n, 6)
    velocity, step = ways @ rng.standard_normal(6), 1e-6  # s: a screw turns by little in it
    ahead, back = (
        exported.jacobian(exported.direct(q + sign * step * velocity)[1]).reshape(6, n)
        for sign in (1, -1)
    )
    expected = (ahead - back) / (2 * step)
    found = exported.jacobian_rate(answer, velocity)
    scale = np.abs(expected).max()
    assert scale > 1e-3
    np.testing.assert_allclose(found, expected, atol=1e-5 * scale)


def test_the_model_s_numbers_are_symbols():
    exported = Exported("delta54")
    model, n = exported.model, len(exported.model.joints)
    array = ctypes.c_double * n
    assert exported.constant("model_hash", ctypes.c_char * 65).value.decode() == model_hash(model)
    low, high = zip(*model.mechanism.joint_limits, strict=True)
    assert tuple(exported.constant("joint_low", array)) == low
    assert tuple(exported.constant("joint_high", array)) == high
    assert np.isinf(exported.constant("joint_velocity", array)).all()
    home = exported.constant("home", exported.kind)
    assert tuple(home.joints) == tuple(model.mechanism.home.joints)
    names = exported.constant("joint_names", (ctypes.c_char * (len(model.joints[0]) + 1)) * n)
    assert [one.value.decode() for one in names] == list(model.joints)


def test_the_effort_of_a_call_can_be_capped_and_the_status_says_so():
    """Far out of reach, Newton's method fails and the careful method takes many steps."""
    exported = Exported("delta54")
    far = [0.05, 0.05, 0.9]
    assert exported.inverse(far)[0] == Status.UNREACHABLE
    for steps in (0, 1, 3):
        assert exported.capped("inverse", steps, far, None)[0] == 7
    assert exported.capped("inverse", 400, far, None)[0] == Status.UNREACHABLE
    home = np.array(exported.model.mechanism.home.joints)
    _, start = exported.direct(home)
    status, answer = exported.capped("direct", 0, home + 0.01, start=start)
    assert status == Status.CONVERGED
    assert answer.position[:] == exported.direct(home + 0.01, start=start)[1].position[:]


def test_direction_and_travel_are_those_of_the_recordings():
    """The readings wander with noise below the threshold and reversals above it."""
    exported, n = Exported("delta54"), 3
    rng, double = np.random.default_rng(6), ctypes.c_double
    turns = np.cumsum(rng.choice([-1.0, 1.0], (40, n)) * rng.uniform(1e-3, 0.05, (40, n)), axis=0)
    t = np.linspace(0, 39, 2000)
    q = np.stack([np.interp(t, np.arange(40), turns[:, j]) for j in range(n)], axis=1)
    q += 2e-5 * rng.standard_normal(q.shape)
    names = "threshold direction travel velocity reading furthest turned_at".split()
    motion = type("motion", (ctypes.Structure,), {"_fields_": [(x, double * n) for x in names]})()
    tracker = DirectionTracker(5e-4)
    assert exported._call("motion_begin", ctypes.byref(motion), numbers(q[0])) == 0
    assert list(motion.threshold) == [5e-4] * n
    for i, reading in enumerate(q):
        follow = (ctypes.byref(motion), numbers(reading), double(1e-3))
        assert exported._call("motion_follow", *follow) == 0
        tracker.follow({str(j): value for j, value in enumerate(reading)})
        direction = np.array([[tracker.direction.get(str(j), 0.0) for j in range(n)]])
        assert list(motion.direction) == direction[0].tolist()
        if i % 20 == 19:
            threshold = np.full(n, 5e-4)
            expected = travel(q, [i + 1], reading[None], direction.astype(int), threshold)
            np.testing.assert_allclose(motion.travel, expected[0], atol=1e-15)
            np.testing.assert_allclose(motion.velocity, (reading - q[i - 1]) * 1e3, rtol=1e-9)
    before = list(motion.travel)
    for bad in ((numbers([np.nan] * n), double(1e-3)), (numbers(q[0]), double(0.0))):
        assert exported._call("motion_follow", ctypes.byref(motion), *bad) == Status.INVALID_INPUT
        assert list(motion.travel) == before


@pytest.mark.parametrize("name", ROBOTS)
def test_the_example_of_a_controller_loop_runs_without_a_failure(name):
    run(
        [*STRICT, *SANITIZERS, f"{name}_loop.c", f"{name}.c", "-o", "loop", "-lm"],
        kept := folder(name).name,
    )
    _, failures, _, worst, *_ = run(["./loop"], kept).split()
    assert failures == "0"
    # A command assumes the last direction; behind a reversal, backlash moves the robot away.
    assert float(worst) < (50e-6 if EFFECTS.get(name) else 1e-12)


@pytest.mark.wide
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no CMake")
@pytest.mark.parametrize("target", ["c", "cpp"])
def test_cmake_builds_checks_and_installs_a_target_for_find_package(target, tmp_path):
    export(robot("cable"), f"{target}:poses=20", tmp_path / "source")
    (tmp_path / "user").mkdir()
    (tmp_path / "user" / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(user LANGUAGES C CXX)\n"
        "find_package(cable REQUIRED)\nadd_executable(user user.cpp)\n"
        "target_link_libraries(user PRIVATE parallel_cal::cable)\n"
    )
    header, begin = (
        ("cable.h", "cable_home") if target == "c" else ("cable.hpp", "cable::c::cable_home")
    )
    (tmp_path / "user" / "user.cpp").write_text(
        f"#include <{header}>\nint main() {{ return {begin}.rotation[0] > 0.5 ? 0 : 1; }}\n"
    )
    run(["cmake", "-S", "source", "-B", "build", "-DCMAKE_INSTALL_PREFIX=installed"], tmp_path)
    run(["cmake", "--build", "build"], tmp_path)
    run(["ctest", "--test-dir", "build", "--output-on-failure"], tmp_path)
    run(["cmake", "--install", "build", "--prefix", "installed"], tmp_path)
    run(["cmake", "-S", "user", "-B", "use", f"-DCMAKE_PREFIX_PATH={tmp_path}/installed"], tmp_path)
    run(["cmake", "--build", "use"], tmp_path)
    run(["./use/user"], tmp_path)


THREADS = """
#include "@.h"
#include <pthread.h>
#include <string.h>
static void *work(void *found)
{
    @_configuration pose = @_home, back = @_home;
    double q[ROBOT_JOINTS];
    for (int i = 0; i < 500; ++i) {
        memcpy(q, @_home.joints, sizeof q);
        q[i % ROBOT_JOINTS] += 1e-4 * i;
        @_direct(q, 0, &pose, &pose, 0);
        @_inverse(pose.position, pose.rotation, 0, &back, &back, 0);
    }
    *(@_configuration *)found = back;
    return 0;
}
int main(void)
{
    pthread_t threads[4];
    @_configuration found[4];
    for (int i = 0; i < 4; ++i) pthread_create(&threads[i], 0, work, &found[i]);
    for (int i = 0; i < 4; ++i) pthread_join(threads[i], 0);
    for (int i = 1; i < 4; ++i)
        if (memcmp(&found[0], &found[i], sizeof found[0])) return 1;
    return 0;
}
"""


@pytest.mark.wide
@pytest.mark.skipif(shutil.which("setarch") is None, reason="no setarch")
@pytest.mark.parametrize("name", keep(WITH_EFFECTS, "delta54"))
def test_threads_share_nothing_and_get_equal_answers(name):
    kept = folder(name).name
    text = THREADS.replace("@", name).replace("ROBOT", name.upper())
    Path(kept, "threads.c").write_text(text)
    sanitizer = ["-O1", "-fsanitize=thread"]
    run([*STRICT, *sanitizer, "threads.c", f"{name}.c", "-o", "threads", "-lm"], kept)
    run(["setarch", "-R", "./threads"], kept)  # the sanitizer needs a fixed layout of the memory


# ------------------------------------------------------------------ C++

CPP_LOOP = """
#include "@.hpp"
#include "@.hpp" // a second inclusion does no harm
#include <cstdio>
#include <cstdlib>
#include <new>
static long allocations = 0;
void *operator new(std::size_t size) { ++allocations; return std::malloc(size); }
void operator delete(void *memory) noexcept { std::free(memory); }
void operator delete(void *memory, std::size_t) noexcept { std::free(memory); }
int main()
{
    @::Robot robot;
    @::Joints q{}, reading{};
    @::Jacobian J{}, rate{};
    @::InverseJacobian inverse{};
    double worst = 0;
    for (int i = 0; i < @::n_joints; ++i)
        reading[static_cast<std::size_t>(i)] = robot.command().joints[i];
    if (robot.begin(reading) != @::Status::converged) return 1;
    for (int cycle = 0; cycle < 1000; ++cycle) {
        @::Vector3 to{robot.command().position[0], robot.command().position[1] + 1e-6,
            robot.command().position[2]};
        @::Rotation level{1, 0, 0, 0, 1, 0, 0, 0, 1};
        if (robot.solve(to, level, q) != @::Status::converged) return 2;
        if (robot.update(q, 1e-3) != @::Status::converged) return 3;
        worst = fmax(worst, fabs(robot.pose().position[1] - to[1]));
        if (robot.jacobian(robot.pose(), J) != @::Status::converged) return 4;
        if (robot.inverse_jacobian(robot.pose(), inverse) != @::Status::converged) return 5;
        if (robot.jacobian_rate(robot.pose(), q, rate) != @::Status::converged) return 6;
    }
    @::Joints kept = q;
    robot.max_steps = 2;
    if (robot.solve({0, 0, 50}, {1, 0, 0, 0, 1, 0, 0, 0, 1}, q) == @::Status::converged) return 7;
    if (q != kept) return 8;
    kept[0] = NAN;
    if (robot.update(kept, 1e-3) != @::Status::invalid_input) return 9;
    std::printf("allocations %ld worst %.3g\\n", allocations, worst);
    return 0;
}
"""


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
@pytest.mark.parametrize("name", ROBOTS)
def test_the_cpp_header_compiles_strictly_and_agrees_with_python(name, tmp_path):
    export(robot(name), "cpp:poses=200", tmp_path)
    run(["g++", *STRICT_CPP, *SANITIZERS, f"{name}_check.cpp", "-o", "check"], tmp_path)
    assert "rows 400 other_status 0" in run(["./check", f"{name}_vectors.csv"], tmp_path)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_a_cpp_robot_allocates_nothing_and_keeps_its_state_after_a_failure(
    tmp_path,
):
    export(robot("delta54"), "cpp:poses=20", tmp_path)
    (tmp_path / "loop.cpp").write_text(CPP_LOOP.replace("@", "delta54"))
    run(["g++", *STRICT_CPP, *SANITIZERS, "loop.cpp", "-o", "loop"], tmp_path)
    _, allocations, _, worst = run(["./loop"], tmp_path).split()
    assert allocations == "0"
    assert float(worst) < 50e-6  # backlash at the first cycles, whose direction is not known


@pytest.mark.parametrize("call", ["begin(q)", "update(q, 1e-3)"])
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_a_cpp_robot_whose_readings_jump_is_on_the_branch_of_home(call, tmp_path):
    model = read_model(Path(__file__).parents[2] / "config/delta_mockup_identified.yaml")
    r, _ = poses_in_workspace(model.mechanism, 400, np.random.default_rng(0))
    kinematics = Kinematics(model)
    q = kinematics.inverse(r).joints
    export(model, "cpp:poses=2", tmp_path)
    (tmp_path / "begin.cpp").write_text(
        '#include "delta54.hpp"\n#include <cstdio>\nint main() {\n'
        "delta54::Robot robot; delta54::Joints q{};\n"
        'while (std::scanf("%lf %lf %lf", &q[0], &q[1], &q[2]) == 3) {\n'
        f"const auto status = robot.{call}; const auto &r = robot.pose().position;\n"
        'std::printf("%d %.17g %.17g %.17g\\n", int(status), r[0], r[1], r[2]); } }\n'
    )
    run(["g++", *STRICT_CPP, "begin.cpp", "-o", "begin"], tmp_path)
    readings = "\n".join(" ".join(map(repr, row)) for row in q.tolist())
    done = subprocess.run([tmp_path / "begin"], input=readings, capture_output=True, text=True)
    found = np.array([line.split() for line in done.stdout.splitlines()], float)
    assert not found[:, 0].any()
    np.testing.assert_allclose(found[:, 1:], kinematics.direct(q).position, atol=1e-12)


@pytest.mark.wide
@pytest.mark.skipif(shutil.which("clang") is None, reason="no clang")
@pytest.mark.parametrize("name", WITH_EFFECTS)
def test_clang_warns_of_nothing_and_its_sanitizers_find_nothing(name, tmp_path):
    export(robot(name), "c:poses=200", tmp_path)
    run(["clang", "-std=c99", *WARNINGS, "-c", f"{name}_loop.c"], tmp_path)
    source = [f"{name}_check.c", f"{name}.c"]
    run(["clang", "-std=c99", *WARNINGS, *SANITIZERS, *source, "-o", "check", "-lm"], tmp_path)
    assert "rows 400 other_status 0" in run(["./check", f"{name}_vectors.csv"], tmp_path)
    export(robot(name), "cpp:poses=200", tmp_path)
    run(["clang++", *STRICT_CPP, *SANITIZERS, f"{name}_check.cpp", "-o", "check"], tmp_path)
    assert "rows 400 other_status 0" in run(["./check", f"{name}_vectors.csv"], tmp_path)


@pytest.mark.skipif(
    shutil.which("g++") is None or not Path("/usr/include/eigen3").exists(), reason="no Eigen"
)
def test_the_views_of_eigen_show_the_arrays(tmp_path):
    export(robot("cable"), "cpp:poses=2", tmp_path)
    (tmp_path / "views.cpp").write_text(
        '#define CABLE_WITH_EIGEN\n#include "cable.hpp"\nint main() {\n'
        "cable::Robot robot; cable::Jacobian J{};\n"
        "if (robot.jacobian(robot.pose(), J) != cable::Status::converged) return 1;\n"
        "auto R = cable::rotation(robot.pose());\n"
        "return cable::view(J)(0, 1) == J[1] && R(0, 0) == 1 ? 0 : 2;\n}\n"
    )
    run(
        ["g++", "-std=c++17", "-isystem", "/usr/include/eigen3", "views.cpp", "-o", "views"],
        tmp_path,
    )
    run(["./views"], tmp_path)


def test_nan_and_infinity_are_a_status_and_nothing_else_is_answered():
    exported = Exported("delta54")
    home = np.array(exported.model.mechanism.home.joints)
    for bad in (np.nan, np.inf):
        status, answer = exported.direct([bad, *home[1:]])
        assert status == Status.INVALID_INPUT
        assert np.isnan(answer.position[:]).all()
        assert exported.inverse([0.0, bad, 0.1])[0] == Status.INVALID_INPUT
        neutral = [0.0] * len(exported.model.conditions)
        assert exported.direct(home, at=[bad, *neutral[1:]])[0] == Status.INVALID_INPUT


@pytest.mark.wide
@pytest.mark.parametrize(
    "options",
    [
        "-O0",
        "-O3 -march=native -ffp-contract=fast",
        as_slow("-Ofast -fno-finite-math-only"),
        as_slow("-O3 -ffp-contract=off"),
    ],
)
def test_status_and_numbers_do_not_depend_on_the_options_of_the_compiler(options, tmp_path):
    export(robot("cable"), "c:poses=200", tmp_path)
    source = ["cable_check.c", "cable.c"]
    run(["gcc", "-std=c99", *options.split(), *source, "-o", "check", "-lm"], tmp_path)
    assert "rows 400 other_status 0" in run(["./check", "cable_vectors.csv"], tmp_path)


@pytest.mark.skipif(shutil.which("tcc") is None, reason="no tcc")
def test_tcc_gives_the_same_status_and_numbers(tmp_path):
    """tcc takes -HUGE_VAL for no constant: joints without limits were an error."""
    model = robot("cable")
    assert np.isinf(model.mechanism.joint_limits).any()
    export(model, "c:poses=50", tmp_path)
    run(["tcc", "-std=c99", "cable_check.c", "cable.c", "-o", "check", "-lm"], tmp_path)
    assert "rows 100 other_status 0" in run(["./check", "cable_vectors.csv"], tmp_path)


def test_options_that_deny_nan_are_refused_with_the_cure(tmp_path):
    """With -Ofast of gcc, invalid input was reported as converged."""
    export(new_model("cable"), "c:poses=2", tmp_path)
    export(new_model("cable"), "cpp:poses=2", tmp_path)
    for option in ("-Ofast", "-ffast-math", "-ffinite-math-only"):
        for compiler, source in (("gcc", "cable.c"), ("g++", "cable_check.cpp")):
            words = [compiler, option, "-fsyntax-only", source]
            done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
            assert done.returncode
            assert "cable must know NaN: add -fno-finite-math-only" in done.stderr


def test_a_start_that_is_not_a_number_does_no_harm():
    exported = Exported("delta54")
    home = np.array(exported.model.mechanism.home.joints)
    _, expected = exported.direct(home)
    status, answer = exported.direct(home, start=exported.kind())  # all zero: no rotation
    assert status == Status.CONVERGED
    np.testing.assert_allclose(answer.position[:], expected.position[:], atol=1e-10)
    nothing = exported.kind()
    nothing.position[0] = np.nan
    status, answer = exported.direct(home, start=nothing)
    assert status == Status.CONVERGED
    np.testing.assert_allclose(answer.position[:], expected.position[:], atol=1e-10)


@pytest.mark.parametrize("name", ["argos27", "delta54", "stewart42"])
def test_an_answer_from_a_start_is_inside_the_limits_if_one_without_it_is(name):
    exported = Exported(name, nominal=True)
    kinematics = Kinematics(exported.model)
    poses = distant_poses(kinematics, 1000)
    starts, wanted = poses[:500], poses[500:]
    expected = kinematics.inverse(wanted.position, wanted.rotation, start=starts)
    for start, pose, joints in zip(starts, wanted, expected.joints, strict=True):
        flat = (start.joints, start.position, start.rotation.ravel())
        begin = exported.kind(*(tuple(part.tolist()) for part in flat))
        given = pose.position, pose.rotation
        status, answer = exported.inverse(*given, start=begin)
        assert status == Status.CONVERGED
        np.testing.assert_allclose(answer.joints[:], joints, rtol=0, atol=1e-12)
        # Newton's method alone converges from the start or without it.
        assert exported.capped("inverse", 0, *given, start=begin)[0] == Status.CONVERGED


def test_a_start_that_leads_outside_the_limits_yields_to_the_solution_inside():
    exported = Exported("argos27", nominal=True)
    _, start = exported.direct([0.5191, -0.7350, -0.3644])
    _, wanted = exported.direct([-0.6889, -0.0841, -0.4883])
    status, answer = exported.inverse(wanted.position, wanted.rotation, start=start)
    assert status == Status.CONVERGED
    np.testing.assert_allclose(answer.joints[:], [-0.6889, -0.0841, -0.4883], atol=1e-12)
    # Joint 1 of a start far outside: the answer from there is kept only if no other is inside.
    beyond = Kinematics(exported.model).direct([1.5, 0.0, 0.0])
    assert exported.inverse(beyond.position, beyond.rotation, start=start)[0] == (
        Status.OUTSIDE_LIMITS
    )


def test_targets_out_of_reach_are_a_status():
    exported = Exported("cable")
    exported_delta = Exported("delta54")
    assert exported_delta.inverse([0.0, 0.0, 5.0])[0] == Status.UNREACHABLE
    # The lines of a cable robot have no end in the model.
    assert exported.inverse([0.0, 0.0, 50.0])[0] == Status.CONVERGED


# ------------------------------------------------------------------ the command


def test_the_command_writes_the_robot_alone_with_a_makefile_that_checks_it(tmp_path, capsys):
    model = new_model("delta_nominal", effects=("encoder_eccentricity", "base_drift"))
    values = {"encoder_eccentricity.joint1.sin": 1e-3, "base_drift.v_x": 1e-6}
    model = model.with_values(model.table.vector(values))
    write_model(model, tmp_path / "m.yaml")
    out = tmp_path / "out"
    words = ["export", str(tmp_path / "m.yaml"), "--to", "c:name=robot,poses=50", "-o", str(out)]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
    assert "robot.h" in capsys.readouterr().out
    names = {"robot.c", "robot.h", "robot_check.c", "robot_loop.c", "robot_vectors.csv"}
    names |= {"Makefile", "CMakeLists.txt"}
    assert {path.name for path in out.iterdir()} == names
    assert "other_status 0" in run(["make", "check"], out)
    assert "failures 0" in run(["make", "loop"], out)


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (
            "d",
            "no target 'd': expected one of c, cpp, fluidnc, grblhal, klipper, linuxcnc, marlin, "
            "marlin_equal_rods, maslow, mjcf, mk4duo, moveit, repetier, richcattell, ros2_control, "
            "rrf, sdf, smoothieware, table, ucnc, urdf",
        ),
        ("c:size=3", "option 'size=3': expected one of name="),
        ("c:poses=many", "option 'poses=many': expected one of name="),
        ("c:poses=1", "poses=1: expected 2 to 300000"),
        ("c:poses=99999999999", "poses=99999999999: expected 2 to 300000"),
        ("c:name=my robot", "name=my robot: expected a valid C identifier"),
    ],
)
def test_what_cannot_be_exported_is_reported(target, said, tmp_path):
    with pytest.raises(ModelError, match=said):
        export(robot("cable"), target, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_users_own_target_is_a_file_on_the_python_path(tmp_path, monkeypatch):
    (tmp_path / "my_pkg").mkdir()
    (tmp_path / "my_pkg" / "my_target.py").write_text(
        "def files(model, ending='txt'):\n    return {f'joints.{ending}': ' '.join(model.joints)}\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    [written] = export(robot("cable"), "my_pkg.my_target:ending=dat", tmp_path / "out").paths
    assert written.name == "joints.dat"
    assert written.read_text().split() == list(robot("cable").joints)


def test_the_lines_of_the_page_compile(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    lines = page.split("```c\n")[1].split("```")[0]
    around = "const double joints[3] = {0}, position[3] = {0};\ndouble residual;\n"
    text = f'#include "delta54.h"\nint main(void)\n{{\n{around}{lines}return status;\n}}\n'
    kept = folder("delta54").name
    Path(kept, "page.c").write_text(text.replace("NULL", "0"))
    run([*STRICT, "page.c", "delta54.c", "-o", "page", "-lm"], kept)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_the_lines_of_the_page_about_cpp_compile(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    lines = page.split("```cpp\n")[1].split("```")[0]
    around = (
        "const delta54::Joints encoders{0.5, 0.5, 0.5}, velocity{};\n"
        "const delta54::Vector3 position{0, 0, 0.2}; const delta54::Rotation rotation{};\n"
    )
    text = f'#include "delta54.hpp"\nint main()\n{{\n{around}{lines}'
    (tmp_path / "page.cpp").write_text(text + "return static_cast<int>(status);\n}\n")
    export(robot("delta54"), "cpp:poses=2", tmp_path)
    run(["g++", *STRICT_CPP, "-O0", "page.cpp", "-o", "page"], tmp_path)


def test_a_robot_without_lengths_is_exported_too():
    model = new_model("argos9")
    assert not any(p.unit == "m" for p in model.table)
    head, row, *_ = files(model, poses=4)["argos9_vectors.csv"].splitlines()
    assert head.endswith(",limit")
    assert float(row.split(",")[-1]) >= 1e-12
