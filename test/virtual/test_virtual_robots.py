"""The virtual robots beside the Delta: parts fit, published facts come out, ways lead back.

Nothing here touches the package: these robots are the truth that it is tested against.
"""

from pathlib import Path

import numpy as np
import pytest
import virtual_paper as vp
import virtual_serial as vs
import virtual_small as vm
from scipy.spatial.transform import Rotation

from parallel_cal.virtual import argos as va
from parallel_cal.virtual import stewart as vt
from parallel_cal.virtual.linear_delta import LinearDelta
from parallel_cal.virtual.robot import NOMINAL, axis_rotation, turn
from parallel_cal.virtual.robot import Delta as RodDelta

DEGREE = np.pi / 180
HP4 = Path(__file__).parents[2] / "real/hangprinter_hp4/hp4_2021-12-14.csv"


def circle(radius, degrees):
    """Points about z, in the plane z = 0."""
    angle = np.radians(degrees)
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], -1)


def points(members, name, values):
    return {
        f"{m}.{name}_{c}": v
        for m, row in zip(members, values, strict=True)
        for c, v in zip("xyz", row, strict=True)
    }


def same(members, **values):
    return {f"{member}.{name}": v for member in members for name, v in values.items()}


SIX, THREE = vt.numbered("leg", 6), vt.numbered("leg", 3)
CHAINS = vt.numbered("chain", 3)
STEWART = (
    points(SIX, "B", circle(0.15, [-50, 50, 70, 170, 190, 290]))
    | points(SIX, "C", circle(0.25, [-10, 10, 110, 130, 230, 250]))
    | same(SIX, L0=0.25)
)
PLANAR = {
    name: value
    for name, value in (
        points(THREE, "B", circle(0.08, [30, 150, 270]))
        | points(THREE, "C", circle(0.3, [0, 120, 240]))
        | same(THREE, L0=0.15, delta=0.1)
    ).items()
    if not name.endswith("_z")
}
SCARA = (
    same(["base"], theta=np.pi, a=0.25, alpha=0.0, beta=0.0)
    | same(["link1"], theta=np.pi, a=0.2, alpha=0.0, beta=0.0)
    | same(["link2"], theta=0.0, a=0.16, alpha=0.0, beta=0.0)
    | same(["link3"], theta=0.0, d=0.0, alpha=np.pi / 2)
    | same(["platform"], theta=0.0)
)
CRANK = {"a": 0.08, "b": 0.05, "q0": 0.0}
FIVE = {
    f"{side}.{n}": v
    for side, x in (("left", -0.05), ("right", 0.05))
    for n, v in {"x": x, "y": 0.0, "crank": 0.1, "rod": 0.15, "q0": 0.0}.items()
}
ARM = np.hypot(0.119963, 0.003)  # table 5.12: La_x and La_y
RSSR = {"a": 0.0, "alpha": -120 * DEGREE, "L": 0.24} | {
    f"{crank}.{name}": value
    for crank, sign in (("input", 1), ("output", -1))
    for name, value in (("r", ARM), ("s", sign * (np.sqrt(0.03) - 0.02)), ("q0", -np.pi / 2))
}
ANCHORS = [(0, -1.6, -0.11), (1.3, 1.25, -0.15), (-1.44, 0.74, -0.16), (0, 0, 2.345)]
LINES = vt.numbered("line", 4)
CABLE = (
    points(LINES, "A", ANCHORS)
    | same(LINES, offset=0.0, gear=255 / 20, advantage=2.0)
    | {"line4.advantage": 4.0, "spool1.R": 0.075, "spool2.R": 0.075}
)
RAIL_POINTS = {"D": (0.1, 0, 0), "b": (0.03, 0, 0), "d": (0, 0.025, 0), "dC": (0, 0, 0)}
RAILS = same(CHAINS, alpha=0.0, beta=0.0, Lb=0.25, dLb=0.0)
for _name, _point in RAIL_POINTS.items():
    RAILS |= points(CHAINS, _name, [_point] * 3)


def delta51():
    """The nominal Delta of table 5.12 in the paper's coordinates, read off its points."""
    thetas = np.radians([-90.0, 30.0, 150.0])
    held, balls = NOMINAL.joint_points(np.zeros(3)), NOMINAL.platform_points(np.zeros(3), np.eye(3))
    rods = [f"rod{i}{j}" for j in (1, 2) for i in (1, 2, 3)]
    arms = [turn([0, 0, -thetas[k % 3]]) @ (held[k] - NOMINAL.hub[k % 3]) for k in range(6)]
    straight = points(CHAINS, "beta", np.zeros((3, 3))) | points(CHAINS, "p", NOMINAL.hub)
    return straight | points(rods, "a", arms) | points(rods, "b", balls) | same(rods, l=0.24)


ROBOTS = {
    "stewart42": (vt.Stewart, STEWART),
    "planar_stewart": (vt.PlanarStewart, PLANAR),
    "argos27": (va.Argos, va.TABLE_5_21),
    "linear_delta": (LinearDelta, RAILS),
    "cable": (vm.Cable, CABLE),
    "rssr": (vm.Rssr, RSSR),
    "slider_crank": (vm.SliderCrank, CRANK),
    "five_bar": (vm.FiveBar, FIVE),
    "parallelogram": (vp.Parallelogram, vp.TABLE_2),
    "parallelogram_simple": (vp.SimpleParallelogram, {"q0": 0.0, "l": 0.95, "h": 0.1}),
    "delta51": (vp.Delta51, delta51()),
}
SPREAD = {"x": 0.02, "y": 0.02, "z": 0.02, "rx": 0.15, "ry": 0.15, "rz": 0.15}


def strayed(parameters, seed, size=1e-3):
    draw = np.random.default_rng(seed).normal(size=len(parameters))
    return {k: v + size * d for (k, v), d in zip(parameters.items(), draw, strict=True)}


def poses(robot, n, seed, wider=1):
    """Joints and poses of a robot about its home, drawn in what it controls."""
    rng, move = np.random.default_rng(seed), np.zeros((n, 6))
    for coordinate in robot.controls.split():
        move[:, vt.POSE.index(coordinate)] = wider * rng.uniform(-1, 1, n) * SPREAD[coordinate]
    return robot.inverse(robot.home + move[:, :3], turn(move[:, 3:]) @ robot.home_turn)


# --- every robot ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("seed", range(2))
def test_parts_touch_and_the_way_there_leads_back(name, seed):
    build, parameters = ROBOTS[name]
    robot = build(strayed(parameters, seed))
    q, r, R = poses(robot, 50, seed)
    assert robot.max_gap(q, r, R).max() < 1e-14
    back = robot.forward(q)
    np.testing.assert_allclose(back[0], r, atol=1e-13)
    np.testing.assert_allclose(back[1], R, atol=1e-12)


def sensitivities(robot, parameters, q, step=1e-6):
    """Change of the pose (metres and radians) for each parameter, (samples * 6, parameters)."""
    columns = []
    for name, value in parameters.items():
        (r1, R1), (r2, R2) = (
            robot({**parameters, name: value + s * step}).forward(q) for s in (1, -1)
        )
        w = Rotation.from_matrix(R1 @ R2.swapaxes(-1, -2)).as_rotvec()
        columns.append(np.concatenate([r1 - r2, w], -1).ravel() / (2 * step))
    return np.stack(columns, -1)


def seen(columns):
    """How many parameter combinations change the poses at all."""
    sizes = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)
    return int((sizes > 1e-8).sum())


# Table 3.1 and eqs 3.3 and 3.4; section 3.5.1 for the Argos; section 5.3.2.
COUNTS = {"stewart42": 42, "planar_stewart": 18, "argos27": 27, "linear_delta": 48}
COUNTS |= {"slider_crank": 3, "five_bar": 10}


@pytest.mark.wide
@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=pytest.mark.slow if one == "argos27" else ()) for one in COUNTS],
)
def test_a_complete_model_has_as_many_independent_parameters_as_the_thesis_counts(name):
    build, parameters = ROBOTS[name]
    parameters = strayed(parameters, 1, 2e-3)
    q, _, _ = poses(build(parameters), 40, 2, wider=1 if name == "slider_crank" else 2)
    assert len(parameters) == COUNTS[name]
    assert seen(sensitivities(build, parameters, q)) == COUNTS[name]


def test_two_encoders_see_all_of_the_rssr_loop_but_its_size():
    parameters = strayed(RSSR, 1, 1e-2)
    q, _, _ = vm.Rssr(parameters).inverse(R=axis_rotation("z", np.linspace(0.5, 1.8, 40)))
    columns = sensitivities(vm.Rssr, parameters, q)
    assert len(parameters) == 9  # section 5.4.5
    assert seen(columns) == 8
    lengths = [
        0.0 if unit in ("alpha", "q0") else parameters[name]
        for name, unit in ((n, n.split(".")[-1]) for n in parameters)
    ]
    np.testing.assert_allclose(columns @ lengths, 0, atol=1e-8)


def test_the_scara_has_sixteen_independent_parameters():
    parameters = strayed(SCARA, 1, 1e-2)
    q = np.random.default_rng(2).uniform(-1, 1, (40, 3)) * [1, 0.7, 0.1] + [0, 1.5, 0]
    assert len(parameters) == 16
    assert seen(sensitivities(vs.Serial, parameters, q)) == 16


@pytest.mark.slow
def test_three_of_the_papers_fifty_one_parameters_say_what_others_say():
    hubs = {k: v for k, v in delta51().items() if ".p_" in k}
    free = {k: v for k, v in strayed(delta51(), 1).items() if k not in hubs}

    def robot(p):
        return vp.Delta51({**hubs, **p})

    q, _, _ = poses(robot(free), 40, 2, wider=3)
    assert len(free) == 51
    # An arm turned about its own axis is in its balls' coordinates and in beta.
    assert seen(sensitivities(robot, free, q)) == 48


# --- Stewart ----------------------------------------------------------------------------------


def test_legs_of_a_stewart_platform_are_as_long_as_pythagoras_says():
    rows = points(SIX, "B", [(0, 0, 1)] * 6) | points(SIX, "C", [(1, 2, 0)] * 6)
    robot = vt.Stewart(rows | same(SIX, L0=0.5))
    # Turned half about z and moved to (4, 5, 3): the ball is at (4, 5, 4), so CB = (3, 3, 4).
    q, _, _ = robot.inverse(np.array([4.0, 5, 3]), axis_rotation("z", np.pi), start=[5.0] * 6)
    np.testing.assert_allclose(q, [np.sqrt(34) - 0.5] * 6, atol=1e-12)


def test_a_misaligned_leg_grows_by_the_law_of_cosines():
    robot = vt.PlanarStewart(PLANAR | same(THREE, delta=60 * DEGREE))
    needed = robot.leg_lengths(np.zeros(3), np.eye(3))
    q, _, _ = robot.inverse(np.zeros(3), np.eye(3), start=[0.1] * 3)
    np.testing.assert_allclose(needed**2, 0.15**2 + q**2 + 0.15 * q, atol=1e-14)


# --- Argos ------------------------------------------------------------------------------------

ARGOS = va.Argos(va.TABLE_5_21)
IDENTIFIED = va.Argos(va.TABLE_5_22)
EULER = "XYX"  # table 3.16: Rot(x, theta1) Rot(y, theta2) Rot(x, theta3)


def orientations(n, seed):
    draw = np.random.default_rng(seed).uniform(-0.6, 0.6, (n, 3))
    return turn(draw) @ ARGOS.home_turn


def test_motor_lines_and_balls_of_the_nominal_argos_are_those_of_table_3_18():
    np.testing.assert_allclose(ARGOS.motors.along, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(ARGOS.motors.point, 0, atol=1e-15)
    np.testing.assert_allclose(ARGOS.balls, va.SPHERE * np.diag([1, 1, -1]), atol=1e-16)


@pytest.mark.parametrize("chain", range(3))
def test_pantograph_planes_of_the_nominal_argos_are_those_of_table_3_18(chain):
    q = np.array([0.3, -0.2, 0.5])
    angle = q[chain] + (-1, 1, -1)[chain] * np.pi / 4
    start = np.array([[0, 1, 0], [-1, 0, 0], [-1, 0, 0]])[chain]
    expected = axis_rotation("xyz"[chain], angle) @ start
    np.testing.assert_allclose(ARGOS.hinges(q)[1].along[chain], expected, atol=1e-15)


def test_a_pantograph_is_a_parallelogram_whose_ball_circles_the_centre():
    q, swing = np.array([0.3, -0.2, 0.5]), np.array([0.4, 1.2, -0.8])
    p = ARGOS.pantographs(q, swing)
    for bar in (p.near_end - p.near, p.far_end - p.far):
        np.testing.assert_allclose(np.linalg.norm(bar, axis=-1), va.SPHERE)
    np.testing.assert_allclose(p.near_end - p.far_end, p.near - p.far, atol=1e-16)
    # The hinges on the motor's part and the distal bar lie along the motor's axis.
    np.testing.assert_allclose(np.cross(p.near - p.far, ARGOS.motors.along), 0, atol=1e-16)
    np.testing.assert_allclose(np.linalg.norm(p.ball, axis=-1), va.SPHERE)


def test_at_home_the_argos_stands_alike_to_all_three_motors():
    R = ARGOS.home_turn
    assert ARGOS.max_gap(np.zeros(3), np.zeros(3), R) < 1e-15
    np.testing.assert_allclose(np.diag(ARGOS.balls @ R.T) / va.SPHERE, [1 / 3] * 3)


def closed_form_joints(R):
    """Eqs 6.51 and 6.54: motor angles of the nominal model from its Euler angles."""
    t1, t2, t3 = np.moveaxis(Rotation.from_matrix(R).as_euler(EULER), -1, 0)
    s1, s2, s3, c1, c2, c3 = *np.sin([t1, t2, t3]), *np.cos([t1, t2, t3])
    a = s1 * s2, -s2 * s3, s2 * c3
    b = -c1 * s2, s1 * c3 + c1 * c2 * s3, -c1 * s3 - s1 * c2 * c3
    angles = np.stack([np.arctan2(k * x, -k * y) for k, x, y in zip((1, 1, -1), a, b, strict=True)])
    return (angles - np.radians([[-45], [45], [-45]])).T


def test_joints_of_the_nominal_argos_are_those_of_the_thesis_closed_form():
    R = orientations(50, 1)
    q, r, _ = ARGOS.inverse(R=R)
    np.testing.assert_allclose(
        turn(np.stack([0 * q, 0 * q, q - closed_form_joints(R)], -1)),
        np.broadcast_to(np.eye(3), (50, 3, 3, 3)),
        atol=1e-12,
    )
    np.testing.assert_allclose(r, 0, atol=1e-14)


def regular(robot, q, start):
    """An orientation that the joints hold, None where a ball lies on its motor's axis."""
    try:
        R = robot.orientation_at_origin(q, start)
    except (ValueError, np.linalg.LinAlgError):
        return None
    off = np.cross(robot.sockets(np.zeros(3), R), robot.motors.along)
    return R if np.linalg.norm(off, axis=-1).min() > 1e-6 * va.SPHERE else None


def bilinear(R, angles):
    """Eqs 6.42 and 6.44 (the latter's two rows written out), zero at a regular solution."""
    a = angles[0]
    sa, sb, sg, ca, cb, cg = *np.sin(angles), *np.cos(angles)
    t1, t2, t3 = Rotation.from_matrix(R).as_euler(EULER)
    if np.cos(t1 - a) < 0:
        t1, t2, t3 = t1 + np.pi, -t2, t3 + np.pi  # the same orientation, told another way
    s2, s3, c2, c3 = np.sin(t2), np.sin(t3), np.cos(t2), np.cos(t3)
    second = c2 * ca * sb * s3 - s2 * cb * s3 + sa * sb * c3
    third = -c2 * sa * sg * c3 + s2 * cg * c3 - ca * sg * s3
    return np.sin(t1 - a), second, third


@pytest.mark.slow
def test_the_nominal_argos_has_four_regular_orientations():
    q = np.array([0.1, -0.2, 0.3])
    half_turns = [np.diag(d) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
    four = [regular(ARGOS, q, ARGOS.home_turn @ half) for half in half_turns]
    for R, half in zip(four, half_turns, strict=True):
        # Two balls change to the other end of their circles' diameters.
        np.testing.assert_allclose(R, four[0] @ half, atol=1e-12)
        assert ARGOS.max_gap(q, np.zeros(3), R) < 1e-13
        np.testing.assert_allclose(bilinear(R, q + np.radians([-45, 45, -45])), 0, atol=1e-12)
    starts = Rotation.random(20, random_state=3).as_matrix()
    others = [R for R in (regular(ARGOS, q, start) for start in starts) if R is not None]
    assert len(others) > 5
    assert all(min(np.abs(R - known).max() for known in four) < 1e-9 for R in others)


def test_a_spherical_argos_turns_about_a_centre_that_stays():
    q, r, R = IDENTIFIED.inverse(R=orientations(30, 4))
    np.testing.assert_allclose(r, 0, atol=1e-14)
    np.testing.assert_allclose(
        IDENTIFIED.orientation_at_origin(q[0], R[0] @ turn([0.05, 0, 0])), R[0], atol=1e-12
    )


@pytest.mark.slow
def test_model_9_has_nine_independent_parameters_from_orientations_only():
    nine = {k: va.TABLE_5_22[k] for k in va.ANGLES}
    q, _, _ = IDENTIFIED.inverse(R=orientations(40, 5))
    columns = sensitivities(lambda p: va.Argos(va.spherical(p)), nine, q)
    assert seen(columns.reshape(-1, 6, 9)[:, 3:].reshape(-1, 9)) == 9


def test_centre_of_an_argos_with_millimetres_of_error_wanders_by_millimetres():
    robot = va.Argos(strayed(va.TABLE_5_22, 6, 1e-3))
    _, r, _ = robot.inverse(R=orientations(100, 7))
    assert 1e-3 < np.linalg.norm(r, axis=-1).max() < 1e-2


def test_centre_of_the_mock_up_wanders_by_the_millimetre_that_the_thesis_measured():
    _, r, _ = va.Argos(va.TABLE_5_25).inverse(R=orientations(47, 0))
    wander = np.linalg.norm(r - r.mean(axis=0), axis=-1)
    assert wander.mean() == pytest.approx(0.958e-3, rel=0.25)  # table 5.27, before calibration
    assert np.abs(r).max() < 5e-3  # section 4.3.2 provides 6 mm of travel


# --- SCARA ------------------------------------------------------------------------------------


def test_a_scara_without_errors_reaches_as_a_planar_arm_does():
    r, R = vs.Serial(SCARA).forward([0.3, 0.5, 0.02])
    # {0} is 0.25 m along -x; half turns point the arms back towards {B} at reading zero.
    arm = [0.2 * np.exp(0.3j), 0.16 * np.exp(0.8j)]
    reached = -0.25 + sum(arm)
    np.testing.assert_allclose(r, [reached.real, reached.imag, 0.02], atol=1e-15)
    np.testing.assert_allclose(
        R, axis_rotation("z", 0.8) @ axis_rotation("x", np.pi / 2), atol=1e-15
    )


def test_one_link_is_the_product_of_its_five_movements():
    whole = vs.link(0.4, 0.1, 0.2, 0.0, 0.3, -0.5)
    expected = axis_rotation("z", 0.4) @ axis_rotation("x", 0.3) @ axis_rotation("y", -0.5)
    np.testing.assert_allclose(whole[:3, :3], expected, atol=1e-15)
    np.testing.assert_allclose(whole[:3, 3], axis_rotation("z", 0.4) @ [0.2, 0, 0.1], atol=1e-15)


def test_a_strayed_scara_reaches_its_target():
    robot = vs.Serial(strayed(SCARA, 1))
    target = np.random.default_rng(2).uniform(-0.05, 0.05, (50, 3))
    q, r, R = robot.inverse(target)
    np.testing.assert_allclose(r, target, atol=1e-14)
    np.testing.assert_allclose(robot.forward(q)[1], R, atol=1e-15)


# --- slider-crank, RSSR -----------------------------------------------------------------------


def test_a_stretched_slider_crank_reaches_130_mm_and_its_rod_is_50_mm_long():
    robot = vm.SliderCrank(CRANK)
    np.testing.assert_allclose(robot.forward([0.0])[0], [0.13, 0, 0], atol=1e-12)
    np.testing.assert_allclose(robot.forward([0.0], ([0.03, 0, 0], np.eye(3)))[0][0], 0.03)


def test_slider_crank_of_the_simulation_follows_equations_5_10_to_5_13():
    a, b, q0 = 0.0802, 0.0501, DEGREE
    robot = vm.SliderCrank({"a": a, "b": b, "q0": q0})
    x = np.linspace(0.075, 0.125, 30)
    q, _, _ = robot.inverse(np.stack([x, 0 * x, 0 * x], -1))
    np.testing.assert_allclose(a**2 + x**2 - b**2, 2 * a * x * np.cos(q[:, 0] + q0), atol=1e-15)
    inner = np.sqrt(b**2 - a**2 * np.sin(q[:, 0] + q0) ** 2)
    both = a * np.cos(q[:, 0] + q0) + np.multiply.outer([1, -1], inner)
    np.testing.assert_allclose(np.abs(both - x).min(axis=0), 0, atol=1e-14)


def test_two_arms_of_the_delta_and_one_of_its_rods_make_the_rssr_loop():
    q, _, R = vm.Rssr(RSSR).inverse(R=axis_rotation("z", np.linspace(0.8, 1.5, 20)))
    output = Rotation.from_matrix(R).as_rotvec()[:, 2]
    lag = np.arctan2(-3.0, 119.963)  # the ball stands 3 mm off the arm (table 5.12)
    balls = NOMINAL.joint_points(np.stack([q[:, 0] - lag, output - lag, 0 * output], -1))
    c12, c21 = balls[:, 3], balls[:, 1]
    np.testing.assert_allclose(np.linalg.norm(c12 - c21, axis=-1), 0.24, atol=1e-14)


# --- cable robot ------------------------------------------------------------------------------


def test_a_line_pays_out_what_its_spool_winds_off():
    robot = vm.Cable(CABLE)
    q, r, _ = robot.inverse(np.array([0.3, -0.4, 0.5]))
    paid = 0.075 * q / 12.75 / np.array([2, 2, 2, 4])
    reach = np.linalg.norm(r - np.array(ANCHORS), axis=-1)
    np.testing.assert_allclose(paid, reach - np.linalg.norm(ANCHORS, axis=-1), atol=1e-14)


def test_a_slack_line_is_noticed():
    robot = vm.Cable(CABLE)
    q, _, _ = robot.inverse(np.array([0.1, 0.2, 0.3]))
    with pytest.raises(ValueError, match="slack"):
        robot.forward(q + [0, 0, 0, 1.0])


def test_the_measured_cable_robot_behaves_so_with_its_makers_numbers():
    data = np.genfromtxt(HP4, delimiter=",", names=True)
    r = np.stack([data[f"{c}_mm"] for c in "xyz"], -1) / 1000
    q = np.radians(np.stack([data[f"motor{m}_deg"] for m in "ABCD"], -1))
    robot = vm.Cable(CABLE)
    gaps = robot.gaps(q, r, np.broadcast_to(np.eye(3), (len(r), 3, 3)), r[:, :0])
    travel = np.linalg.norm(r[:, None] - robot.anchors, axis=-1).std(axis=0)
    assert (np.sqrt((gaps**2).mean(axis=0)) < 0.15 * travel).all()


# --- linear Delta -----------------------------------------------------------------------------


def test_carriages_of_the_linear_delta_stand_where_pythagoras_puts_them():
    q, _, R = LinearDelta(RAILS).inverse(np.array([0.0, 0, 0.1]))
    np.testing.assert_allclose(q, 0.1 + np.sqrt(0.25**2 - 0.1**2), atol=1e-14)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-14)


def test_a_linear_delta_without_errors_does_not_tilt():
    _, _, R = poses(LinearDelta(RAILS), 30, 3)
    np.testing.assert_allclose(R, np.broadcast_to(np.eye(3), (30, 3, 3)), atol=1e-13)


def test_carriages_slide_along_their_rails():
    robot = LinearDelta(strayed(RAILS, 2), inclination=0.3)
    here = robot.ends(np.zeros(3), np.zeros(3), np.eye(3))[0]
    there = robot.ends(np.array([0.1, 0.2, 0.3]), np.zeros(3), np.eye(3))[0]
    np.testing.assert_allclose(np.linalg.norm(there - here, axis=-1), [0.1, 0.2, 0.3] * 2)
    assert (np.sum((there - here)[:3] * here[:3] * [1, 1, 0], -1) > 0).all()  # leaning outwards


# --- the paper --------------------------------------------------------------------------------


def test_a_perfect_parallelogram_moves_as_equation_34_says():
    q = np.radians([[-45.0], [0], [30]])
    r, R = vp.Parallelogram(vp.TABLE_2).forward(q)
    expected = np.stack([0.95 * np.sin(q), -0.95 * np.cos(q) - 0.1, 0 * q], -1)[:, 0]
    np.testing.assert_allclose(r, expected, atol=1e-12)
    np.testing.assert_allclose(R, np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-13)
    bar = vp.SimpleParallelogram({"q0": 0.0, "l": 0.95, "h": 0.1}).forward(q)
    np.testing.assert_allclose(bar[0], expected, atol=1e-12)


def test_six_of_the_nine_errors_of_the_parallelogram_can_be_seen():
    nine = {k: v for k, v in vp.TABLE_2.items() if k != "h"}
    q = np.radians(np.arange(-45.0, 46, 5))[:, None]
    columns = sensitivities(lambda p: vp.Parallelogram({**p, "h": 0.1}), nine, q)
    assert seen(columns) == 6
    at = dict(zip(nine, columns.T, strict=True))
    for one, other in (("a2_x", "b2_x"), ("a2_y", "b2_y"), ("b1_x", "a1_x")):  # eqs 70 to 72
        np.testing.assert_allclose(at[one], -at[other], atol=1e-6)


def paper_sensitivity(q, l=0.95, h=0.1, b=0.125):
    """Eqs 61 and 64 to 67: S_C = J_X^-1 J_kC of the nominal parallelogram, put right twice.

    The last row of eq. 65 is printed -l 0 ...: by eq. 55 the first entry is +l, and the second is
    v since A1 carries B1 along; only so does eq. 72 hold, and do the poses follow.
    """
    u, v = np.sin(q), -np.cos(q)
    moved = [[u, v, -u * h - v * b], [u, v, -u * h + v * b], [-v, u, v * h - u * b]]
    caused = [
        [0, -u, 0, 0, u, 0, 0, 1, 0],
        [0, 0, u, v, 0, -u, -v, 0, 1],
        [l, v, 0, 0, -v, 0, 0, 0, 0],
    ]
    return np.linalg.solve(moved, caused)


@pytest.mark.parametrize("q", [-0.7, 0.0, 0.4])
def test_small_errors_move_the_parallelogram_as_the_paper_derives(q):
    nine = {k: v for k, v in vp.TABLE_2.items() if k != "h"}
    columns = sensitivities(lambda p: vp.Parallelogram({**p, "h": 0.1}), nine, np.array([[q]]))
    np.testing.assert_allclose(columns[[0, 1, 5]], paper_sensitivity(q), atol=1e-6)


def test_table_2s_errors_tilt_the_parallelograms_platform():
    q = np.radians(np.arange(-45.0, 46, 5))[:, None]
    r, R = vp.Parallelogram(vp.TABLE_2_STRAYED).forward(q)
    right = vp.Parallelogram(vp.TABLE_2).forward(q)[0]
    tilt = Rotation.from_matrix(R).as_rotvec()[:, 2]
    assert 1e-3 < np.abs(tilt).max() < 5e-2
    assert np.abs(r - right).max() < 5e-3


def test_the_papers_delta_is_the_thesis_delta_at_the_same_points():
    robot = vp.Delta51(delta51())
    q = np.random.default_rng(1).uniform(0.3, 0.8, (20, 3))
    (r, R), (expected, _) = robot.forward(q), RodDelta(NOMINAL.parameters).forward(q)
    np.testing.assert_allclose(r, expected, atol=1e-13)
    np.testing.assert_allclose(R, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)


def paper_columns(robot, q, r, R):
    """Eqs 12 to 20 of one pose: what moves the platform, and what each of 51 errors asks for."""
    arm, ball = (end[0] for end in robot.ends(q, r, R))
    rods = ball - arm
    moved = np.concatenate([rods, np.cross(ball - r, rods)], -1)
    caused = {}
    for k, rod in enumerate(rods):
        i, name = k % 3, f"rod{k % 3 + 1}{k // 3 + 1}"
        held = axis_rotation("z", robot.thetas[i]) @ axis_rotation("x", q[0, i])
        lever = np.cross(arm[k] - robot.hub[i], rod)
        caused |= dict(
            zip((f"{name}.b_{c}" for c in "xyz"), np.outer(-rod, np.eye(6)[k]), strict=True)
        )
        caused |= dict(
            zip((f"{name}.a_{c}" for c in "xyz"), np.outer(rod @ held, np.eye(6)[k]), strict=True)
        )
        caused[f"{name}.l"] = np.linalg.norm(rod) * np.eye(6)[k]
        for c, value in zip("xyz", lever, strict=True):
            key = f"chain{i + 1}.beta_{c}"
            caused[key] = caused.get(key, 0) + value * np.eye(6)[k]
    return moved, caused


@pytest.mark.wide
def test_small_errors_move_the_papers_delta_as_equation_12_says():
    parameters, q = delta51(), np.array([[0.5, 0.6, 0.4]])
    robot = vp.Delta51(parameters)
    moved, caused = paper_columns(robot, q, *robot.forward(q))
    free = {k: v for k, v in parameters.items() if ".p_" not in k}
    columns = sensitivities(lambda p: vp.Delta51({**parameters, **p}), free, q)
    expected = np.linalg.solve(moved, np.stack([caused[name] for name in free], -1))
    assert len(free) == 51
    np.testing.assert_allclose(columns, expected, atol=1e-6)
