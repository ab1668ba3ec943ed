"""The exported ROS 2 packages are whole, and their part without ROS agrees with Python.

The plug-ins themselves need a ROS 2 workspace: docs/export.md describes a run in one.
"""

import csv
import re
import shutil
import subprocess
from functools import cache
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

import numpy as np
import pytest
import virtual_arm as va
import yaml
from arms import AXES
from marks import keep

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.export import export
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
STRICT = "-std=c++17 -O0 -Wall -Wextra -Wconversion -Wsign-conversion -Wpedantic -Wshadow -Werror"
TARGETS = ("ros2_control", "moveit")
CONVERGED, UNREACHABLE, OUTSIDE_LIMITS, EFFORT_EXCEEDED = 0, 1, 3, 7

# One line of input is one call: its kind, target pose, seed, and what belongs to the kind.
PROGRAM = """
#include "{package}/{robot}_solver.hpp"

#include <cstdio>
#include <string>

using namespace {robot};

template <std::size_t n> std::array<double, n> read()
{{
    std::array<double, n> numbers{{}};
    for (double &number : numbers)
        if (std::scanf("%lf", &number) != 1) return {{}};
    return numbers;
}}

int main()
{{
    char kind[20];
    while (std::scanf("%19s", kind) == 1) {{
        const auto position = read<3>();
        const auto rotation = read<9>();
        const auto seed = read<n_joints>();
        const auto given = read<n_joints>();
        const double timeout = read<1>()[0];
        const std::string what = kind;
        Solver solver;
        Joints joints{{}};
        Status status;
        int asked = 0;
        if (what == "narrow")
            for (std::size_t i = 0; i < n_joints; ++i) solver.high[i] = given[i];
        if (what == "tolerant") solver.orientation_tolerance = 4, solver.position_tolerance = 1e6;
        const auto begin = std::chrono::steady_clock::now();
        if (what == "search" || what == "second" || what == "never")
            status = solver.search(position, rotation, seed,
                what == "search" ? given.data() : nullptr, timeout, false, joints,
                [&](const Joints &) {{
                    ++asked;
                    return what == "search" || (what == "second" && asked == 2);
                }});
        else
            status = solver.inverse(position, rotation, seed, what == "approximate", joints);
        const std::chrono::duration<double> lapse = std::chrono::steady_clock::now() - begin;
        std::printf("%d %d %.17g", int(status), asked, lapse.count());
        for (double joint : joints) std::printf(" %.17g", joint);
        std::printf("\\n");
    }}
}}
"""


@cache
def robot(name):
    """A robot off its nominal."""
    model = arm() if name == "arm" else new_model(name)
    table, rng = model.table, np.random.default_rng(1)
    off = table.nominal + 0.3 * table.tolerance * rng.standard_normal(len(table))
    return model.with_values(np.where(model.fixed, table.nominal, off))


def arm():
    """A UR5 whose joints turn by nearly a turn to each side."""
    links = [{"joint": None, "axes": "coincident"}]
    for (a, d, alpha), axes in zip(va.UR5, [*AXES["ur5"], None], strict=True):
        links.append({"joint": "R", "a": a, "d": d, "alpha": alpha, "low": -6.2, "high": 6.2})
        links[-1] |= {"axes": axes} if axes else {}
    return new_model(load_mechanism("serial", links=links, home=va.HOME["ur5"]))


@cache
def package(target, name):
    kept = TemporaryDirectory(prefix="exported")
    export(robot(name), f"{target}:name=rob,poses=60", kept.name)
    return kept


def text(target, name, file):
    with open(f"{package(target, name).name}/{file}", encoding="utf-8") as opened:
        return opened.read()


@cache
def program(name):
    folder = package("moveit", name).name
    with open(f"{folder}/main.cpp", "w") as file:
        file.write(PROGRAM.format(package="rob_moveit", robot="rob"))
    words = ["g++", *STRICT.split(), "-I", "include", "main.cpp", "-o", "main"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return f"{folder}/main"


def line(kind, pose, seed, given=None, timeout=0.0):
    r, R = pose
    given = np.zeros(len(seed)) if given is None else given
    numbers = np.concatenate([r, np.ravel(R), seed, given, [timeout]])
    return " ".join([kind, *(repr(float(number)) for number in numbers)])


def answers(name, lines):
    """(status, number of questions, duration in s, joints) of every call."""
    words, text = [program(name)], "\n".join(lines)
    done = subprocess.run(words, input=text, capture_output=True, text=True, check=True)
    for row in map(str.split, done.stdout.splitlines()):
        yield int(row[0]), int(row[1]), float(row[2]), np.array(row[3:], float)


def call(name, *words, **options):
    return next(answers(name, [line(*words, **options)]))


@cache
def poses(name, n=12):
    """Poses that the robot reaches, and their joints, by Python."""
    rows = list(csv.DictReader(text("moveit", name, "test/configurations.csv").splitlines()))[:n]
    read = lambda columns: np.array([[float(row[c]) for c in columns] for row in rows])  # noqa: E731
    q = read(robot(name).joints)
    R = read([f"R{i}{j}" for i in "123" for j in "123"]).reshape(-1, 3, 3)
    return q, list(zip(read("xyz"), R, strict=True))


# ------------------------------------------------------------------ the packages as text


@pytest.mark.parametrize("target", TARGETS)
def test_the_package_is_whole_and_its_parts_name_each_other(target):
    name = f"rob_{target}"
    manifest = ElementTree.fromstring(text(target, "delta54", "package.xml"))
    assert manifest.find("name").text == name
    depends = {depend.text for depend in manifest.findall("depend")}
    build = text(target, "delta54", "CMakeLists.txt")
    assert f"project({name} " in build
    assert set(re.findall(r"find_package\((\w+) REQUIRED\)", build)) >= depends | {"ament_cmake"}
    base_package, described = re.search(
        r"pluginlib_export_plugin_description_file\((\w+) (\S+)\)", build
    ).groups()
    assert base_package in depends
    library = ElementTree.fromstring(text(target, "delta54", described))
    exported = library.find("class")
    assert (library.get("path"), exported.get("name")) == (name, f"{name}/Kinematics")
    source = text(target, "delta54", "src/plugin.cpp")
    macro = re.search(r"PLUGINLIB_EXPORT_CLASS\((\S+), (\S+)\)", source).groups()
    assert macro == (exported.get("type"), exported.get("base_class_type"))
    for built in ("src/plugin.cpp", "test/self_test.cpp", "test/configurations.csv", "include/"):
        assert f" {built}" in build


@pytest.mark.parametrize("target", TARGETS)
def test_every_quoted_include_of_the_package_is_in_it_or_in_a_dependency(target):
    folder = package(target, "delta54").name
    manifest = ElementTree.fromstring(text(target, "delta54", "package.xml"))
    known = {depend.text for depend in manifest.findall("depend")}
    # Packages whose headers have another name than the package.
    known |= {"moveit"} if "moveit_core" in known else set()
    known |= {"urdf_parser"} if "urdfdom" in known else set()
    for file in ("src/plugin.cpp", "test/self_test.cpp", "test/configurations.hpp"):
        for include in re.findall(r'#include "([^"]+)"', text(target, "delta54", file)):
            first = include.split("/")[0]
            own = [f"{folder}/include/{include}", f"{folder}/test/{include}"]
            assert first in known or any(map(exists, own)), include


def exists(path):
    try:
        with open(path, encoding="utf-8"):
            return True
    except OSError:
        return False


@pytest.mark.parametrize("target", TARGETS)
def test_the_readme_gives_parameters_of_the_exported_robot(target):
    readme = text(target, "delta54", "README.md")
    block = yaml.safe_load(re.search(r"```yaml\n(.*?)```", readme, re.S)[1])
    if target == "ros2_control":
        assert block["joints"] == list(robot("delta54").joints)
        assert block["kinematics"]["plugin_name"] == "rob_ros2_control/Kinematics"
        assert (block["kinematics"]["base"], block["kinematics"]["tip"]) == ("base", "platform")
    else:
        assert block["robot"]["kinematics_solver"] == "rob_moveit/Kinematics"
        assert block["robot"]["orientation_tolerance"] == 0.01
    assert "The robot controls x y z." in readme
    assert "The robot controls" not in text(target, "stewart42", "README.md")


def test_the_note_on_loops_is_for_robots_that_have_them():
    assert "a parallel robot has loops" in text("moveit", "delta54", "README.md")
    assert "a parallel robot has loops" not in text("moveit", "arm", "README.md")


def test_links_can_have_the_names_of_the_robot_description(tmp_path):
    export(robot("delta54"), "moveit:base=world,tip=tool0,poses=5", tmp_path)
    source = (tmp_path / "src/plugin.cpp").read_text()
    assert 'base[] = "world"' in source
    assert 'tip[] = "tool0"' in source
    assert "`world` and `tool0`" in (tmp_path / "README.md").read_text()


@pytest.mark.parametrize(
    ("name", "out_of_reach"), [("delta54", "true"), ("argos27", "true"), ("cable", "false")]
)
def test_the_self_test_asks_for_a_far_pose_only_of_robots_that_do_not_reach_it(name, out_of_reach):
    """Spools without limits reach any point; Argos cannot move to a point at all."""
    source = text("moveit", name, "test/self_test.cpp")
    assert f"far_is_out_of_reach = {out_of_reach};" in source


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("tip=a/b", "tip=a/b: expected the name of a link"),
        ("base=x,tip=x", "base=x, tip=x: expected two links"),
        ("poses=0", "poses=0: expected 1 to 10000"),
        ("name=2delta", "name=2delta: expected a valid C identifier"),
    ],
)
@pytest.mark.parametrize("target", TARGETS)
def test_a_wrong_option_is_refused(target, options, words, tmp_path):
    with pytest.raises(ModelError, match=re.escape(words)):
        export(robot("delta54"), f"{target}:{options}", tmp_path)
    assert not any(tmp_path.iterdir())


# ------------------------------------------------------------------ the table of the self-test


@pytest.mark.parametrize("name", ["delta54", "stewart42", "arm"])
def test_the_jacobians_of_the_self_test_are_differences_of_solutions(name):
    rows = list(csv.DictReader(text("ros2_control", name, "test/configurations.csv").splitlines()))
    model, h = robot(name), 1e-6
    kinematics = Kinematics(model)
    for row in rows[:3]:
        q = np.array([float(row[joint]) for joint in model.joints])
        for joint, step in zip(model.joints, h * np.eye(len(q)), strict=True):
            found = kinematics.direct(np.array([q + step, q - step]))
            rate = (found.position[0] - found.position[1]) / (2 * h)
            turn = found.rotation[0] @ found.rotation[1].T / (2 * h)
            rate = [*rate, *(turn[[2, 0, 1], [1, 2, 0]] - turn[[1, 2, 0], [2, 0, 1]]) / 2]
            stated = [float(row[f"d_{c}_d_{joint}"]) for c in "x y z rx ry rz".split()]
            assert stated == pytest.approx(rate, abs=1e-7)
        forward, back = (
            np.array([[float(row[n(c, joint)]) for joint in model.joints] for c in CONTROLS[name]])
            for n in ("d_{}_d_{}".format, lambda c, joint: f"d_{joint}_d_{c}")
        )
        assert np.allclose(forward @ back.T, np.eye(len(forward)), atol=1e-9)


CONTROLS = {
    "delta54": ["x", "y", "z"],
    "stewart42": "x y z rx ry rz".split(),
    "arm": "x y z rx ry rz".split(),
}


# ------------------------------------------------------------------ the solver without ROS


@needs_compiler
@pytest.mark.parametrize("name", ["delta54", "stewart42"])
def test_the_inverse_from_any_seed_within_the_limits_is_pythons(name):
    _, targets = poses(name)
    low, high = np.array(robot(name).mechanism.joint_limits).T
    seeds = np.random.default_rng(2).uniform(low, high, (40, len(low)))
    inverse = Kinematics(robot(name)).inverse(*map(np.array, zip(*targets, strict=True)))
    asked = [(k % len(targets), seed) for k, seed in enumerate(seeds)]
    lines = [line("inverse", targets[k], seed) for k, seed in asked]
    for (k, _), (status, _, _, joints) in zip(asked, answers(name, lines), strict=True):
        assert status == CONVERGED
        assert joints == pytest.approx(inverse.joints[k], abs=1e-9)


@needs_compiler
@pytest.mark.wide
@pytest.mark.parametrize(
    "name", keep(["argos27", "cable", "linear_delta", "slider_crank", "arm"], "argos27", "arm")
)
def test_joints_are_their_own_solution_from_their_own_seed(name):
    q, targets = poses(name)
    lines = [line("inverse", target, seed) for target, seed in zip(targets, q, strict=True)]
    for seed, (status, _, _, joints) in zip(q, answers(name, lines), strict=True):
        assert status == CONVERGED
        assert joints == pytest.approx(seed, abs=1e-9)


@needs_compiler
def test_a_pose_out_of_reach_has_no_solution_and_a_search_ends_by_its_timeout():
    q, targets = poses("delta54")
    far = (targets[0][0] + [3.0, 0.0, 3.0], targets[0][1])
    status, _, _, joints = call("delta54", "inverse", far, q[0])
    assert status not in (CONVERGED, OUTSIDE_LIMITS)
    assert not joints.any()
    near = np.full(3, 10.0)
    status, asked, lapse, _ = call("delta54", "search", far, q[0], near, timeout=0.05)
    assert (status, asked) == (EFFORT_EXCEEDED, 0)
    assert lapse >= 0.05


@needs_compiler
def test_narrower_limits_of_a_robot_description_are_kept():
    q, targets = poses("delta54")
    assert call("delta54", "narrow", targets[0], q[0], q[0] + 1e-6)[0] == CONVERGED
    assert call("delta54", "narrow", targets[0], q[0], q[0] - 1e-6)[0] == OUTSIDE_LIMITS


@needs_compiler
def test_orientation_that_a_delta_does_not_control_must_agree_within_the_tolerance():
    q, targets = poses("delta54")
    r, R = targets[0]
    for angle, expected in ((0.009, CONVERGED), (0.011, UNREACHABLE)):
        turned = (
            r,
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]] @ R,
        )
        assert call("delta54", "inverse", turned, q[0])[0] == expected
        for kind in ("tolerant", "approximate"):
            status, _, _, joints = call("delta54", kind, turned, q[0])
            assert status == CONVERGED
            assert joints == pytest.approx(q[0], abs=1e-9)


@needs_compiler
def test_a_search_keeps_near_the_seed_and_asks_about_every_solution():
    q, targets = poses("delta54")
    limits = np.full(3, 1e-3)
    assert call("delta54", "search", targets[0], q[0] + 9e-4, limits, 0.05)[0] == CONVERGED
    status, asked, _, _ = call("delta54", "search", targets[0], q[0] + 2e-3, limits, 0.05)
    assert (status, asked) == (EFFORT_EXCEEDED, 0)
    status, asked, _, joints = call("delta54", "second", targets[0], q[0], timeout=10.0)
    assert (status, asked) == (CONVERGED, 2)
    assert joints == pytest.approx(q[0], abs=1e-9)
    status, asked, _, _ = call("delta54", "never", targets[0], q[0], timeout=0.02)
    assert status == EFFORT_EXCEEDED
    assert asked > 1


@needs_compiler
def test_joints_that_can_make_whole_turns_stay_near_the_seed_and_within_their_limits():
    q, targets = poses("arm")
    turns = -2 * np.pi * np.sign(q[0])
    for seed, expected in ((q[0] + turns, q[0] + turns), (q[0] - turns, q[0])):
        status, _, _, joints = call("arm", "inverse", targets[0], seed)
        assert status == CONVERGED
        assert joints == pytest.approx(expected, abs=1e-9)
