"""Closed chains from MJCF, SDF and URDF with loops, and their numbers written back."""

import re

import linkage_files as own
import numpy as np
import pytest
from scipy.optimize import fsolve

import parallel_cal as pc
from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.exporting.export import export_into
from parallel_cal.importing import closed_chain
from parallel_cal.importing.closed_chain import chain
from parallel_cal.importing.compound_joints import product_of_joints
from parallel_cal.importing.linkage import LinkageJoint, locked_value
from parallel_cal.kinematics.kinematics import Kinematics

ANGLES = np.random.default_rng(0).uniform(-0.4, 0.4, (30, 2))
NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")


def written(tmp_path, name, text, loops=""):
    path = tmp_path / name
    path.write_text(text)
    if loops:
        (tmp_path / "robot.yaml").write_text(loops)
    return path


def five_bars(tmp_path):
    """Return every file of the five-bar with its base, and the readings where it is drawn."""
    drawn, zero = np.array([own.LEFT, own.RIGHT]), np.zeros(2)
    for folder in ("mjcf", "sdf", "listed", "constraint"):
        (tmp_path / folder).mkdir()
    return {
        "mjcf": (written(tmp_path / "mjcf", "model.xml", own.FIVE_BAR_MJCF), "frame", drawn),
        "sdf": (written(tmp_path / "sdf", "model.sdf", own.five_bar_sdf()), "world", zero),
        "listed": (
            written(tmp_path / "listed", "robot.urdf", own.five_bar_urdf(""), own.LOOP_FILE),
            "frame",
            zero,
        ),
        "constraint": (
            written(tmp_path / "constraint", "arm.urdf", own.five_bar_urdf(own.CONSTRAINT)),
            "frame",
            zero,
        ),
    }


KINDS = ("mjcf", "sdf", "listed", "constraint")
WRITTEN = [pytest.param(kind, marks=pytest.mark.wide if kind != "mjcf" else ()) for kind in KINDS]


@pytest.mark.parametrize("kind", KINDS)
def test_a_five_bar_moves_as_its_circles_intersect(tmp_path, kind):
    path, base, drawn = five_bars(tmp_path)[kind]
    model = chain([path], base, "tip", ["left", "right"]).model
    found = Kinematics(model).direct(drawn + ANGLES)
    expected = [own.five_bar_tip(own.LEFT + a, own.RIGHT + b) for a, b in ANGLES]
    assert model.joints == ("left", "right")
    assert np.abs(found.position[:, :2] - expected).max() < 1e-12
    assert np.abs(found.position[:, 2]).max() < 1e-12


def masked(text):
    """Return a text without its numbers; an MJCF gets a pose where it was the identity."""
    return NUMBER.sub("#", re.sub(r'\s+(pos|quat)="[^"]*"', "", text))


@pytest.mark.parametrize("kind", WRITTEN)
def test_identified_numbers_go_into_the_file_and_nothing_else_changes(tmp_path, kind):
    path, base, drawn = five_bars(tmp_path)[kind]
    model = chain([path], base, "tip", ["left", "right"]).model
    rng = np.random.default_rng(4)
    step = np.where(model.fixed, 0.0, rng.normal(size=len(model.values)) * model.table.tolerance)
    better = model.with_values(model.values + step)
    before = path.read_text()
    done = export_into(better, {"mjcf": "mjcf", "sdf": "sdf"}.get(kind, "urdf"), [path])
    again = chain([path], base, "tip", ["left", "right"]).model
    one, other = (Kinematics(m).direct(drawn + ANGLES) for m in (better, again))
    nominal = Kinematics(model).direct(drawn + ANGLES)
    assert np.abs(one.position - other.position).max() < 1e-11
    assert np.abs(one.position - nominal.position).max() > 1e-4
    assert path.with_name(path.name + ".previous").read_text() == before
    assert masked(path.read_text()) == masked(before)
    assert "changed" in done.remarks[0]


def test_a_ball_that_closes_a_loop_of_a_urdf_is_written_into_both_of_its_links(tmp_path):
    """A link has the frame of its joint: what else is on it moves the other way."""
    path = written(tmp_path, "robot.urdf", own.spatial_urdf(), own.SPATIAL_LOOP)
    model = chain([path], "base", "tip").model
    assert "ball.b_x" in model.table.names
    changes = {
        f"ball.{side}_{axis}": value
        for side, axis, value in (
            ("a", "x", 0.004),
            ("a", "z", -0.002),
            ("b", "x", 0.003),
            ("b", "y", 0.002),
            ("b", "z", -0.005),
        )
    }
    values = {name: model.value(name) + change for name, change in changes.items()}
    better = model.with_values(model.table.vector(values))
    export_into(better, "urdf", [path])
    again = chain([path], "base", "tip").model
    one, other, before = (Kinematics(each).direct(0.3 * ANGLES) for each in (better, again, model))
    assert one.ok.all()
    assert np.abs(one.position - other.position).max() < 1e-11
    assert np.abs(one.rotation - other.rotation).max() < 1e-10
    assert np.abs(one.position - before.position).max() > 1e-3


def test_a_strut_whose_reading_falls_as_it_grows_is_written_where_it_hangs(tmp_path):
    """Its slide hangs on a ball that the file has as a hinge and a ball 0.05 m along its axis."""
    path = written(tmp_path, "robot.urdf", own.STRUT_URDF, own.STRUT_LOOP)
    model = chain([path], "base", "tip").model
    assert model.mechanism.skeleton.joints[1].type == "universal"
    q = np.linspace(-0.02, 0.03, 6)[:, None]
    found = Kinematics(model).direct(q)
    expected = [own.lever_tip(*reading) for reading in q]
    assert np.abs(found.position[:, :2] - expected).max() < 1e-12
    step = {"holder_hinge.x": 1e-3, "holder_hinge.y": -2e-3, "motor.zero": 5e-4}
    better = model.with_values(
        model.table.vector({name: model.value(name) + change for name, change in step.items()})
    )
    export_into(better, "urdf", [path])
    again = chain([path], "base", "tip").model
    one, other = (Kinematics(each).direct(q) for each in (better, again))
    assert np.abs(one.position - found.position).max() > 1e-3
    assert np.abs(one.position - other.position).max() < 1e-11


def foot_by_hand(left, right):
    """Solve both rod lengths of the ankle for pitch and roll; return the toe in the shank."""

    def foot(pitch, roll):
        return rotation_matrix(np.array([0, pitch, 0])) @ rotation_matrix(np.array([roll, 0, 0]))

    def gaps(x):
        heels = np.array([[-0.05, 0.035, 0], [-0.05, -0.035, 0]])
        cranks = [
            np.array([0, y, z]) + rotation_matrix(np.array([0, q, 0])) @ [-0.05, 0, 0]
            for y, z, q in ((0.035, 0.25, left), (-0.035, 0.2, right))
        ]
        return [
            np.linalg.norm(foot(*x) @ heel - crank) - length
            for heel, crank, length in zip(heels, cranks, (0.25, 0.2), strict=True)
        ]

    return foot(*fsolve(gaps, [0, 0], xtol=1e-13)) @ [0.1, 0, -0.03]


def test_an_ankle_with_rods_of_an_mjcf_moves_as_its_rod_lengths_demand(tmp_path):
    found = chain([written(tmp_path, "ankle.xml", own.ANKLE_MJCF)], platform="toe")
    model = found.model
    assert model.frames == {"base": "shank", "platform": "toe"}
    assert model.mechanism.passive == ("pitch", "roll")
    assert {f"{rod}.length" for rod in ("left_bar", "right_bar")} <= {*model.table.names}
    expected = [foot_by_hand(*row) for row in ANGLES]
    assert np.abs(Kinematics(model).direct(ANGLES).position - expected).max() < 1e-9


def test_the_mass_of_a_rod_is_shared_by_the_bodies_at_its_ends(tmp_path):
    """Its centre is 0.1 m from the crank's ball, of 0.25 m to the heel's."""
    ball = '<joint name="left_ball" type="ball"/>'
    inertial = '<inertial mass="0.5" pos="0.01 0 -0.1" diaginertia="1 1 1"/>'
    text = own.ANKLE_MJCF.replace(ball, ball + inertial)
    mechanism = chain([written(tmp_path, "ankle.xml", text)], platform="toe").model.mechanism
    assert mechanism.masses == pytest.approx({"left_crank": 0.3, "foot": 0.2})
    given = mechanism.options["masses"]
    assert given["left_crank"]["centre"] == pytest.approx([-0.05, 0, 0])
    assert given["foot"]["centre"] == pytest.approx([-0.05, 0.035, 0])


BOOM = """<mujoco><worldbody>
  <body name="boom" pos="0 0 0.5"><joint name="hip" type="hinge" axis="0 -1 0"/>
    <inertial mass="8" pos="0.4 0 0.05" diaginertia="1 1 1"/>
    <site name="eye" pos="0.5 0 -0.1"/><site name="tip" pos="1 0 0"/></body>
  <body name="cross" pos="0.2 0 0"><joint name="foot1" type="hinge" axis="0 1 0"/>
    <inertial mass="0.5" pos="0 0 0" diaginertia="1 1 1"/>
    <body name="gimbal"><joint name="foot2" type="hinge" axis="1 0 0"/>
      <body name="cylinder" euler="0 36.86989764584402 0"><joint name="foot3" type="hinge"/>
        <inertial mass="3" pos="0.02 0 0.15" diaginertia="1 1 1"/>
        <body name="piston" pos="0 0 0.3"><joint name="ram" type="slide" axis="0 0 1"/>
          <inertial mass="2" pos="0 0 0.1" diaginertia="1 1 1"/><site name="head" pos="0 0 0.2"/>
</body></body></body></body></worldbody>
<equality><connect site1="head" site2="eye"/></equality>
<actuator><position joint="ram"/></actuator></mujoco>"""


def test_both_halves_of_a_strut_weigh_on_it_where_they_are(tmp_path):
    """The cylinder's centre is 0.15 m from the foot, the piston's 0.1 m from the eye of the boom.
    The force on the strut is what all weights lose in height per metre of it."""
    chain_read = chain([written(tmp_path, "boom.xml", BOOM)], platform="tip").model
    m = chain_read.mechanism
    links = {"boom": 8.0, "cylinder": 3.0, "piston": 2.0, "world": 0.5}  # the cross is at the foot
    assert m.masses == pytest.approx(links)
    at = m.options["masses"]
    assert at["cylinder"] == {
        "mass": 3.0,
        "rod": "ram",
        "end": "a",
        "distance": pytest.approx(0.15),
    }
    assert at["piston"] == {"mass": 2.0, "rod": "ram", "end": "b", "distance": pytest.approx(0.1)}
    foot = np.array([0.2, 0.5])  # below the hip, which is the origin here

    def heights(angle):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        eye, boom = turn @ [0.5, -0.1] + [0, 0.5], turn @ [0.4, 0.05]
        along = eye - foot * [1, 0]
        length = np.linalg.norm(along)
        up = along[1] / length
        return length, 8 * boom[1] + 3 * 0.15 * up + 2 * (length - 0.1) * up

    (one, low), (two, high) = heights(0.2 - 1e-5), heights(0.2 + 1e-5)
    force = -9.81 * (high - low) / (two - one)
    plain = Kinematics(chain_read)
    model = chain_read.with_effect("own_weight_sag")
    sizes = {"own_weight_sag.ram.compliance": 1e-7}
    yields = Kinematics(model.with_values(model.table.vector(sizes)))
    reading = heights(0.2)[0] - 0.5  # the strut is 0.5 m long in the drawing
    expected = plain.direct([reading + 1e-7 * force]).position
    assert yields.direct([reading]).position == pytest.approx(expected, abs=1e-9)
    assert np.abs(expected - plain.direct([reading]).position).max() > 1e-5


def test_mujoco_reads_the_same_masses_from_an_mjcf(tmp_path):
    pytest.importorskip("mujoco")
    from parallel_cal.importing.mjcf import read_mjcf
    from parallel_cal.importing.mjcf_compiled import read_compiled_mjcf

    path = written(tmp_path, "boom.xml", BOOM)
    one, other = read_mjcf(path).masses, read_compiled_mjcf(path).masses
    assert set(one) == {"boom", "cross", "cylinder", "piston"} == set(other)
    for name, (mass, centre) in one.items():
        assert mass == pytest.approx(other[name][0])
        assert centre == pytest.approx(other[name][1])


def test_rod_lengths_balls_and_the_target_of_an_ankle_go_into_its_mjcf(tmp_path):
    path = written(tmp_path, "ankle.xml", own.ANKLE_MJCF)
    model = chain([path], platform="toe").model
    values = dict(zip(model.table.names, model.values, strict=True))
    for name, change in {
        "left_bar.length": 1e-3,
        "right_bar.length": -2e-3,
        "left_bar.a_x": 5e-4,
        "right_bar.b_y": 7e-4,
        "left.zero": 0.01,
        "right.z": 1e-3,
        "target.x": 2e-3,
    }.items():
        values[name] += change
    better = model.with_values(np.array([*values.values()]))
    export_into(better, "mjcf", [path])
    again = chain([path], platform="toe").model
    one, other = (Kinematics(m).direct(ANGLES).position for m in (better, again))
    assert np.abs(one - other).max() < 1e-11
    assert again.value("left_bar.length") == pytest.approx(0.251, abs=1e-12)
    assert again.value("right_bar.length") == pytest.approx(0.198, abs=1e-12)


def test_a_site_that_is_the_platform_and_the_end_of_a_loop_is_at_one_place(tmp_path):
    path = written(tmp_path, "ankle.xml", own.ANKLE_MJCF)
    model = chain([path], platform="left_heel").model
    shift = {"target.x": model.value("target.x") + 1e-3}
    apart = model.with_values(model.table.vector(shift))
    words = "'left_heel' is the platform and the end of a loop, which are 1 mm apart now"
    with pytest.raises(ModelError, match=words):
        export_into(apart, "mjcf", [path])
    end = {"left_bar.b_x": model.value("left_bar.b_x") + 1e-3}
    together = model.with_values(model.table.vector(shift | end))
    export_into(together, "mjcf", [path])
    again = chain([path], platform="left_heel").model
    one, other = (Kinematics(each).direct(ANGLES).position for each in (together, again))
    assert np.abs(one - other).max() < 1e-11


def test_the_joints_of_an_arm_without_loops_can_be_a_chain(tmp_path):
    path = written(tmp_path, "arm.urdf", own.five_bar_urdf(""))
    model = chain([path], platform="tip", driven=["left", "left_elbow"]).model
    a, b = 0.3, -0.2
    reached = Kinematics(model).direct(np.array([[a, b]])).position[0, :2]
    first, second = own.LEFT + a, own.LEFT + own.BENDS[0] + a + b
    by_hand = [
        -own.HALF + own.CRANK * np.cos(first) + own.ROD * np.cos(second),
        own.CRANK * np.sin(first) + own.ROD * np.sin(second),
    ]
    assert np.abs(reached - by_hand).max() < 1e-12


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name="left_elbow"/>', 'name="left_elbow" type="screw"/>', "type is 'screw'"),
        ('childclass="hinge"', 'childclass="hing"', "class 'hing' is not in <default>"),
        ('body2="right_rod"', 'body2="rod"', "there is no body 'rod'"),
        ('anchor="0.15 0 0"', 'anchor="0.15 0"', "anchor is '0.15 0', expected 3 numbers"),
        ('<site name="tip"', '<replicate count="2"/><site name="tip"', "MuJoCo"),
    ],
)
def test_an_element_of_an_mjcf_that_is_not_understood_is_named(
    tmp_path, monkeypatch, old, new, words
):
    monkeypatch.setattr(closed_chain, "find_spec", lambda name: None)
    text = own.FIVE_BAR_MJCF.replace(old, new)
    assert text != own.FIVE_BAR_MJCF
    path = written(tmp_path, "model.xml", text)
    with pytest.raises(DatasetError, match=re.escape(words)) as error:
        chain([path], "frame", "tip")
    assert re.search(r"model\.xml:\d+: <", str(error.value))


def test_unknown_names_are_refused_with_those_of_the_file(tmp_path):
    path = written(tmp_path, "model.xml", own.FIVE_BAR_MJCF)
    with pytest.raises(DatasetError, match="--driven wrong is no joint that can be driven"):
        chain([path], "frame", "tip", ["wrong"])
    with pytest.raises(DatasetError, match=r"platform 'nose' is not there.*left_rod"):
        chain([path], "frame", "nose")
    with pytest.raises(DatasetError, match=r"choose the body .* with --platform"):
        chain([path], "frame")


def test_a_joint_that_follows_another_one_is_refused_only_between_the_ends(tmp_path):
    follow = '<equality>\n    <joint joint1="right" joint2="left"/>'
    text = own.FIVE_BAR_MJCF.replace("<equality>", follow)
    path = written(tmp_path, "model.xml", text)
    with pytest.raises(DatasetError, match="joint 'right' follows joint 'left'"):
        chain([path], "frame", "tip", ["left", "right"])


def test_another_file_than_the_models_is_refused(tmp_path):
    path = written(tmp_path, "model.xml", own.FIVE_BAR_MJCF)
    model = chain([path], "frame", "tip").model
    path.write_text(own.FIVE_BAR_MJCF.replace('name="left_elbow"', 'name="knee"'))
    with pytest.raises(ModelError, match="it has knee and it lacks left_elbow"):
        export_into(model, "mjcf", [path])
    with pytest.raises(ModelError, match="give it with --into"):
        pc.export(model, "mjcf", tmp_path)


@pytest.mark.parametrize("rest", [0, 5])
def test_a_joint_locked_where_its_spring_rests_is_written_only_if_the_file_is_drawn_there(
    tmp_path, rest
):
    leaf = f'<joint name="leaf" pos="0.02 0 0" stiffness="100" springref="{rest}"/>'
    text = own.FIVE_BAR_MJCF.replace(
        '<joint name="left_elbow"/>',
        f"""<joint name="left_elbow"/>
            {leaf}""",
    )
    path = written(tmp_path, "model.xml", text)
    model = chain([path], "frame", "tip", ["left", "right"], locked=["leaf"]).model
    if not rest:
        export_into(model, "mjcf", [path])
        return
    with pytest.raises(ModelError, match=r"joint leaf is locked at 0\.0872665 rad, but the file"):
        export_into(model, "mjcf", [path])


def test_a_spring_that_rests_beyond_a_limit_holds_its_joint_there(tmp_path):
    leaf = '<joint name="leaf" pos="0.02 0 0" stiffness="1" springref="150" range="-10 20"/>'
    text = own.FIVE_BAR_MJCF.replace(
        '<joint name="left_elbow"/>', f'<joint name="left_elbow"/>{leaf}'
    )
    linkage = closed_chain.read_linkage([written(tmp_path, "model.xml", text)])
    leaf = next(joint for joint in linkage.joints if joint.name == "leaf")
    assert locked_value(leaf) == pytest.approx(np.radians(20))


def test_new_makes_a_chain_and_export_writes_its_numbers(tmp_path, run_cli):
    path = written(tmp_path, "model.xml", own.FIVE_BAR_MJCF)
    model = tmp_path / "model.yaml"
    ends = ["--base", "frame", "--platform", "tip"]
    out = run_cli("new", "--from", path, *ends, "--driven", "right,left", "-o", model)
    assert f"as in {path}" in out
    assert pc.read_model(model).joints == ("right", "left")
    out = run_cli("export", model, "--to", "mjcf", "--into", path)
    assert "no joint and no loop changed" in out
    assert path.read_text() == own.FIVE_BAR_MJCF


def test_a_file_that_draws_its_loops_open_is_closed_and_the_joints_at_home_are_stated(tmp_path):
    """The right rod is drawn 0.3 rad away from where it meets the left one."""
    bend = own.BENDS[1]
    turn = f'quat="{float(np.cos(bend / 2))!r} 0 0 {float(np.sin(bend / 2))!r}"'
    opened = f'quat="{np.cos(bend / 2 - 0.15):.17g} 0 0 {np.sin(bend / 2 - 0.15):.17g}"'
    assert turn in own.FIVE_BAR_MJCF
    anchored = f'body1="left_rod" body2="right_rod" anchor="{own.ROD} 0 0"'
    at_sites = own.FIVE_BAR_MJCF.replace(anchored, 'site1="tip" site2="other_tip"')
    said = {
        name: " ".join(chain([written(tmp_path, name, text)], "frame", "tip").remarks)
        for name, text in (("closed.xml", at_sites), ("open.xml", at_sites.replace(turn, opened)))
    }
    assert "open as the file draws them" not in said["closed.xml"]
    assert "at home they close with right_elbow 0.3 rad." in said["open.xml"]


@pytest.mark.parametrize("text", [own.FIVE_BAR_MJCF, own.ANKLE_MJCF])
def test_mujoco_reads_the_same_linkage_from_an_mjcf(tmp_path, text):
    pytest.importorskip("mujoco")
    from parallel_cal.importing.mjcf import read_mjcf
    from parallel_cal.importing.mjcf_compiled import read_compiled_mjcf

    path = written(tmp_path, "model.xml", text)
    one, other = read_mjcf(path), read_compiled_mjcf(path)
    assert [joint.name for joint in one.joints] == [joint.name for joint in other.joints]
    assert (one.roots, one.driven) == (other.roots, other.driven)
    for a, b in zip(one.joints, other.joints, strict=True):
        assert (a.kind, a.parent, a.child) == (b.kind, b.parent, b.child)
        assert np.allclose(a.origin, b.origin, rtol=0, atol=1e-12)
        assert np.allclose(a.anchor, b.anchor, rtol=0, atol=1e-12)
        assert np.allclose(a.axes, b.axes, rtol=0, atol=1e-12)
        assert a.limits == pytest.approx(b.limits)
        assert a.zero == pytest.approx(b.zero)
    for a, b in zip(one.loops, other.loops, strict=True):
        assert (a.name, a.kind, a.a.body, a.b.body) == (b.name, b.kind, b.a.body, b.b.body)
        assert np.allclose(a.a.frame[:3, 3], b.a.frame[:3, 3], rtol=0, atol=1e-9)
        assert np.allclose(a.b.frame[:3, 3], b.b.frame[:3, 3], rtol=0, atol=1e-9)


def listed_urdf(tmp_path, loops, urdf):
    return written(tmp_path, "robot.urdf", urdf, loops)


def test_a_chain_that_closes_with_other_readings_has_its_home_there(tmp_path):
    """At zero of both cranks the rods do not meet: each crank points away from the other one, and
    the rods nearly to one another."""
    text = own.five_bar_urdf("")
    turns = (own.LEFT, np.pi), (own.RIGHT, 0.0)
    bends = (own.BENDS[0], np.pi + 0.1), (own.BENDS[1], np.pi - 0.1)
    for angle, drawn in (*turns, *bends):
        text = text.replace(f"0 0 {angle!r}", f"0 0 {drawn!r}")
    text = text.replace(f'xyz="{own.ROD} 0 0"', 'xyz="0.14 0 0"')
    found = chain([listed_urdf(tmp_path, own.LOOP_FILE, text)], "frame", "tip")
    left, right = found.model.mechanism.home.joints
    one = np.array([-own.HALF, 0]) + own.CRANK * np.array([-np.cos(left), -np.sin(left)])
    other = np.array([own.HALF, 0]) + own.CRANK * np.array([np.cos(right), np.sin(right)])
    # At the nearest readings, the rods are in line: 0.28 m. Home is where they are not.
    assert np.linalg.norm(one - other) < 0.9 * 0.28
    assert Kinematics(found.model).direct([left, right] + 0.5 * ANGLES).ok.all()
    assert f"home is where the loops close next to the file's zero: left {left:.6g} rad" in (
        " ".join(found.remarks)
    )


def test_a_chain_that_is_drawn_where_it_is_singular_has_a_regular_home_beside_it(tmp_path):
    """Both cranks are upright, 0.1 m apart, and both rods of 0.05 m lie on the line between."""
    text = own.five_bar_urdf("")
    turns = (own.LEFT, np.pi / 2), (own.RIGHT, np.pi / 2)
    bends = (own.BENDS[0], -np.pi / 2), (own.BENDS[1], np.pi / 2)
    for angle, drawn in (*turns, *bends):
        text = text.replace(f"0 0 {angle!r}", f"0 0 {drawn!r}")
    text = text.replace(f'xyz="{own.ROD} 0 0"', 'xyz="0.05 0 0"')
    found = chain([listed_urdf(tmp_path, own.LOOP_FILE, text)], "frame", "tip")
    left, right = found.model.mechanism.home.joints
    apart = np.array([2 * own.HALF, 0]) + own.CRANK * (
        np.array([-np.sin(right), np.cos(right)]) - np.array([-np.sin(left), np.cos(left)])
    )
    assert np.linalg.norm(apart) < 0.095
    assert Kinematics(found.model).direct([left, right] + 0.1 * ANGLES).ok.all()
    said = " ".join(found.remarks)
    assert "where the chain is singular: left" in said
    assert "left_elbow" in said


def test_loops_that_close_nowhere_are_named_with_what_may_be_wrong(tmp_path):
    """The end of the right rod is twisted by 0.3 rad, which no hinge of the plane follows."""
    text = own.five_bar_urdf("").replace(
        f'<origin rpy="0 0 0" xyz="{own.ROD} 0 0"/>\n    <parent link="right_rod"/>',
        f'<origin rpy="0.3 0 0" xyz="{own.ROD} 0 0"/>\n    <parent link="right_rod"/>',
    )
    assert text != own.five_bar_urdf("")
    loops = own.LOOP_FILE.replace("3d", "6d")
    with pytest.raises(DatasetError) as error:
        chain([listed_urdf(tmp_path, loops, text)], "frame", "tip")
    assert "if these may move, too, from 30 starts" in str(error.value)
    assert re.search(r"join points only .*check left_pin_to_right_pin$", str(error.value))


def test_ends_of_loops_that_the_list_lacks_are_named(tmp_path):
    text = own.five_bar_urdf("").replace("left_pin", "pin1_A").replace("right_pin", "pin1_B")
    text = text.replace(
        "</robot>",
        '<link name="pin2_A"/><joint name="second" type="fixed"><parent link="frame"/>'
        '<child link="pin2_A"/></joint></robot>',
    )
    loops = own.LOOP_FILE.replace("left_pin, right_pin", "pin1_A, pin1_B")
    found = chain([listed_urdf(tmp_path, loops, text)], "frame", "tip")
    said = [words for words in found.remarks if "closed_loop does not list" in words]
    assert len(said) == 1
    assert "does not list pin2_A, which are named as the ends" in said[0]


@pytest.mark.parametrize(
    ("extra", "name", "words"),
    [
        ("", "spherical_elbow", "hinges named spherical are read as ball joints"),
        (
            "joint_name: [right_elbow_bal]\njoint_type: [SPHERICAL]\n",
            "right_elbow_ball",
            "no joint 'right_elbow_bal' of joint_name: read as 'right_elbow_ball'",
        ),
        ("joint_name: []\njoint_type: []\n", "spherical_elbow", ""),
        (
            "joint_name: [wheel]\njoint_type: [SPHERICAL]\n",
            "right_elbow",
            "no joint 'wheel' of joint_name: not read",
        ),
    ],
)
def test_ball_joints_of_a_loop_file_by_their_names(tmp_path, extra, name, words):
    text = own.five_bar_urdf("").replace('"right_elbow"', f'"{name}"')
    linkage = closed_chain.read_linkage([listed_urdf(tmp_path, own.LOOP_FILE + extra, text)])
    kind = next(joint.kind for joint in linkage.joints if joint.name == name)
    assert kind == ("spherical" if "read as" in words else "revolute")
    assert words in " ".join(linkage.remarks)


def test_a_hinge_whose_line_passes_through_a_ball_turns_about_its_centre():
    """The hinge is 0.05 m below the ball, on its axis."""
    up = np.eye(4)
    up[2, 3] = 0.05
    hinge = LinkageJoint("hinge", "revolute", "a", "b", np.eye(4), axes=(np.eye(3)[2],))
    ball = LinkageJoint("ball", "spherical", "b", "c", up)
    both = product_of_joints(hinge, ball, on_line=True)
    assert both.kind == "spherical"
    assert np.allclose((both.origin @ [*both.anchor, 1.0])[:3], [0, 0, 0.05], atol=1e-15)
