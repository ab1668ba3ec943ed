"""The chain between two links of a URDF becomes an arm of DH and Hayati links; or one line."""

from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.cli import main as cli
from parallel_cal.identification.completeness import compute_completeness
from parallel_cal.importing.urdf import arm
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model

QUARTER = "1.5707963267948966"


def joint(name, kind, parent, child, xyz="0 0 0", rpy="0 0 0", axis="0 0 1", limit=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def robot(*joints):
    return f'<?xml version="1.0"?>\n<robot name="r">{"".join(joints)}</robot>\n'


TURN = '<limit lower="-2.5" upper="1.5" velocity="3.1" effort="1"/>'
# As Universal Robots publish it, a UR5: shoulder, three parallel axes, wrist.
UR5 = robot(
    joint("mount", "fixed", "world", "base", "0 0 0.3", "0 0 3.141592653589793"),
    joint("pan", "revolute", "base", "shoulder", "0 0 0.089159", limit=TURN),
    joint("lift", "revolute", "shoulder", "upper", "0 0.13585 0", f"0 {QUARTER} 0", "0 1 0", TURN),
    joint("elbow", "revolute", "upper", "fore", "0 -0.1197 0.425", "0 0 0", "0 1 0", TURN),
    joint("wrist1", "revolute", "fore", "w1", "0 0 0.39225", f"0 {QUARTER} 0", "0 1 0", TURN),
    joint("wrist2", "revolute", "w1", "w2", "0 0.093 0", "0 0 0", "0 0 1", TURN),
    joint("wrist3", "continuous", "w2", "w3", "0 0 0.09465", "0 0 0", "0 1 0"),
    joint("flange", "fixed", "w3", "tool0", "0 0.0823 0", f"-{QUARTER} 0 0"),
    joint("camera", "fixed", "w3", "camera", "0 0.1 0.05", f"0 0 {QUARTER}"),
)
SCARA = robot(
    joint("first", "revolute", "base", "a", "0.1 0 0.3", limit=TURN),
    joint("second", "revolute", "a", "b", "0.25 0 0.05", limit=TURN),
    joint(
        "slide",
        "prismatic",
        "b",
        "c",
        "0.2 0 -0.1",
        "3.141592653589793 0 0",
        "0 0 1",
        '<limit lower="0.02" upper="0.12" velocity="0.5"/>',
    ),
    joint("roll", "continuous", "c", "d", "0 0 0.04"),
)


def forward(text, start, end, q):
    """Pose (4, 4) of `end` in `start` by plain products, q by joint name."""
    root = ElementTree.fromstring(text)
    into = {j.find("child").get("link"): j for j in root.iter("joint")}
    T, link = np.eye(4), end
    while link != start:
        part = into[link]
        step, moved = np.eye(4), np.eye(4)
        origin = part.find("origin")
        step[:3, 3] = np.array(origin.get("xyz").split(), float)
        turn = Rotation.from_euler("xyz", np.array(origin.get("rpy").split(), float))
        step[:3, :3] = turn.as_matrix()
        axis = np.array(part.find("axis").get("xyz").split(), float)
        axis /= np.linalg.norm(axis)
        if part.get("type") == "prismatic":
            moved[:3, 3] = axis * q[part.get("name")]
        elif part.get("type") != "fixed":
            moved[:3, :3] = Rotation.from_rotvec(axis * q[part.get("name")]).as_matrix()
        T, link = step @ moved @ T, part.find("parent").get("link")
    return T


@pytest.fixture
def file(tmp_path):
    def write(text):
        (tmp_path / "robot.urdf").write_text(text)
        return tmp_path / "robot.urdf"

    return write


def agrees(model, text, start, end, seed=1):
    """Largest difference (m, 1) of both evaluations at 20 configurations."""
    rng, worst = np.random.default_rng(seed), 0.0
    for _ in range(20):
        q = rng.uniform(-1.4, 1.4, len(model.joints))
        expected = forward(text, start, end, dict(zip(model.joints, q, strict=True)))
        found = Kinematics(model).direct(q)
        worst = max(
            worst,
            np.abs(found.position - expected[:3, 3]).max(),
            np.abs(found.rotation - expected[:3, :3]).max(),
        )
    return worst


@pytest.mark.parametrize(
    ("text", "start", "end"),
    [
        (UR5, "world", "tool0"),
        (UR5, "base", "camera"),
        (UR5, "shoulder", "w3"),
        (SCARA, "base", "d"),
    ],
)
def test_the_arm_is_where_the_urdf_puts_it(file, text, start, end):
    model = arm(file(text), start, end).model
    assert agrees(model, text, start, end) < 1e-12
    assert model.frames == {"base": start, "platform": end}


@pytest.mark.parametrize("seed", range(8))
def test_an_arm_of_any_shape_is_where_its_urdf_puts_it(file, seed):
    """Axes anywhere, some parallel, opposed, intersecting or the same; slides among them."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice(["revolute", "prismatic"], 6, p=[0.75, 0.25])
    joints = []
    for k, kind in enumerate(kinds):
        shift = rng.choice([0, 0.1, -0.2], 3)
        turn = rng.choice([0, np.pi / 2, -np.pi / 2, np.pi, 0.7], 3)
        axis = rng.choice([0, 1, -1], 3)
        axis = axis if axis.any() else np.array([0, 0, 1])
        words = [" ".join(map(repr, v.tolist())) for v in (shift, turn, axis)]
        joints.append(joint(f"q{k}", kind, f"l{k}", f"l{k + 1}", *words, limit=TURN))
    text = robot(*joints)
    assert agrees(arm(file(text)).model, text, "l0", "l6") < 1e-12


def test_the_links_are_those_of_table_3_5(file):
    """Of the UR5: parallel where shoulder lift, elbow and wrist 1 are, DH elsewhere; complete."""
    model = arm(file(UR5), "base", "tool0").model
    free = {n.split(".")[0]: set() for n in model.table.names}
    for name in model.table.names:
        free[name.split(".")[0]].add(name.split(".")[1])
    hayati, dh = {"theta", "a", "alpha", "beta"}, {"theta", "d", "a", "alpha"}
    assert free["base"] == {"a", "b", "alpha", "beta"}  # the first axis is z of the base
    assert free["link1"] == free["link4"] == free["link5"] == dh
    assert free["link2"] == free["link3"] == hayati
    assert model.value("link2.a") == pytest.approx(0.425)
    assert model.value("link3.a") == pytest.approx(0.39225)
    for name, ends in ((UR5, ("world", "camera")), (SCARA, ("base", "d"))):
        counted = compute_completeness(arm(file(name), *ends).model.mechanism).document()
        assert counted["parameters"] == counted["needed"] == counted["rank"]


def test_limits_rates_and_names_are_the_urdfs(file):
    m = arm(file(SCARA)).model.mechanism
    assert m.joints == ("first", "second", "slide", "roll")
    assert m.joint_limits == ((-2.5, 1.5), (-2.5, 1.5), (0.02, 0.12), (-np.inf, np.inf))
    assert [rate[0] for rate in m.joint_rates] == [3.1, 3.1, 0.5, np.inf]
    assert m.joint_units == ("rad", "rad", "m", "rad")
    low, high = np.array(m.joint_limits).T
    assert ((m.home.joints > low) & (m.home.joints < high)).all()


def test_home_is_a_regular_configuration(file):
    """With all joints at zero, this wrist is stretched: `plan` found 11 poses for 30."""
    found = arm(file(UR5), "base", "tool0")
    home = np.array(found.model.mechanism.home.joints)
    assert found.remarks[-1].startswith("home is at ")
    assert "singular" in found.remarks[-1]
    step = 1e-6 * np.eye(6)
    poses = Kinematics(found.model).direct(np.vstack([home + step, home - step]))
    turns = rotation_vector(poses.rotation[:6] @ poses.rotation[6:].transpose(0, 2, 1))
    motion = np.hstack([poses.position[:6] - poses.position[6:], turns]) / 2e-6
    assert np.linalg.svd(motion, compute_uv=False)[-1] > 0.05
    stated = arm(file(UR5), "base", "tool0", home=[0.0] * 6)
    assert stated.model.mechanism.home.joints == (0.0,) * 6


def test_the_command_writes_a_model_that_is_read_again(file, tmp_path, capsys):
    words = ["new", "serial", "--from", str(file(UR5)), "--from-link", "base", "--to-link", "tool0"]
    for more in ([], ["--option", "home=[0, -1, 1, 0, 1, 0]"]):
        out = tmp_path / f"arm{len(more)}.yaml"
        with pytest.raises(SystemExit) as ended:
            cli.main([*words, *more, "-o", str(out)])
        assert ended.value.code == 0, capsys.readouterr().err
        model = read_model(out)
        assert agrees(model, UR5, "base", "tool0") < 1e-12
        assert model.mechanism.joint_limits[5] == (-np.inf, np.inf)
    assert model.mechanism.home.joints == (0, -1, 1, 0, 1, 0)
    with pytest.raises(SystemExit) as ended:
        cli.main(["new", "delta24", "--from", str(file(UR5)), "-o", str(tmp_path / "x.yaml")])
    assert ended.value.code == 2


def test_a_link_that_no_joint_moves_is_no_end_of_the_chain(file):
    """As ROS-Industrial's files have it: the base's own frame is a leaf, and so is a flange."""
    frame = joint("frame", "fixed", "base", "base_frame")
    again = UR5.replace("</robot>", frame + "</robot>")
    with pytest.raises(ParallelCalError, match="the chain may end in camera, tool0: choose"):
        arm(file(again))
    tool = joint("hand", "fixed", "tool0", "gripper")
    found = arm(file(again.replace("</robot>", tool + "</robot>")))
    assert found.model.frames == {"base": "world", "platform": "gripper"}
    assert found.remarks[0] == "the chain ends in gripper; camera can be chosen with --to-link"
    assert arm(file(SCARA.replace("</robot>", frame + "</robot>"))).model.frames["platform"] == "d"


def test_fingers_that_different_joints_move_are_offered(file):
    fingers = [joint(f"f{k}", "revolute", "tool0", f"finger{k}", limit=TURN) for k in (1, 2)]
    with pytest.raises(ParallelCalError) as error:
        arm(file(UR5.replace("</robot>", "".join(fingers) + "</robot>")))
    assert "may end in camera, finger1, finger2: choose one with --to-link" in str(error.value)


def test_limits_of_0_and_0_state_no_limits(file):
    zero = '<limit lower="0" upper="0" velocity="3.1" effort="1"/>'
    found = arm(file(UR5.replace(TURN, zero, 2)), "", "tool0")
    m = found.model.mechanism
    assert m.joint_limits[:3] == ((-np.inf, np.inf), (-np.inf, np.inf), (-2.5, 1.5))
    assert found.remarks[0].startswith("the limits of pan, lift are 0 to 0, which does not state")
    slide = '<limit lower="0.02" upper="0.12" velocity="0.5"/>'
    stands = arm(file(SCARA.replace(slide, zero))).model.mechanism.joint_limits[2]
    assert stands[0] < stands[1]
    assert np.isfinite(stands).all()


@pytest.mark.parametrize(
    "before", ["\n", "\r\n\r\n", "<!-- by xacro -->\n", "\ufeff", "\ufeff\n", "String value is: "]
)
def test_what_precedes_the_declaration_does_not_matter(tmp_path, before):
    for name, text in (("plain.urdf", SCARA), ("other.urdf", before + SCARA)):
        (tmp_path / name).write_bytes(text.encode("utf-8"))
    plain, other = (arm(tmp_path / name).model for name in ("plain.urdf", "other.urdf"))
    assert other.values.tolist() == plain.values.tolist()
    assert other.joints == plain.joints


BROKEN = {
    "leaves": ("", "", ("", ""), "the chain may end in camera, tool0: choose one with --to-link"),
    "no link": ("", "", ("base", "hand"), "no link 'hand', expected one of base, camera, fore"),
    "other way": ("", "", ("camera", "tool0"), "link 'tool0' does not descend from link 'camera'"),
    "one": ("", "", ("tool0", "tool0"), "'tool0' and 'tool0' are the same link"),
    "fixed": ("", "", ("w3", "tool0"), "no joint moves between 'w3' and 'tool0'"),
    "number": ("0.425", "O.425", ("", "tool0"), "joint 'elbow': xyz is '0 -0.1197 O.425', exp"),
    "axis": ('axis xyz="0 1 0"', 'axis xyz="0 0 0"', ("", "tool0"), "joint 'lift': axis xyz is '0"),
    "limit": ('upper="1.5"', "", ("", "tool0"), "joint 'pan': limit upper is '', expected a num"),
    "type": ('"continuous"', '"floating"', ("", "tool0"), "joint 'wrist3': type 'floating', expec"),
    "xml": ("</robot>", "", ("", ""), "not a URDF: no element found: line 3, column 0"),
    "other": ("robot", "sdf", ("", ""), "not a URDF: expected <robot> with <joint>s, found <sdf>"),
    "child": ('<child link="fore"/>', "", ("", "tool0"), "joint 'elbow': no parent or child link"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_named_with_its_joint(file, name):
    old, new, ends, message = BROKEN[name]
    with pytest.raises(ParallelCalError) as error:
        arm(file(UR5.replace(old, new) if old else UR5), *ends)
    assert message in str(error.value)
    assert "robot.urdf" in str(error.value)
