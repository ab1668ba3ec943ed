"""What `import parallel_cal` offers: every name in any order, nothing heavy before its use."""

import dataclasses
import doctest
import enum
import html
import inspect
import io
import operator
import random
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.planning.options import PlanKeywords, PlanOptions
from parallel_cal.recordings.options import ReadKeywords, ReadOptions

HEAVY = "numpy casadi scipy yaml pydantic plotly rich rosbags rclpy typer".split()
SHELVES = {"effects": "backlash", "mechanisms": "delta24", "sensors": "probe"}


def fresh(code):
    """The last line that a new interpreter prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def test_importing_the_package_imports_nothing_heavy():
    assert (
        fresh(f"import sys, parallel_cal; print(sorted({set(HEAVY)!r} & set(sys.modules)))") == "[]"
    )


@pytest.mark.wide
@pytest.mark.parametrize("seed", [None, 1])
def test_every_name_exists_in_whatever_order_it_is_requested(seed):
    names = list(pc.__all__)
    if seed is not None:
        random.Random(seed).shuffle(names)
    code = (
        "import parallel_cal\n"
        f"found = {{name: getattr(parallel_cal, name) for name in {names!r}}}\n"
        "again = {name: getattr(parallel_cal, name) for name in found}\n"
        "print(all(found[name] is again[name] for name in found), len(found))"
    )
    assert fresh(code) == f"True {len(names)}"


def test_star_gives_them_all():
    code = (
        "before = set(globals())\nfrom parallel_cal import *\nprint(len(set(globals()) - before))"
    )
    assert fresh(code) == str(len(pc.__all__) + 1)  # and `before` itself


USERS_SCRIPT = """
import parallel_cal as pc

model = pc.read_model("robot.yaml")
data = pc.load_dataset("bag", joints=model.joints)
result = pc.fit(model, data, hold_out=0.1)
print(result.held_out.summary.position_rms)
comparison: pc.Comparison = pc.compare(result.model, data)
diagnosis = pc.diagnose(result.model, data, effects=["backlash"], loss="huber")
step = pc.add(result.model, diagnosis.effects[0], data, seed=1)
plan: pc.Plan = pc.plan(step.model, 30, criterion="D")
pc.export(step.model, "c", "robot_c")
pc.write_model(step.model, "better.yaml")

pc.fit(model, 3, hold_ouut=5)  # WRONG
result.estimat  # WRONG
pc.nonsense(1)  # WRONG
pc.plan(model, "thirty")  # WRONG
step.model.valuess  # WRONG
"""


@pytest.mark.wide
def test_a_type_checker_accepts_a_users_script_and_finds_its_mistakes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(USERS_SCRIPT)
    wrong = {n for n, line in enumerate(USERS_SCRIPT.splitlines(), 1) if "# WRONG" in line}
    command = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", str(script)]
    root = Path(pc.__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root)
    found = {int(number) for number in re.findall(r"script\.py:(\d+): error", done.stdout)}
    assert found == wrong, done.stdout + done.stderr


PUBLIC_FUNCTIONS = [n for n in pc.__all__ if inspect.isfunction(getattr(pc, n))]


@pytest.mark.wide
@pytest.mark.parametrize("name", PUBLIC_FUNCTIONS)
def test_every_public_function_is_documented_and_its_examples_run(name, monkeypatch):
    monkeypatch.chdir(Path(pc.__file__).parents[1])
    function = getattr(pc, name)
    text = inspect.getdoc(function)
    assert "Parameters\n----" in text
    assert "Returns\n----" in text or function.__annotations__["return"] == "None"
    (example,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={})
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    said = io.StringIO()
    result = doctest.DocTestRunner(optionflags=flags).run(example, out=said.write)
    assert result.attempted > 0
    assert result.failed == 0, said.getvalue()


PUBLIC_CLASSES = [n for n in pc.__all__ if inspect.isclass(getattr(pc, n))]


def is_shown_by_its_name(cls):
    """Whether a class is an error or an enumeration: its members need no list."""
    return issubclass(cls, (Exception, enum.Enum))


@pytest.mark.parametrize("name", PUBLIC_CLASSES)
def test_every_public_class_documents_itself_and_its_members(name):
    cls = getattr(pc, name)
    text = inspect.getdoc(cls)
    assert text, name
    if not is_shown_by_its_name(cls) and cls is not pc.Cell:  # a protocol has methods only
        assert "Parameters\n----" in text or "Attributes\n----" in text
    for member, value in vars(cls).items():
        accessor = getattr(value, "fget", None) or getattr(value, "func", None)
        function = accessor or getattr(value, "__func__", value)
        if not member.startswith("_") and inspect.isfunction(function):
            assert inspect.getdoc(function), f"{name}.{member}"


@pytest.mark.parametrize("name", PUBLIC_FUNCTIONS + PUBLIC_CLASSES)
def test_every_argument_is_documented_by_its_name(name):
    documented = getattr(pc, name)
    text = inspect.getdoc(documented)
    if "Parameters\n----" not in text:
        return
    section = re.split(r"\n\n\w+\n---", text.split("Parameters\n----", 1)[1])[0]
    for parameter in inspect.signature(documented).parameters.values():
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            assert re.search(rf"\b{parameter.name}\b", section), parameter.name


WITH_EXAMPLE = [n for n in PUBLIC_CLASSES if ">>>" in inspect.getdoc(getattr(pc, n))]


@pytest.mark.wide
@pytest.mark.parametrize("name", [*WITH_EXAMPLE, "Dataset.from_arrays"])
def test_the_examples_of_public_classes_run(name, monkeypatch):
    assert len(WITH_EXAMPLE) > 10
    monkeypatch.chdir(Path(pc.__file__).parents[1])
    function = operator.attrgetter(name)(pc)
    (example,) = doctest.DocTestFinder(recurse=False).find(function, name, globs={})
    said = io.StringIO()
    result = doctest.DocTestRunner().run(example, out=said.write)
    assert result.attempted > 0
    assert result.failed == 0, said.getvalue()


@pytest.mark.parametrize(
    ("options", "keywords"),
    [
        (FitOptions, FitKeywords),
        (PlanOptions, PlanKeywords),
        (ReadOptions, ReadKeywords),
    ],
)
def test_keyword_arguments_are_the_fields_of_the_options(options, keywords):
    fields = {field.name: field.type for field in dataclasses.fields(options)}
    assert fields == {name: one.__forward_arg__ for name, one in keywords.__annotations__.items()}


@pytest.fixture(scope="module")
def results():
    model = pc.new_model("delta24")
    data = pc.simulate(model, 40, seed=3).dataset()
    fitted = pc.fit(model, data)
    return {
        "Model": model,
        "Dataset": data,
        "FitResult": fitted,
        "Comparison": pc.compare(model, data),
        "Diagnosis": pc.diagnose(fitted.model, data, effects=["backlash"]),
        "Step": pc.add(model, "backlash", data, force=True),
        "Kinematics": pc.Kinematics(model),
        "Simulation": pc.simulate(model, 3),
    }


def test_a_result_prints_on_one_line(results):
    for name, result in results.items():
        assert repr(result).startswith(f"{name}(")
        assert len(repr(result)) < 200


def test_a_part_of_a_diagnosis_fits_on_a_screen(results):
    diagnosis = results["Diagnosis"]
    for field in dataclasses.fields(diagnosis):
        part = getattr(diagnosis, field.name)
        for one in part if isinstance(part, tuple) else [part]:
            assert len(repr(one)) < 2000, field.name


def test_a_notebook_shows_the_tables_of_the_command_line(results):
    for name in ("FitResult", "Comparison", "Diagnosis", "Step"):
        shown = html.unescape(results[name]._repr_html_())
        assert shown.count("<table>") >= 2
        for line in pc.show(results[name]).splitlines():
            is_sentence = "  " not in line and len(line.split()) > 4
            assert not is_sentence or line.replace(" um", " µm").replace("+-", "±") in shown


def test_the_wrong_kind_of_argument_is_named_with_the_cure(results):
    model, data = results["Model"], results["Dataset"]
    for call in (pc.fit, pc.compare, pc.diagnose):
        with pytest.raises(pc.ModelError, match=r"model is 'file.yaml' \(str\).*read_model"):
            call("file.yaml", data)
        with pytest.raises(pc.DatasetError, match=r"dataset is 'bag' \(str\).*load_dataset"):
            call(model, "bag")


IS_NO_MODEL = r"model is 'robot.yaml' \(str\); expected a Model.*read_model"
WRONG_CALLS = {  # of functions that take a model, a dataset or a path
    IS_NO_MODEL: [
        lambda model, data: pc.add("robot.yaml", "backlash", data),
        lambda model, data: pc.remove("robot.yaml", "backlash", data),
        lambda model, data: pc.discover("robot.yaml", data),
        lambda model, data: pc.plan("robot.yaml", 30),
        lambda model, data: pc.export("robot.yaml", "c", "folder"),
        lambda model, data: pc.simulate("robot.yaml", 30),
        lambda model, data: pc.write_model("robot.yaml", "copy.yaml"),
        lambda model, data: pc.Kinematics("robot.yaml"),
    ],
    r"dataset is 'bag' \(str\); expected a Dataset": [
        lambda model, data: pc.add(model, "backlash", "bag"),
        lambda model, data: pc.remove(model, "backlash", "bag"),
    ],
    r"effect is 3 \(int\); expected a string": [lambda model, data: pc.add(model, 3, data)],
    r"effects is 'backlash' \(str\); expected a list: \['backlash'\]": [
        lambda model, data: pc.diagnose(model, data, effects="backlash"),
        lambda model, data: pc.simulate(model, 30, effects="backlash"),
        lambda model, data: pc.new_model("delta24", effects="backlash"),
    ],
    r"free is 'chain1\.\*' \(str\); expected a list": [
        lambda model, data: pc.fit(model, data, free="chain1.*")
    ],
    r"hold_out is '0.1' \(str\); expected a number": [
        lambda model, data: pc.fit(model, data, hold_out="0.1")
    ],
    r"n is 30.5 \(float\); expected a whole number": [lambda model, data: pc.plan(model, 30.5)],
    r"(path|folder) is 3 \(int\); expected the path of a file or folder": [
        lambda model, data: pc.read_model(3),
        lambda model, data: pc.load_dataset(3),
        lambda model, data: pc.info(3),
        lambda model, data: pc.Session(3),
    ],
    r"paths is 'bag' \(str\); expected a list": [lambda model, data: pc.load_sessions("bag")],
    r"session is Dataset.* expected a Simulation": [lambda model, data: pc.write_bag(data, "bag")],
    r"result is Model.* expected the result of fit": [
        lambda model, data: pc.show(model),
        lambda model, data: pc.figure(result=model),
    ],
    r"report is None \(NoneType\); expected a Report": [lambda model, data: pc.page(None)],
    r"dataset is None \(NoneType\); expected a Dataset": [
        lambda model, data: pc.report(model, None)
    ],
    r"model is Dataset": [lambda model, data: pc.report(data), lambda model, data: pc.fit(data)],
    r"mechanism is 3 \(int\); expected a Mechanism or a string": [
        lambda model, data: pc.new_model(3)
    ],
    r"model is 3 \(int\); expected a Model": [lambda model, data: pc.model_hash(3)],
    r"q is 'a' \(str\); expected an array of numbers": [
        lambda model, data: pc.Kinematics(model).direct("a")
    ],
    r"rotation has the shape \(2, 2\); expected": [
        lambda model, data: pc.Kinematics(model).inverse([0, 0, 0.3], np.eye(2))
    ],
    r"r has the shape \(3,\); expected \(2, 3\)": [
        lambda model, data: pc.Dataset.from_arrays(["a"], [[1], [2]], [1, 2, 3])
    ],
}


def sound_arguments(results, folder):
    """For each public function, arguments with which it works; a test replaces one of them."""
    model, data, fitted = results["Model"], results["Dataset"], results["FitResult"].model
    (folder / "bag").mkdir()
    some = {"model": model, "dataset": data}
    with_backlash = model.with_effect("backlash")
    pc.write_model(model, folder / "robot.yaml")
    kinematics = pc.Kinematics(with_backlash)
    return [
        (pc.fit, some),
        (pc.compare, some),
        (pc.diagnose, some),
        (pc.discover, some),
        (pc.report, some),
        (pc.add, some | {"effect": "backlash"}),
        (pc.remove, {"model": with_backlash, "effect": "backlash", "dataset": data}),
        (pc.plan, {"model": model, "n": 30}),
        (pc.simulate, {"model": model, "poses": 3}),
        (pc.export, {"model": model, "target": "c", "folder": folder / "c"}),
        (pc.new_model, {"mechanism": "delta24"}),
        (pc.model_hash, {"model": model}),
        (pc.read_model, {"path": folder / "robot.yaml"}),
        (pc.write_model, {"model": model, "path": folder / "copy.yaml"}),
        (pc.load_dataset, {"path": folder / "bag"}),
        (pc.load_sessions, {"paths": [folder / "bag"]}),
        (pc.info, {"path": folder / "bag"}),
        (pc.write_bag, {"session": results["Simulation"], "path": folder / "new"}),
        (pc.show, {"result": fitted}),
        (pc.figure, {"result": fitted}),
        (pc.page, {"report": fitted}),
        (kinematics.direct, {"q": [0.3] * 3}),
        (kinematics.inverse, {"position": [0, 0, 0.3]}),
        (kinematics.direct_covariance, {"solution": kinematics.direct([0.3] * 3)}),
        (kinematics.inverse_covariance, {"solution": kinematics.inverse([0, 0, 0.3])}),
        (
            pc.Dataset.from_arrays,
            {"joint_names": ["a"], "q": np.ones((2, 1)), "r": np.ones((2, 3))},
        ),
        (model.value, {"name": "chain1.Lb"}),
        (model.with_values, {"values": model.values}),
        (model.with_effects, {"effects": ()}),
        (model.with_sensors, {"sensors": ()}),
    ]


OPTIONAL = {"run", "options", "effects", "also", "at", "start", "certificate", "values", "sensors"}


def test_no_public_function_answers_a_wrong_kind_with_an_error_of_python(results, tmp_path):
    """An object that is of no kind at all, in place of each argument that has none as a default."""
    functions = sound_arguments(results, tmp_path)
    assert {f.__name__ for f, _ in functions} >= set(PUBLIC_FUNCTIONS)
    for function, sound in functions:
        for name in sound.keys() | (OPTIONAL & inspect.signature(function).parameters.keys()):
            with pytest.raises(pc.ParallelCalError, match=rf"^{name} is <object.*; expected "):
                function(**sound | {name: object()})


@pytest.mark.parametrize(
    ("options", "error"),
    [(FitOptions, pc.FitError), (PlanOptions, pc.FitError), (ReadOptions, pc.DatasetError)],
)
def test_every_option_refuses_what_is_of_no_kind(options, error):
    for field in dataclasses.fields(options):
        with pytest.raises(error, match=rf"^{field.name} is <object.*; expected "):
            options(**{field.name: object()})


@pytest.mark.parametrize("words", WRONG_CALLS)
def test_every_function_names_a_wrong_argument_and_what_was_expected(words, results):
    for call in WRONG_CALLS[words]:
        with pytest.raises(pc.ParallelCalError, match=words):
            call(results["Model"], results["Dataset"])


def test_the_result_of_a_fit_in_place_of_its_model_is_named(results):
    with pytest.raises(pc.ModelError, match="pass the model of this FitResult"):
        pc.add(results["FitResult"], "backlash", results["Dataset"])


def test_a_misspelt_option_is_named_with_the_nearest_one(results):
    model, data = results["Model"], results["Dataset"]
    with pytest.raises(pc.FitError, match="unknown option hold_ouut; did you mean 'hold_out'"):
        pc.fit(model, data, hold_ouut=0.1)
    with pytest.raises(pc.FitError, match="unknown option criterium; did you mean 'criterion'"):
        pc.plan(model, 30, criterium="D")
    with pytest.raises(pc.DatasetError, match="unknown option exclud; did you mean 'exclude'"):
        pc.load_dataset("bag", exclud=[1])


@pytest.mark.parametrize("shelf", SHELVES)
@pytest.mark.parametrize(
    "first", ["", "import parallel_cal.{0}.{1}; ", "from parallel_cal.{0} import {1}; "]
)
def test_a_shelf_is_itself_however_its_files_were_imported_before(shelf, first):
    name = SHELVES[shelf]
    code = (
        f"import parallel_cal; {first.format(shelf, name)}shelf = parallel_cal.{shelf}; "
        f"one = shelf.load({name!r}, **{options(shelf)}); "
        f"print({name!r} in shelf.names(), type(one).__module__)"
    )
    assert fresh(code) == f"True parallel_cal.{shelf}.{name}"


def options(shelf):
    return {"height": 0.3} if shelf == "sensors" else {}


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="No parallel_cal attribute calibrate_it_all"):
        pc.calibrate_it_all  # noqa: B018


def test_every_name_is_shown_to_whoever_presses_tab():
    assert set(pc.__all__) <= set(dir(pc))


def test_a_simulated_session_is_the_dataset_of_its_own_recording(tmp_path):
    robot = pc.new_model("delta24")
    session = pc.simulate(robot, 12, seed=1, effects=["backlash:width=0.002"], replicates=3)
    pc.write_bag(session, tmp_path / "bag")
    here, there = session.dataset(), pc.load_dataset(tmp_path / "bag", joints=robot.joints)
    assert len(here) == len(there) == 15
    # Stamps in a bag are whole microseconds: at a dwell's edge that is one reading more or less.
    for name, near in {"q": 2e-6, "r": 2e-6, "R": 2e-5, "pose_cov": 1e-12, "time": 0.02}.items():
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), rtol=0, atol=near)
    np.testing.assert_array_equal(here.pose_id, there.pose_id)
    np.testing.assert_array_equal(here.measured, there.measured)
    assert here.conditions.keys() == there.conditions.keys()
    for joint in robot.joints:
        column = f"direction.{joint}"
        np.testing.assert_array_equal(here.conditions[column], there.conditions[column])
    np.testing.assert_allclose(here.conditions["payload"], there.conditions["payload"])
    assert session.model.value("backlash.joint1.width") == 0.002
    assert here.sha256 != session_of(robot, seed=2).sha256


def session_of(robot, seed):
    return pc.simulate(robot, 4, seed).dataset()
