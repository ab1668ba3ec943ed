"""The recipes of CONTRIBUTING.md work from outside the package, by Python path.

Their files are written to a folder of their own, their commands run there in order; each quoted
line must be among those printed.
"""

import importlib
import json
import re
import shlex
import sys
from pathlib import Path

import bag_writing as bw
import numpy as np
import pytest
from test_docs import execute, like

import parallel_cal as pc
from parallel_cal.recordings.channels import CHANNELS

PAGE = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")
KINDS = "robot effect sensor method solver channel importer plot".split()
NOISE = 1.21e-4  # rad, of the page's recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the page's files, on the Python path while these tests run."""
    path = tmp_path_factory.mktemp("outside")
    for text in re.findall(r"^```python\n(.*?)^```$", PAGE, flags=re.M | re.S):
        file = path / re.match(r"# (\S+\.py)\n", text)[1]
        file.parent.mkdir(exist_ok=True)
        file.write_text(text, encoding="utf-8")
    for name, text in re.findall(r"^```text\n# (\S+)\n(.*?)^```$", PAGE, flags=re.M | re.S):
        (path / name).write_text(text, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(path))
        yield path
    for name in [n for n in sys.modules if n.split(".")[0] == "my_pkg"]:
        del sys.modules[name]
    CHANNELS.pop("humidity", None)


@pytest.fixture(scope="module")
def ran(folder):
    """{command: (words, printed lines)} of every command of the page, run in order."""
    done = {}
    for block in re.findall(r"^```console\n(.*?)^```$", PAGE, flags=re.M | re.S):
        for line in block.splitlines():
            if line.startswith("$ "):
                code, printed = execute(shlex.split(line[2:]), folder)
                assert code == 0, (line, printed)
                done[line[2:]] = printed
            else:
                assert any(like(line, p) for p in printed), (line, printed)
    return done


def answer(folder, text):
    """The JSON document of a command."""
    code, printed = execute(shlex.split(f"parallel-cal {text} --json"), folder)
    assert code == 0, printed
    return json.loads(next(line for line in printed if line.startswith("{")))


def test_the_page_has_a_file_of_each_kind(folder):
    assert sorted(f.stem for f in (folder / "my_pkg").glob("*.py")) == sorted(
        f"my_{kind}" for kind in KINDS
    )


def test_the_mechanism_solves_both_problems_as_worked_by_hand(folder, ran):
    # Cranks at 120 and 60 degrees: elbows at (-+100, 86.60) mm, the point 111.80 mm above them.
    height = 0.1 * np.sin(np.pi / 3) + np.sqrt(0.15**2 - 0.1**2)
    there = answer(folder, "direct five.yaml --joints 2.0943951023931953 1.0471975511965976")
    assert there["solutions"][0]["position"] == pytest.approx([0, height, 0], abs=1e-12)
    back = answer(folder, f"inverse five.yaml --position 0 {height} 0")["solutions"][0]
    assert back["joints"] == pytest.approx([2 * np.pi / 3, np.pi / 3], abs=1e-9)
    assert back["status"] == "converged"


def test_the_effect_is_named_by_the_diagnosis_and_lowers_the_error(folder, ran):
    command = "diagnose fit.yaml bag --effect backlash --also my_pkg.my_effect"
    found = answer(folder, f"{command} --joint-sigma {NOISE}")
    assert found["verdict"] == "explained"
    assert found["effects"] == ["my_pkg.my_effect"]
    before, better = (pc.read_model(folder / f"{name}.yaml") for name in ("fit", "better"))
    assert [effect.name for effect in better.effects] == ["my_pkg.my_effect"]
    assert better.value("my_pkg.my_effect.left.sin") == pytest.approx(0.002, abs=0.0015)
    data = pc.load_dataset(folder / "bag", joints=better.joints)
    errors = [
        np.mean(pc.compare(model, data, NOISE).errors.norms("position"))
        for model in (before, better)
    ]
    assert errors[1] < 0.75 * errors[0]


def test_the_sensor_reads_what_it_shows_and_its_numbers_are_found_again(folder, ran):
    model = pc.read_model(folder / "scale.yaml")
    assert model.structure.channels == ("scale",)
    rng = np.random.default_rng(0)
    q = np.array(model.mechanism.home.joints) + rng.uniform(-0.3, 0.3, (30, 2))
    r = pc.Kinematics(model).direct(q).position
    read = r[:, 0] * np.cos(0.02) + r[:, 1] * np.sin(0.02) - 0.0005
    data = pc.Dataset.from_arrays(
        model.joints,
        q,
        r,
        measured=[1, 1, 0, 0, 0, 0],
        pose_cov=1e-12 * np.eye(6),
        joint_sigma=1e-6,
        conditions={"reading.scale": read},
    )
    found = pc.fit(model, data, hold_out=0).model
    assert found.value("my_pkg.my_sensor.zero") == pytest.approx(0.0005, abs=5e-6)
    assert found.value("my_pkg.my_sensor.turn") == pytest.approx(0.02, abs=5e-5)


def test_the_method_ends_where_implicit_calibration_does(folder, ran):
    fit = f"fit better.yaml bag --joint-sigma {NOISE}"
    own, usual = (answer(folder, f"{fit} --method {m}") for m in ("my_pkg.my_method", "implicit"))
    assert own["method"] == "my_pkg.my_method"
    for name, row in usual["parameters"].items():
        assert own["parameters"][name]["value"] == pytest.approx(
            row["value"], abs=1e-3 * row["sigma"]
        )


@pytest.mark.parametrize("problem", ["direct --joints 2.1 1.0", "inverse --position 0.01 0.2 0"])
def test_the_solver_answers_as_newtons_method_does(folder, ran, problem):
    word, given = problem.split(" ", 1)
    own, usual = (
        answer(folder, f"{word} better.yaml {given} --solver {solver}")["solutions"][0]
        for solver in ("my_pkg.my_solver:steps=4", "newton")
    )
    assert own["status"] == "converged"
    assert own["position"] == pytest.approx(usual["position"], abs=1e-10)
    assert own["joints"] == pytest.approx(usual["joints"], abs=1e-10)


def test_the_channel_comes_from_a_bag_to_the_samples(folder, ran):
    kind, moves = "sensor_msgs/msg/RelativeHumidity", bw.Session([[0.1, 0.2, 0.3], [0.4, 0.0, 0.5]])
    said = [
        ("lab/air", kind, bw.ns(t), bw.kind(kind)(bw.header(bw.ns(t)), value, 0.0))
        for t, value in ((0, 0.4), (10, 0.6))
    ]
    bw.write_bag(folder / "humid", bw.joint_states(moves) + bw.poses(moves) + said)
    own = "--data channels=my_pkg.my_channel --data humidity=lab/air"
    told = answer(folder, f"info humid {own}")
    assert told["channels"]["humidity"] == "lab/air"
    span, time = told["conditions"]["humidity"], told["conditions"]["time"]
    for end in ("min", "max"):
        assert span[end] == pytest.approx(0.4 + 0.02 * time[end])


def test_the_plot_shows_every_sample(folder, ran):
    model = pc.read_model(folder / "better.yaml")
    comparison = pc.compare(model, pc.load_dataset(folder / "bag", joints=model.joints), NOISE)
    figure = importlib.import_module("my_pkg.my_plot").over_height(comparison)
    assert len(figure.data[0].x) == len(figure.data[0].y) == 40
    assert figure.layout.yaxis.title.text == "position error [um]"


WRONG = {
    "fit better.yaml bag --method my_pkg.my_solver": "my_pkg.my_solver is not a method: it has",
    "info bag --data channels=my_pkg.my_plot": "my_pkg.my_plot defines no Channel: assign",
    "info bag --data channels=my_pkg.none": "my_pkg.none: ModuleNotFoundError: No module named 'my",
    "fit better.yaml bag --method my_pkg.nowhere": "no method 'my_pkg.nowhere': expected one of",
    "fit better.yaml bag --method my_pkg.bad": "my_pkg.bad: ZeroDivisionError: division by zero (b",
    "direct better.yaml --joints 2 1 --solver my_pkg.my_plot": "my_pkg.my_plot is not a solver: it",
    "direct better.yaml --joints 2 1 --solver my_pkg.bad": "my_pkg.bad: ZeroDivisionError: divisio",
    "direct better.yaml --joints 2 1 --solver my_pkg.nowhere": "no solver 'my_pkg.nowhere': expect",
    "direct better.yaml --joints 2 1 --all --solver my_pkg.my_solver": "my_pkg.my_solver finds one",
    "inverse better.yaml --position 0 0.2 0 --solver my_pkg.bad": "my_pkg.bad does not solve the i",
}


@pytest.mark.parametrize("command", WRONG)
def test_a_fault_in_a_users_file_is_reported_in_one_line(folder, ran, command):
    (folder / "my_pkg" / "bad.py").write_text(
        "def estimate(model, observations, free, prior=False):\n    return 1 / 0\n\n\n"
        "def direct(model, q, at=None):\n    return 1 / 0\n"
    )
    importlib.invalidate_caches()
    code, printed = execute(shlex.split(f"parallel-cal {command}"), folder)
    assert code == 1
    assert printed[-1].startswith(f"error: {WRONG[command]}")


def test_the_importers_notes_are_what_the_mechanism_does(folder, ran):
    """Cranks with cosine -+0.6 lift the elbows 80 mm, 110 mm out: the point is at 181.98 mm."""
    compared = answer(folder, "compare five.yaml notes.json")
    assert compared["samples"] == 2
    assert compared["position_mean"] < 2e-5
