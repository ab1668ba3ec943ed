"""The links of the description are where independent readers of its URDF put them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_export_arm_urdf import DIFFERENTIAL, calibrated
from test_export_urdf import Urdf as TreeReader
from test_export_urdf import everything
from urdf_reader import Urdf as ArmReader

from parallel_cal.exporting.description import describe
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

LINKS = (
    {"joint": None, "axes": "coincident"},
    {"joint": "R", "a": 0.4, "axes": "parallel", "low": -2, "high": 2},
    {"joint": "R", "a": 0.3, "low": -2, "high": 2},
)


def frames(description, configuration, at=None):
    """The pose of each link in the base, from the transforms in their order."""
    found = {description.model.frames["base"]: (np.zeros(3), np.eye(3))}
    steps = zip(*description.transforms(configuration, at), strict=True)
    for parent, child, (r, q) in zip(description.parents, description.children, steps, strict=True):
        at_parent, R = found[parent]
        found[child] = at_parent + R @ r, R @ Rotation.from_quat(q).as_matrix()
    return found


def assert_same(one, other, tolerance=1e-11):
    np.testing.assert_allclose(one[0], other[0], rtol=0, atol=tolerance)
    np.testing.assert_allclose(one[1], other[1], rtol=0, atol=tolerance)


OTHERS = ("stewart42", "linear_delta", "cable", "argos9", "rssr", "five_bar", "planar_stewart")


@pytest.mark.parametrize(
    "name", ["delta54", *(pytest.param(other, marks=pytest.mark.wide) for other in OTHERS)]
)
def test_the_links_of_a_parallel_robot_are_those_of_its_urdf(name, tmp_path):
    model = calibrated(new_model(name)) if name == "delta54" else new_model(name)
    description, path = describe(model), tmp_path / "robot.urdf"
    path.write_text(description.urdf)
    reader = TreeReader(path)
    r, R = poses_in_workspace(model.mechanism, 3, np.random.default_rng(5))
    found = Kinematics(model).inverse(r, R)
    for row, q in zip(found.configuration.rows, found.joints, strict=True):
        links, at = frames(description, row), everything(model, description.tree, q, row)
        assert set(links) == set(reader.links)
        for link, (place, turn) in links.items():
            R_link, r_link = reader.frame(link, at)
            assert_same((place, turn), (r_link, R_link))
        assert_same(links[model.frames["platform"]], (row[-12:-9], row[-9:].reshape(3, 3)))


@pytest.mark.parametrize("links", [LINKS, DIFFERENTIAL])
def test_the_links_of_an_arm_are_those_of_its_urdf(links, tmp_path):
    model = calibrated(new_model(load_mechanism("serial", links=links)))
    description, path = describe(model), tmp_path / "robot.urdf"
    path.write_text(description.urdf)
    reader, base = ArmReader(path), model.frames["base"]
    q = np.linspace(0.2, -0.4, len(model.joints))
    found = Kinematics(model).direct(q)
    for link, pose in frames(description, found.configuration.rows).items():
        if link != base:
            T = reader.pose(base, link, dict(zip(model.joints, q, strict=True)))
            assert_same(pose, (T[:3, 3], T[:3, :3]))


def test_the_links_of_an_arm_are_where_its_effects_place_them():
    """A gain of 0.01 turns the first link by 0.505 rad at a reading of 0.5, and backlash of 2 mrad
    after a falling reading by 1 mrad more."""
    model = new_model(load_mechanism("serial", links=LINKS))
    model = model.with_effect("encoder_gain", {"joint1.gain": 0.01})
    model = model.with_effect("backlash", {"joint1.width": 2e-3})
    at = {"direction.joint1": -1.0, "direction.joint2": 1.0}
    found = Kinematics(model).direct(np.array([0.5, 0.0]), at)
    links = frames(describe(model), found.configuration.rows, at)
    expected = Rotation.from_rotvec([0, 0, 0.506]).as_matrix()
    np.testing.assert_allclose(links["joint1_link"][1], expected, atol=1e-12)
    tip = expected @ [0.7, 0, 0]
    np.testing.assert_allclose(links[model.frames["platform"]][0], tip, atol=1e-12)


def test_what_an_effect_changes_besides_the_joints_moves_the_platform_alone():
    """Links of 0.7 m are 420 um longer 30 K above the reference, at 20 ppm per K."""
    model = new_model(load_mechanism("serial", links=LINKS))
    warm = model.with_effect("thermal_expansion", {"links.alpha": 2e-5})
    at = {"temperature": warm.value("thermal_expansion.reference") + 30.0}
    found = Kinematics(warm).direct(np.zeros(2), at)
    links = frames(describe(warm), found.configuration.rows, at)
    assert links[warm.frames["platform"]][0] == pytest.approx([0.70042, 0, 0], abs=1e-12)
    assert links["joint2_link"][0] == pytest.approx([0.4, 0, 0], abs=1e-12)


def test_errors_of_the_device_do_not_move_the_robot():
    model = new_model("stewart42")
    seen = model.with_effect("target_offset", {"o_x": 4e-3})
    home = model.mechanism.home
    robot = Kinematics(seen.robot()).direct(np.array(home.joints))
    links = frames(describe(seen), robot.configuration.rows)
    assert_same(links["platform"], (np.array(home.position), np.eye(3)), 1e-9)


UNDRAWN = """import casadi as ca
from parallel_cal import Home, Mechanism, Parameter, ParameterTable, Workspace


class Slide(Mechanism):
    joints = ("slide",)
    moves = controls = ("x",)
    joint_unit = "m"
    parameters = ParameterTable([Parameter("zero", "m", 0.0, 1e-3)])
    home = Home(joints=(0.0,), position=(0.0, 0.0, 0.0))
    workspace = Workspace(low=(-0.1,), high=(0.1,))
    joint_limits = ((-0.2, 0.2),)

    def closure(self, q, r, R, p):
        return ca.vertcat(r[0] - q[0] - p.zero)
"""


def test_a_robot_without_a_drawing_has_the_frames_of_base_and_platform(tmp_path, monkeypatch):
    (tmp_path / "undrawn_slide.py").write_text(UNDRAWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    model = new_model("undrawn_slide")
    model = replace(model, frames={"base": "bed", "platform": "carriage"})
    found = Kinematics(model).direct(np.array([0.05]))
    links = frames(describe(model), found.configuration.rows)
    assert_same(links["carriage"], (np.array([0.05, 0, 0]), np.eye(3)))
    assert "<cylinder" not in describe(model).urdf
