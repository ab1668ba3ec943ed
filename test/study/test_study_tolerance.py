"""What a design's tolerances are worth: by hand for a crank, by robots built another way."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from clusters import cluster

from parallel_cal.base.errors import DatasetError, FitError
from parallel_cal.cli import main as cli
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.mechanism import Workspace
from parallel_cal.model.model import Noise, new_model
from parallel_cal.planning.plan import plan
from parallel_cal.reporting.studies import format_tolerances, remarks, tolerances_page
from parallel_cal.study.planned_session import planned_joints
from parallel_cal.study.tolerance import draw_values, find_varying_parameters, tolerances
from parallel_cal.virtual.robot import TABLE_5_12, Delta


def crank(*effects, at=0.1, reach=0.0):
    """A slider-crank that stands at x = 100 mm: cos q = 0.86875 by eq. 5.12."""
    model = new_model("slider_crank", effects=effects)
    model.mechanism.workspace = Workspace((at - reach,), (at + reach,))
    return model


def test_a_cranks_budget_is_that_worked_by_hand():
    """x = a cos q + w, w = sqrt(b^2 - a^2 sin^2 q) = 30.5 mm: dx/da = cos q - a sin^2 q / w =
    0.22541, dx/db = b / w = 1.63934, dx/dq0 = -a sin q (1 + a cos q / w) = -129.90 mm/rad, for
    tolerances of 0.2 mm, 0.2 mm and 1 deg."""
    found = tolerances(crank(), robots=400, poses=4)
    by_hand = {"q0": 2267.2e-6, "b": 327.87e-6, "a": 45.08e-6}
    assert {one.name: one.rms["position"] for one in found.budget} == pytest.approx(by_hand, 1e-4)
    assert [one.name for one in found.budget] == ["q0", "b", "a"]
    assert found.linear == {"position": pytest.approx(2291.2e-6, rel=1e-4)}
    # 1133.6 um of the offset beside the others' 330.95
    assert found.budget[0].halved["position"] == pytest.approx(1180.9e-6, rel=1e-4)
    assert found.budget[0].compute_fraction(found.linear, "position") == pytest.approx(
        0.9792, abs=1e-4
    )
    assert found.summary("position")["rms"] == pytest.approx(2291e-6, rel=0.1)
    assert not found.differs("position")
    first, *others = remarks(found)
    assert first == (
        "encoder offset (q0), 1.00 deg, contributes most: 98 % of the squared position error; half "
        "the tolerance would reduce the error from 2291.2 to 1180.9 um"
    )
    assert not others


def test_a_play_counts_by_half_of_it_and_is_never_negative():
    """129.90 mm/rad times half the play's tolerance of 0.3 mrad: 19.5 um."""
    found = tolerances(crank("backlash", reach=1e-3), robots=50, poses=40)
    play = next(one for one in found.budget if one.name == "backlash.crank.width")
    assert play.rms["position"] == pytest.approx(19.485e-6, rel=0.02)
    table = found.model.table
    drawn = [
        draw_values(
            table, table.nominal, find_varying_parameters(found.model), np.random.default_rng(k)
        )[-1]
        for k in range(100)
    ]
    assert min(drawn) > 0
    assert np.sqrt(np.mean(np.square(drawn))) == pytest.approx(0.3e-3, rel=0.2)


def test_conditions_count():
    """What grows with the temperature is nothing at 20 degC; that reference is known."""
    model = crank("thermal_expansion")
    cold, warm = (tolerances(model, 2, 1, at={"temperature": t}).budget for t in (20.0, 30.0))
    of = {one.name: one.rms["position"] for one in cold}
    grown = {one.name: one.rms["position"] for one in warm}
    names = [name for name in of if name.startswith("thermal_expansion")]
    assert names
    assert all(of[name] == 0 < grown[name] for name in names)
    assert not any(name.endswith("reference") for name in of)


def test_tolerances_too_large_for_the_budget_are_reported():
    """The crank's angle strays by 10 deg where rod and crank are nearly stretched (12.5 deg): its
    squares add a fifth."""
    model = crank(at=0.125)
    model.mechanism.parameters = type(model.table)(
        replace(p, tolerance=np.radians(10)) if p.name == "q0" else p for p in model.table
    )
    found = tolerances(new_model(model.mechanism), robots=1000, poses=2)
    assert found.linear["position"] == pytest.approx(8.07e-3, rel=1e-2)  # of 10 deg, not of 1
    assert found.differs("position")
    assert any("times those of the budget" in text for text in remarks(found))
    assert found.document()["errors"]["position"]["linear_differs"]


@pytest.mark.wide
def test_robots_built_another_way_err_as_much():
    """Delta robots of points and rods, drawn by their own dice: of a hundred, an rms is uncertain
    by some 5 %."""
    mechanism = new_model("delta54").mechanism
    mechanism.parameters = mechanism.parameters.with_nominal(TABLE_5_12)
    model = new_model(mechanism)
    found = tolerances(model, robots=300, poses=40)
    rng = np.random.default_rng(5)
    r = rng.uniform(mechanism.workspace.low, mechanism.workspace.high, (12, 3))
    q, R = Delta(TABLE_5_12).inverse(r)
    squares = []
    for _ in range(100):
        strayed = {
            name: value + model.table[name].tolerance * rng.standard_normal()
            for name, value in TABLE_5_12.items()
        }
        there, attitude = Delta(strayed).forward(q)
        trace = np.trace(attitude @ R.transpose(0, 2, 1), axis1=1, axis2=2)
        squares.append((np.sum((there - r) ** 2, axis=1), np.arccos((trace - 1) / 2) ** 2))
    away, turned = np.sqrt(np.mean(squares, axis=(0, 2)))
    for kind, rms in (("position", away), ("orientation", turned)):
        assert found.summary(kind)["rms"] == pytest.approx(rms, rel=0.1)
        assert found.linear[kind] == pytest.approx(rms, rel=0.1)


@pytest.fixture
def planned(tmp_path):
    model = replace(new_model("delta54"), noise=Noise(1e-4, 1e-5, 1e-4))
    write_model(model, tmp_path / "delta.yaml")
    found = plan(model, 24, pool=60, seed=3)
    (tmp_path / "plan.csv").write_text(found.csv())
    return model, found, tmp_path


def test_what_a_calibration_leaves_is_what_the_plan_expects(planned):
    model, found, path = planned
    joints = planned_joints(path / "plan.csv", model)
    np.testing.assert_array_equal(joints, found.poses.joints)
    left = tolerances(model, 2, 20, planned=joints)
    # other places of the workspace are asked
    assert left.calibrated.position_rms == pytest.approx(found.expected.position_rms, rel=0.15)
    assert left.document()["calibrated"]["poses"] == 24
    assert "error after a calibration at the 24 poses of the plan: " in format_tolerances(left)
    assert "Tolerances of delta54" in tolerances_page(left)
    with pytest.raises(FitError, match="at least"):
        tolerances(model, 2, 20, planned=joints[:5])


def test_a_plan_for_another_robot_is_refused(planned):
    _, _, path = planned
    with pytest.raises(DatasetError, match=r"plan\.csv:1: no column leg1, .*this stewart42"):
        planned_joints(path / "plan.csv", new_model("stewart42"))


def test_the_command_gives_a_page_and_numbers(planned, capsys):
    _, _, path = planned
    words = ["study", "tolerance", str(path / "delta.yaml"), "--robots", "4", "--poses", "9"]
    code, out, _ = run(capsys, *words, "-o", str(path / "out"), "--json")
    document = json.loads(out)
    assert (code, document["robots"], document["seed"]) == (0, 4, 0)
    assert json.loads((path / "out" / "tolerance.json").read_text()) == document
    assert 'id="largest-contribution"' in (path / "out" / "tolerance.html").read_text()


def test_bad_input_is_named(planned, capsys):
    _, _, path = planned
    text = (path / "delta.yaml").read_text()
    (path / "none.yaml").write_text(re.sub(r", tolerance: [^,}]*", "", text, count=1))
    code, _, err = run(capsys, "study", "tolerance", str(path / "none.yaml"))
    assert code == 1
    assert re.match(r"error: .*none\.yaml:\d+: parameters\.chain1\.D_x.*tolerance", err), err
    code, _, err = run(capsys, "study", "tolerance", str(path / "delta.yaml"), "--at", "heat=3")
    assert code == 1
    assert "no condition 'heat'" in err


@pytest.mark.wide
def test_an_address_without_a_scheduler_is_a_clear_error(planned, capsys, monkeypatch):
    monkeypatch.setattr("parallel_cal.fleet.cluster.SCHEDULER_TIMEOUT_S", 0.2)
    model = str(planned[2] / "delta.yaml")
    code, _, err = run(capsys, "study", "tolerance", model, "--scheduler", "tcp://127.0.0.1:1")
    assert code == 1
    assert err.startswith("error: tcp://127.0.0.1:1: no Dask scheduler answers")


def run(capsys, *words):
    with pytest.raises(SystemExit) as ended:
        cli.main(list(words))
    return ended.value.code, *capsys.readouterr()


@pytest.mark.wide
def test_a_cluster_says_the_same_to_the_last_bit(tmp_path):
    pytest.importorskip("distributed")
    model = new_model("delta54")
    with cluster(tmp_path, 2) as workers:
        there = tolerances(model, 120, 10, scheduler=workers.address)
    here = tolerances(model, 120, 10)
    assert there.document() == here.document()
    assert (there.errors["position"] == here.errors["position"]).all()
