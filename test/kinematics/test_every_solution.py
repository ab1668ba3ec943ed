"""All solutions of one sample, and whether they are known to be all: a user's own five-bar, and
the mechanisms of the shelf whose closed forms or complete methods say so."""

import json
from itertools import product

import numpy as np
import pytest
from hexapod_ends import find_ends

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.all_solutions import direct_all, inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

FIVE_BAR = '''
import casadi as ca

from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Parameter, ParameterTable


class FiveBar(Mechanism):
    """Two cranks of 0.5 m about (-0.3, 0) and (0.3, 0), each with a rod of 0.5 m to the point."""

    joints = ("left", "right")
    moves = controls = ("x", "y")
    parameters = ParameterTable(
        [Parameter(f"{s}.{n}", "m", 0.5, 1e-3) for s in ("left", "right") for n in ("crank", "rod")]
    )
    home = Home(joints=(1.9, 1.2), position=(0.0, 0.4, 0.0))
    workspace = Workspace(low=(-0.1, 0.3), high=(0.1, 0.5))
    joint_limits = ((-4.0, 4.0),) * 2

    def closure(self, q, r, R, p):
        rows = []
        for i, (side, x) in enumerate((("left", -0.3), ("right", 0.3))):
            chain = p[side]
            elbow = ca.vertcat(x + chain.crank * ca.cos(q[i]), chain.crank * ca.sin(q[i]))
            rows.append((ca.sumsqr(r[:2] - elbow) - chain.rod**2) / (2 * chain.rod))
        return ca.vertcat(*rows)
'''


@pytest.fixture
def five_bar(tmp_path, monkeypatch):
    """A user's own mechanism that says nothing of its branches."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_robots").mkdir()
    (tmp_path / "my_robots" / "five_bar.py").write_text(FIVE_BAR)
    return new_model("my_robots.five_bar")


# At (0, 0.4) crank, rod and the way from each pivot (3-4-5) are an equilateral triangle: each crank
# stands 60 degrees to one or the other side of the line to the point.
TO_POINT = np.arctan2(0.4, 0.3)
LEFT = TO_POINT + np.array([1, -1]) * np.pi / 3
RIGHT = np.pi - TO_POINT + np.array([-1, 1]) * np.pi / 3


def off_by_turns(q, expected):
    return np.abs(np.angle(np.exp(1j * (q - expected)))).max()


def test_a_users_mechanism_without_candidates_shows_all_four_working_modes(five_bar):
    found = inverse_all(five_bar, np.array([0, 0.4, 0]))
    assert len(found) == 4
    assert found.complete is False
    for expected in product(LEFT, RIGHT):
        assert min(off_by_turns(q, expected) for q in found.joints) < 1e-9
    assert off_by_turns(found.joints[0], (LEFT[0], RIGHT[0])) < 1e-9  # home first
    assert found.residual.max() < 1e-10


def test_a_users_mechanism_shows_both_assembly_modes(five_bar):
    """The elbows lie at the same height: the point above them or below, as far from the line."""
    q = np.array([LEFT[0], RIGHT[0]])
    height = 0.5 * np.sin(LEFT[0])
    found = direct_all(five_bar, q)
    assert found.complete is False
    assert found.position[:, 0] == pytest.approx(0, abs=1e-9)
    assert found.position[:, 1] == pytest.approx([0.4, 2 * height - 0.4])


def test_a_search_gives_the_same_answers_again(five_bar):
    first, again = (inverse_all(five_bar, np.array([0.05, 0.35, 0])) for _ in range(2))
    assert np.array_equal(first.joints, again.joints)


def test_json_says_whether_others_may_exist_and_the_screen_does_too(five_bar, tmp_path, run_cli):
    from parallel_cal.model.file.modelfile import write_model

    write_model(five_bar, tmp_path / "own.yaml")
    asked = ("inverse", tmp_path / "own.yaml", "--position", "0 0.4 0")
    every = json.loads(run_cli(*asked, "--all", "--json"))
    assert (len(every["solutions"]), every["complete"]) == (4, False)
    assert "4 solutions found, home branch first; 4 within limits; others may exist" in run_cli(
        *asked, "--all"
    )
    assert "complete" not in json.loads(run_cli(*asked, "--json"))
    assert "others may exist" not in run_cli(*asked)


COMPLETE = {  # mechanism: how many poses of its home's joints, and joint sets of its home's pose
    "delta24": (2, 8),
    "slider_crank": (2, 2),
    "rssr": (2, 2),
    "argos9": (None, 8),
    "argos_nominal": (None, 8),
    "stewart42": (None, 1),
    "parallelogram": (2, None),
}


@pytest.mark.parametrize("name", sorted(COMPLETE))
def test_a_closed_form_or_a_complete_method_says_that_there_are_no_others(name):
    model = new_model(name)
    r, R = poses_in_workspace(model.mechanism, 1, np.random.default_rng(3))
    here = Kinematics(model).inverse(r[0], R[0])
    poses, joints = COMPLETE[name]
    every = direct_all(model, here.joints)
    assert every.complete
    assert poses is None or len(every) == poses
    if joints is not None:
        every = inverse_all(model, here.position, here.rotation)
        assert every.complete
        assert len(every) == joints


@pytest.mark.parametrize("name", ["delta54", "argos27"])
def test_a_complete_method_speaks_of_its_own_problem_only(name):
    model = new_model(name)
    here = Kinematics(model).inverse(model.mechanism.home.position)
    assert direct_all(model, here.joints).complete
    assert inverse_all(model, here.position, here.rotation).complete is False


def test_an_effect_that_bends_the_closed_form_leaves_others_possible():
    model = new_model("delta24").with_effect("encoder_gain")
    gained = model.with_values(model.values + 1e-3 * (model.values == 0))
    found = inverse_all(gained, np.array([0.01, 0.0, 0.2]))
    assert (len(found), found.complete) == (8, False)


def test_a_pose_out_of_reach_has_no_solution_and_a_closed_form_reports_it():
    found = inverse_all(new_model("delta24"), np.array([0, 0, 9.0]))
    assert list(found.status) == [Status.UNREACHABLE]
    assert found.complete


def test_one_solution_does_not_exclude_others():
    model = new_model("delta24")
    assert solving.inverse(model, np.array([0, 0, 0.2]), None, {})[0].complete is None


def test_deltas_and_five_bars_have_as_many_solutions_as_circles_intersect():
    """Two sides to each arm: 8 ways to a pose of a Delta and 4 of a five-bar. Three spheres meet in
    two points, and so do two circles."""
    rng = np.random.default_rng(1)
    for _ in range(3):
        base, platform, arm = rng.uniform((0.08, 0.02, 0.1), (0.15, 0.04, 0.15))
        delta = load_mechanism("delta24", base=base, platform=platform, arm=arm, rod=0.4)
        crank, rod = rng.uniform((0.08, 0.15), (0.12, 0.2))
        bars = load_mechanism("five_bar", base=0.06, crank=crank, rod=rod)
        for mechanism, ways in ((delta, 8), (bars, 4)):
            model = new_model(mechanism)
            q = np.array(mechanism.home.joints) + rng.uniform(-0.1, 0.1, len(mechanism.joints))
            poses = direct_all(model, q)
            joints = inverse_all(model, poses.position[0])
            assert (len(poses), len(joints)) == (2, ways)
            assert poses.complete
            assert joints.complete


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(4))
def test_a_general_hexapod_has_no_pose_beyond_those_listed(seed):
    """Newton's method in NumPy, from 2,000 random poses."""
    rng = np.random.default_rng(seed)
    feet, heads = rng.uniform(-0.3, 0.3, (2, 6, 3))
    names = [f"leg{i + 1}.{point}_{axis}" for point in "CB" for i in range(6) for axis in "xyz"]
    model = new_model("stewart42", dict(zip(names, np.ravel([feet, heads]), strict=True)))
    turn = rotation_matrix(rng.normal(size=3))
    length = np.linalg.norm([0.1, -0.1, 0.5] + heads @ turn.T - feet, axis=1)
    zero = np.array([model.value(f"leg{i + 1}.L0") for i in range(6)])
    found = direct_all(model, length - zero)
    assert found.complete
    assert len(found) % 2 == 0
    r, R = find_ends(feet, heads, length, rng, 2000)
    assert len(r) > 100
    apart = np.abs(r[:, None] - found.position).max(axis=-1)
    apart += np.abs(R[:, None] - found.rotation).max(axis=(-1, -2))
    assert apart.min(axis=1).max() < 1e-6  # each end is listed
    assert apart.min(axis=0).max() < 1e-6  # each listed pose is an end
