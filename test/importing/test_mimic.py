"""A joint that follows others: `<mimic>` of a URDF, and `driven_by` of a serial arm's link."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from urdf_reader import Urdf, difference

import parallel_cal as pc
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.importing.urdf import arm
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import parse_model
from parallel_cal.model.file.writer import dump_model
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

LIMIT = '<limit lower="-3" upper="3" velocity="2" effort="1"/>'


def joint(name, kind, parent, child, xyz, axis, mimic="", limit=LIMIT):
    follows = f"<mimic {mimic}/>" if mimic else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>{limit}{follows}</joint>'
    )


def robot(*joints):
    return f'<robot name="r">{"".join(joints)}</robot>'


def chain(*rows):
    """A robot whose joints follow each other: rows of name, kind, xyz, axis, mimic."""
    return robot(
        *(
            joint(name, kind, f"l{k}", f"l{k + 1}", xyz, axis, mimic)
            for k, (name, kind, xyz, axis, mimic) in enumerate(rows)
        )
    )


MOTOR = joint("motor", "revolute", "l0", "motor_link", "0 1 0", "0 0 1")
TWICE = 'joint="a" multiplier="2" offset="0.1"'
PALLETIZER = chain(
    ("a", "revolute", "0 0 0.3", "0 0 1", ""),
    ("b", "revolute", "0.1 0 0", "0 1 0", ""),
    ("c", "revolute", "0 0 0.5", "0 1 0", 'joint="b" multiplier="-1" offset="0.2"'),
    ("d", "revolute", "0.6 0 0", "0 0 1", ""),
)
ROBOTS = {
    "one": (
        chain(
            ("a", "revolute", "0 0 0", "0 0 1", ""), ("b", "revolute", "0.1 0 0", "0 0 1", TWICE)
        ),
        ("a",),
    ),
    "several of one master": (PALLETIZER.replace('joint="b"', 'joint="a"'), ("a", "b", "d")),
    "mimic of a mimic": (
        chain(
            ("a", "revolute", "0 0 0.1", "0 0 1", ""),
            ("b", "revolute", "0.2 0 0", "0 1 0", TWICE),
            ("c", "revolute", "0.3 0 0", "1 0 0", 'joint="b" multiplier="-0.5" offset="0.3"'),
        ),
        ("a",),
    ),
    "the master comes later": (
        chain(
            ("c", "revolute", "0 0 0.1", "0 0 1", 'joint="a" multiplier="-1"'),
            ("a", "revolute", "0.2 0 0", "0 1 0", ""),
        ),
        ("a",),
    ),
    "a slide follows a turn": (
        chain(
            ("a", "revolute", "0 0 0.1", "0 0 1", ""),
            ("lift", "prismatic", "0.2 0 0", "0 0 1", 'joint="a" multiplier="0.01" offset="-0.05"'),
        ),
        ("a",),
    ),
    "the master is off the chain": (
        chain(
            ("b", "revolute", "0 0 0.1", "0 0 1", 'joint="motor" multiplier="0.5" offset="0.1"'),
            ("lift", "prismatic", "0.2 0 0", "0 0 1", 'joint="motor" multiplier="0.02"'),
        ).replace("</robot>", MOTOR + "</robot>"),
        ("motor",),
    ),
    "a motor off the chain moves a slide": (
        chain(
            ("lift", "prismatic", "0.2 0 0", "0 0 1", 'joint="motor" multiplier="0.02"'),
            ("a", "revolute", "0 0 0.1", "0 1 0", ""),
        ).replace("</robot>", MOTOR + "</robot>"),
        ("motor", "a"),
    ),
    "it does not move": (
        chain(
            ("a", "revolute", "0 0 0.1", "0 0 1", ""),
            ("b", "revolute", "0.2 0 0", "0 1 0", 'joint="a" multiplier="0" offset="0.4"'),
            ("c", "revolute", "0.2 0 0", "0 1 0", ""),
        ),
        ("a", "c"),
    ),
}


def imported(tmp_path, text, end=""):
    (tmp_path / "r.urdf").write_text(text)
    return arm(
        tmp_path / "r.urdf",
        "l0",
        end or max(link for link in Urdf(text).parent if link[1:].isdigit()),
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_a_mimic_is_one_driven_joint_with_factor_and_offset(name, tmp_path):
    text, joints = ROBOTS[name]
    found = imported(tmp_path, text)
    model, end = found.model, found.model.frames["platform"]
    assert model.joints == joints
    assert difference(model, Urdf(text), "l0", end) < 1e-12
    again = parse_model(dump_model(model), "m.yaml")
    assert again.mechanism.joint_units == model.mechanism.joint_units
    assert difference(again, Urdf(text), "l0", end) < 1e-12
    k = Kinematics(model)
    q = np.array(model.mechanism.home.joints) + 0.02
    pose = k.direct(q)
    assert k.inverse(pose.position, pose.rotation).joints == pytest.approx(q, abs=1e-6)


def test_the_angle_of_both_joints_by_hand(tmp_path):
    model = imported(tmp_path, ROBOTS["one"][0]).model
    pose = Kinematics(model).direct([0.3])
    assert Rotation.from_matrix(pose.rotation).as_rotvec() == pytest.approx([0, 0, 0.3 + 0.7])
    assert pose.position == pytest.approx([0.1 * np.cos(0.3), 0.1 * np.sin(0.3), 0])


def test_what_follows_is_said_and_keeps_its_limits(tmp_path):
    """b stands at 2 a + 0.1 within +-3 and turns with at most 2 rad/s."""
    found = imported(tmp_path, ROBOTS["one"][0])
    assert "b follows a (2 a + 0.1 rad); the factor link2.by_link1 is fixed" in found.remarks
    assert any(remark.startswith("a is limited to -1.55 to 1.45 rad") for remark in found.remarks)
    assert found.model.mechanism.joint_limits == pytest.approx(np.array([[-1.55, 1.45]]))
    assert found.model.mechanism.joint_rates[0][0] == 1.0
    off = imported(tmp_path, ROBOTS["the master is off the chain"][0])
    assert "b follows motor, which is not on the chain (0.5 motor + 0.1 rad)" in off.remarks
    narrow = chain(("b", "revolute", "0 0 0", "0 0 1", 'joint="motor" multiplier="2"'))
    text = narrow.replace("</robot>", MOTOR + "</robot>")
    assert imported(tmp_path, text).model.mechanism.joint_limits == ((-1.5, 1.5),)


@pytest.mark.parametrize(
    ("mimic", "words"),
    [
        ('joint="x"', "joint 'b': mimic names the joint 'x', which the file does not have; expect"),
        ('joint="b"', "joint 'b': mimic: b follows b: remove one of these mimics"),
        ('multiplier="2"', "joint 'b': mimic names the joint '', which the file does not have"),
        ('joint="a" multiplier="two"', "joint 'b': mimic multiplier is 'two', expected a number"),
        ('joint="a" offset=""', "joint 'b': mimic offset is '', expected a number"),
    ],
)
def test_a_mimic_that_makes_no_sense_is_refused(mimic, words, tmp_path):
    with pytest.raises(ParallelCalError, match=words):
        imported(tmp_path, ROBOTS["one"][0].replace(TWICE, mimic))


def test_a_fixed_master_and_a_circle_are_refused(tmp_path):
    fixed = ROBOTS["one"][0].replace('name="a" type="revolute"', 'name="a" type="fixed"')
    with pytest.raises(
        ParallelCalError, match="names the joint 'a', which is fixed; expected a rev"
    ):
        imported(tmp_path, fixed)
    circle = ROBOTS["mimic of a mimic"][0].replace(TWICE, 'joint="c"')
    with pytest.raises(ParallelCalError, match="mimic: b follows c follows b: remove one"):
        imported(tmp_path, circle)


def test_a_link_without_a_joint_has_no_offset():
    with pytest.raises(
        ParallelCalError, match=r"base: offset is .*, expected none without a joint"
    ):
        load_mechanism("serial", links=[FANUC[0] | {"offset": 0.1}, *FANUC[1:]])


def test_an_arm_controls_what_it_can_move(tmp_path):
    """A lift rises and turns."""
    lift = chain(
        ("lower", "prismatic", "0 0 0", "0 0 1", ""),
        ("upper", "prismatic", "0 0 0", "0 0 1", 'joint="lower"'),
        ("turn", "revolute", "0.3 0 0", "0 0 1", ""),
    )
    found = imported(tmp_path, lift)
    assert found.model.joints == ("lower", "turn")
    assert found.model.mechanism.controls == ("z", "rz")
    assert "the arm controls z, rz: other coordinates follow from them" in found.remarks


# ------------------------------------------------------------------ driven_by, by hand

FANUC = (
    {"joint": None, "axes": "coincident"},
    {"joint": "R", "axes": "perpendicular", "alpha": -np.pi / 2, "d": 0.4, "a": 0.3},
    {"joint": "R", "axes": "parallel", "theta": -np.pi / 2, "a": 0.8},
    {"joint": "R", "a": 0.6, "driven_by": {"link3": 1, "link2": -1}},
)


def test_a_joint_may_be_driven_by_several_readings():
    """A forearm whose angle counts from the horizontal; J3 alone keeps it parallel."""
    coupled = new_model(load_mechanism("serial", links=FANUC))
    own = [{k: v for k, v in link.items() if k != "driven_by"} for link in FANUC]
    plain = new_model(load_mechanism("serial", links=own))
    for q in np.random.default_rng(2).uniform(-1, 1, (5, 3)):
        one = Kinematics(coupled).direct(q)
        other = Kinematics(plain).direct([q[0], q[1], q[2] - q[1]])
        np.testing.assert_allclose(one.position, other.position, atol=1e-14)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-14)
    assert coupled.table.names[-1] == "link3.by_link2"
    assert coupled.fixed[-1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"driven_by": {"link9": 1}},
            "link3: driven_by names link9, expected links whose joints h",
        ),
        ({"driven_by": {"link2": 0}}, "link3: the factor of link2 in driven_by is 0"),
        ({"driven_by": {"link2": "a"}}, "link3: driven_by link2 is 'a', expected a number"),
        ({"driven_by": {}}, "link3: driven_by is {}, expected names of links with factors"),
        ({"driven_by": "link2"}, "link3: driven_by is 'link2', expected names of links with fact"),
        ({"offset": "a"}, "link3: offset is 'a', expected a number in rad or m"),
        (
            {"driven_by": {"link2": 1}, "reading": "rad/s"},
            "link3: reading is 'rad/s', expected rad",
        ),
    ],
)
def test_a_drive_that_makes_no_sense_is_refused(change, words):
    links = [dict(link) for link in FANUC]
    links[-1] |= change
    with pytest.raises(ParallelCalError, match=words):
        load_mechanism("serial", links=links)


def measured(tmp_path, text, end, joints, n=40, noise=2e-5):
    """A table of poses by another program."""
    rng, urdf = np.random.default_rng(5), Urdf(text)
    rows = []
    for q in rng.uniform(-1.2, 1.2, (n, len(joints))):
        T = urdf.pose("l0", end, dict(zip(joints, q, strict=True)))
        turn = Rotation.from_rotvec(rng.normal(size=3) * noise) * Rotation.from_matrix(T[:3, :3])
        rows.append([*q, *(T[:3, 3] + rng.normal(size=3) * noise), *turn.as_quat()])
    header = ",".join([*(f"{j} [rad]" for j in joints), "x [m]", "y [m]", "z [m]", "qx,qy,qz,qw"])
    (tmp_path / "t.csv").write_text(
        "\n".join([header, *(",".join(map(repr, map(float, r))) for r in rows)]) + "\n"
    )
    return tmp_path / "t.csv"


def test_a_wrong_factor_is_identified_when_it_is_freed(tmp_path):
    model = imported(tmp_path, PALLETIZER).model
    real = PALLETIZER.replace('multiplier="-1"', 'multiplier="-1.003"').replace(
        "0 0 0.5", "0.001 0 0.5"
    )
    table = measured(tmp_path, real, "l4", model.joints)
    data = pc.load_dataset(table, mechanism=model.mechanism)
    held = pc.fit(model, data)
    freed = pc.fit(model, data, free=["link3.by_link2"])
    factor = model.table.names.index("link3.by_link2")
    assert not held.free[factor]
    assert held.model.values[factor] == -1
    assert freed.model.values[factor] == pytest.approx(-1.003, abs=2e-4)
    assert freed.held_out.summary.position_rms < 1e-4 < held.held_out.summary.position_rms
