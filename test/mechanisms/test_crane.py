"""A platform on eight lines, from its table by command line to a controller; docs/cable_robot.md
quotes it. The robot is virtual, with equations of its own (virtual_crane.py)."""

import re
from pathlib import Path

import numpy as np
import pytest
import virtual_crane

from parallel_cal.base.errors import ModelError
from parallel_cal.cli import main as cli
from parallel_cal.identification import column_doubts
from parallel_cal.kinematics import home_branch
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.session.steps import fitted

ROOT = Path(__file__).parents[2]
DRIVE = "{kind: spool, radius: 0.05, gear: 10}"


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def new(path, *options):
    points = (
        ("base", virtual_crane.ANCHORS.round(3)),
        ("platform", virtual_crane.CORNERS.round(3)),
    )
    own = [f"--option={name}={value.tolist()}" for name, value in points]
    numbers = ["--option=height=1.2", "--option=limits=[-2.5, 2.5]", "--option=tolerance=0.005"]
    return run("new", "stewart42", *own, *numbers, *options, "-o", path)


def error(model, poses=200):
    """rms position error (m) of the true robot, sent to new poses with the model's motor angles."""
    kinematics, travel = Kinematics(model), virtual_crane.RADIUS / virtual_crane.GEAR
    errors = virtual_crane.position_errors(
        lambda r, R: kinematics.inverse(r, R).joints / travel, poses
    )
    return np.sqrt(np.mean(errors**2))


def test_the_table_of_the_page_is_that_of_the_virtual_robot():
    assert (ROOT / "examples/eight_lines.csv").read_text() == virtual_crane.table()


def drawn_and_measured(folder):
    """The files of the drawn model and of the samples, as the command line makes them."""
    assert new(folder / "drawn.yaml", f"--drive={DRIVE}") == 0
    columns = ROOT / "config/columns/eight_lines.yaml"
    table, samples = ROOT / "examples/eight_lines.csv", folder / "samples.json"
    assert run("import-csv", table, "--columns", columns, "-o", samples) == 0
    return folder / "drawn.yaml", samples


def check_build_up(better):
    found = better.table.index_of("spool_buildup.Q")
    sigma = better.covariance[found, found] ** 0.5
    assert abs(better.values[found] - virtual_crane.BUILDUP) < 3 * sigma


@pytest.mark.wide
def test_a_platform_on_eight_lines_goes_from_its_table_to_a_better_model(tmp_path, capsys):
    file, samples = drawn_and_measured(tmp_path)
    drawn = read_model(file)
    data = load_dataset(samples, mechanism=drawn.mechanism)
    better = fitted(drawn, data, effects=["spool_buildup"]).model
    assert error(drawn, 40) > 2.5e-3
    assert error(better, 40) < 0.25e-3
    check_build_up(better)


@pytest.mark.wide
def test_the_commands_lead_from_its_table_to_a_better_model(tmp_path, capsys):
    file, samples = drawn_and_measured(tmp_path)
    assert run("fit", file, samples, "-o", tmp_path / "plain.yaml") == 0
    words = ("add", tmp_path / "plain.yaml", "spool_buildup", samples)
    assert run(*words, "-o", tmp_path / "better.yaml") == 0
    better = read_model(tmp_path / "better.yaml")
    assert error(better) < 0.25e-3
    check_build_up(better)


@pytest.mark.wide
def test_exchanged_columns_of_eight_lines_are_named(tmp_path, capsys):
    """Drums that are wrong by up to 3 % make lengths contradict each other: many quick solutions
    of the direct problem do not converge."""
    assert new(tmp_path / "drawn.yaml", f"--drive={DRIVE}") == 0
    text = (ROOT / "config/columns/eight_lines.yaml").read_text()
    exchanged = text.replace("leg3", "leg_").replace("leg6", "leg3").replace("leg_", "leg6")
    (tmp_path / "columns.yaml").write_text(exchanged)
    lines = (ROOT / "examples/eight_lines.csv").read_text().splitlines()
    factors = np.ones(len(lines[0].split(",")))
    first = [name.startswith("W1") for name in lines[0].split(",")].index(True)
    factors[first : first + 8] += np.linspace(-0.03, 0.03, 8)
    rows = [
        ",".join(map(repr, (np.array(row.split(","), float) * factors).tolist()))
        for row in lines[1:]
    ]
    (tmp_path / "table.csv").write_text("\n".join([lines[0], *rows]) + "\n")
    samples = tmp_path / "samples.json"
    words = ("import-csv", tmp_path / "table.csv", "--columns", tmp_path / "columns.yaml")
    assert run(*words, "-o", samples) == 0
    assert run("fit", tmp_path / "drawn.yaml", samples, "-o", tmp_path / "plain.yaml") == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "leg3, leg6 are in the columns of leg6, leg3" in said


def test_an_unknown_option_names_those_that_exist():
    with pytest.raises(ModelError, match="there is no option 'platform'; its options: anchors"):
        load_mechanism("cable", platform=virtual_crane.CORNERS)


def test_a_drive_for_joints_that_are_angles_is_refused(tmp_path, capsys):
    assert run("new", "delta24", "--drive", DRIVE, "-o", tmp_path / "delta.yaml") == 1
    assert "the readings of this joint are angles (rad)" in capsys.readouterr().err
    assert not (tmp_path / "delta.yaml").exists()


@pytest.mark.wide
def test_a_model_of_another_machine_is_told_apart_from_one_that_needs_no_change(
    tmp_path, capsys, monkeypatch
):
    """The motors turn the other way: a point on eight lines cannot move so. What its samples may
    mean is asked before the fit and after it, and judged once."""
    judged, judge = [], column_doubts._judge_guesses

    def judge_counted(*given):
        judged.append(given)
        return judge(*given)

    monkeypatch.setattr(column_doubts, "_judge_guesses", judge_counted)
    points = virtual_crane.ANCHORS.round(3).tolist()
    options = [f"--option=anchors={points}", "--option=radius=0.05", "--option=gear=10"]
    assert run("new", "cable", *options, "-o", tmp_path / "point.yaml") == 0
    columns = (ROOT / "config/columns/eight_lines.yaml").read_text().replace("leg", "motor")
    columns = columns.replace("unit: rev", "unit: rev, factor: -1")
    (tmp_path / "columns.yaml").write_text(columns)
    table, samples = ROOT / "examples/eight_lines.csv", tmp_path / "samples.json"
    assert run("import-csv", table, "--columns", tmp_path / "columns.yaml", "-o", samples) == 0
    capsys.readouterr()
    assert run("fit", tmp_path / "point.yaml", samples, "-o", tmp_path / "fit.yaml") == 1
    words = capsys.readouterr().err
    [share] = re.findall(r"(\d+) % of their measured motion \(1002 mm rms\)", words)
    assert int(share) > 50  # in a fit to what no such robot can do, the number says no more
    assert "the drive (spool, screw or belt) of each joint" in words
    assert len(judged) == 1


def test_no_path_of_poses_is_sought_to_readings_that_contradict_each_other(monkeypatch):
    """It ends with the readings of a pose, and these do not contradict each other."""
    anchors = virtual_crane.ANCHORS.round(3).tolist()
    model = new_model(load_mechanism("cable", anchors=anchors, radius=0.05))
    robot = Kinematics(model)
    there = robot.inverse(model.mechanism.sample(6, np.random.default_rng(0)))
    sought, follow = [], home_branch.follow_from_home

    def follow_counted(problem, *given, **options):
        sought.append(problem.name)
        return follow(problem, *given, **options)

    monkeypatch.setattr(home_branch, "follow_from_home", follow_counted)
    found = robot.direct(-there.joints)
    assert sought == ["direct"]
    assert (found.residual > 5e-3).all()
    assert not found.ok.any()
