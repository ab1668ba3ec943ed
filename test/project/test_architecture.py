"""The rules of the layout that no reader should have to check by hand."""

import ast
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from parallel_cal.model.shelf import list_plugins, load_module

TESTS = Path(__file__).parents[1]
PACKAGE = TESTS.parent / "parallel_cal"
MAY_USE_ROSBAGS = {"bag.py", "ros1_files.py", "writer.py", "replay_node.py", "recorder.py"}

# The rooms, each importing only from those before it; CONTRIBUTING draws them.
ROOMS = (
    "base imaging virtual model mechanisms effects sensors kinematics recordings importing "
    "exporting identification thesis planning posterior causes diagnosis short_cut session "
    "discovery campaign fleet study watch reporting workbench nodes cli"
).split()
# Between rooms; a new one needs a reason, and this number says so. The last ones: blocks of causes
# (causes, posterior) stand between identification and diagnosis, and whoever draws a residual sees
# its scene there. A watch linearises recordings, plans what confirms an alarm, and is shown. What
# only the tables of the documents need stands on kinematics and identification, and nobody on it.
ARROWS = 158


@cache
def parse(path):
    return ast.parse(path.read_text())


def imports(path):
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def test_rclpy_the_web_opencv_and_rosbags_are_each_imported_in_one_place():
    for path in PACKAGE.rglob("*.py"):
        names = {name.split(".")[0] for name in imports(path)}
        if path.parent.name != "nodes":
            assert not names & {"rclpy", "parallel_cal_msgs", "control_msgs"}, path
        if path.name != "trajectory_action.py":
            assert "control_msgs" not in names, path  # not everybody has it
        if path.parent.name != "workbench":
            assert "nicegui" not in names, path
        if path.parent.name != "imaging":
            assert "cv2" not in names, path
        if path.name not in MAY_USE_ROSBAGS:
            assert "rosbags" not in names, path


def test_the_mathematics_loads_without_scipy_rosbags_or_ros():
    code = (
        "import sys, parallel_cal.identification.fit, parallel_cal.kinematics.kinematics\n"
        "heavy = ('scipy', 'rosbags', 'rclpy', 'plotly', 'pydantic', 'cv2')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_only_the_tables_of_the_documents_need_is_in_a_room_that_no_other_imports():
    """It is found by its name on the shelf, as all solvers and methods are."""
    users = {file for file, others in graph().items() if any(room(o) == "thesis" for o in others)}
    assert {room(file) for file in users} == {"thesis"}
    for shelf, names in {
        "kinematics.solvers": ("cascaded", "cascaded_circles", "fixed_newton", "ipr_compensation"),
        "identification.methods": ("cascaded", "linear", "semiparametric", "sensitivity"),
    }.items():
        for name in names:
            assert name in list_plugins(shelf)
            assert load_module(shelf, name).__name__.startswith("parallel_cal.thesis.")


def test_the_virtual_robots_share_nothing_with_the_other_rooms():
    virtual = [*TESTS.glob("helpers/virtual*.py"), *PACKAGE.glob("virtual/*.py")]
    assert len(virtual) > 15
    for path in virtual:
        ours = {name for name in imports(path) if name.startswith("parallel_cal")}
        assert all(name.startswith("parallel_cal.virtual") for name in ours), path
        assert "casadi" not in imports(path), path


def name_of(path):
    return ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)


MODULES = {name_of(path): path for path in PACKAGE.rglob("*.py")}


def used(path):
    """Modules of the package that a file imports, in functions and for type checkers, too."""
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("parallel_cal"):
            for alias in node.names:
                longer = f"{node.module}.{alias.name}"
                yield longer if longer in MODULES else node.module


@cache
def graph():
    return {name: {m for m in used(path) if m in MODULES} for name, path in MODULES.items()}


def room(name):
    return name.split(".")[1]


def test_every_file_is_in_a_room():
    assert {room(name) for name in MODULES} - {"__init__"} == set(ROOMS)


def test_each_test_is_in_the_folder_of_a_room():
    folders = {path.parent.relative_to(TESTS).as_posix() for path in TESTS.rglob("test_*.py")}
    assert folders <= {*ROOMS, "project"}


def test_rooms_import_downward_only_and_along_no_new_arrow():
    arrows = {(room(a), room(b)) for a, its in graph().items() for b in its} - {
        (name, name) for name in ROOMS
    }
    upward = [(a, b) for a, b in arrows if ROOMS.index(a) < ROOMS.index(b)]
    assert not upward
    assert len(arrows) <= ARROWS


def test_no_file_imports_itself_in_a_circle():
    done, open_ = set(), []

    def visit(name):
        if name in done:
            return
        assert name not in open_, [*open_[open_.index(name) :], name]
        open_.append(name)
        for other in sorted(graph()[name]):
            visit(other)
        open_.pop()
        done.add(name)

    for name in sorted(graph()):
        visit(name)


MAX_SHARE_CALLED_ONCE = 0.117  # of all functions


@dataclass
class PrivateNames:
    """How often the private names of a file are used outside their own definitions."""

    uses: Counter[str] = field(default_factory=Counter)
    calls: Counter[str] = field(default_factory=Counter)
    functions: list[ast.FunctionDef] = field(default_factory=list)

    def read(self, node, inside=frozenset(), called=False):
        if isinstance(node, ast.FunctionDef):
            self.functions.append(node)
            inside |= {node.name}
        name = getattr(node, "id", None) or getattr(node, "attr", None)
        if name and name not in inside:
            self.uses[name] += 1
            self.calls[name] += called
        for child in ast.iter_child_nodes(node):
            is_called = isinstance(node, ast.Call) and child is node.func
            self.read(child, inside, is_called)
        return self


@pytest.mark.wide
def test_few_private_functions_are_called_only_once():
    """Extract a function when its name says more than its body.

    Callbacks, threads' targets and decorated functions are left aside: they are no calls that a
    body could replace.
    """
    names = {module: PrivateNames().read(parse(path)) for module, path in MODULES.items()}
    users = {module: {module} for module in MODULES}  # a subclass may call a private method
    for module, imported in graph().items():
        for one in imported:
            users[one].add(module)
    once = [
        f"{module}.{f.name}"
        for module, read in names.items()
        for f in read.functions
        if f.name.startswith("_")
        and not f.name.startswith("__")
        and not f.decorator_list
        and sum(names[user].uses[f.name] for user in users[module]) == 1
        and sum(names[user].calls[f.name] for user in users[module]) == 1
    ]
    functions = sum(len(read.functions) for read in names.values())
    assert functions > 3000
    assert len(once) / functions <= MAX_SHARE_CALLED_ONCE, (len(once), functions)


MAX_LINES, MAX_FIELDS, MAX_FILE = 60, 10, 500  # of a function without its docstring, a value
# Their fields are parameters by name, options of a file or keys of a document that are promised
# (docs/stability.md), or all of what a file states of one thing.
WIDE = {
    "campaign.goal.Goal",
    "campaign.judging.Judgement",
    "diagnosis.patterns.OddSample",
    "discovery.law.Law",
    "identification.budget.Iso9283",
    "identification.estimate.Estimate",
    "identification.fit.FitResult",
    "identification.options.FitOptions",
    "identification.prediction_errors.Summary",
    "importing.deltas.Towers",
    "importing.linkage.LinkageJoint",
    "mechanisms._chain_reading.Joint",
    "model.model.Model",
    "nodes.trajectory_action._Goal",
    "planning.plan.Plan",
    "posterior.scene.Scene",
    "recordings.dataset.Dataset",
    "recordings.options.ReadOptions",
    "recordings.options.SampleOptions",
    "recordings.recording.Recording",
    "recordings.samples.Sample",
    "reporting.certificate.CertificateFields",
    "reporting.report.Provenance",
    "reporting.report.Report",
    "sensors.camera.Camera",
    "virtual.cell.Circumstances",
}
LARGE = {
    "identification.fit",
    "identification.registration",
    "mechanisms.chain",
    "session.session",
    "workbench.bench",
}


def count_lines(function):
    """Lines of a function without its docstring."""
    lines = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is not None:
        lines -= function.body[0].end_lineno - function.body[0].lineno + 1
    return lines


@pytest.mark.wide
def test_functions_values_and_files_are_small_enough_to_read():
    """Values and files that are not are listed: the lists may only become shorter."""
    long, wide, large = set(), set(), set()
    for module, path in MODULES.items():
        name, text = module.removeprefix("parallel_cal."), path.read_text()
        if text.count("\n") > MAX_FILE:
            large.add(name)
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                long |= {f"{name}.{node.name}"} if count_lines(node) > MAX_LINES else set()
            elif isinstance(node, ast.ClassDef) and node.decorator_list:
                fields = sum(isinstance(one, ast.AnnAssign) for one in node.body)
                wide |= {f"{name}.{node.name}"} if fields > MAX_FIELDS else set()
    assert (long, wide - WIDE, large - LARGE) == (set(), set(), set())
    assert (WIDE - wide, LARGE - large) == (set(), set())


def test_a_private_module_is_imported_by_its_own_folder_only():
    elsewhere = {
        (name, used)
        for name, others in graph().items()
        for used in others
        if used.split(".")[-1].startswith("_")
        and used.rpartition(".")[0] != name.rpartition(".")[0]
    }
    # What effects compute of forces, lines and legs are also the drivers of laws.
    assert {used for _, used in elsewhere} <= {
        "parallel_cal.effects._legs",
        "parallel_cal.effects._lines",
        "parallel_cal.effects._statics",
    }


@pytest.mark.wide
def test_the_picture_of_the_rooms_is_that_of_the_code():
    file = TESTS.parent / "docs" / "rooms.py"
    rooms = module_from_spec(spec := spec_from_file_location("rooms", file))
    spec.loader.exec_module(rooms)
    assert rooms.PICTURE.read_text(encoding="utf-8") == rooms.picture(), "python docs/rooms.py"
    shown = rooms.imported()
    assert all((a, b) in rooms.arrows() for a, b in [("model", "base"), ("reporting", "discovery")])
    assert ("cli", "base") not in rooms.arrows()  # it follows from others
    assert "base" in shown["cli"]
