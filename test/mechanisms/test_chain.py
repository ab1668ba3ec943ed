"""A chain of bodies, joints and loops has the numbers worked by hand, and those of the shelf."""

from dataclasses import replace

import arms
import casadi as ca
import chains
import numpy as np
import pytest
from chains import make_chain, revolute
from marks import keep

import parallel_cal as pc
from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.base.rotation import matrix_to_quaternion, rotation_matrix, rotation_vector
from parallel_cal.kinematics.all_solutions import direct_all, inverse_all
from parallel_cal.model.declaration import check


def deg(*angles):
    return np.radians(angles)


# ---------------------------------------------------------------------- worked by hand


def test_both_cranks_upright_lift_the_tip_of_a_five_bar_to_the_height_of_the_triangle():
    model = make_chain(chains.five_bar(base=0.1, crank=0.1, bar=0.15))
    tip = pc.Kinematics(model).direct(deg(90, 90))
    # Elbows at x = -0.05 and 0.05, height 0.1; the rods make a triangle of height sqrt(0.02) m.
    assert tip.position == pytest.approx([0, 0.1 + np.sqrt(0.15**2 - 0.05**2), 0], abs=1e-12)
    # The left rod points from (-0.05, 0.1) to the tip; its joint is turned against the crank.
    along = np.arctan2(np.sqrt(0.02), 0.05)
    assert tip.passive[0] == pytest.approx(along - np.pi / 2, abs=1e-12)


def test_equal_motors_of_an_ankle_with_parallel_rods_pitch_the_foot_by_their_angle():
    model = make_chain(chains.ankle())
    found = pc.Kinematics(model).direct([[0.3, 0.3], [-0.2, -0.2]])
    assert rotation_vector(found.rotation) == pytest.approx(
        np.array([[0, 0.3, 0], [0, -0.2, 0]]), abs=1e-12
    )


def test_a_rod_of_balls_is_solved_by_its_distance():
    """The left rod joins (-0.05 cos q, 0.035, 0.25 + 0.05 sin q) with the foot's ball."""
    model = make_chain(chains.ankle())
    q = np.array([0.25, -0.1])
    R = pc.Kinematics(model).direct(q).rotation
    for angle, y, z in ((q[0], 0.035, 0.25), (q[1], -0.035, 0.2)):
        crank = [-0.05 * np.cos(angle), y, z + 0.05 * np.sin(angle)]
        assert np.linalg.norm(R @ [-0.05, y, 0] - crank) == pytest.approx(z, abs=1e-12)


def test_the_position_of_a_foot_that_only_turns_follows_its_parameters_if_it_is_stated_to_move():
    """Its origin is on the axes of the ankle by the drawing; the real ankle is 1 mm ahead."""
    for more, expected in (({}, 0.0), ({"moves": ["x", "y", "z", "rx", "ry", "rz"]}, 1e-3)):
        model = make_chain(chains.ankle() | more)
        ahead = model.with_values(model.table.vector({"ankle.x": 1e-3}))
        found = pc.Kinematics(ahead).direct([[0.0, 0.0], [0.3, -0.2]])
        assert found.position == pytest.approx(np.array([[expected, 0, 0]] * 2), abs=1e-12)


@pytest.mark.parametrize(
    ("kind", "home", "shift", "turn"),
    [
        ("prismatic", 0.2, [0, 0, 0.2], [0, 0, 0]),
        ("revolute", 0.2, [0, 0, 0], [0, 0, 0.2]),
    ],
)
def test_a_driven_joint_moves_its_child_along_or_about_its_axis(kind, home, shift, turn):
    joint = revolute("j", "base", "arm", driven=True, home=home) | {"type": kind}
    found = pc.Kinematics(make_chain({"base": "base", "platform": "arm", "joints": [joint]}))
    at = found.direct([home])
    assert at.position == pytest.approx(shift)
    assert rotation_vector(at.rotation) == pytest.approx(turn)


def test_an_anchor_turns_the_child_about_a_point_of_its_own():
    """A child at (1, 0, 0) turned by 90 degrees about its point (-1, 0, 0), the base's origin."""
    joint = revolute("j", "base", "arm", origin=[1, 0, 0], anchor=[-1, 0, 0], driven=True)
    kinematics = pc.Kinematics(make_chain({"base": "base", "platform": "arm", "joints": [joint]}))
    assert kinematics.direct([np.pi / 2]).position == pytest.approx([0, 1, 0], abs=1e-12)


def test_an_encoder_zero_adds_to_the_reading():
    joint = revolute("j", "base", "arm", driven=True, zero=0.5)
    at = pc.Kinematics(make_chain({"base": "base", "platform": "arm", "joints": [joint]}))
    assert rotation_vector(at.direct([0.1]).rotation) == pytest.approx([0, 0, 0.6])


def test_roll_pitch_and_yaw_are_those_of_urdf():
    joint = revolute("j", "base", "arm", driven=True, rpy=[0.1, 0.2, 0.3])
    at = pc.Kinematics(make_chain({"base": "base", "platform": "arm", "joints": [joint]}))
    x, y, z = (rotation_matrix(a * np.eye(3)[k]) for k, a in enumerate((0.1, 0.2, 0.3)))
    assert at.direct([0.0]).rotation == pytest.approx(z @ y @ x)


# ---------------------------------------------------------------------- descriptions of one robot


def same(one, other, q):
    return np.allclose(
        pc.Kinematics(make_chain(one)).direct(q).position,
        pc.Kinematics(make_chain(other)).direct(q).position,
        atol=1e-10,
        rtol=0,
    )


def test_a_joint_that_closes_a_loop_does_as_the_loop():
    """SDF joins both rods by a joint; MJCF by an equality."""
    given = chains.five_bar()
    closing = revolute("tip", "left_rod", "right_rod", origin=[0.15, 0, 0], anchor=[0.15, 0, 0])
    closing["origin"] = [0, 0, 0]  # both tips are at x = 0.15 of their rod
    other = given | {"joints": [*given["joints"], closing], "loops": []}
    assert same(given, other, [[2.0, 1.0], [2.4, 0.7]])


@pytest.mark.parametrize("ball", ["spherical", "universal"])
def test_a_rod_as_a_body_with_a_ball_and_a_point_is_a_distance(ball):
    given = chains.ankle()
    more = {"axes": [[1, 0, 0], [0, 1, 0]]} if ball == "universal" else {}
    link = {"name": "ball", "type": ball, "parent": "left_crank", "child": "left_link",
            "origin": [-0.05, 0, 0], **more}  # fmt: skip
    point = {"name": "connect", "type": "point",
             "a": {"body": "left_link", "point": [0, 0, -0.25]},
             "b": {"body": "foot", "point": [-0.05, 0.035, 0]}}  # fmt: skip
    other = given | {"joints": [*given["joints"], link], "loops": [point, given["loops"][1]]}
    model = make_chain(other)
    assert model.mechanism.passive == ("ankle.1", "ankle.2")
    assert model.value("left_link.length") == pytest.approx(0.25)
    q = [[0.2, -0.1], [0.0, 0.3]]
    rotations = [pc.Kinematics(make_chain(one)).direct(q).rotation for one in (given, other)]
    assert rotations[0] == pytest.approx(rotations[1], abs=1e-10)


def test_a_joint_may_be_passed_from_its_child_to_its_parent():
    """The base is the child of the file's joint: the platform moves the other way."""
    joint = revolute("j", "arm", "base", origin=[0.3, 0, 0], driven=True)
    at = pc.Kinematics(make_chain({"base": "base", "platform": "arm", "joints": [joint]}))
    found = at.direct([0.4])
    assert rotation_vector(found.rotation) == pytest.approx([0, 0, -0.4])
    assert found.position == pytest.approx([-0.3 * np.cos(0.4), 0.3 * np.sin(0.4), 0])


def test_an_idle_turn_is_held_and_named():
    """A leg between two balls and a slide turns about itself."""
    given = chains.from_stewart42(pc.new_model("stewart42"))
    leg = given["loops"][0]
    foot, top = leg["a"]["point"], leg["b"]["point"]
    up = (np.array([0, 0, 0.3]) + top - foot) / np.linalg.norm(np.array([0, 0, 0.3]) + top - foot)
    length, limits = leg["length"], leg["limits"]
    joints = [
        {"name": "foot", "type": "spherical", "parent": "base", "child": "barrel", "origin": foot,
         "home": [0.2, 0.1, 0.3]},
        {"name": "leg1", "type": "prismatic", "parent": "barrel", "child": "piston",
         "axis": up.tolist(), "origin": (length * up).tolist(), "driven": True,
         "home": leg["home"], "limits": limits},
    ]  # fmt: skip
    top_ball = {"name": "top", "type": "point", "a": {"body": "piston"},
                "b": {"body": "plate", "point": top}}  # fmt: skip
    other = given | {"joints": joints, "loops": [*given["loops"][1:], top_ball]}
    model = make_chain(other)
    assert model.mechanism.held == {"foot.3": 0.3}  # it rests where it is drawn
    assert "turn idly" in " ".join(model.mechanism.remarks)
    order = [model.joints.index(name) for name in pc.new_model("stewart42").joints]
    q = np.array(pc.new_model("stewart42").mechanism.home.joints) + 0.01 * np.arange(6)
    seen = np.empty(6)
    seen[order] = q
    expected = pc.Kinematics(pc.new_model("stewart42")).direct(q)
    assert pc.Kinematics(model).direct(seen).position == pytest.approx(expected.position, abs=1e-10)


# ---------------------------------------------------------------------- dependent rows


def turned(given, R):
    """Turn a robot by R: its base is in another plane."""

    foot = {"name": "mount", "type": "fixed", "parent": "world", "child": given["base"],
            "quaternion": matrix_to_quaternion(R).tolist()}  # fmt: skip
    more = {"base": "world", "joints": [foot, *given["joints"]], "moves": ["x", "y", "z"]}
    return given | more


def test_a_plane_loop_keeps_the_two_rows_of_its_plane_in_any_direction():
    R = rotation_matrix(np.array([0.4, -0.7, 0.3]))
    plane, tilted = make_chain(chains.five_bar()), make_chain(turned(chains.five_bar(), R))
    assert plane.structure.phi.shape[0] == 4  # two of the platform, two of the loop
    assert tilted.structure.phi.shape[0] == 5  # three of the platform
    assert tilted.mechanism.controls == ("x", "y")
    q = [[2.0, 1.0], [2.4, 0.7]]
    here, there = (pc.Kinematics(m).direct(q).position for m in (plane, tilted))
    assert there == pytest.approx(here @ R.T, abs=1e-10)


def test_parameters_that_only_dependent_rows_contain_are_fixed_and_named():
    model = make_chain(chains.five_bar())
    fixed = {name for name, held in zip(model.table.names, model.fixed, strict=True) if held}
    assert {"left.rx", "left.ry", "left.z", "right_elbow.rx", "tip.a_z"} <= fixed
    said = " ".join(model.mechanism.remarks)
    assert "3 of 7 rows" in said
    assert "only such rows contain them: tip (a_z b_z), left (z rx ry)" in said


def with_driven(driven):
    given = chains.five_bar()
    joints = [joint | {"driven": joint["name"] in driven} for joint in given["joints"]]
    return given | {"joints": joints}


def test_more_driven_joints_than_freedoms_are_named():
    home = make_chain(chains.five_bar()).mechanism.home
    given = with_driven(("left", "right", "left_elbow"))
    given["joints"][1]["home"] = home.passive[0]
    model = make_chain(given)
    said = " ".join(model.mechanism.remarks)
    assert "3 joints are driven, but the chain has 2 freedoms" in said
    assert "freedoms" not in " ".join(make_chain(chains.five_bar()).mechanism.remarks)


def test_a_chain_that_moves_with_locked_motors_is_refused_and_a_joint_that_moves_then_named():
    expected = "move in 1 of its 2 freedoms.*if right(_elbow)?, which moves most, rests"
    with pytest.raises(ModelError, match=expected):
        make_chain(with_driven(("left",)))


def test_a_home_with_both_rods_in_line_is_refused_with_a_regular_one():
    """Both cranks upright: 0.1 m between the elbows, and two rods of 0.05 m."""
    given = chains.five_bar(base=0.1, crank=0.1, bar=0.05)
    for joint, home in zip(given["joints"], deg(90, -90, 90, 90), strict=True):
        joint["home"] = home
    with pytest.raises(
        ModelError, match="singular at home: two assembly modes meet there"
    ) as error:
        make_chain(given)
    stated = str(error.value).partition("regular at ")[2].partition(": state these")[0]
    values = {part.split()[0]: float(part.split()[1]) for part in stated.split(", ")}
    for joint in given["joints"]:
        joint["home"] = values[joint["name"]]
    at_home = make_chain(given).mechanism.home
    elbows = [values[f"{side}_elbow"] for side in ("left", "right")]
    assert at_home.passive == pytest.approx(elbows, abs=1e-5)


def test_a_tilted_axis_of_a_plane_robot_still_closes():
    model = make_chain(chains.five_bar())
    off = model.with_values(model.table.vector({"left.rx": 0.02, "tip.a_z": 1e-3}))
    assert pc.Kinematics(off).direct([2.1, 1.0]).ok


def test_free_parameters_are_as_many_as_the_data_determine():
    """On the shelf they were counted by hand."""
    for name, convert in SHELF.items():
        shelf = SHELF_MODELS[name]()
        chain = make_chain(convert(shelf))
        extra = {"five_bar": 2}.get(name, 0)  # the place of the target on its rod
        assert np.sum(~chain.fixed) == np.sum(~np.asarray(shelf.fixed)) + extra, name


# ---------------------------------------------------------------------- the shelf as chains

SHELF_MODELS = {
    "five_bar": lambda: pc.new_model(
        pc.mechanisms.load("five_bar", base=0.1, crank=0.1, rod=0.15, home=[2.2, 0.9])
    ),
    "stewart42": lambda: pc.new_model("stewart42"),
    "delta54": lambda: pc.new_model("delta54"),
    "planar_stewart": lambda: pc.new_model("planar_stewart"),
    "rssr": lambda: pc.new_model("rssr", values={"a": 0.005}),
    "serial": lambda: arms.nominal("ur5"),
}
SHELF = {
    "five_bar": lambda model: chains.five_bar(),
    "stewart42": chains.from_stewart42,
    "delta54": chains.from_delta54,
    "planar_stewart": chains.from_planar_stewart,
    "rssr": chains.from_rssr,
    "serial": lambda model: chains.from_serial(model.mechanism),
}


@pytest.mark.parametrize("name", SHELF)
def test_a_robot_of_the_shelf_as_a_chain_has_the_same_solutions(name):
    shelf = SHELF_MODELS[name]()
    chain = make_chain(SHELF[name](shelf))
    one, other = pc.Kinematics(shelf), pc.Kinematics(chain)
    m, rng = shelf.mechanism, np.random.default_rng(0)
    joints = one.inverse(*m.poses(m.sample(100, rng)))
    joints = joints[joints.ok]
    poses, found = one.direct(joints.joints), other.direct(joints.joints)
    assert len(poses) > 90
    assert poses.ok.all()
    assert found.ok.all()
    assert found.position == pytest.approx(poses.position, abs=1e-10)
    assert found.rotation == pytest.approx(poses.rotation, abs=1e-10)
    back = other.inverse(poses.position, poses.rotation)
    assert back.ok.all()
    assert back.joints == pytest.approx(joints.joints, abs=1e-10)


@pytest.mark.parametrize("name", ["five_bar", "planar_stewart", "stewart42"])
@pytest.mark.parametrize("problem", ["direct", "inverse"])
def test_iterations_from_home_begin_at_its_expansion_of_second_order(name, problem):
    """At half the distance from home, an eighth of the error remains."""
    chain = make_chain(SHELF[name](SHELF_MODELS[name]()))
    kinematics, m = pc.Kinematics(chain), chain.mechanism
    home = np.array([*m.home.position, *m.home.rotation_vector])[m.controlled]
    step = 0.1 * (np.array(m.workspace.high) - home)
    left = []
    for share in (1.0, 0.5):
        pose = m.poses((home + share * step)[None])
        truth = kinematics.inverse(*pose).configuration.rows[0]
        begin = chains.find_start(kinematics, problem, truth)
        off = chain.configuration(begin).change_from(chain.configuration(truth))
        left.append(np.linalg.norm(off))
    assert 0 < left[0] < 1e-2
    assert left[1] == pytest.approx(left[0] / 8, rel=0.3)


# Parameters that the shelf does not have, or knows: each pair of models then has the same freedoms.
KNOWN = {
    "five_bar": ("target.*", "tip.a_?"),
    "stewart42": (),
    "delta54": ("joint?.zero", "joint?.rx", "rod*.b_?"),
    "delta51": ("joint?.[xyz]", "joint?.rx", "rod*.a_x"),
    "planar_stewart": (),
    "rssr": ("output.*", "input.[yz]", "input.r[yz]", "bar.a_[xy]", "bar.length"),
    "serial": (),
}
NOISE = {"position": 1e-6, "orientation": 1e-6, "joint": {"rad": 1e-7, "m": 1e-7}}


def pair(name):
    """A robot of the shelf, and the same as a chain, with noise and equal freedoms."""
    if name == "five_bar":
        chain = make_chain(chains.five_bar_with_pin())
    else:
        source = "delta54" if name == "delta51" else name
        chain = make_chain(SHELF[source](SHELF_MODELS[source]()))
    shelf = pc.new_model("delta51") if name == "delta51" else SHELF_MODELS[name]()
    fixed = chain.fixed
    if name == "delta54":
        # Its angles also turn the platform's balls, whose places in a chain it holds: a tie that no
        # choice of fixed coordinates of these balls states.
        shelf = replace(shelf, fixed=shelf.fixed | shelf.table.matching(["*.theta", "*.alpha"]))
    if name in ("delta51", "delta54", "rssr"):
        fixed = chain.table.matching(["target.*", *KNOWN[name]])
    elif KNOWN[name]:
        fixed = fixed | chain.table.matching(KNOWN[name])
    noise = pc.Noise(**NOISE)
    return replace(shelf, noise=noise), replace(chain, fixed=fixed, noise=noise)


def session_of(shelf, name):
    """A session of a robot that differs from its drawing."""
    rng, table = np.random.default_rng(5), shelf.table
    off = 0.3 * table.tolerance * rng.standard_normal(len(table))
    true = shelf.with_values(shelf.values + np.where(shelf.fixed, 0.0, off))
    data = pc.simulate(true, 80, seed=2).dataset()
    if name != "rssr":
        return data
    # The second encoder shows nothing but the turn about its axis.
    turn = rotation_matrix(rotation_vector(data.R) * [0, 0, 1])
    return pc.Dataset.from_arrays(
        data.joint_names, data.q, 0 * data.r, turn, measured=[False] * 5 + [True]
    )


@pytest.mark.wide
@pytest.mark.parametrize("name", keep(KNOWN, "delta54", "rssr", "serial"))
def test_a_robot_of_the_shelf_as_a_chain_has_the_same_fit(name):
    shelf, chain = pair(name)
    data = session_of(shelf, name)
    one, other = (pc.fit(model, data) for model in (shelf, chain))
    first, second = one.estimate, other.estimate
    assert second.spectrum.rank == first.spectrum.rank
    assert second.chi2_per_dof == pytest.approx(first.chi2_per_dof, rel=1e-5)
    rng, m = np.random.default_rng(6), shelf.mechanism
    q = np.array(m.home.joints) + 0.1 * np.minimum(m.joint_ranges, 1) * rng.uniform(
        -1, 1, (50, len(m.joints))
    )
    poses, found = (pc.Kinematics(fit.model).direct(q) for fit in (one, other))
    ok = poses.ok & found.ok
    assert ok.sum() > 40
    assert found.position[ok] == pytest.approx(poses.position[ok], abs=1e-9)
    assert found.rotation[ok] == pytest.approx(poses.rotation[ok], abs=1e-9)


# ---------------------------------------------------------------------- passive coordinates


class ElbowBar(pc.Mechanism):
    """A five-bar whose elbow angles are not eliminated; the right one turns the other way."""

    joints = ("left", "right")
    passive = ("left_rod", "right_rod")
    moves = controls = ("x", "y")
    parameters = pc.ParameterTable(
        pc.Parameter(f"{side}.{name}", "m", value, 2e-4)
        for side in ("left", "right")
        for name, value in (("crank", 0.1), ("rod", 0.15))
    )
    home = pc.Home((2.2, 0.9), (0.0, 0.19, 0.0), passive=(0.9, 2.2))
    workspace = pc.Workspace((-0.03, 0.16), (0.03, 0.22))
    joint_limits = ((1.0, 3.2), (0.0, 2.1))

    def closure(self, q, u, r, R, p):
        rows = []
        for i, (side, x) in enumerate((("left", -0.05), ("right", 0.05))):
            c, s = p[side], (ca.cos, ca.sin)
            rows += [
                r[k] - (x if k == 0 else 0) - c.crank * s[k](q[i]) - c.rod * s[k](u[i])
                for k in range(2)
            ]
        return ca.vertcat(*rows)


def test_a_mechanism_of_ones_own_with_passive_coordinates_is_solved_and_fitted():
    model = replace(pc.new_model(ElbowBar()), noise=pc.Noise(joint=1e-6, position=1e-6))
    at = pc.Kinematics(model).direct([[np.pi / 2, np.pi / 2]])
    assert at.position[0] == pytest.approx([0, 0.1 + np.sqrt(0.02), 0], abs=1e-12)
    along = np.arctan2(np.sqrt(0.02), 0.05)
    assert at.passive[0] == pytest.approx([along, np.pi - along], abs=1e-12)
    back = pc.Kinematics(model).inverse(at.position)
    assert back.joints == pytest.approx(at.joints, abs=1e-12)
    true = model.with_values(model.values + [1e-4, -2e-4, 3e-4, 1e-4])
    data = pc.simulate(true, 30, seed=1).dataset()
    found = pc.fit(model, data)
    assert found.model.values == pytest.approx(true.values, abs=3e-6)
    assert found.estimate.chi2_per_dof == pytest.approx(1, abs=0.4)
    # A table without a map does not state the noise.
    bare = pc.Dataset.from_arrays(data.joint_names, data.q, data.r)
    unstated = pc.fit(replace(model, noise=pc.Noise()), bare)
    assert unstated.observations.noise_assumed
    assert unstated.model.values == pytest.approx(true.values, abs=3e-6)


def test_a_home_without_passive_coordinates_is_refused():
    class Short(ElbowBar):
        home = pc.Home((2.2, 0.9), (0.0, 0.19, 0.0))

    with pytest.raises(ModelError, match=r"home\.passive has 0 entries, expected 2"):
        check(Short())


def test_the_uncertainty_of_a_pose_is_that_of_drawn_robots():
    chain = make_chain(chains.five_bar())
    size = 0.05 * chain.table.tolerance * ~np.asarray(chain.fixed)
    model = chain.with_values(chain.values, np.diag(size**2))
    kinematics, q, rng = pc.Kinematics(model), np.array([2.1, 1.0]), np.random.default_rng(0)
    sigma = np.sqrt(np.diag(kinematics.direct_covariance(kinematics.direct(q))))[:2]
    places = [
        pc.Kinematics(chain.with_values(chain.values + size * draw)).direct(q).position[:2]
        for draw in rng.standard_normal((200, len(size)))
    ]
    assert np.std(places, axis=0) == pytest.approx(sigma, rel=0.15)


def test_all_assembly_modes_are_those_of_the_closed_form():
    shelf, chain = SHELF_MODELS["five_bar"](), make_chain(chains.five_bar())
    modes, known = (direct_all(m, np.array([2.0, 1.0])) for m in (chain, shelf))
    assert modes.position == pytest.approx(known.position, abs=1e-10)
    pose = known.position[0]
    elbows, known = (inverse_all(m, pose) for m in (chain, shelf))
    assert elbows.joints == pytest.approx(known.joints, abs=1e-10)


def test_a_singularity_is_where_both_rods_are_in_line():
    """Elbows 0.3 m apart and rods of 0.15 m: the tip may leave their line on either side."""
    chain = make_chain(chains.five_bar())
    lean = np.arccos(0.1 / 0.1)  # cranks outwards: elbows at x = -0.15 and 0.15
    found = pc.Kinematics(chain).direct([np.pi - lean, lean])
    assert pc.Status(int(found.status)) == pc.Status.SINGULAR
    assert found.position == pytest.approx([0, 0, 0], abs=1e-6)


def test_a_model_file_of_a_chain_is_read_as_it_was_written(tmp_path):
    model = make_chain(chains.ankle())
    pc.write_model(model, tmp_path / "ankle.yaml")
    text = (tmp_path / "ankle.yaml").read_text()
    assert "passive: [0.0, 0.0]" in text
    again = pc.read_model(tmp_path / "ankle.yaml")
    assert again.table.names == model.table.names
    assert (again.fixed == model.fixed).all()
    assert again.mechanism.home == model.mechanism.home
    (tmp_path / "ankle.yaml").write_text(text.replace("passive: [0.0, 0.0]", "passive: [0.0]"))
    with pytest.raises(ModelFileError, match=r"passive.*one for each of ankle.1, ankle.2"):
        pc.read_model(tmp_path / "ankle.yaml")


# ---------------------------------------------------------------------- effects


def yielding(chain, effect, size):
    """A chain with a compliance of this size at every joint, or of every rod."""
    model = chain.with_effect(effect)
    names = [name for name in model.table.names if name.endswith(".compliance")]
    return model.with_values(model.table.vector(dict.fromkeys(names, size)))


def test_the_weight_of_a_payload_twists_a_motor_by_its_torque_times_the_compliance():
    """A level arm of 0.5 m with 2 kg: 2 kg * 9.81 m/s^2 * 0.5 m = 9.81 Nm, down."""
    joint = revolute("arm", "base", "link", driven=True) | {"axis": [0, -1, 0]}
    chain = make_chain(
        {"base": "base", "platform": "link", "target": [0.5, 0, 0], "joints": [joint]}
    )
    model = yielding(chain, "joint_compliance", 1e-4)
    found = pc.Kinematics(model).direct([0.0], {"payload": 2.0})
    drop = 1e-4 * 2 * 9.81 * 0.5
    assert found.position == pytest.approx([0.5, 0, -0.5 * drop], abs=1e-6)


def test_the_weight_on_an_ankle_twists_both_motors_as_virtual_work_says():
    """The torque on a motor is the weight times the height that the foot gains per angle."""
    given = chains.ankle() | {"target": [0.15, 0.02, -0.05]}
    chain, q = make_chain(given), np.array([0.2, -0.1])
    rigid = pc.Kinematics(chain)
    step = 1e-6 * np.eye(2)
    lift = [rigid.direct(q + s).position[2] - rigid.direct(q - s).position[2] for s in step]
    torque = -3.0 * 9.81 * np.array(lift) / 2e-6
    model = yielding(chain, "joint_compliance", 1e-5)
    found = pc.Kinematics(model).direct(q, {"payload": 3.0})
    assert found.ok
    assert found.position == pytest.approx(rigid.direct(q + 1e-5 * torque).position, abs=2e-8)


def test_a_mass_on_a_crank_acts_at_its_centre():
    given = chains.ankle() | {"target": [0.15, 0, 0]}
    masses = {"left_crank": {"mass": 4.0, "centre": [-0.1, 0, 0]}}
    chain = make_chain(given | {"masses": masses})
    model = yielding(chain, "joint_compliance", 1e-5)
    assert model.value("joint_compliance.mass.left_crank") == 4.0
    q = np.array([0.2, 0.1])
    # The left crank alone carries it: 4 kg at 0.1 m on the side -x, which the weight turns down.
    torque = np.array([-4.0 * 9.81 * 0.1 * np.cos(0.2), 0.0])
    expected = pc.Kinematics(chain).direct(q + 1e-5 * torque)
    found = pc.Kinematics(model).direct(q, {"payload": 0.0})
    assert found.rotation == pytest.approx(expected.rotation, abs=1e-8)


def heavy_ankle():
    """An ankle with a heavy left crank and a heavy foot."""
    masses = {
        "left_crank": {"mass": 4.0, "centre": [-0.1, 0, 0]},
        "foot": {"mass": 2.5, "centre": [0.06, 0.02, -0.04]},
    }
    return make_chain(chains.ankle() | {"target": [0.15, 0.05, -0.05], "masses": masses})


def weights_by_virtual_work(chain, q, tool=0.0):
    """The torques of the weights (N m): what their heights lose per angle of each motor."""
    on_foot = np.array([0.06, 0.02, -0.04]) - [0.15, 0.05, -0.05]

    def lost_energy(q):
        at = pc.Kinematics(chain).direct(q)
        crank = 0.1 * np.sin(q[0])  # it turns about y, so the mass on its side -x rises
        foot = at.position[2] + (at.rotation @ on_foot)[2]
        return -9.81 * (4.0 * crank + 2.5 * foot + tool * at.position[2])

    step = 1e-5 * np.eye(2)
    return np.array([lost_energy(q + s) - lost_energy(q - s) for s in step]) / 2e-5


@pytest.mark.parametrize("tool", [0.0, 1.5])
def test_known_masses_of_links_twist_the_motors_without_a_payload(tool):
    chain, q = heavy_ankle(), np.array([0.2, -0.1])
    model = yielding(chain, "own_weight_sag", 1e-5)
    model = model.with_values(
        np.where(np.array(model.table.names) == "own_weight_sag.tool", tool, model.values)
    )
    torque = weights_by_virtual_work(chain, q, tool)
    assert np.abs(torque).min() > 0.1
    expected = pc.Kinematics(chain).direct(q + 1e-5 * torque)
    found = pc.Kinematics(model).direct(q)
    assert found.position == pytest.approx(expected.position, abs=1e-8)
    assert np.abs(found.position - pc.Kinematics(chain).direct(q).position).max() > 1e-6


def test_links_of_a_closed_chain_without_known_masses_yield_nothing():
    with pytest.raises(ModelError, match="no other robot with links of a known mass"):
        make_chain(chains.ankle()).with_effect("own_weight_sag")


def test_a_body_named_platform_has_a_mass_of_its_own():
    """Many files call a body so; `mass.platform` is the mass at the origin of {P}."""
    crank = {"left_crank": "platform"}
    given = chains.ankle() | {"target": [0.15, 0, 0]}
    given["joints"] = [
        {key: crank.get(str(value), value) for key, value in joint.items()}
        for joint in given["joints"]
    ]
    for loop in given["loops"]:
        for end in ("a", "b"):
            loop[end] = {**loop[end], "body": crank.get(loop[end]["body"], loop[end]["body"])}
    masses = {"platform": {"mass": 4.0, "centre": [-0.1, 0, 0]}}
    model = yielding(make_chain(given | {"masses": masses}), "joint_compliance", 1e-5)
    assert model.value("joint_compliance.mass.platform_body") == 4.0
    assert model.value("joint_compliance.mass.platform") != 4.0


def test_a_rod_under_load_is_shorter_by_its_compliance():
    chain = make_chain(chains.ankle() | {"target": [0.15, 0, 0]})
    model = yielding(chain, "rod_compliance", 1e-7)
    q, payload = [0.1, 0.1], 5.0
    # Level parallel rods at 0.05 m behind the ankle carry 0.15 / 0.05 times the weight, in halves;
    # they are pressed, as the load is in front and the cranks are above the foot.
    tension = -payload * 9.81 * 0.15 / 0.05 / 2
    names = {f"{side}_rod.length": length + 1e-7 * tension
             for side, length in (("left", 0.25), ("right", 0.2))}  # fmt: skip
    longer = chain.with_values(chain.table.vector(names))
    found = pc.Kinematics(model).direct(q, {"payload": payload})
    assert found.position == pytest.approx(pc.Kinematics(longer).direct(q).position, abs=2e-8)


@pytest.mark.wide
def test_a_diagnosis_names_the_backlash_of_an_ankle():
    noise = pc.Noise(joint=2e-5, position=2e-5, orientation=1e-4)
    model = replace(make_chain(chains.ankle()), noise=noise)
    session = pc.simulate(model, 60, effects=["backlash:left_motor.width=0.003"], seed=1)
    found = pc.diagnose(model, session.dataset()).document()
    assert found["verdict"] == "explained"
    [cause] = found["missing"]
    assert set(cause["effects"]) == {"backlash", "hysteresis"}
    assert cause["probability"] > 0.95
