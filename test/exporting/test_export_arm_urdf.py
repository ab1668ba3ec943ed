"""The URDF of a serial arm is the arm: its own joints, at which others find the same poses."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_import_urdf import SCARA, UR5
from test_mimic import FANUC, PALLETIZER, ROBOTS
from urdf_reader import Urdf, difference, three

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.urdf import arm
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

DIFFERENTIAL = (
    *FANUC[:2],
    FANUC[2] | {"driven_by": {"link2": 0.5, "link3": 0.5}, "offset": 0.3},
    FANUC[3] | {"driven_by": {"link2": 0.5, "link3": -0.5}},
)


def calibrated(model, seed=0):
    """The model with values as a fit may find them."""
    moved = model.table.tolerance * np.random.default_rng(seed).standard_normal(len(model.values))
    return model.with_values(model.values + moved)


def from_urdf(tmp_path, text, start="", end=""):
    path = tmp_path / "own.urdf"
    path.write_text(text)
    return path, arm(path, start, end).model


def models(tmp_path):
    for links in (FANUC, DIFFERENTIAL):
        yield new_model(load_mechanism("serial", links=links))
    yield new_model("scara16")
    for text, start, end in (
        (UR5, "world", "tool0"),
        (SCARA, "base", "d"),
        (PALLETIZER, "l0", "l4"),
    ):
        yield from_urdf(tmp_path, text, start, end)[1]
    yield from_urdf(tmp_path, ROBOTS["the master is off the chain"][0], "l0", "l2")[1]


@pytest.mark.parametrize("number", range(7))
def test_the_urdf_of_an_arm_is_its_chain_of_joints(number, tmp_path):
    model = calibrated([*models(tmp_path)][number])
    [path] = export(model, "urdf", tmp_path / "out").paths
    urdf, (start, end) = Urdf(path), (model.frames[name] for name in ("base", "platform"))
    assert difference(model, urdf, start, end) < 1e-12
    again = arm(path, start, end).model
    assert sorted(again.joints) == sorted(model.joints)
    if again.joints == model.joints:
        limits = [np.array(m.mechanism.joint_limits) for m in (again, model)]
        np.testing.assert_allclose(*limits, atol=0.01)  # factors narrow them
        q = np.array(model.mechanism.home.joints) + 0.1
        one, other = Kinematics(model).direct(q), Kinematics(again).direct(q)
        np.testing.assert_allclose(one.position, other.position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(one.rotation, other.rotation, rtol=0, atol=1e-12)
    axes = [
        joint.find("axis").get("xyz")
        for joint in urdf.joints.values()
        if joint.get("type") != "fixed"
    ]
    assert {*axes} == {"0 0 1"}


def test_an_arms_joints_have_their_names_limits_and_no_passive_joint(tmp_path):
    model = from_urdf(tmp_path, UR5, "base", "tool0")[1]
    [path] = export(model, "urdf", tmp_path / "out").paths
    joints = Urdf(path).joints
    assert [*joints] == ["pan", "lift", "elbow", "wrist1", "wrist2", "wrist3", "tool0_fixed"]
    assert [j.get("type") for j in joints.values()] == ["revolute"] * 5 + ["continuous", "fixed"]
    assert three(joints["lift"].find("limit"), "lower", "") == pytest.approx(-2.5)


ONE_JOINT = ({"joint": None, "axes": "coincident"}, {"joint": "R", "a": 0.5, "low": -1, "high": 1})


def test_what_a_urdf_cannot_hold_is_named_with_its_size(tmp_path):
    """A gain of 0.001 at 1 rad moves a tool at 0.5 m by 500 um; half of 0.4 mrad of backlash by
    100 um."""
    model = new_model(load_mechanism("serial", links=ONE_JOINT))
    gain = model.with_effect("encoder_gain", {"joint1.gain": 1e-3})
    both = gain.with_effect("backlash", {"joint1.width": 4e-4})
    [said, _] = export(both, "urdf", tmp_path).remarks
    found = re.findall(r"(\w+) up to ([\d.]+) um and ([\d.]+) urad", said)
    sizes = {name: (float(um), float(urad)) for name, um, urad in found}
    assert sizes["encoder_gain"] == pytest.approx((500, 1000), rel=0.01)
    assert sizes["backlash"] == pytest.approx((100, 200), rel=0.01)
    assert sizes["together"] == pytest.approx((600, 1200), rel=0.02)
    assert "which holds geometry only" in said


def masked(text):
    """A file without the numbers of its origins."""
    return re.sub(r'(xyz|rpy)="[^"]*"(?=[^<]*/?>)', r'\1=""', re.sub(r"<axis[^>]*>", "", text))


DRESSED = UR5.replace(
    "</robot>",
    '<link name="upper"><inertial><origin xyz="0 0 0.28"/><mass value="8.4"/></inertial>'
    "<!-- <joint name='elbow'><origin xyz='9 9 9'/></joint> --></link>\r\n</robot>",
)


def test_only_origins_of_an_own_file_change(tmp_path):
    path, model = from_urdf(tmp_path, DRESSED, "base", "tool0")
    before = path.read_bytes().decode()
    done = export_into(calibrated(model), "urdf", [path])
    after = path.read_bytes().decode()
    assert masked(after) == masked(before) != before
    assert after.count('mass value="8.4"') == 1
    assert re.findall(r"<axis[^>]*>", after) == re.findall(r"<axis[^>]*>", before)
    assert difference(calibrated(model), Urdf(path), "base", "tool0") < 1e-12
    assert path.with_name("own.urdf.previous").read_bytes().decode() == before
    assert done.remarks[0].startswith("origins changed: 7, by up to ")


def test_a_file_that_is_right_stays_as_it_is(tmp_path):
    path, model = from_urdf(tmp_path, DRESSED, "base", "tool0")
    before = path.read_bytes()
    assert export_into(model, "urdf", [path]).remarks[0] == "no origin changed"
    assert path.read_bytes() == before


@pytest.mark.parametrize("joint", ["pan", "elbow", "wrist1", "wrist3", "slide"])
def test_an_encoders_zero_is_in_the_origin_of_its_own_joint(joint, tmp_path):
    """The model of a robot whose readings are 0.01 less, made by turning its real joint's frame."""
    text, end = (SCARA, "d") if joint == "slide" else (UR5, "tool0")
    path, model = from_urdf(tmp_path, text, "base", end)
    before = Urdf(path)
    at = model.joints.index(joint)
    links = [dict(link) for link in model.mechanism.options["links"]]
    moving = [link for link in links if link["joint"]]
    key = "d" if joint == "slide" else "theta"
    moving[at] |= {key: moving[at].get(key, 0.0) + 0.01}
    shifted = load_mechanism("serial", links=links, home=list(model.mechanism.home.joints))
    shifted.joints = model.joints
    export_into(replace(new_model(shifted), frames=model.frames), "urdf", [path])
    after, zero = Urdf(path), dict.fromkeys(before.joints, 0.0)
    moved = {
        name: np.linalg.solve(before.step(before.joints[name], zero), after.step(part, zero))
        for name, part in after.joints.items()
    }
    axis = three(before.joints[joint].find("axis"), "xyz", "1 0 0")
    expected = np.eye(4)
    if joint == "slide":
        expected[:3, 3] = 0.01 * axis
    else:
        expected[:3, :3] = Rotation.from_rotvec(0.01 * axis).as_matrix()
    for name, T in moved.items():
        np.testing.assert_allclose(T, expected if name == joint else np.eye(4), atol=1e-12)


def test_a_factor_that_was_identified_is_written(tmp_path):
    path, model = from_urdf(tmp_path, PALLETIZER, "l0", "l4")
    factor = model.table.names.index("link3.by_link2")
    values = model.values.copy()
    values[factor] = -1.003
    moved = model.with_values(values)
    done = export_into(moved, "urdf", [path])
    assert Urdf(path).joints["c"].find("mimic").get("multiplier") == "-1.003"
    assert difference(moved, Urdf(path), "l0", "l4") < 1e-12
    assert "the mimics of c have identified factors" in done.remarks


def test_a_tool_beside_the_last_axis_gets_a_link_of_its_own(tmp_path):
    path, model = from_urdf(tmp_path, PALLETIZER, "l0", "l4")
    done = export_into(calibrated(model), "urdf", [path])
    assert difference(calibrated(model), Urdf(path), "l0", "l4") < 1e-12
    words = "d now moves a new link l4_axis, to which l4 is fixed"
    assert any(remark.startswith(words) for remark in done.remarks)


REFUSED = {
    "xacro": ("<robot ", '<robot xmlns:xacro="http://wiki.ros.org/xacro" ', None),
    "joints": (
        'name="pan"',
        'name="shoulder_pan"',
        "its joints from 'base' to 'tool0' are shoulde",
    ),
    "links": ("tool0", "flange", "no link 'tool0', expected one of .*names the links of both ends"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_is_not_the_models_is_refused_and_stays(name, tmp_path):
    path, model = from_urdf(tmp_path, UR5, "base", "tool0")
    old, new, words = REFUSED[name]
    text = UR5.replace(old, new, 1 if name == "xacro" else -1)
    if name == "xacro":
        text = text.replace("</robot>", '<xacro:arm prefix=""/></robot>')
        words = "own.urdf: a xacro, expected a URDF: expand it first"
    path.write_text(text)
    with pytest.raises(ParallelCalError, match=words):
        export_into(model, "urdf", [path])
    assert path.read_text() == text
    assert [*tmp_path.iterdir()] == [path]


def test_a_robot_with_loops_has_no_file_of_its_own_to_change(tmp_path):
    path = tmp_path / "own.urdf"
    path.write_text(UR5)
    with pytest.raises(ParallelCalError, match="stewart42 is neither a serial arm nor a chain"):
        export_into(new_model("stewart42"), "urdf", [path])


def test_the_shape_of_the_tags_does_not_matter(tmp_path):
    """Other quotes, an origin in two lines, none at all, and a blank line before the file."""
    text = UR5.replace(
        '<origin xyz="0 0 0.089159" rpy="0 0 0"/>', "<origin\n xyz='0 0 0.089159' />"
    )
    text = text.replace('<origin xyz="0 0.0823 0"', '<origin note="a > b" xyz="0 0.0823 0"')
    text = text.replace('<origin xyz="0 0.093 0" rpy="0 0 0"/>', "")
    path, model = from_urdf(tmp_path, text, "base", "tool0")
    path.write_text("\n" + text.partition("\n")[2])
    export_into(calibrated(model), "urdf", [path])
    assert difference(calibrated(model), Urdf(Path(path)), "base", "tool0") < 1e-12
    assert 'note="a > b"' in path.read_text()
