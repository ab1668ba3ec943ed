"""The exported URDF, read and moved by somebody else: its links end where the robot's parts do."""

from xml.etree import ElementTree

import numpy as np
import pytest
import virtual_day as vd

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.export import export
from parallel_cal.exporting.tree import tree_of
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.reporting.drawings import lines
from parallel_cal.virtual import robot as vr


def rpy(roll, pitch, yaw):
    x, y, z = (vr.turn(np.array(a) * b) for a, b in zip(np.eye(3), (roll, pitch, yaw), strict=True))
    return z @ y @ x


def vector(element, key):
    return np.array(element.get(key).split(), float)


class Urdf:
    """A reader that knows URDF and nothing of ours."""

    def __init__(self, path):
        root = ElementTree.parse(path).getroot()
        self.links = {link.get("name"): link for link in root.findall("link")}
        self.joints = {joint.find("child").get("link"): joint for joint in root.findall("joint")}
        self.names = [joint.get("name") for joint in root.findall("joint")]
        [self.root] = set(self.links) - set(self.joints)

    def frame(self, link, at):
        """Rotation and position of a link where joints stand `at`."""
        if link == self.root:
            return np.eye(3), np.zeros(3)
        joint = self.joints[link]
        R, p = self.frame(joint.find("parent").get("link"), at)
        p = p + R @ vector(joint.find("origin"), "xyz")
        moved = vector(joint.find("axis"), "xyz") * at[joint.get("name")]
        if joint.get("type") == "prismatic":
            return R, p + R @ moved
        return R @ vr.turn(moved), p

    def ends(self, at, kind=None):
        """Both ends of every cylinder in the root's frame, (n, 2, 3)."""
        found = []
        for name, link in self.links.items():
            R, p = self.frame(name, at)
            for visual in link.findall("visual"):
                if kind not in (None, visual.find("material").get("name")):
                    continue
                origin = visual.find("origin")
                along = R @ rpy(*vector(origin, "rpy"))[:, 2]
                half = 0.5 * float(visual.find("geometry/cylinder").get("length"))
                middle = p + R @ vector(origin, "xyz")
                found.append([middle - half * along, middle + half * along])
        return np.array(found)


def everything(model, tree, q, x):
    return {
        **dict(zip(model.joints, q, strict=True)),
        **dict(zip(tree.passive, tree.values(x), strict=True)),
    }


def apart(points, others):
    """How far each of the points is from the nearest of the others."""
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(axis=1).max()


OTHERS = (
    "delta_nominal",
    "stewart42",
    "linear_delta",
    "cable",
    "argos27",
    "slider_crank",
    "rssr",
    "planar_stewart",
    "parallelogram",
    "five_bar",
)


@pytest.mark.parametrize(
    "name", ["delta54", *(pytest.param(other, marks=pytest.mark.wide) for other in OTHERS)]
)
def test_every_drawn_point_is_where_the_tree_puts_it(name, tmp_path):
    model = new_model(name)
    [path] = export(model, "urdf", tmp_path).paths
    urdf, tree = Urdf(path), tree_of(model)
    r, R = poses_in_workspace(model.mechanism, 5, np.random.default_rng(5))
    found = Kinematics(model).inverse(r, R)
    assert found.solved.all()
    for row, q in zip(found.configuration.rows, found.joints, strict=True):
        ends = urdf.ends(everything(model, tree, q, row)).reshape(-1, 3)
        drawn = np.vstack([line.points for line in lines(model, row)])
        assert apart(drawn, ends) < 1e-6


def test_rods_end_in_the_balls_of_a_robot_built_another_way(tmp_path):
    model = new_model("delta54", vr.TABLE_5_18)
    [path] = export(model, "urdf:name=mock_up", tmp_path).paths
    assert path.name == "mock_up.urdf"
    urdf, tree = Urdf(path), tree_of(model)
    q, _ = vr.MOCK_UP.inverse(vd.targets(4, seed=8))
    r, R = vr.MOCK_UP.forward(q)
    for k in range(4):
        x = np.concatenate([q[k], r[k], R[k].ravel()])
        rods = urdf.ends(everything(model, tree, q[k], x), "rod")
        assert len(rods) == 6
        lower, upper = vr.MOCK_UP.joint_points(q[k]), vr.MOCK_UP.platform_points(r[k], R[k])
        assert apart(lower, rods.reshape(-1, 3)) < 1e-8
        assert apart(upper, rods.reshape(-1, 3)) < 1e-8


def test_the_arms_turn_with_the_robots_own_joints_within_their_limits(tmp_path):
    model = new_model("delta54")
    [path] = export(model, "urdf", tmp_path).paths
    root = ElementTree.parse(path).getroot()
    own = {j.get("name"): j for j in root.findall("joint") if j.get("name") in model.joints}
    assert list(own) == ["joint1", "joint2", "joint3"]
    assert {joint.get("type") for joint in own.values()} == {"revolute"}
    limit = own["joint2"].find("limit")
    assert np.degrees([float(limit.get("lower")), float(limit.get("upper"))]) == pytest.approx(
        [-30, 135]
    )
    tree = tree_of(model)
    assert not set(tree.passive) & set(model.joints)
    assert len(tree.passive) == 6 + 2 * 6  # the platform, and two for each of six rods


@pytest.mark.wide
def test_the_legs_of_a_hexapod_are_driven_telescopes(tmp_path):
    model = new_model("stewart42")
    [path] = export(model, "urdf", tmp_path).paths
    joints = {j.get("name"): j.get("type") for j in ElementTree.parse(path).iter("joint")}
    assert {joints[name] for name in model.joints} == {"prismatic"}


@pytest.mark.parametrize("name", ["cable", "deltesian"])
def test_every_reading_has_a_joint_of_its_name(name, tmp_path):
    """A cable robot had none: its motors wind lines, whose lengths are passive joints."""
    model = new_model(name)
    [path] = export(model, "urdf", tmp_path).paths
    joints = {j.get("name"): j for j in ElementTree.parse(path).iter("joint")}
    units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    for joint, unit in units.items():
        assert (joints[joint].get("type") == "prismatic") == (unit == "m")
    tree = tree_of(model)
    assert not set(tree.passive) & set(model.joints)
    q = model.mechanism.home.joints
    found = Kinematics(model).direct(np.array(q))
    at = everything(model, tree, q, found.configuration.rows)
    _, placed = Urdf(path).frame(model.frames["platform"], at)
    np.testing.assert_allclose(placed, found.position, atol=1e-9)


def test_a_single_file_has_the_name_that_is_given(tmp_path):
    """`-o robot.urdf` made a folder of this name."""
    model = new_model("delta24")
    [inside] = export(model, "urdf", tmp_path / "folder").paths
    [named] = export(model, "urdf", tmp_path / "new" / "robot.urdf").paths
    assert (inside.parent, named) == (tmp_path / "folder", tmp_path / "new" / "robot.urdf")
    assert named.read_text() == inside.read_text()
    (tmp_path / "v1.urdf").mkdir()
    [there] = export(model, "urdf", tmp_path / "v1.urdf").paths
    assert there == tmp_path / "v1.urdf" / inside.name
    named.write_text("<robot/>")
    export(model, "urdf", named)
    assert named.read_text() == inside.read_text()
    assert named.with_name("robot.urdf.previous").read_text() == "<robot/>"


def test_the_name_of_a_file_is_refused_where_a_folder_is_needed(tmp_path):
    with pytest.raises(
        ModelError, match=r"robot\.h is the name of a file: c writes .*, delta24\.c,"
    ):
        export(new_model("delta24"), "c", tmp_path / "robot.h")
    model = tmp_path / "robot.yaml"
    model.write_text("of the robot")
    with pytest.raises(ModelError, match=r"give a folder, or a file whose name ends in \.urdf"):
        export(new_model("delta24"), "urdf", model)
    assert [path.name for path in tmp_path.iterdir()] == ["robot.yaml"]
    assert model.read_text() == "of the robot"
