"""The paper's mechanisms and its approximate compensation (Savoure et al., ICRA 2006)."""

import numpy as np
import pytest
import virtual_day as vd

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.mechanisms.delta51 import RODS, from_delta54, to_delta54
from parallel_cal.model.model import new_model
from parallel_cal.thesis.solvers import ipr_compensation
from parallel_cal.virtual import robot as vr

MM, DEGREE = 1e-3, np.pi / 180
QUARTER = np.pi / 2


def phi(model, q, r, R):
    x = np.concatenate([np.atleast_1d(q), r, np.asarray(R, dtype=float).ravel()])
    return np.array(model.structure.closure(x, [], model.values)[0]).ravel()


def off_nominal(name, seed, size=1.0, free_only=False):
    model = new_model(name)
    t = model.table
    error = size * t.tolerance * np.random.default_rng(seed).standard_normal(len(t))
    return model.with_values(t.nominal + error * (~model.fixed if free_only else 1))


# ------------------------------------------------------------------------- the parallelogram

WHOLE = {
    "q0": 0,
    "a1_x": 1,
    "a2_x": 2,
    "a2_y": 3,
    "b1_x": 1,
    "b2_x": 2,
    "b2_y": 3,
    "l1": 5,
    "l2": 10,
    "h": 1,
}
# C = (4, -6), platform turned by a quarter: (x, y) -> (-y, x). Then B1 = C + (-1, -1), so
# A1 B1 = (4, -7) and the crank hangs at (0, -5); B2 = C + (-4, 2), so A2 B2 = (-2, -7).
PARALLELOGRAM_BY_HAND = {
    "": (0, 4, -2, -2.35),
    "q": (QUARTER, -1, -7, -2.35),
    "q0": (QUARTER, -1, -7, -2.35),
    "a1_x": (2, 5, -2, -2.35),
    "a2_x": (3, 4, -2, -2.1),
    "a2_y": (4, 4, -2, -1.6),
    "b1_x": (2, 4, -3, -2.35),
    "b2_x": (3, 4, -2, -3.0),
    "b2_y": (4, 4, -2, -2.1),
    "l1": (6, 4, -1, -2.35),
    "l2": (20, 4, -2, -8.675),
    "h": (2, 3, -2, -2.1),
}


@pytest.mark.parametrize("changed", PARALLELOGRAM_BY_HAND, ids=lambda name: name or "nothing")
def test_the_parallelograms_closure_is_what_paper_and_pencil_say(changed):
    value, *rows = PARALLELOGRAM_BY_HAND[changed]
    numbers = {**WHOLE, changed: value} if changed in WHOLE else WHOLE
    model = new_model("parallelogram", numbers)
    q = value if changed == "q" else 0.0
    assert phi(model, q, [4, -6, 0], X_TO_Y) == pytest.approx(rows, abs=1e-12)


X_TO_Y = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]


class Linkage:
    """The parallelogram with ruler and compass: B2 is where two circles meet."""

    def __init__(self, p):
        self.p = p

    def pose(self, q):
        """C and the tilt for crank angles q (N,)."""
        p, angle = self.p, np.asarray(q) + self.p["q0"]
        A2 = np.array([p["a2_x"], p["a2_y"]])
        B1 = p["l1"] * np.stack([np.sin(angle), -np.cos(angle)], -1) - [p["a1_x"], 0]
        width = np.hypot(p["b1_x"] + p["b2_x"], p["b2_y"])
        B2 = self.meeting(B1, width, A2, p["l2"])
        along = (B2 - B1) / width
        slant = np.arctan2(p["b2_y"], p["b1_x"] + p["b2_x"])
        tilt = np.arctan2(along[:, 1], along[:, 0]) - slant
        x, y = (
            np.stack([np.cos(tilt), np.sin(tilt)], -1),
            np.stack([-np.sin(tilt), np.cos(tilt)], -1),
        )
        return B1 + p["b1_x"] * x - p["h"] * y, tilt

    @staticmethod
    def meeting(a, radius, b, other):
        """Where circles about a (N, 2) and b meet, on the right when looking from b to a."""
        line = a - b
        d = np.linalg.norm(line, axis=1)[:, None]
        foot = (d**2 + other**2 - radius**2) / (2 * d)
        normal = np.stack([-line[:, 1], line[:, 0]], -1) / d
        return b + foot * line / d + np.sqrt(other**2 - foot**2) * normal


@pytest.mark.parametrize("seed", range(3))
def test_the_parallelogram_is_built_with_ruler_and_compass(seed):
    model = off_nominal("parallelogram", seed, size=3)
    q = np.linspace(-0.8, 0.8, 41)
    C, tilt = Linkage(model.table.mapping(model.values)).pose(q)
    found = Kinematics(model).direct(q[:, None])
    assert found.ok.all()
    assert np.abs(found.position[:, :2] - C).max() < 1e-13
    assert np.abs(rotation_vector(found.rotation)[:, 2] - tilt).max() < 1e-12
    assert np.abs(found.position[:, 2]).max() == 0


def test_both_assemblies_of_the_parallelogram_are_found():
    found = direct_all(off_nominal("parallelogram", 0), [0.3])
    assert len(found) == 2
    assert abs(rotation_vector(found.rotation[0])[2]) < 0.05  # the parallelogram comes first


@pytest.mark.parametrize("name", ["parallelogram", "parallelogram_simple", "delta51"])
@pytest.mark.parametrize("size", [0, 1])
def test_round_trips_over_the_workspace(name, size):
    model = off_nominal(name, 1, size)
    m, kinematics = model.mechanism, Kinematics(model)
    position = np.tile(m.home.position, (200, 1))
    position[:, m.controlled] = m.sample(200, np.random.default_rng(0))
    inverse = kinematics.inverse(position)
    direct = kinematics.direct(inverse.joints)
    assert inverse.ok.all()
    assert direct.ok.all()
    assert np.abs(direct.position - inverse.position).max() < 1e-12
    assert np.abs(direct.position - position)[:, m.controlled].max() < 1e-12
    assert np.abs(direct.rotation - inverse.rotation).max() < 1e-12


def test_the_simple_mechanism_is_the_complete_one_with_equal_rods():
    simple = new_model("parallelogram_simple", {"q0": 0.01, "l": 0.951, "h": 0.2})
    q = np.linspace(-0.8, 0.8, 21)[:, None]
    x = 0.951 * np.sin(q + 0.01)  # eq. 34
    assert np.abs(Kinematics(simple).direct(q).position[:, :1] - x).max() < 1e-15
    wide = Kinematics(simple.widen()).direct(q)
    assert np.abs(wide.position - Kinematics(simple).direct(q).position).max() < 1e-14
    assert np.abs(wide.rotation - np.eye(3)).max() < 1e-13


def test_the_papers_jacobians_with_two_slips_put_right():
    """Eqs 64-65: in the third row the drive turns the other way (l, not -l), and A1's error
    moves B1 (v, not 0), as eq. 72 presupposes."""
    model, q, l, h, b = new_model("parallelogram"), 0.4, 0.95, 0.1, 0.125
    u, v = np.sin(q), -np.cos(q)
    s = Kinematics(model).direct([q])
    x = np.concatenate([s.joints, s.position, s.rotation.ravel()])
    _, J, J_v = (np.array(o) for o in model.structure.closure(x, [], model.values))
    turn = np.array([[u, v, 0], [0, 0, 1], [-v, u, 0]])  # rows along u, rod 2, along v
    J_X = [[u, v, -u * h - v * b], [u, v, -u * h + v * b], [-v, u, v * h - u * b]]
    J_k = [
        [0, -u, 0, 0, u, 0, 0, 1, 0],
        [0, 0, u, v, 0, -u, -v, 0, 1],
        [l, v, 0, 0, -v, 0, 0, 0, 0],
    ]
    assert turn @ J[:, [1, 2, 6]] == pytest.approx(np.array(J_X), abs=1e-12)
    assert -turn @ J_v[:, :9] == pytest.approx(np.array(J_k), abs=1e-12)


# Nominal values and errors of table 2, added up.
TABLE_2 = {"q0": 0.01 * DEGREE, "l1": 951 * MM, "l2": 949 * MM}
TABLE_2 |= {"a1_x": 126 * MM, "a2_x": 125 * MM, "a2_y": 3 * MM}
TABLE_2 |= {"b1_x": 125 * MM, "b2_x": 123 * MM, "b2_y": 0.0}


def identified(nominal, q, dX, rows, free):
    """Eq. 26: nominal values plus least squares on dX = S dk at the nominal geometry."""
    moved = nominal.mechanism.moved
    s = Kinematics(nominal).direct(q)
    columns = []
    for k in np.flatnonzero(free):
        e = np.zeros(len(nominal.values))
        e[k] = 1e-6
        shifted = nominal.with_values(nominal.values + e)
        columns.append(ipr_compensation.pose_error(shifted, s)[:, moved][:, rows].ravel() / 1e-6)
    weight = np.array([1 / (3 * MM / 1000), 1 / (3 * MM / 1000), 1 / (0.003 * DEGREE)])[rows]
    S, d = np.array(columns).T, dX[:, rows].ravel()
    w = np.tile(weight, len(q))
    values = nominal.values.copy()
    values[free] += np.linalg.lstsq(S * w[:, None], d * w, rcond=1e-9)[0]
    return nominal.with_values(values), np.linalg.matrix_rank(S, 1e-9)


def calibrated(h):
    """Section III-B: 19 measured configurations; the classical and the improved identification."""
    rng, q = np.random.default_rng(0), np.radians(np.arange(-45, 46, 5))
    C, tilt = Linkage({**TABLE_2, "h": h}).pose(q)
    measured = np.column_stack([C, tilt]) + rng.normal(size=(19, 3)) * [3e-6, 3e-6, 0.003 * DEGREE]
    simple = new_model("parallelogram_simple", {"h": h})
    complete = new_model("parallelogram", {"h": h})
    at_nominal = np.column_stack([0.95 * np.sin(q), -0.95 * np.cos(q) - h, 0 * q])
    dX = measured - at_nominal
    classical, _ = identified(simple, q[:, None], dX[:, :2], [0], ~simple.fixed)
    improved, rank = identified(complete, q[:, None], dX, [0, 1, 2], ~complete.fixed)
    assert rank == 6  # eq. 73
    return {"none": simple, "classical": classical, "improved": improved}


def tcp_error(model, h, inverse=None):
    """Mean error (m) in x over the commanded positions (figures 5-7)."""
    asked = np.zeros((91, 3))
    asked[:, 0], asked[:, 1] = 0.95 * np.sin(np.radians(np.arange(-45, 46))), -0.95
    found = inverse(model, asked) if inverse else Kinematics(model).inverse(asked)
    C, _ = Linkage({**TABLE_2, "h": h}).pose(found.joints[:, 0])
    return np.abs(C[:, 0] - asked[:, 0]).mean()


@pytest.mark.parametrize("pair", [("a2_x", "b2_x"), ("a2_y", "b2_y"), ("a1_x", "b1_x")])
def test_a_shift_of_a_base_point_is_a_shift_of_the_platform_point_it_faces(pair):
    """Eqs 70-72, exact for the perfect parallelogram."""
    nominal, q = new_model("parallelogram"), np.linspace(-0.7, 0.7, 19)[:, None]
    both = new_model("parallelogram", {k: nominal.value(k) + 1 * MM for k in pair})
    one = new_model("parallelogram", {pair[0]: nominal.value(pair[0]) + 1 * MM})
    poses = [Kinematics(model).direct(q).position for model in (nominal, both, one)]
    assert np.abs(poses[1] - poses[0]).max() < 1e-14
    assert np.abs(poses[2] - poses[0]).max() > 10e-6


def test_the_improved_calibration_beats_the_classical_one_more_so_with_a_long_tool():
    """Figures 5-7, which the paper gives as curves only."""
    error = {}
    for h in (0.0, 200 * MM):
        models = calibrated(h)
        error[h] = [tcp_error(models[k], h) for k in ("none", "classical", "improved")]
        error[h].append(tcp_error(models["improved"], h, ipr_compensation.inverse))
        none, classical, improved, approximate = error[h]
        # What is left is of second order in millimetres of error on a metre: some 20 um. The
        # linear compensation undoes part of what the linear identification got wrong.
        assert improved < classical / 2 < none / 8
        assert approximate < classical / 10
    assert error[200 * MM][1] > 4 * error[0.0][1]
    assert error[200 * MM][2] < error[0.0][1] / 2


# ------------------------------------------------------------------------- the Delta, 51 parameters

RODS_IN_WHOLE = {"b_x": 1, "b_y": 2, "b_z": 3, "a_x": 1, "a_y": 2, "a_z": 3, "l": 10}
CHAIN_IN_WHOLE = {"beta_x": 0, "beta_y": 0, "beta_z": 0, "p_x": 1, "p_y": 2, "p_z": 3}
CYCLE = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # takes (x, y, z) to (z, x, y)
# Chain 1's frame takes (x, y, z) to (y, -x, z). A = (1, 2, 3) + (2, -1, 3), B = (10, 0, 8) +
# (3, 1, 2), so AB = (10, 0, 4) and the row is (116 - 100) / 20.
ROD_BY_HAND = {
    "": (0, 0.8),
    "q": (QUARTER, 7.5),
    "b_x": (2, 0.85),
    "b_y": (3, 1.25),
    "b_z": (4, 1.85),
    "a_x": (2, 0.85),
    "a_y": (3, -0.15),
    "a_z": (4, 0.45),
    "l": (20, -7.1),
    "p_x": (2, -0.15),
    "p_y": (3, 0.85),
    "p_z": (4, 0.45),
    "beta_x": (QUARTER, 3.4),
    "beta_y": (QUARTER, 3.1),
    "beta_z": (QUARTER, 2.3),
}


@pytest.mark.parametrize("changed", ROD_BY_HAND, ids=lambda name: name or "nothing")
@pytest.mark.parametrize("rod", ["11", "12"])
def test_a_rods_closure_is_what_paper_and_pencil_say(changed, rod):
    value, row = ROD_BY_HAND[changed]
    numbers = {f"rod{rod}.{k}": v for k, v in RODS_IN_WHOLE.items()}
    numbers |= {f"chain1.{k}": v for k, v in CHAIN_IN_WHOLE.items()}
    key = f"rod{rod}.{changed}" if changed in RODS_IN_WHOLE else f"chain1.{changed}"
    if key in numbers:
        numbers[key] = value
    model = new_model("delta51", numbers)
    q = [value if changed == "q" else 0.0, 0, 0]
    assert phi(model, q, [10, 0, 8], CYCLE)[int(rod) - 11] == pytest.approx(row, abs=1e-12)


@pytest.mark.parametrize("rod", RODS)
def test_a_rods_slopes_are_the_papers_matrices_with_one_sign_put_right(rod):
    """Eqs 12-19 by cross products; by eqs 5, 6 and 13 the columns of b must be -A B, not A B."""
    model, q, i = new_model("delta51"), np.array([0.4, 0.6, 0.5]), int(rod[0])
    s, k = Kinematics(model).direct(q), model.value
    x = np.concatenate([q, s.position, s.rotation.ravel()])
    slopes = model.structure.closure(x, [], model.values)[1:]
    J, J_v = (np.array(slope)[RODS.index(rod)] for slope in slopes)
    b, a = (np.array([k(f"rod{rod}.{n}_{axis}") for axis in "xyz"]) for n in "ba")
    turn = vr.axis_rotation("z", np.radians([-90, 30, 150][i - 1])) @ vr.axis_rotation(
        "x", q[i - 1]
    )
    AP, BC, l = -turn @ a, -s.rotation @ b, k(f"rod{rod}.l")
    AB = s.position - BC - (np.array([k(f"chain{i}.p_{axis}") for axis in "xyz"]) - AP)
    assert l * J[3:] == pytest.approx([*AB, *np.cross(AB, BC)], abs=1e-14)
    names = [f"rod{rod}.{n}_{axis}" for n in "ba" for axis in "xyz"]
    names += [f"rod{rod}.l", *(f"chain{i}.beta_{axis}" for axis in "xyz")]
    columns = l * J_v[[model.table.index_of(name) for name in names]]
    printed = [*(-AB @ s.rotation), *(AB @ turn), l, *np.cross(AB, AP)]
    assert -columns == pytest.approx(printed, abs=1e-14)


class PointDelta(vr.RodRobot):
    """Six rods between points, from the 51-parameter table; solved by the virtual robot."""

    home_joints = np.full(3, np.radians(30.65))

    def points(self, kind):
        p = self.parameters
        return np.array(
            [[p[f"rod{i}{j}.{kind}_{k}"] for k in "xyz"] for j in (1, 2) for i in (1, 2, 3)]
        )

    def joint_points(self, q):
        p = self.parameters
        beta = np.array([[p[f"chain{i}.beta_{k}"] for k in "xyz"] for i in (1, 2, 3)])
        hub = np.array([[p[f"chain{i}.p_{k}"] for k in "xyz"] for i in (1, 2, 3)])
        frame = vr.turn(beta) @ vr.axis_rotation("z", np.radians([-90, 30, 150]))
        frame = frame @ vr.axis_rotation("x", np.asarray(q))
        A = self.points("a")
        return np.concatenate([hub + vr.apply(frame, A[:3]), hub + vr.apply(frame, A[3:])], -2)

    def platform_points(self, r, R):
        b = vr.apply(np.asarray(R)[..., None, :, :], self.points("b"))
        return np.asarray(r)[..., None, :] + b

    def lengths(self, q):
        p = self.parameters
        return np.array([p[f"rod{i}{j}.l"] for j in (1, 2) for i in (1, 2, 3)])


@pytest.mark.parametrize("seed", range(3))
def test_delta51_is_six_rods_between_points(seed):
    model = off_nominal("delta51", seed)
    q = np.random.default_rng(seed).uniform(0.2, 0.9, (40, 3))
    r, R = PointDelta(model.table.mapping(model.values)).forward(q)
    found = Kinematics(model).direct(q)
    assert np.abs(found.position - r).max() < 1e-12
    assert np.abs(found.rotation - R).max() < 1e-10


def test_delta51_is_the_thesis_mock_up():
    model = new_model("delta51", from_delta54(vr.TABLE_5_18))
    r, R = vr.MOCK_UP.forward(np.random.default_rng(0).uniform(0.2, 0.9, (50, 3)))
    q, _ = vr.MOCK_UP.inverse(r)
    found = Kinematics(model).direct(q)
    assert np.abs(found.position - r).max() < 1e-11
    assert np.abs(found.rotation - R).max() < 1e-9


@pytest.mark.wide
@pytest.mark.parametrize("seed", range(5))
def test_model_54_and_joint_points_describe_the_same_robots(seed):
    """With the hubs p_i free: both ways, all parameters random, poses and joints equal."""
    q = np.random.default_rng(seed).uniform(0.2, 0.9, (40, 3))
    one = off_nominal("delta54", seed, size=2)
    other = new_model("delta51", from_delta54(one.table.mapping(one.values)))
    assert_same_robot(one, other, q)
    points = off_nominal("delta51", seed, size=2)
    assert_same_robot(points, points.widen(), q)


def assert_same_robot(one, other, q):
    a, b = Kinematics(one).direct(q), Kinematics(other).direct(q)
    assert a.ok.all()
    assert np.abs(a.position - b.position).max() < 1e-12
    assert np.abs(a.rotation - b.rotation).max() < 1e-11


def test_going_there_and_back_gives_model_54s_own_numbers():
    model = off_nominal("delta54", 8, size=3)
    numbers = model.table.mapping(model.values)
    back = to_delta54(from_delta54(numbers))
    assert max(abs(back[k] - v) for k, v in numbers.items()) < 1e-14


def test_a_hub_counts_as_a_platform_point_only_while_the_platform_is_level():
    """Eq. 13, which is why the paper has 51 parameters and not 60."""
    q = np.random.default_rng(0).uniform(0.3, 0.8, (30, 3))

    def apart(model):
        numbers, shift = model.table.mapping(model.values), 1 * MM
        hub = {"chain1.p_x": numbers["chain1.p_x"] + shift}
        points = {f"rod1{j}.b_x": numbers[f"rod1{j}.b_x"] - shift for j in (1, 2)}
        moved = [Kinematics(new_model("delta51", numbers | c)).direct(q) for c in (hub, points)]
        return np.abs(moved[0].position - moved[1].position).max()

    assert apart(new_model("delta51")) < 1e-15
    assert 1e-9 < apart(off_nominal("delta51", 0)) < 0.05 * MM  # the tilt is a few hundredths


def test_turning_an_arm_on_its_axis_is_in_the_arm_points_and_in_beta():
    numbers = from_delta54(vr.TABLE_5_18)
    other = to_delta54(numbers)
    assert max(abs(other[k] - v) for k, v in vr.TABLE_5_18.items()) < 1e-12
    model, q = new_model("delta51", numbers), np.random.default_rng(0).uniform(0.3, 0.8, (20, 3))
    again = dict(numbers)
    for rod in ("11", "12"):  # arm points turned by atan(3/4) about u, the encoder shows less
        y, z = numbers[f"rod{rod}.a_y"], numbers[f"rod{rod}.a_z"]
        again[f"rod{rod}.a_y"], again[f"rod{rod}.a_z"] = 0.8 * y - 0.6 * z, 0.6 * y + 0.8 * z
    turned = Kinematics(new_model("delta51", again)).direct(q - [np.arctan2(3, 4), 0, 0])
    assert np.abs(turned.position - Kinematics(model).direct(q).position).max() < 1e-13


# ------------------------------------------------------------------------- compensation (27-33)


@pytest.mark.parametrize("name", ["delta51", "delta54", "parallelogram", "scara16"])
def test_what_the_compensation_leaves_is_of_second_order(name):
    left = []
    for size in (0.1, 0.2):
        model = off_nominal(name, 2, size, free_only=True)
        m = model.mechanism
        position = np.tile(m.home.position, (50, 1))
        position[:, m.controlled] = m.sample(50, np.random.default_rng(0))
        found = ipr_compensation.inverse(model, position)
        reached = Kinematics(model).direct(found.joints)
        left.append(np.linalg.norm((reached.position - position)[:, m.controlled], axis=1).max())
        nominal = Kinematics(new_model(name)).inverse(position).joints
        before = Kinematics(model).direct(nominal).position - position
        assert left[-1] < 0.05 * np.abs(before).max()
    assert left[1] / left[0] == pytest.approx(4, rel=0.15)


def test_the_mock_up_is_compensated_to_a_hundredth():
    """Table 5.15: 550 um measured before calibration; 594 um by tables 5.12 and 5.18."""
    model, asked = new_model("delta54", vr.TABLE_5_18), vd.targets(74, seed=0)
    before, _ = vr.MOCK_UP.forward(vr.NOMINAL.inverse(asked)[0])
    after, _ = vr.MOCK_UP.forward(ipr_compensation.inverse(model, asked).joints)
    assert np.linalg.norm(before - asked, axis=1).mean() == pytest.approx(594e-6, abs=10e-6)
    assert np.linalg.norm(after - asked, axis=1).max() < 10e-6


def test_the_compensated_pose_has_the_predicted_tilt_and_an_honest_residual():
    model, asked = new_model("delta54", vr.TABLE_5_18), vd.targets(20, seed=0)
    found = ipr_compensation.inverse(model, asked)
    exact = Kinematics(model).inverse(asked)
    tilt = rotation_vector(found.rotation @ exact.rotation.transpose(0, 2, 1))
    assert np.abs(tilt).max() < 0.05 * np.abs(rotation_vector(exact.rotation)).max()
    assert found.ok.all()
    assert ((found.residual > 1e-8) & (found.residual < 1e-5)).all()
    assert (found.position == asked).all()


def test_an_orientation_that_follows_the_joints_follows_their_correction():
    model = off_nominal("scara16", 2, 0.2)
    asked = model.mechanism.sample(30, np.random.default_rng(0))
    found, exact = ipr_compensation.inverse(model, asked), Kinematics(model).inverse(asked)
    nominal = Kinematics(new_model("scara16")).inverse(asked)

    def apart(one):
        return np.abs(rotation_vector(one.rotation @ exact.rotation.transpose(0, 2, 1))).max()

    assert apart(found) < 0.02 * apart(nominal)


def test_the_approximate_direct_problem_predicts_the_whole_pose():
    model = new_model("delta51", from_delta54(vr.TABLE_5_18))
    q, _ = vr.NOMINAL.inverse(vd.targets(20, seed=1))
    r, R = vr.MOCK_UP.forward(q)
    found = ipr_compensation.direct(model, q)
    assert np.abs(found.position - r).max() < 15e-6
    assert np.abs(rotation_vector(found.rotation @ R.transpose(0, 2, 1))).max() < 5e-4


def test_one_pose_is_answered_with_one_solution_and_failures_keep_their_reason():
    model = new_model("delta54", vr.TABLE_5_18)
    one = ipr_compensation.inverse(model, np.array([0, 0, 0.2]))
    assert one.joints.shape == (3,)
    far = ipr_compensation.inverse(model, np.array([[0, 0, 0.2], [0, 0, 2.0]]))
    assert far.status.tolist() == [Status.CONVERGED, Status.UNREACHABLE]


def test_a_correction_that_corrects_nothing_is_no_solution():
    """Rods of half their length reach nowhere; a first-order step from nominal is no pose."""
    short = new_model("delta_nominal", {"Lb": 0.12})
    assert Kinematics(short).direct(np.full(3, 0.5)).status == Status.UNREACHABLE
    found = ipr_compensation.direct(short, np.full(3, 0.5))
    assert found.residual > 1e-2
    assert found.status == Status.NOT_CONVERGED


def test_a_robot_with_more_lines_than_freedoms_is_not_compensated_through_its_pose():
    with pytest.raises(
        SolveError, match="more closure rows than degrees of freedom: use --solver newton"
    ):
        ipr_compensation.inverse(new_model("cable"), np.zeros(3))
