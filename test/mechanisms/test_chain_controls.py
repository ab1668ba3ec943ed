"""A chain controls the coordinates that determine its platform over the range of its joints."""

import chains
import numpy as np
import pytest
import test_shelf_as_chain as shelf
from chains import make_chain, revolute
from test_chain import SHELF, SHELF_MODELS

import parallel_cal as pc
from parallel_cal.base.errors import ModelFileError

FEET = {"ahead": [0.14, 0.0, -0.035], "sideways": [0.02, 0.12, -0.03], "below": [0, 0, -0.05]}


def ankle(foot, **more):
    """Make an ankle whose {P} is at FEET[foot] from its universal joint."""
    return make_chain(chains.ankle() | {"target": FEET[foot]} | more)


def wrong_shares(model, seed=0):
    """Draw readings over the limits and return the share of their poses that `inverse` does not
    lead back to although it says that it converged, and the share that it does not reach."""
    low, high = np.array(model.mechanism.joint_limits).T
    solver = pc.Kinematics(model)
    poses = solver.direct(np.random.default_rng(seed).uniform(low, high, (200, len(low))))
    poses = poses[poses.ok]
    found = solver.inverse(poses.position, poses.rotation)
    off = np.hypot(*found.distance_from(poses.position, poses.rotation)) > 1e-9
    return float(np.mean(off & found.ok)), float(np.mean(~found.ok))


# ------------------------------------------------------------------ the choice


@pytest.mark.parametrize(
    "foot", [pytest.param(foot, marks=pytest.mark.wide if foot != "ahead" else ()) for foot in FEET]
)
def test_an_ankle_controls_its_angles_wherever_its_foot_is_measured(foot):
    model = ankle(foot)
    assert model.mechanism.controls == ("rx", "ry")
    assert wrong_shares(model) == (0.0, 0.0)


@pytest.mark.wide
@pytest.mark.parametrize(("foot", "position"), [("ahead", ["x", "y"]), ("sideways", ["y", "x"])])
def test_a_position_with_a_maximum_in_the_range_would_lead_to_other_poses(foot, position):
    """0.14 m ahead and 0.035 m below a pitch p: x = 0.14 cos p - 0.035 sin p."""
    wrong, _ = wrong_shares(ankle(foot, controls=position))
    assert wrong > 0.2


@pytest.mark.wide
@pytest.mark.parametrize("name", SHELF)
def test_a_robot_of_the_shelf_as_a_chain_controls_what_it_controls_on_the_shelf(name):
    model = SHELF_MODELS[name]()
    given = SHELF[name](model)
    given.pop("controls", None)
    assert make_chain(given).mechanism.controls == model.mechanism.controls


@pytest.mark.wide
@pytest.mark.parametrize(
    "describe", [shelf.tripod_prs, shelf.plate_rrs, shelf.ankle_2rsu, shelf.palletizer]
)
def test_other_robots_of_the_shelf_need_no_stated_controls(describe):
    given = describe()
    stated = given.pop("controls", None) or list(pc.new_model(describe.__name__).mechanism.controls)
    assert list(make_chain(given).mechanism.controls) == stated


def test_a_crank_controls_its_angle_and_not_a_position_with_a_maximum():
    arm = revolute("arm", "base", "link", driven=True, limits=[-2.0, 2.0], home=0.5)
    given = {"base": "base", "platform": "link", "target": [0.3, 0, 0], "joints": [arm]}
    model = make_chain(given)
    assert model.mechanism.controls == ("rz",)
    assert wrong_shares(model) == (0.0, 0.0)


@pytest.mark.wide
def test_an_arm_with_two_parallel_axes_controls_the_position_of_its_end():
    joints = [
        revolute("shoulder", "base", "upper", driven=True, home=0.3, limits=[-1, 1]),
        revolute(
            "elbow", "upper", "fore", origin=[0.2, 0, 0], driven=True, home=1.0, limits=[0.2, 2.5]
        ),
    ]
    given = {"base": "base", "platform": "fore", "target": [0.15, 0, 0], "joints": joints}
    assert make_chain(given).mechanism.controls == ("x", "y")


@pytest.mark.wide
def test_of_a_platform_with_five_freedoms_the_turn_that_follows_is_the_one_left_out():
    """A gantry carries a wrist that yaws about z and pitches about y: as it hardly yaws, it cannot
    roll about x."""
    joints = [
        {
            "name": f"slide_{axis}",
            "type": "prismatic",
            "parent": parent,
            "child": axis,
            "axis": list(map(float, np.eye(3)[k])),
            "driven": True,
            "limits": [-0.2, 0.2],
        }
        for k, (parent, axis) in enumerate((("base", "x"), ("x", "y"), ("y", "z")))
    ]
    for name, parent, axis in (("yaw", "z", [0, 0, 1]), ("pitch", "fork", [0, 1, 0])):
        child = {"yaw": "fork", "pitch": "tool"}[name]
        joints.append(
            revolute(name, parent, child, driven=True, limits=[-0.7, 0.7]) | {"axis": axis}
        )
    given = {"base": "base", "platform": "tool", "target": [0.05, 0, -0.1], "joints": joints}
    assert make_chain(given).mechanism.controls == ("x", "y", "z", "ry", "rz")


# ------------------------------------------------------------------ far from home


def test_a_knee_bends_as_the_triangle_of_its_actuator_says():
    """Far from home, the expansion is beyond the pose at which knee and actuator are in line."""
    model = make_chain(chains.knee())
    upper, lower = np.array([-0.06, 0.23]), np.array([-0.06, 0.03])  # x, z from the knee
    between = np.arctan2(*upper) - np.arctan2(*lower)  # of both arms, about y, at a straight knee
    a, b = np.hypot(*upper), np.hypot(*lower)

    def length(bend):
        return np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(between - bend))

    bends = np.linspace(0.9, 2.1, 60)  # home is 1, and knee and actuator are in line at 0.85
    readings = (length(bends) - length(1.0))[:, None]
    found = pc.Kinematics(model).direct(readings)
    assert found.solved.all()
    expected = 0.36 * np.column_stack([-np.sin(bends), 0 * bends, -np.cos(bends)])
    np.testing.assert_allclose(found.position, expected, atol=1e-9)


def test_a_leg_finds_its_readings_over_the_whole_range_of_its_knee():
    """One in seven poses had a knee that bends the other way, which is outside its limits."""
    model = make_chain(chains.bird_leg())
    low, high = np.array(model.mechanism.joint_limits).T
    readings = np.random.default_rng(0).uniform(low, high, (100, 5))
    solver = pc.Kinematics(model)
    poses = solver.direct(readings)
    poses = poses[poses.ok]
    assert len(poses) > 80
    found = solver.inverse(poses.position, poses.rotation)
    assert found.ok.mean() > 0.97  # some feet cannot come straight from home
    np.testing.assert_allclose(found.joints[found.ok], poses.joints[found.ok], atol=1e-8)


def test_inverse_kinematics_begins_at_second_order_also_where_a_turn_is_not_controlled():
    """The given orientation contains this turn already: a quarter of it remained to be undone."""
    model = make_chain(chains.bird_leg())
    assert model.mechanism.controls == ("x", "y", "z", "ry", "rz")
    solver, home = pc.Kinematics(model), np.array(model.mechanism.home.joints)
    step, left = np.array([0.03, -0.07, 0.05, -0.08, 0.06]), []
    for share in (1.0, 0.5):
        truth = solver.direct(home + share * step).configuration.rows
        begin = chains.find_start(solver, "inverse", truth)
        off = model.configuration(begin).change_from(model.configuration(truth))
        left.append(np.linalg.norm(off))
    assert 0 < left[0] < 1e-2
    assert left[1] == pytest.approx(left[0] / 8, rel=0.3)


# ------------------------------------------------------------------ the model file


def test_a_model_file_states_the_controls_that_were_chosen(tmp_path):
    path = tmp_path / "ankle.yaml"
    pc.write_model(ankle("ahead"), path)
    text = path.read_text()
    assert "    controls: [rx, ry]\n" in text
    path.write_text(text.replace("controls: [rx, ry]", 'controls: [x, "y"]'))
    assert pc.read_model(path).mechanism.controls == ("x", "y")


def test_a_file_whose_workspace_is_one_of_other_coordinates_is_refused_with_what_to_do(tmp_path):
    """Earlier releases did not state the controls, and chose others."""
    path = tmp_path / "ankle.yaml"
    pc.write_model(ankle("ahead", controls=["x", "y"]), path)
    text = "".join(
        line for line in path.read_text().splitlines(keepends=True) if "controls:" not in line
    )
    path.write_text(text)
    number = 1 + text[: text.index("workspace:")].count("\n")
    with pytest.raises(ModelFileError, match=rf":{number}:.*state the controls in the options"):
        pc.read_model(path)
