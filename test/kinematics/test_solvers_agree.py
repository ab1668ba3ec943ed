"""Every solver that serves a mechanism gives Newton's answer on the same branch; others refuse."""

from functools import cache

import numpy as np
import pytest
from marks import keep

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics import solving
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import list_plugins

ALL = set(list_plugins("mechanisms")) - {"serial", "chain"}  # described in a file of their own
SPHERICAL = {"argos9", "argos_nominal"}
SIX_RODS = {"delta54", "delta51", "linear_delta", "stewart42", "stewart_rss", "hexaglide"}
SMALL = {
    "cable",
    "deltesian",
    "five_bar",
    "delta24",
    "delta_nominal",
    "parallelogram_simple",
    "rssr",
    "slider_crank",
    "tripod_struts",
}
SHELF = {"stewart_rss", "hexaglide", "quattro", "pentapod"}
SERVED = {  # solver: mechanisms whose direct, and whose inverse problem it solves
    "closed_form": (
        SMALL | {"argos_nominal", "parallelogram", "scara16"},
        SMALL - {"parallelogram_simple"} | SPHERICAL | {"planar_stewart", "stewart42"} | SHELF,
    ),
    "cascaded:half_steps=9": ({"delta54", "linear_delta"}, {"delta54"}),
    "cascaded_circles:half_steps=24": ({"argos27"}, {"argos27"}),
    "fixed_newton:steps=12,update=true": (ALL - {"cable"}, ALL),
    "homotopy": (SIX_RODS, set()),
    "polynomial:form=polynomial": (SPHERICAL, set()),
    "polynomial:form=eigenvalue": (SPHERICAL, set()),
    "three_circles": ({"argos27"}, set()),
}


@cache
def strayed(name):
    """A robot a third of its tolerances off its nominal, and its answers over the workspace."""
    model, rng = new_model(name), np.random.default_rng(7)
    t = model.table
    off = t.tolerance * ~model.fixed * rng.standard_normal(len(t))
    model = model.with_values(t.nominal + off / 3)
    kinematics = Kinematics(model)
    joints = kinematics.inverse(*poses_in_workspace(model.mechanism, 12, rng))
    poses = kinematics.direct(joints.joints[joints.ok])
    return model, poses[poses.ok]


def apart(found, expected):
    pairs = ((getattr(s, part) for s in (found, expected)) for part in PARTS)
    return max(np.abs(a - b).max() for a, b in pairs)


PARTS = ("joints", "position", "rotation")


@pytest.mark.wide
@pytest.mark.parametrize("name", sorted(ALL))
@pytest.mark.parametrize("solver", SERVED)
def test_a_solver_gives_newtons_answer_or_refuses(solver, name):
    model, expected = strayed(name)
    assert len(expected) > 3
    problems = (
        (solving.direct, (expected.joints,)),
        (solving.inverse, (expected.position, expected.rotation)),
    )
    for (solve, given), served in zip(problems, SERVED[solver], strict=True):
        if name in served:
            assert apart(solve(model, *given, {}, solver=solver), expected) < 1e-7
        else:
            with pytest.raises(SolveError, match=r"newton|option 'steps=3': newton has none"):
                solve(model, *given, {}, solver=solver)


@pytest.mark.wide
@pytest.mark.parametrize(
    "name",
    keep(sorted(SIX_RODS | SPHERICAL | {"argos27"}), "argos9", "argos27", "delta54", "hexaglide"),
)
def test_the_first_of_all_poses_is_the_one_answer(name):
    model, expected = strayed(name)
    assert len(expected) > 3
    for pose in expected:
        every = solving.direct(model, pose.joints, {}, every=True)
        assert apart(every[0], pose) < 1e-7


def test_a_complete_search_does_not_prefer_a_tilted_platform_that_is_nearer_to_home():
    """On the workspace's edge the tilted poses of other assembly modes are nearer to home."""
    model = new_model("delta54")
    corner = Kinematics(model).inverse([0.06, 0.06, 0.26])
    every = solving.direct(model, corner.joints, {}, every=True)
    home = np.array(model.mechanism.home.position)
    assert np.argmin(np.linalg.norm(every.position - home, axis=1)) > 0
    assert every.position[0] == pytest.approx(corner.position)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("cascaded:half_steps=0", "expected 1 or more"),
        ("cascaded:half_steps=x", "half_steps=3, rough=False"),
        (
            "fixed_newton:slow",
            "solver 'fixed_newton:slow': expected NAME:key=value",
        ),
        ("homotopy:steps=3", "option 'steps=3': homotopy has none"),
        ("newton:steps=3", "option 'steps=3': newton has none"),
    ],
)
def test_an_option_that_cannot_be_is_refused(option, words):
    model, expected = strayed("delta54")
    with pytest.raises(SolveError, match=words):
        solving.direct(model, expected.joints, {}, solver=option)


def test_the_rough_cascade_can_be_chosen_by_name():
    model, expected = strayed("delta54")
    rough = solving.direct(model, expected.joints, {}, solver="cascaded:rough=true")
    assert 1e-6 < apart(rough, expected) < 1e-2


@pytest.mark.parametrize("name", ["delta24", "delta_nominal", "slider_crank"])
def test_the_closed_form_calls_a_target_out_of_reach_unreachable(name):
    model, expected = strayed(name)
    targets = expected.position.copy()
    targets[1, model.mechanism.controlled[0]] += 9.0
    found = solving.inverse(model, targets, expected.rotation, {}, solver="closed_form")
    assert list(found.ok) == [True, False, *[True] * (len(targets) - 2)]
    assert found.status[1] == Status.UNREACHABLE


def test_every_solver_says_in_its_last_line_what_it_is_for():
    purposes = solving.solvers()
    assert set(purposes) == set(list_plugins("kinematics.solvers")) >= {"newton", "closed_form"}
    for purpose in purposes.values():
        assert purpose.startswith(("Prefer it", "Kept as the thesis' own"))
        assert len(purpose) <= 100
