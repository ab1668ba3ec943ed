"""Each mechanism goes the whole way, and so does one from a user's own file."""

from dataclasses import replace

import numpy as np
import pytest
from marks import keep

from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins, load_effect, load_mechanism
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.simulate import simulate, stated_noise
from parallel_cal.recordings.writer import write_bag

NEEDS_OPTIONS = {"serial", "chain"}  # described in its file: test_serial.py, test_chain.py
# One angle against another, or two against two, tell little: the tolerances must help.
NEEDS_PRIOR = {"rssr", "ankle_2rsu"}
# Rods or none, lines, orientations alone, joints in m and in rad, a prior. Fits of the others are
# in test_methods_coverage.py and test_shelf_truth.py.
TYPICAL = ("argos9", "cable", "rssr", "scara16", "stewart42", "tripod_struts")


@pytest.mark.wide
@pytest.mark.parametrize(
    "name", keep(sorted(set(list_plugins("mechanisms")) - NEEDS_OPTIONS), *TYPICAL)
)
def test_file_bag_samples_and_fit_work_with(name, tmp_path):
    model = parse_model(dump_model(new_model(name)), name)
    write_bag(simulate(model, 60, 3, replicates=8), tmp_path / "bag", "mcap")
    data = load_dataset(tmp_path / "bag")
    prior = name in NEEDS_PRIOR
    joints = stated_noise(model).joint  # a robot may have joints in rad and in m
    model = replace(model, noise=replace(model.noise, joint=joints))
    result = fit(model, data, prior=prior)
    assert result.samples == 68
    low, high = chi2_band(result.estimate.dof)
    assert 0.9 * low < result.estimate.chi2_per_dof < 1.1 * high
    for kind in ("position_rms", "orientation_rms"):
        held, floor = (getattr(e, kind) for e in (result.held_out.summary, result.noise_floor))
        assert held < 1.5 * floor


USERS = """
import casadi as ca
from parallel_cal.model.effect import Effect
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Parameter, ParameterTable


class Crank(Mechanism):
    joints, moves, controls = ("crank",), ("x",), ("x",)
    parameters = ParameterTable([Parameter("a", "m", 0.1, 1e-3)])
    home = Home((1.0,), (0.1 * 0.5403023058681398, 0, 0))
    workspace, joint_limits = Workspace((0.02,), (0.08,)), ((0.1, 3.0),)

    def closure(self, q, r, R, p):
        return {closure}
"""


GOOD = "r[0] - p.a * ca.cos(q[0])"
BENT = """from parallel_cal.model.effect import Effect
from parallel_cal.model.parameters import Parameter


class Bent(Effect):
    def parameters(self, mechanism):
        return [Parameter("by", "m", 0.0, 1e-3)]

    def ideal(self, seen, e, at, mechanism):
        return {ideal}
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A user's package on the Python path, of a name no other test has."""
    folder = tmp_path / f"pkg_{tmp_path.name}"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    return folder


def test_a_users_mechanism_is_named_by_its_python_path(package):
    crank, bent = f"{package.name}.crank", f"{package.name}.bent"
    (package / "crank.py").write_text(USERS.replace("{closure}", GOOD))
    (package / "bent.py").write_text(
        BENT.format(ideal="type(seen)(seen.q, seen.r - e.by, seen.R, seen.p)")
    )
    model = new_model(crank, effects=[bent])
    assert model.table.names == ("a", f"{bent}.by")
    answer = Kinematics(model).direct(np.array([1.2]))
    assert answer.position[0] == pytest.approx(0.1 * np.cos(1.2), abs=1e-15)
    assert parse_model(dump_model(model), "file").mechanism.name == crank
    assert load_effect(bent).name == bent


@pytest.mark.parametrize(
    ("closure", "words"),
    [
        ("ca.SX(0, 1)", "closure has shape .0, 1., expected one column with at least 1 rows"),
        ("ca.horzcat(r[0], q[0])", "closure has shape .1, 2., expected one column"),
        ("r[0] - ca.SX.sym('mystery')", "unknown symbols .'mystery'."),
        ("None", "closure is a NoneType, expected casadi.vertcat of its rows"),
        ("[r[0] - p.a]", "closure is a list, expected casadi.vertcat of its rows"),
        ("r[0] - float('nan')", r"closure is not finite in rows \[0\] at home"),
        ("r[0] - p.length", "crank: no entry 'length'; there are a"),
        ("r[0] - q[3]", r"crank: RuntimeError: .*out of bounds.* \(crank.py:15\)$"),
        ("r[0] - 1 / 0", r"crank: ZeroDivisionError.* \(crank.py:15\)$"),
    ],
)
def test_a_users_closure_of_the_wrong_kind_is_a_clear_error(closure, words, package):
    (package / "crank.py").write_text(USERS.replace("{closure}", closure))
    model = new_model(f"{package.name}.crank")
    with pytest.raises(ModelError, match=words):
        Kinematics(model).direct(np.array([1.0]))
    with pytest.raises(ModelFileError, match=rf"robot\.yaml:\d+: mechanism: .*{words}"):
        parse_model(dump_model(model), "robot.yaml")


@pytest.mark.parametrize(
    ("given", "instead", "words"),
    [
        ("import casadi", "import not_here\nimport casadi", "ModuleNotFoundError.*crank.py:2"),
        ("    def closure(", "    def closure((", "SyntaxError: .*crank.py, line 14"),
        ("closure(self", "clause(self", "TypeError: .*closure"),
        ("    home = ", "    away = ", "the class does not define home"),
        (
            'moves, controls = ("crank",), ("x",)',
            'moves, controls = ("crank",), ("u",)',
            "coordinates .'u'., expected some of x y z rx ry rz",
        ),
        ('("x",), ("x",)', '("x",), ("y",)', "it controls y, which it does not move"),
        ('("x",), ("x",)', '("x", "y"), ("x", "y")', "it controls x y, but has only the joints"),
        ("Workspace((0.02,)", "Workspace((0.02, 0.0)", "workspace.low has 2 entries, expected 1"),
        ("((0.1, 3.0),)", "((0.1, 3.0),) * 2", "joint_limits has 2 entries, expected 1"),
        ('"m", 0.1, 1e-3', '"mm", 100, 1', "a has the unit mm, expected SI units"),
        ('"m", 0.1', '"m", float("inf")', "nominal values, .* must be finite numbers"),
        ("    home", "    joint_unit = 'deg'\n    home", "joint units are deg, expected rad or m"),
        ("    home", "    length = 0.0\n    home", "length is 0.0 m.*expected above 0"),
    ],
)
def test_a_users_class_that_lacks_or_miscounts_something_is_a_clear_error(
    given, instead, words, package
):
    text = USERS.replace("{closure}", GOOD)
    assert given in text
    (package / "crank.py").write_text(text.replace(given, instead))
    with pytest.raises(ModelError, match=f"crank: {words}") as refused:
        load_mechanism(f"{package.name}.crank")
    assert "\n" not in str(refused.value)


def test_a_users_effect_that_fails_is_named_with_its_line(package):
    (package / "crank.py").write_text(USERS.replace("{closure}", GOOD))
    (package / "bent.py").write_text(
        BENT.format(ideal="seen.with_q(seen.q + e.by * (1 / len([])))")
    )
    model = new_model(f"{package.name}.crank", effects=[f"{package.name}.bent"])
    with pytest.raises(ModelError, match=r"bent: ZeroDivisionError: .* \(bent.py:10\)"):
        Kinematics(model).direct(np.array([1.0]))


def test_a_module_without_a_mechanism_or_an_unknown_path_is_a_clear_error():
    with pytest.raises(ModelError, match="defines 0 subclasses of Mechanism, expected 1"):
        load_mechanism("parallel_cal.base.errors")
    with pytest.raises(ModelError, match=r"no mechanism 'nobody\.has_this'"):
        load_mechanism("nobody.has_this")


@pytest.mark.parametrize("name", sorted(set(list_plugins("mechanisms")) - NEEDS_OPTIONS))
def test_joints_that_are_not_numbers_are_invalid_input_even_where_all_poses_are_requested(name):
    kinematics = Kinematics(new_model(name))
    joints = np.full(len(kinematics.model.joints), np.nan)
    for found in (kinematics.direct(joints), direct_all(kinematics.model, joints)[0]):
        assert Status(int(found.status)) == Status.INVALID_INPUT


@pytest.mark.parametrize(
    ("name", "solver"),
    [("argos9", "polynomial"), ("argos27", "three_circles"), ("delta54", "homotopy")],
)
def test_a_complete_solver_chosen_by_name_also_refuses_joints_that_are_not_numbers(name, solver):
    found = solving.direct(new_model(name), np.full(3, np.nan), {}, every=True, solver=solver)
    assert Status(int(found[0].status)) == Status.INVALID_INPUT


def test_a_double_root_of_the_direct_problem_is_singular_and_not_an_error():
    """Arms and rods of the nominal Delta all in one plane: the direct problem has a double root."""
    model = new_model("delta_nominal", {"R": 0.05, "La": 0.1, "Lb": 0.05})
    answer = Kinematics(model).direct(np.full(3, np.pi / 2))
    assert Status(int(answer.status)) == Status.SINGULAR
    assert answer.position == pytest.approx([0, 0, 0.1], abs=1e-6)


@pytest.mark.parametrize("name", [n for n in list_plugins("mechanisms") if n not in NEEDS_OPTIONS])
def test_home_closes(name):
    model = new_model(name)
    home = model.mechanism.home
    pose = Kinematics(model).direct(np.array(home.joints))
    assert np.abs(pose.position - home.position).max() < 2e-5
