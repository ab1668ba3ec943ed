"""The command line: its documents, its exit codes, and that nothing else reaches stdout."""

import contextlib
import csv
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import chains
import numpy as np
import pytest
from typer import Typer

from parallel_cal import __version__
from parallel_cal.base.options import option
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.cli import main as cli
from parallel_cal.cli.arguments import with_options
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import (
    model_hash,
    read_model,
    replace_model,
    write_model,
)
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_class, options_of
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.reporting import console

ROOT = Path(__file__).parents[2]
IDENTIFIED = str(ROOT / "config" / "delta_mockup_identified.yaml")
NOMINAL = str(ROOT / "config" / "delta_mockup_nominal.yaml")
DELTA24 = str(ROOT / "config" / "delta24_mockup_identified.yaml")
BAG = str(ROOT / "bags" / "delta_clean")
KINDS = ("position", "orientation", "joint", "reading", "pixel")
E = {f"{k}_{m}" for k in KINDS for m in ("mean", "rms")} | {"closure_rms"}


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Both recordings as saved samples, which load sooner than bags."""
    folder = tmp_path_factory.mktemp("samples")
    for name in ("delta_clean", "delta_backlash"):
        load_dataset(ROOT / "bags" / name).to_json(folder / f"{name}.json")
    return folder


@pytest.fixture
def clean(samples):
    return str(samples / "delta_clean.json")


@pytest.fixture
def backlash(samples):
    return str(samples / "delta_backlash.json")


@pytest.fixture
def run(capsys):
    """run(*arguments) -> (exit code, stdout, stderr)."""

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            cli.main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return ended.value.code, out, err

    return call


@pytest.fixture
def document(run):
    """document(*arguments): the one JSON document of a command that succeeds."""

    def call(*arguments):
        code, out, err = run(*arguments, "--json")
        assert code == 0, err
        assert out.count("\n") == 1
        assert "NaN" not in out
        return json.loads(out)

    return call


def fails(result, *words, code=1):
    """A failure says one line on stderr, nothing on stdout."""
    assert result[0] == code, result
    assert result[1] == ""
    if code == 1:
        assert result[2].count("\n") == 1
        assert result[2].startswith("error: ")
    for word in words:
        assert word in result[2]


def child(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "parallel_cal.cli", *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


# ------------------------------------------------------------------- starting up


# What costs a tenth of a second or more to import; `parallel-cal bench startup` times it.
HEAVY = {"scipy", "rclpy", "rosbags", "plotly", "ruamel"}


def started(command, **environment):
    """Its output, and the names of the packages that it loaded: start-up without a clock."""
    code = (
        "import atexit, sys; from parallel_cal.cli.main import main;"
        "atexit.register(lambda: print(*{m.split('.')[0] for m in sys.modules}, file=sys.stderr));"
        f"sys.argv[1:] = [{command!r}]; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(done.stderr.split())
    assert "parallel_cal" in loaded
    return done.stdout, loaded


def test_help_imports_nothing_heavy():
    assert not (HEAVY | {"numpy", "casadi", "pydantic", "rich"}) & started("--help")[1]


def test_what_is_on_a_shelf_is_built_for_its_first_listing_only(tmp_path):
    first, loaded = started("mechanisms", XDG_CACHE_HOME=str(tmp_path))
    assert "casadi" in loaded
    assert not HEAVY & loaded
    again, loaded = started("mechanisms", XDG_CACHE_HOME=str(tmp_path))
    assert again == first
    assert not (HEAVY | {"numpy", "casadi"}) & loaded


def test_help_names_the_commands_that_exist_and_no_other():
    commands = child("--help").stdout.split("Commands:")[1].split("Other names:")[0]
    listed = re.findall(r"^  ([\w-]+) ", commands, flags=re.M)
    assert listed == [
        "new",
        "mechanisms",
        "effects",
        "sensors",
        "direct",
        "inverse",
        "info",
        "import",
        "import-csv",
        "simulate",
        "replay",
        "record-topics",
        "fit",
        "compare",
        "add",
        "remove",
        "diagnose",
        "discover",
        "report",
        "export",
        "export-residuals",
        "short-cut",
        "plan",
        "calibrate",
        "workbench",
        "fleet",
        "watch",
        "drift",
        "demo",
        "bench",
        "board",
        "session",
        "study",
    ]


@pytest.mark.parametrize("columns", [80, 100])
@pytest.mark.parametrize("group", ["", "session", "study", "board"])
def test_no_summary_in_a_list_of_commands_is_cut(run, monkeypatch, group, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    code, shown, _ = run(*filter(None, [group]), "--help")
    assert code == 0
    listed = shown.split("Commands:\n")[1].split("\n\n")[0].splitlines()
    assert len(listed) >= {"": 30, "session": 15, "study": 2, "board": 1}[group]
    for line in listed:
        summary = line.strip().partition("  ")[2]  # empty if a summary continues on this line
        assert summary.endswith("."), line
        assert not summary.endswith(".."), line
        assert len(line) <= columns


def test_version_is_that_of_the_package(run):
    assert run("--version")[1] == f"parallel-cal {__version__}\n"
    assert f"version = {__version__}\n" in (ROOT / "setup.cfg").read_text()


@dataclass
class Knobs:
    size: "float" = field(default=2.0, metadata=option("size of it (m)", min=0))
    names: "Sequence[str]" = field(default=("a",), metadata=option("its names"))
    quick: "bool | Sequence[str] | None" = field(default=None, metadata=option("be quick"))
    hidden: "int" = 3


def run_with_knobs(capsys, kind, *arguments):
    received = []

    def command(place: str, *, options: kind, last: bool = False) -> None:
        received.append(options)

    app = Typer(rich_markup_mode=None, add_completion=False)
    app.command()(with_options(command))
    with pytest.raises(SystemExit):
        app(args=["here", *arguments])
    return (received or [None])[0], capsys.readouterr()


def test_the_fields_of_a_dataclass_are_options_of_a_command(capsys):
    assert run_with_knobs(capsys, Knobs)[0] == Knobs()
    given = ("--size", "3", "--names", "b c", "--names", "d,e", "--quick")
    expected = Knobs(3.0, ("b", "c", "d", "e"), True)
    assert run_with_knobs(capsys, Knobs, *given)[0] == expected
    _, printed = run_with_knobs(capsys, Knobs, "--help")
    options = re.findall(r"--[\w-]+", printed.out)
    assert options == ["--size", "--names", "--quick", "--last", "--no-last", "--help"]
    assert re.search(r"size of it \(m\) +\[default: 2.0;\s+x>=0\]", printed.out)
    received, printed = run_with_knobs(capsys, Knobs, "--size=-1")
    assert received is None
    assert "Invalid value for '--size'" in printed.err


def test_a_command_may_offer_some_fields_in_another_order(capsys):
    some = Annotated[Knobs, ("quick", "size")]
    assert run_with_knobs(capsys, some, "--quick")[0] == Knobs(quick=True)
    _, printed = run_with_knobs(capsys, some, "--help")
    assert re.findall(r"--[\w-]+", printed.out)[:3] == ["--quick", "--size", "--last"]


def test_wrong_usage_exits_with_2(run):
    for arguments in (["nonsense"], ["direct"], ["fit", NOMINAL, BAG, "--hold-out", "2"]):
        fails(run(*arguments), "Usage", code=2)


def test_a_child_process_prints_the_error_in_one_line_and_exits_with_1():
    done = child("direct", "no.yaml", "--joints", "1", "2", "3")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: no.yaml: cannot be read: No such file or directory\n"


# ------------------------------------------------------------------- models


def test_new_writes_a_nominal_model_file(document, run, tmp_path):
    path = tmp_path / "m.yaml"
    made = document("new", "delta24", "-o", path)
    model = read_model(path)
    assert (model.values == new_model("delta24").values).all()
    assert made["hash"] == model_hash(model)
    fails(run("new", "delta24", "-o", path), "exists already")
    fails(run("new", "delta99", "-o", tmp_path / "x.yaml"), "no mechanism 'delta99'")
    fails(run("new", "serial", "-o", tmp_path / "x.yaml"), "serial", "links")


def test_new_takes_options_of_a_mechanism(document, tmp_path):
    links = "[{joint: R, axes: parallel, a: 0.3}, {joint: R, a: 0.2}, {axes: frame}]"
    document("new", "serial", "--option", f"links={links}", "-o", tmp_path / "m.yaml")
    assert len(read_model(tmp_path / "m.yaml").joints) == 2


def test_the_options_of_a_mechanism_are_listed(run):
    listed = run("mechanisms", "cable")[1]
    assert "Options: without any" in listed
    assert "\n- `anchors` (n, 3): positions of the anchors, m.\n" in listed
    assert (
        "If the same coordinate is 0 for all anchors and for `home`, the robot is planar" in listed
    )
    assert "Options" not in run("mechanisms", "scara16")[1]
    assert "\njoints: motor1 [rad], motor2 [rad], motor3 [rad], motor4 [rad]\n" in listed


@pytest.mark.parametrize("name", ["palletizer", "deltesian"])
def test_options_in_m_are_listed_too(run, name):
    """`Options, in m: ...` were left out of the list."""
    _, listed, _ = run("mechanisms", name)
    for one in options_of(load_class("mechanisms", name, Mechanism)):
        assert f"`{one.partition('=')[0]}`" in listed


def test_a_mechanism_that_needs_an_option_is_described_without_it(run):
    code, listed, _ = run("mechanisms", "serial")
    assert code == 0
    assert "Options: `links` is needed." in listed
    assert listed.endswith("pass --option links=...\n")


def test_mechanisms_and_effects_are_listed_with_what_they_need(document, run):
    listed = {m["name"]: m for m in document("mechanisms")["mechanisms"]}
    assert listed["delta54"]["parameters"] == 54
    assert listed["delta24"]["moves"] == ["x", "y", "z"]
    named = {e["name"]: e for e in document("effects")["effects"]}
    assert named["backlash"]["needs"] == ["direction"]
    assert "delta54" in run("mechanisms")[1]
    assert "backlash" in run("effects")[1]


# ------------------------------------------------------------------- direct and inverse


def test_direct_prints_the_promised_document(document):
    found = document("direct", IDENTIFIED, "--joints", "0.5", "0.5", "0.6")
    (solution,) = found["solutions"]
    assert set(found) == {"solutions"}
    assert set(solution) == {"position", "quaternion", "joints", "residual", "status"}
    expected = Kinematics(read_model(IDENTIFIED)).direct(np.array([0.5, 0.5, 0.6]))
    assert solution["position"] == pytest.approx(expected.position, abs=1e-12)
    assert solution["quaternion"] == pytest.approx(expected.quaternion, abs=1e-12)
    assert solution["joints"] == [0.5, 0.5, 0.6]
    assert solution["residual"] < 1e-12
    assert solution["status"] == "converged"


def test_inverse_undoes_direct(document):
    pose = document("direct", IDENTIFIED, "--joints", "-0.1", "0.5", "6e-1")["solutions"][0]
    position, quaternion = pose["position"], pose["quaternion"]
    back = document("inverse", IDENTIFIED, "--position", *position)["solutions"][0]
    assert back["joints"] == pytest.approx([-0.1, 0.5, 0.6], abs=1e-9)
    turned = document("inverse", IDENTIFIED, "--position", *position, "--orientation", *quaternion)[
        "solutions"
    ][0]
    assert turned["joints"] == pytest.approx(back["joints"], abs=1e-9)


def test_fk_and_ik_are_other_names_of_direct_and_inverse(document):
    joints, position = ("--joints", "-0.1", "0.5", "6e-1"), ("--position", "-0.01", "0", "0.2")
    assert document("fk", IDENTIFIED, *joints) == document("direct", IDENTIFIED, *joints)
    assert document("ik", IDENTIFIED, *position) == document("inverse", IDENTIFIED, *position)


def test_an_orientation_that_follows_from_the_position_does_not_choose_the_branch(run, document):
    flipped = ("inverse", IDENTIFIED, "--position", 0.03, 0.02, 0.17, "--orientation", 0, 0, 1, 0)
    expected = document(*flipped[:6])
    for solver in ("newton", "fixed_newton"):
        turned, plain = (document(*c, "--solver", solver) for c in (flipped, flipped[:6]))
        assert turned["solutions"][0].pop("orientation_difference") == pytest.approx(np.pi, abs=0.1)
        assert turned == plain
        assert turned["solutions"][0]["joints"] == pytest.approx(expected["solutions"][0]["joints"])
    assert "delta54 does not control its orientation" in run(*flipped, "--json")[2]


def test_an_orientation_that_the_robot_has_is_no_reason_for_a_warning(run, document):
    pose = document("direct", DELTA24, "--joints", -0.1, 0.1, 0.2)["solutions"][0]
    asked = ("inverse", DELTA24, "--position", *pose["position"], "--orientation", 0, 0, 0, 1)
    code, out, err = run(*asked, "--json")
    (found,) = json.loads(out)["solutions"]
    assert (code, err) == (0, "")
    assert found["orientation_difference"] == 0.0
    assert found["position_difference"] < 1e-12


def test_what_is_assumed_for_a_pose_that_was_given_in_part_is_said(run, tmp_path):
    """The answer for the position of an ankle has the orientation of home, which must be said."""
    robot = tmp_path / "ankle.yaml"
    write_model(new_model("ankle_2rsu"), robot)
    code, _, err = run("inverse", robot, "--position", 0.05, 0.05, 0.1)
    assert code == 0
    missed, assumed = err.strip().splitlines()
    assert missed.startswith("warning: ankle_2rsu does not control its position: the solution is ")
    assert assumed == "warning: no --orientation was given, so that of home was taken"
    assert run("inverse", robot, "--orientation", 0.1, 0, 0, 1)[2] == ""
    stewart = tmp_path / "stewart.yaml"
    write_model(new_model("stewart42"), stewart)
    err = run("inverse", stewart, "--orientation", 0, 0, 0, 1)[2]
    assert err.strip() == "warning: no --position was given, so that of home was taken"


def test_a_height_that_a_plane_robot_does_not_have_is_said_with_its_size(run, tmp_path):
    robot, table = tmp_path / "plane.yaml", tmp_path / "poses.csv"
    write_model(new_model("five_bar"), robot)
    x, y, _ = new_model("five_bar").mechanism.home.position
    expected = "five_bar does not control z: "
    code, out, err = run("inverse", robot, "--position", x, y, 0.005, "--json")
    assert json.loads(out)["solutions"][0]["position_difference"] == pytest.approx(0.005, abs=1e-9)
    assert f"{expected}the solution is 5 mm from the given position" in err
    table.write_text(f"x,y,z\n{x},{y},0\n{x},{y},0.002\n{x},{y},-0.003\n")
    code, out, err = run("inverse", robot, "--input", table, "--json")
    sizes = [row["position_difference"] for row in json.loads(out)["solutions"]]
    assert (code, sizes) == (0, pytest.approx([0, 0.002, 0.003], abs=1e-9))
    assert f"{expected}in 2 of 3 rows, most in row 3: the solution is 3 mm from" in err
    run("inverse", robot, "--input", table, "--output", tmp_path / "joints.csv")
    written = [float(row["position_difference"]) for row in rows(tmp_path / "joints.csv")]
    assert written == pytest.approx(sizes, abs=1e-12)


def test_a_table_tells_in_which_rows_another_reading_has_the_controlled_coordinate(run, tmp_path):
    """The foot of an ankle has each x at two pitches. A robot that controls all has no column."""
    robot, table = tmp_path / "foot.yaml", tmp_path / "poses.csv"
    target = [0.14, 0.0, -0.035]
    write_model(
        chains.make_chain(chains.ankle() | {"target": target, "controls": ["x", "y"]}), robot
    )
    pitches = np.array([0.1, -0.4])  # before and beyond the maximum of x at -0.245 rad
    poses = [rotation_matrix(np.array([0.0, pitch, 0.0])) @ target for pitch in pitches]
    text = "\n".join(",".join(map(repr, pose.tolist())) for pose in poses)
    table.write_text(f"x,y,z\n{text}\n")
    run("inverse", robot, "--input", table, "--output", tmp_path / "joints.csv")
    near, mirrored = (float(row["position_difference"]) for row in rows(tmp_path / "joints.csv"))
    assert near < 1e-9
    assert mirrored > 0.01
    assert "orientation_difference" not in rows(tmp_path / "joints.csv")[0]
    whole = tmp_path / "whole.csv"
    whole.write_text("x,y,z,qx,qy,qz,qw\n0,0,0.3,0,0,0,1\n")
    write_model(new_model("stewart42"), robot)
    assert (
        run("inverse", robot, "--input", whole)[1].splitlines()[0].endswith("leg6,residual,status")
    )


def test_numbers_may_be_negative_in_exponents_and_with_commas_and_options_may_come_first(document):
    expected = document("direct", DELTA24, "--joints", "-0.1", "-1e-1", "0.2")
    assert document("direct", "--joints", "-0.1", "-1e-1", "0.2", DELTA24) == expected
    assert document("direct", DELTA24, "--joints=-0.1,-0.1,0.2") == expected
    assert document("direct", DELTA24, "--joints", "-0.1,-1e-1,0.2") == expected


def test_all_solutions_begin_with_the_home_branch(document):
    one = document("direct", DELTA24, "--joints", "0.5", "0.5", "0.6")["solutions"]
    every = document("direct", DELTA24, "--joints", "0.5", "0.5", "0.6", "--all")["solutions"]
    assert len(every) == 2
    assert every[0]["position"] == pytest.approx(one[0]["position"])
    assert len(document("inverse", DELTA24, "--position", 0, 0, 0.2, "--all")["solutions"]) == 8


def test_the_closed_form_agrees_with_newton_and_refuses_where_it_is_not_exact(document, run):
    for command in (
        ["direct", DELTA24, "--joints", "0.5", "0.5", "0.6"],
        ["inverse", DELTA24, "--position", "0.01", "0", "0.2"],
    ):
        newton, closed = (document(*command, *more) for more in ([], ["--solver", "closed_form"]))
        assert closed["solutions"][0]["status"] == "converged"
        for key in ("position", "joints"):
            assert closed["solutions"][0][key] == pytest.approx(newton["solutions"][0][key])
    every = document(
        "inverse", DELTA24, "--position", 0, 0, 0.2, "--all", "--solver", "closed_form"
    )
    assert len(every["solutions"]) == 8
    refused = run("inverse", IDENTIFIED, "--position", 0, 0, 0.2, "--solver", "closed_form")
    fails(refused, "closed_form is not exact", "newton")


def test_an_unknown_solver_lists_those_that_exist(run):
    result = run("direct", DELTA24, "--joints", 1, 1, 1, "--solver", "magic")
    fails(result, "no solver 'magic'; there are cascaded, cascaded_circles, closed_form")


def test_help_on_solvers_says_what_each_is_for(run):
    code, said, _ = run("direct", "--solver", "help")
    assert code == 0
    assert re.search(r"newton +Prefer it: it serves every mechanism", said)
    assert re.search(r"cascaded +Kept as the thesis' own", said)


def test_a_problem_without_solution_has_a_status_and_exit_code_0(document, run):
    far = document("inverse", DELTA24, "--position", 0, 0, 2)["solutions"][0]
    assert far["status"] == "unreachable"
    nothing = document("direct", DELTA24, "--joints", "nan", 1, 1)["solutions"][0]
    assert nothing["status"] == "invalid_input"
    assert nothing["position"] == [None, None, None]
    code, out, _ = run("inverse", DELTA24, "--position", 0, 0, 2)
    assert code == 0
    assert "unreachable" in out


def test_joints_beyond_their_limits_are_reported(document):
    found = document("direct", DELTA24, "--joints", 2.5, 2.5, 2.5)["solutions"][0]
    assert found["status"] == "outside_limits"


def test_the_wrong_number_of_joints_is_a_clear_error(run):
    fails(run("direct", DELTA24, "--joints", 1, 2), "2 values given", "joint1, joint2, joint3")
    fails(run("inverse", DELTA24, "--position", 1, 2), "expected 3 numbers", code=2)
    fails(run("direct", DELTA24), "give either --joints or --input", code=2)
    fails(
        run("inverse", DELTA24, "--position", 0, 0, 0.2, "--orientation", 0, 0, 0, 0), "quaternion"
    )


def test_conditions_reach_the_effects_of_the_model(document, run, tmp_path):
    model = new_model("delta24", {"backlash.joint1.width": 0.001}, ["backlash"])
    write_model(model, tmp_path / "m.yaml")
    command = ["direct", tmp_path / "m.yaml", "--joints", 0.5, 0.5, 0.5]
    rest, up, down = (
        np.array(document(*command, *more)["solutions"][0]["position"])
        for more in ([], ["--at", "direction=1"], ["--at", "direction.joint1=-1", "temperature=30"])
    )
    assert np.linalg.norm(up - rest) > 1e-5
    assert up - rest == pytest.approx(rest - down, rel=0.01)
    assert "temperature" in run(*command, "--at", "temperature=30")[2]
    fails(run(*command, "--at", "weather=1"), "no condition 'weather'")
    fails(run(*command, "--at", "temperature=warm"), "expected NAME=NUMBER")


def test_people_read_millimetres_and_degrees_with_their_unit(run):
    _, out, _ = run("inverse", NOMINAL, "--position", 0, 0, 0.2)
    assert "[mm]" in out
    assert "[deg]" in out
    assert "200.0000" in out
    assert "30.65497" in out


# ------------------------------------------------------------------- tables


def rows(path):
    with path.open() as stream:
        return list(csv.DictReader(stream))


def test_a_table_of_joints_gives_a_table_of_poses_and_bad_rows_a_status(document, tmp_path):
    (tmp_path / "q.csv").write_text(
        "joint1, joint2,joint3\n0.5,0.5,0.6\nx,1,1\n1,1\n,,\n0.5,0.5,inf\n-0.1,0.2,0.3\n"
    )
    summary = document(
        "direct", IDENTIFIED, "--input", tmp_path / "q.csv", "--output", tmp_path / "p.csv"
    )
    assert summary["rows"] == 6
    assert summary["statuses"] == {"invalid_input": 4, "converged": 2}
    answers = rows(tmp_path / "p.csv")
    assert [r["status"] for r in answers] == ["converged"] + ["invalid_input"] * 4 + ["converged"]
    assert answers[1]["joint1"] == "x"
    assert answers[1]["x"] == ""
    expected = Kinematics(read_model(IDENTIFIED)).direct(np.array([0.5, 0.5, 0.6]))
    assert float(answers[0]["z"]) == pytest.approx(expected.position[2], abs=1e-12)
    assert float(answers[0]["residual"]) < 1e-12
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.csv", "q.csv"]


def test_a_table_of_poses_gives_a_table_of_joints_with_every_solver(document, tmp_path):
    (tmp_path / "p.csv").write_text(
        "z,y,x,qx,qy,qz,qw\n0.2,0,0,0,0,0,1\n2,0,0,0,0,0,1\n.2,0,0,0,0,0,0\n"
    )
    for solver in ("newton", "closed_form"):
        found = document("inverse", DELTA24, "--input", tmp_path / "p.csv", "--solver", solver)
        statuses = [s["status"] for s in found["solutions"]]
        assert statuses == ["converged", "unreachable", "invalid_input"]
        assert found["solutions"][0]["position"] == [0, 0, 0.2]


POSES_OF_TABLES = {  # mechanism: the controlled coordinates of a pose, and the same pose in full
    "five_bar": ("x [mm],y\n10,0.2\n", "x,y,z\n0.01,0.2,0\n"),
    "five_bar with a turn": ("x,y,rz\n0.01,0.2,0\n", "x,y,z,qx,qy,qz,qw\n0.01,0.2,0,0,0,0,1\n"),
    "quattro": ("x,y,z,rz [deg]\n0.01,0.02,0,20\n", "x,y,z,qx,qy,qz,qw\n0.01,0.02,0,0,0,{},{}\n"),
    "ankle_2rsu": ("rx,ry\n0.2,0\n", "qx,qy,qz,qw\n{},0,0,{}\n"),
}


@pytest.mark.parametrize("name", POSES_OF_TABLES)
def test_a_table_of_poses_needs_the_controlled_coordinates_only(name, run, document, tmp_path):
    model = new_model(name.split()[0])
    write_model(model, tmp_path / "m.yaml")
    half = np.radians(10) if name == "quattro" else 0.1
    short, full = POSES_OF_TABLES[name]
    full = full.format(np.sin(half), np.cos(half))
    height = model.mechanism.home.position[2]
    for file, text in (("short.csv", short), ("full.csv", full)):
        (tmp_path / file).write_text(text.replace(",0.02,0,", f",0.02,{height},"))
    one, other = (
        document("inverse", tmp_path / "m.yaml", "--input", tmp_path / file)["solutions"][0]
        for file in ("short.csv", "full.csv")
    )
    assert one["status"] == other["status"] == "converged"
    assert one["joints"] == pytest.approx(other["joints"], abs=1e-12)
    code, _, err = run("inverse", tmp_path / "m.yaml", "--input", tmp_path / "short.csv")
    assert (code, "does not control" in err) == (0, False)


def test_a_coordinate_that_follows_is_compared_where_the_table_has_it_only(document, tmp_path):
    """x, y and rz of a plate on three cranks follow; x was asked, off by 1 mm."""
    model = new_model("plate_rrs")
    write_model(model, tmp_path / "m.yaml")
    z = model.mechanism.home.position[2]
    (tmp_path / "p.csv").write_text(f"z,rx,ry\n{z},0.1,0.05\n")
    (here,) = document("inverse", tmp_path / "m.yaml", "--input", tmp_path / "p.csv")["solutions"]
    assert here["position_difference"] < 1e-9
    assert here["orientation_difference"] < 1e-9
    (tmp_path / "p.csv").write_text(f"z,x,rx,ry\n{z},{here['position'][0] + 1e-3},0.1,0.05\n")
    (off,) = document("inverse", tmp_path / "m.yaml", "--input", tmp_path / "p.csv")["solutions"]
    assert off["position_difference"] == pytest.approx(1e-3, abs=1e-9)
    assert off["joints"] == pytest.approx(here["joints"], abs=1e-12)


def test_a_controlled_coordinate_without_a_column_is_an_error(run, tmp_path):
    write_model(new_model("five_bar"), tmp_path / "m.yaml")
    (tmp_path / "p.csv").write_text("x,z\n0,0\n")
    result = run("inverse", tmp_path / "m.yaml", "--input", tmp_path / "p.csv")
    fails(result, "header 'x,z' (missing: y); expected the columns x,y (and may have z)")


def test_names_of_coordinates_may_be_in_capitals_as_of_a_recording(document, tmp_path):
    """`X,Y` was refused."""
    found = []
    for header in ("x,y,z,qx,qy,qz,qw", "X [mm],Y [mm],Z [mm],QX,QY,QZ,QW"):
        length = 1e3 if "mm" in header else 1.0
        row = f"{0.01 * length},{0.02 * length},{0.25 * length},0,0,0,1"
        (tmp_path / "p.csv").write_text(f"{header}\n{row}\n")
        found += document("inverse", DELTA24, "--input", tmp_path / "p.csv")["solutions"]
    plain, capitals = found
    assert capitals["joints"] == pytest.approx(plain["joints"], abs=1e-12)


def test_a_table_may_carry_conditions(document, tmp_path):
    write_model(
        new_model("delta24", {"backlash.joint1.width": 0.001}, ["backlash"]), tmp_path / "m.yaml"
    )
    (tmp_path / "q.csv").write_text(
        "joint1,joint2,joint3,direction.joint1\n.5,.5,.5,1\n.5,.5,.5,-1\n"
    )
    up, down = document("direct", tmp_path / "m.yaml", "--input", tmp_path / "q.csv")["solutions"]
    assert up["position"] != down["position"]


def test_conditions_that_a_model_does_not_depend_on_may_stand_in_a_table(document, tmp_path):
    rows = "0.5,0.6,0.7", "0.4,0.5,0.6"
    (tmp_path / "bare.csv").write_text("joint1,joint2,joint3\n" + "\n".join(rows) + "\n")
    more = "\n".join(f"{row},1,20" for row in rows)
    header = "joint1,joint2,joint3,direction.joint1,temperature"
    (tmp_path / "more.csv").write_text(f"{header}\n{more}\n")
    bare, full = (
        document("direct", DELTA24, "--input", tmp_path / name)["solutions"]
        for name in ("bare.csv", "more.csv")
    )
    assert [one["position"] for one in full] == [one["position"] for one in bare]


def test_a_table_may_state_its_units_in_the_header(run, document, tmp_path):
    model = new_model("stewart42").with_effect("thermal_expansion")
    write_model(model, tmp_path / "m.yaml")
    tables = {
        "q.csv": ",".join([*model.joints, "temperature"]) + "\n" + "0.01," * 6 + "25\n",
        "mm.csv": ",".join(f"{j} [mm]" for j in model.joints)
        + ",temperature [degF]\n"
        + "10," * 6
        + "77\n",
        "deg.csv": "leg1 [deg],leg2,leg3,leg4,leg5,leg6\n1,0,0,0,0,0\n",
        "p.csv": "x [mm],y_mm,z (mm),qx,qy,qz,qw\n10,0,300,0,0,0,1\n",
        "m.csv": "x,y,z,qx,qy,qz,qw\n0.01,0,0.3,0,0,0,1\n",
    }
    for name, text in tables.items():
        (tmp_path / name).write_text(text)

    def solutions(command, name):
        return document(command, tmp_path / "m.yaml", "--input", tmp_path / name)["solutions"]

    for command, name, other, key in (
        ("direct", "q.csv", "mm.csv", "position"),
        ("inverse", "m.csv", "p.csv", "joints"),
    ):
        expected, found = (solutions(command, one)[0] for one in (name, other))
        assert found["status"] == "converged"
        assert found[key] == pytest.approx(expected[key], abs=1e-12)
    result = run("direct", tmp_path / "m.yaml", "--input", tmp_path / "deg.csv")
    fails(result, "deg.csv:1: column leg1 [deg] is in deg, but leg1 is in m")
    code, out, _ = run("direct", tmp_path / "m.yaml", "--input", tmp_path / "mm.csv")
    assert code == 0
    assert out.startswith("leg1 [mm],leg2 [mm],")  # the given cells stay as they are


def test_the_columns_that_are_added_to_a_table_are_in_si_units_whatever_it_has(run, tmp_path):
    """A position_difference beside `z [mm]` is in m, and the help says so."""
    robot = tmp_path / "plane.yaml"
    write_model(new_model("five_bar"), robot)
    x, y, _ = (1e3 * v for v in new_model("five_bar").mechanism.home.position)
    (tmp_path / "p.csv").write_text(f"x [mm],y [mm],z [mm]\n{x},{y},2\n")
    run("inverse", robot, "--input", tmp_path / "p.csv", "--output", tmp_path / "q.csv")
    (row,) = rows(tmp_path / "q.csv")
    assert float(row["position_difference"]) == pytest.approx(2e-3, abs=1e-9)
    for command in ("direct", "inverse"):
        assert "in SI units (m, rad)" in " ".join(
            run(command, "--help")[1].replace("│", "").split()
        )


def test_without_output_the_table_goes_to_stdout(run, tmp_path):
    (tmp_path / "q.csv").write_text("joint1,joint2,joint3\n.5,.5,.5\n")
    code, out, err = run("direct", DELTA24, "--input", tmp_path / "q.csv")
    assert code == 0
    assert [line["status"] for line in csv.DictReader(out.splitlines())] == ["converged"]
    assert "1 converged" in err


def test_a_malformed_table_is_a_clear_error_and_writes_nothing(run, tmp_path):
    for text, word in (
        ("", "empty; expected a header"),
        ("a,b,c\n1,2,3\n", "header 'a,b,c' (missing: joint1,joint2,joint3; unknown: a,b,c); "),
        ("joint1,speed\n1,4\n", "(missing: joint2,joint3; unknown: speed); expected the columns"),
        ("joint1,joint2,joint2\n1,2,3\n", "(missing: joint3; repeated: joint2); expected the"),
        ("joint1,joint2,joint3,joint3\n1,2,3,3\n", "(repeated: joint3); expected the columns"),
    ):
        (tmp_path / "q.csv").write_text(text)
        result = run(
            "direct", DELTA24, "--input", tmp_path / "q.csv", "--output", tmp_path / "p.csv"
        )
        fails(result, "q.csv:1", word)
    (tmp_path / "q.csv").write_bytes(b"\xff\xfe\x00")
    fails(run("direct", DELTA24, "--input", tmp_path / "q.csv"), "it is not text")
    fails(run("direct", DELTA24, "--input", tmp_path / "no.csv"), "cannot be read")
    assert not (tmp_path / "p.csv").exists()


def test_columns_of_a_table_that_change_nothing_are_named(run, tmp_path):
    """They were ignored without a word; a direction needs the name of its joint."""
    q, pose = "joint1,joint2,joint3", "x,y,z"
    for command, header in (("direct", q), ("inverse", pose)):
        (tmp_path / "t.csv").write_text(f"{header},temperature,direction\n0,0,0.2,25,1\n")
        code, _, err = run(command, DELTA24, "--input", tmp_path / "t.csv")
        assert code == 0
        assert "warning: no effect of the model depends on temperature, direction\n" in err


def test_what_effects_depend_on_and_nobody_stated_is_named(run, tmp_path):
    """Without the temperature, a model with thermal growth was used as one without, unseen."""
    model = read_model(DELTA24).with_effect("backlash").with_effect("thermal_expansion")
    write_model(model, tmp_path / "m.yaml")
    head, row = "joint1,joint2,joint3,temperature", "0.1,0.2,0.3,25"
    (tmp_path / "t.csv").write_text(f"{head}\n{row}\n")
    given = ("direct", tmp_path / "m.yaml", "--input", tmp_path / "t.csv")
    *two, said = run(*given, "--at", "direction.joint1=1")
    assert two[0] == 0
    assert (
        "effects of the model depend on direction.joint2, direction.joint3, of which neither a "
        "column nor --at has values: these effects count as zero"
    ) in " ".join(said.split())
    directions = [f"direction.joint{k}=1" for k in (1, 2, 3)]
    assert "depend on" not in run(*given, "--at", *directions)[2]


def test_no_output_takes_the_place_of_what_the_command_reads(run, tmp_path):
    """A recording became a model, and a table or its column map became samples."""
    copy = {}
    for name, text in (
        ("t.csv", "q1,q2,q3,x,y,z\n" + "0.1,0.2,0.3,0,0,0.2\n" * 3),
        ("map.yaml", "joints: {joint1: q1, joint2: q2, joint3: q3}\nposition: [x, y, z]\n"),
        ("q.csv", "joint1,joint2,joint3\n.5,.5,.5\n"),
        ("m.yaml", Path(DELTA24).read_text()),
    ):
        copy[tmp_path / name] = text
        (tmp_path / name).write_text(text)
    table, columns, q, model = copy
    (tmp_path / "link.csv").symlink_to(table)
    for words in (
        ("import-csv", table, "--columns", columns, "-o", tmp_path / "link.csv"),
        ("import-csv", table, "--columns", columns, "-o", columns),
        ("direct", model, "--input", q, "--output", q),
        ("direct", model, "--input", q, "--output", model),
        ("fit", model, q, "-o", q),
    ):
        fails(run(*words), str(words[-1]), "this command reads this file", "give another name")
    assert all(file.read_text() == text for file, text in copy.items())


def test_a_table_of_measurements_is_solved_without_changes(run, document, tmp_path):
    """`direct` and `inverse` refused the table that `fit` takes: names, units, measured poses."""
    table, solved = tmp_path / "t.csv", tmp_path / "s.csv"
    head = "point,q_1 [deg],q_2 [deg],q_3 [deg],x_mm,y_mm,z_mm,note"
    table.write_text(f"{head}\nA,10,20,30,0,0,200,first\nB,30,abc,10,0,10,200,second\n")
    code, _, err = run("direct", DELTA24, "--input", table, "--output", solved)
    assert code == 0
    said = (
        "joints were matched by their numbers: q_1 for joint1, q_2 for joint2, q_3 for joint3. If",
        "columns that are not read: point, x_mm, y_mm, z_mm, note\n",
        "t.csv:3: column q_2 [deg] contains 'abc', expected a finite number: enter one or",
    )
    assert all(f"warning: {words}" in err or words in err for words in said)
    first, second = rows(solved)
    given = dict(zip(head.split(","), "A,10,20,30,0,0,200,first".split(","), strict=True))
    assert given.items() <= first.items()  # nothing of the table is lost, or hidden by an answer
    joints = ["--joints", " ".join(str(v) for v in np.radians([10, 20, 30]))]
    (alone,) = document("direct", DELTA24, *joints)["solutions"]
    assert [float(first[f"solved.{axis}"]) for axis in "xyz"] == pytest.approx(alone["position"])
    assert second["status"] == "invalid_input"
    # What one of them writes, the other reads.
    code, _, err = run("inverse", DELTA24, "--input", solved, "--output", tmp_path / "back.csv")
    assert code == 0
    assert {"joint1", "solved.status"} <= rows(tmp_path / "back.csv")[0].keys()
    # What it wrote itself is solved again, and each column has a name of its own.
    code, again, _ = run("direct", DELTA24, "--input", solved)
    assert code == 0
    columns = again.splitlines()[0].split(",")
    assert "solved.solved.x" in columns
    assert len(columns) == len({*columns})


def test_a_misspelt_condition_is_named_with_the_one_that_it_may_be(run, tmp_path):
    robot = tmp_path / "m.yaml"
    write_model(new_model("delta24").with_effect("thermal_expansion"), robot)
    (tmp_path / "t.csv").write_text("joint1,joint2,joint3,temprature\n.5,.5,.5,30\n")
    result = run("direct", robot, "--input", tmp_path / "t.csv", "--at", "temperature=20")
    assert "columns that are not read: temprature; did you mean 'temperature'?" in result[2]


@pytest.mark.parametrize("rows", ["", "\n , ,\n"])
def test_a_table_without_rows_is_an_error_of_every_command(run, tmp_path, rows):
    """`direct` and `inverse` answered with an empty table, and exit 0."""
    file = tmp_path / "t.csv"
    for command in ("direct", "inverse"):
        header = "joint1,joint2,joint3" if command == "direct" else "x,y,z"
        file.write_text(f"{header}\n{rows}")
        result = run(command, DELTA24, "--input", file, "--output", tmp_path / "p.csv")
        fails(result, f"t.csv: no rows below the header '{header}'; expected a header line")
        assert not (tmp_path / "p.csv").exists()
    file.write_text(f"joint1 [rad],joint2 [rad],joint3 [rad],x [m],y [m],z [m]\n{rows}")
    for command in ("info", "compare", "fit", "diagnose"):
        fails(run(command, *([] if command == "info" else [DELTA24]), file), "t.csv: no rows below")


def test_an_output_that_cannot_be_written_is_a_clear_error(run, tmp_path):
    (tmp_path / "q.csv").write_text("joint1,joint2,joint3\n.5,.5,.5\n")
    result = run(
        "direct", DELTA24, "--input", tmp_path / "q.csv", "--output", tmp_path / "no" / "p.csv"
    )
    fails(result, f"error: {tmp_path / 'no' / 'p.csv'}: No such file or directory")


def test_an_option_that_would_do_nothing_is_wrong_usage(run, tmp_path):
    single = ("direct", DELTA24, "--joints", ".5", ".5", ".5")
    fails(run(*single, "--output", tmp_path / "p.csv"), "--output needs --input", code=2)
    fails(run("direct", DELTA24, "--input", tmp_path / "q.csv", "--all"), "--input", code=2)


# ------------------------------------------------------------------- calibration


def test_a_model_file_that_is_replaced_stays_beside_the_new_one(document, tmp_path):
    out, aside = tmp_path / "robot.yaml", tmp_path / "robot.yaml.previous"
    document("new", "stewart42", "-o", out)
    assert not aside.exists()
    before = out.read_bytes()
    document("fit", NOMINAL, BAG, "-o", out)
    assert aside.read_bytes() == before != out.read_bytes()


def test_fit_prints_the_promised_document_and_writes_the_model_with_its_history(document, tmp_path):
    out = tmp_path / "out.yaml"
    found = document("fit", NOMINAL, BAG, "-o", out)
    assert set(found) >= {
        "samples",
        "parameters",
        "before",
        "after",
        "held_out",
        "improvement",
        "chi2_per_dof",
        "rank",
        "unidentifiable",
    }
    assert set(found["before"]) == set(found["after"]) == E
    assert set(found["held_out"]) == {"before", "after"}
    assert set(found["improvement"]) == set(KINDS)
    assert found["samples"] == 94
    assert found["before"]["position_mean"] == pytest.approx(590e-6, rel=0.05)
    assert found["held_out"]["after"]["position_mean"] < 50e-6
    model = read_model(out)
    parameter = found["parameters"]["chain1.D_x"]
    assert set(parameter) >= {"value", "sigma", "nominal", "unit"}
    assert model.value("chain1.D_x") == parameter["value"]
    assert np.sqrt(model.covariance[0, 0]) == pytest.approx(parameter["sigma"])
    assert found["hash"] == model_hash(model)
    assert [step["step"] for step in model.history] == ["published", "fit"]
    step = model.history[-1]
    assert step["dataset"]["sha256"] == found["dataset"]["sha256"]
    assert step["held_out"]["after"] == found["held_out"]["after"]


def test_the_same_fit_gives_the_same_file(document, tmp_path, clean):
    hashes = {document("fit", NOMINAL, clean, "-o", tmp_path / f"{k}.yaml")["hash"] for k in "ab"}
    assert len(hashes) == 1


def test_a_fit_can_free_and_fix_parameters_by_pattern(document, clean):
    only = document("fit", NOMINAL, clean, "--fix", "*", "--free", "chain1.L*,chain2.Lb")
    free = [name for name, p in only["parameters"].items() if not p["fixed"]]
    assert free == ["chain1.La_x", "chain1.La_y", "chain1.Lb", "chain2.Lb"]


def test_answers_carry_the_uncertainty_of_the_fit_on_request(document, run, tmp_path, clean):
    fitted = tmp_path / "fitted.yaml"
    document("fit", NOMINAL, clean, "-o", fitted)
    pose = document("direct", fitted, "--joints", "0.5 0.5 0.5", "--covariance")["solutions"][0]
    assert 1e-6 < np.sqrt(pose["covariance"][0][0]) < 2e-5
    joints = document("inverse", fitted, "--position", "0 0 0.2", "--covariance")["solutions"][0]
    assert np.shape(joints["covariance"]) == (3, 3)
    fails(run("direct", NOMINAL, "--joints", "0.5 0.5 0.5", "--covariance"), "has no covariance")
    for command, table, single, sigmas in (
        ("direct", "joint1,joint2,joint3\n0.5,0.5,0.5\n", pose, ["x", "y", "z", "rx", "ry", "rz"]),
        ("inverse", "x,y,z\n0,0,0.2\n", joints, ["joint1", "joint2", "joint3"]),
    ):
        given, output = tmp_path / "given.csv", tmp_path / "answers.csv"
        given.write_text(table + "x,1,1\n")
        words = (command, fitted, "--input", given, "--covariance")
        solved, invalid = document(*words)["solutions"]
        np.testing.assert_allclose(solved["covariance"], single["covariance"], rtol=1e-6)
        assert {number for row in invalid["covariance"] for number in row} == {None}
        document(*words, "--output", output)
        first, second = rows(output)
        stated = [float(first[f"sigma.{name}"]) for name in sigmas]
        assert stated == pytest.approx(np.sqrt(np.diag(single["covariance"])), rel=1e-6)
        assert {second[f"sigma.{name}"] for name in sigmas} == {""}


def test_a_failed_fit_writes_nothing(run, tmp_path, clean):
    few = tmp_path / "few"
    assert run("simulate", NOMINAL, "--poses", 3, "-o", few)[0] == 0
    fails(run("fit", NOMINAL, few, "-o", tmp_path / "out.yaml"), "different poses")
    fails(run("fit", NOMINAL, clean, "-o", tmp_path / "out.yaml", "--method", "magic"), "no method")
    fails(run("fit", NOMINAL, tmp_path / "no", "-o", tmp_path / "out.yaml"), "no such file")
    fails(run("fit", NOMINAL, clean, "--free", "chain9.*"), "no parameter matches 'chain9.*'")
    assert not (tmp_path / "out.yaml").exists()


@pytest.mark.wide
def test_add_lowers_the_error_and_remove_is_refused_where_it_would_raise_it(
    document, run, tmp_path, backlash
):
    fitted, better, out = (tmp_path / f"{name}.yaml" for name in ("fitted", "better", "out"))
    first = document("fit", NOMINAL, backlash, "-o", fitted)
    found = document("add", fitted, "backlash", backlash, "-o", better)
    assert found["before"] == pytest.approx(first["after"])
    assert found["held_out"]["after"]["position_rms"] < first["held_out"]["after"]["position_rms"]
    model = read_model(better)
    assert [effect.name for effect in model.effects] == ["backlash"]
    assert model.history[-1]["effect"] == "backlash"
    assert model.value("backlash.joint1.width") == pytest.approx(3e-4, abs=1e-4)
    fails(run("remove", better, "backlash", backlash, "-o", out), "rises", "--force")
    assert not out.exists()
    document("remove", better, "backlash", backlash, "-o", out, "--force")
    assert read_model(out).effects == ()
    fails(run("add", better, "backlash", backlash), "already has the effect")
    fails(run("remove", fitted, "backlash", backlash), "has no effect 'backlash'")


def test_a_number_given_with_an_effect_is_kept_fixed(document, backlash):
    found = document("add", IDENTIFIED, "backlash:joint2.width=0.00025", backlash, "--force")
    widths = [found["parameters"][f"backlash.joint{j}.width"] for j in (1, 2, 3)]
    assert [w["fixed"] for w in widths] == [False, True, False]
    assert widths[1]["value"] == 0.00025
    assert widths[0]["sigma"] > 0


def test_add_is_refused_where_the_held_out_error_does_not_fall(document, run, tmp_path, clean):
    out = tmp_path / "out.yaml"
    fails(run("add", NOMINAL, "backlash", clean, "-o", out), "does not fall", "--force")
    assert not out.exists()


def test_a_refused_fit_names_priors_until_they_were_used(run, tmp_path, clean):
    """A model that is right already, and that states no fit of these samples."""
    right, said = tmp_path / "right.yaml", "drawing as priors (--prior). Use --force to write it"
    assert run("fit", NOMINAL, clean, "-o", right)[0] == 0
    replace_model(replace(read_model(right), history=()), right)
    command = ("fit", right, clean, "-o", tmp_path / "out.yaml")
    fails(run(*command), said)
    assert said not in run(*command, "--prior")[2]


def test_compare_prints_errors_and_rows_worst_first(document, run, clean):
    found = document("compare", IDENTIFIED, clean)
    assert set(found) >= E
    norms = [row["position_norm"] for row in found["rows"]]
    assert len(norms) == found["samples"] == 94
    assert norms == sorted(norms, reverse=True)
    assert "um" in run("compare", IDENTIFIED, clean)[1]


def test_people_see_the_fit_as_a_table_with_units(run, tmp_path, clean):
    code, out, _ = run("fit", NOMINAL, clean, "-o", tmp_path / "out.yaml")
    assert code == 0
    for word in ("position error, mean", "um", "arcmin", "held-out", "written:"):
        assert word in out
    assert max(map(len, out.splitlines()[1:15])) <= 80
    last = [line.split(":")[0] for line in out.splitlines()[-5:]]
    assert last == ["before", "after", "noise", "missing", "next"]
    assert out.splitlines()[-1].split() == [
        *("next:", "parallel-cal", "diagnose"),
        *(str(tmp_path / "out.yaml"), str(clean)),
    ]


@pytest.mark.wide
def test_parameters_and_figures_for_experts_are_shown_on_request(run, clean):
    short = run("fit", NOMINAL, clean)[1].splitlines()
    parameters = run("fit", NOMINAL, clean, "--parameters")[1].splitlines()
    details = run("fit", NOMINAL, clean, "--details")[1].splitlines()
    assert {*short} < {*parameters}
    assert sum(" mm" in line or " deg" in line for line in parameters) >= 42
    assert [line[:14] for line in details if line not in short] == [
        "94 samples of ",
        "after ISO 9283",
    ]


@pytest.mark.wide
def test_the_command_that_a_diagnosis_proposes_runs_as_it_is_shown(run, tmp_path):
    robot, better = tmp_path / "my robot.yaml", tmp_path / "better.yaml"
    bag = ROOT / "bags" / "delta_backlash"
    run("fit", NOMINAL, bag, "-o", robot)
    _, out, _ = run("diagnose", robot, bag, "--data", "max_samples=10000")
    last = shlex.split(out.splitlines()[-1])
    assert last[:4] == ["parallel-cal", "add", str(robot), "backlash"]
    assert last[4:] == [str(bag), "--data=max_samples=10000", "-o", "better.yaml"]
    assert run(*last[1:-1], better)[0] == 0
    assert read_model(better).effects[0].name == "backlash"


# ------------------------------------------------------------------- recordings and the rest


@pytest.mark.wide
def test_the_help_lists_the_other_names_of_commands(run):
    shown = run("--help")[1]
    assert "Other names: fk is direct, ik is inverse, look is info." in " ".join(shown.split())


def test_look_prints_what_a_recording_holds(document, run):
    assert document("look", BAG)["samples"] == 94
    assert document("look", BAG, "--data", "mode=continuous")["mode"] == "continuous"
    assert "94 samples" in run("look", BAG)[1].replace("\n", " ")
    fails(
        run("look", BAG, "--data", "min_dwell=abc"), "min_dwell is 'abc' (str); expected a number"
    )
    tolerances = "still_tolerance=1e-3,2e-3,1e-3"
    assert document("look", BAG, "--data", tolerances, "--data", "exclude=3")["samples"] == 93
    both = ("--data", "exclude=3", "--data", "exclude=7")
    assert document("look", BAG, *both)["samples"] == 92
    fails(run("look", BAG, "--data", "mood=good"), "expected KEY=VALUE", "measured_pose")
    fails(run("look", ROOT / "setup.cfg"), "not a recording")


def test_topics_can_be_named(run, document):
    assert document("look", BAG, "--data", "measured_pose=measured_pose")["samples"] == 94
    fails(run("look", BAG, "--data", "measured_pose=/tracker"), "/tracker", "In the bag")


def test_replay_without_ros_and_an_unknown_benchmark_are_clear_errors(run, monkeypatch):
    monkeypatch.setattr("parallel_cal.cli.recordings.find_spec", lambda name: None)
    fails(run("replay", BAG), "needs ROS 2")
    fails(run("bench", "nonsense"), "unknown benchmark nonsense; expected one of")


def test_all_benchmarks_run_each_table_once(run, monkeypatch):
    ran = []

    def ended(command, **_):
        ran.append(command[-1].rpartition(".")[2])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", ended)
    run("bench")
    assert {"speed", "direct"} <= {*ran}
    assert "peers" not in ran  # `speed` shows its tables
    run("bench", "peers")
    assert ran[-1] == "peers"


def test_ctrl_c_ends_without_a_traceback(run, monkeypatch):
    from parallel_cal.recordings import loading

    def pressed(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(loading, "load_dataset", pressed)
    code, out, err = run("fit", NOMINAL, BAG)
    assert code != 0
    assert out == ""
    assert "Traceback" not in err


def test_a_broken_model_file_is_named_with_its_line(run, tmp_path):
    text = Path(DELTA24).read_text().replace("0.075949", "75.949")
    (tmp_path / "m.yaml").write_text(text)
    result = run("direct", tmp_path / "m.yaml", "--joints", 1, 1, 1)
    fails(result, "m.yaml:", "chain1.D_x.value", "is it in mm?")


def test_renamed_joints_are_used_everywhere(document, tmp_path):
    model = read_model(DELTA24)
    model.mechanism.joints = ("a", "b", "c")
    write_model(replace(model), tmp_path / "m.yaml")
    (tmp_path / "q.csv").write_text("c,b,a\n0.6,0.5,0.5\n")
    table = document("direct", tmp_path / "m.yaml", "--input", tmp_path / "q.csv")
    one = document("direct", DELTA24, "--joints", 0.5, 0.5, 0.6)
    assert table["solutions"][0]["position"] == pytest.approx(one["solutions"][0]["position"])


@pytest.mark.wide
def test_a_direct_problem_loads_nothing_heavy_that_it_does_not_need():
    code = (
        "import sys; from parallel_cal.cli.main import main\n"
        f"sys.argv = ['x', 'direct', {str(DELTA24)!r}, '--joints', '0.5', '0.5', '0.5']\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "heavy = ('scipy', 'rosbags', 'rclpy', 'plotly', 'rich.table')\n"
        "sys.stderr.write(str([m for m in heavy if m in sys.modules]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]"


def test_a_ctrl_c_that_was_swallowed_ends_the_work_at_its_next_step():
    before = signal.getsignal(signal.SIGINT)
    with console.bar() as progress:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            progress("sessions", 0.5)
    assert signal.getsignal(signal.SIGINT) is before
