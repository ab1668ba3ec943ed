"""Solutions of chains far from home are those to which small steps from home lead, in Python and C.

The linkages are written here a second time, from their points alone.
"""

import ctypes
import subprocess
from types import SimpleNamespace

import chains
import numpy as np
import pytest
import test_shelf_as_chain as shelf
from chains import make_chain, revolute, rod
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import parallel_cal as pc
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.exporting.export import export
from parallel_cal.kinematics.all_solutions import inverse_all
from parallel_cal.kinematics.kinematics import Status
from parallel_cal.kinematics.newton import short_step
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solvers.continuous import follow_joints
from parallel_cal.kinematics.split_turns import turn_towards

# ------------------------------------------------------------------ cranks that turn around

CRANK, BACK, SIDES, HEIGHTS = 0.04, 0.05, np.array([0.035, -0.035]), np.array([0.25, 0.2])


def foot_balls(angles):
    """Balls (N, 2, 3) of both rods on a foot that pitches and rolls by angles (N, 2)."""
    balls = np.column_stack([[-BACK, -BACK], SIDES, [0, 0]])
    return balls @ Rotation.from_euler("YX", angles).as_matrix().swapaxes(1, 2)


def rod_errors(angles, q):
    """How much longer both rods are than they are (N, 2)."""
    cranks = np.stack(
        [-0.01 - CRANK * np.cos(q), SIDES + 0 * q, HEIGHTS + CRANK * np.sin(q)], axis=-1
    )
    return np.linalg.norm(foot_balls(angles) - cranks, axis=2) - HEIGHTS


def slopes(angles, q, step=1e-6):
    columns = [
        (rod_errors(angles + step * unit, q) - rod_errors(angles - step * unit, q)) / (2 * step)
        for unit in np.eye(2)
    ]
    return np.stack(columns, axis=-1)


def walk_ankle(q, steps=150):
    """Turn both cranks from home to readings (N, 2) in small steps; return the angles of the foot,
    and which samples met no singularity on the way."""
    angles, regular = np.zeros_like(q), np.ones(len(q), dtype=bool)
    first = np.linalg.det(slopes(angles[:1], 0 * q[:1]))[0]
    for share in np.linspace(0, 1, steps + 1)[1:]:
        before = angles
        for _ in range(4):
            J = slopes(angles, share * q)
            regular &= np.linalg.det(J) / first > 0.01
            J[~regular] = np.eye(2)
            error = rod_errors(angles, share * q)
            angles = angles - np.linalg.solve(J, error[..., None])[..., 0] * regular[:, None]
        regular &= (np.abs(rod_errors(angles, share * q)) < 1e-9).all(axis=1)
        regular &= (np.abs(angles - before) < 0.3).all(axis=1)
    return angles, regular


AROUND = np.random.default_rng(0).uniform(-np.pi, np.pi, (120, 2))


@pytest.mark.wide
def test_an_ankle_whose_cranks_turn_around_stays_in_the_mode_of_home():
    """At 7 of 94 readings it was another mode, in which the determinant has the sign of home."""
    model = make_chain(shelf.ankle_2rsu())
    angles, regular = walk_ankle(AROUND)
    assert regular.sum() > 85
    found = pc.Kinematics(model).direct(AROUND)
    assert found.ok[regular].all()
    expected = Rotation.from_euler("YX", angles[regular]).as_matrix()
    np.testing.assert_allclose(found.rotation[regular], expected, atol=1e-8)
    alone = [pc.Kinematics(model).direct(q) for q in AROUND[regular][:20]]
    np.testing.assert_allclose([one.rotation for one in alone], expected[:20], atol=1e-8)


# ------------------------------------------------------------------ a knee beyond its toggle


def bent(angles):
    """Poses of the shank of `chains.knee`, bent about y."""
    turned = Rotation.from_euler("y", np.reshape(angles, (-1, 1)))
    return turned.apply([0, 0, -0.36]), turned.as_matrix()


def toggle(bend):
    """Zero where the knee and both ends of its actuator are in line."""
    lower = Rotation.from_euler("y", bend).apply([-0.06, 0, 0.03])
    return np.cross([-0.06, 0, 0.23], lower)[1]


def test_no_readings_are_an_answer_for_a_knee_beyond_its_toggle():
    """The actuator has the same length there as at a knee that bends the other way, to which it
    leads from home."""
    solver = pc.Kinematics(make_chain(chains.knee()))
    line = brentq(toggle, 0.7, 1.0)
    beyond = solver.inverse(*bent(line - np.array([0.5, 0.2, 0.05, 0.005])))
    assert (beyond.status == Status.OTHER_BRANCH).all()
    before = solver.inverse(*bent(line + np.array([0.005, 0.05, 0.5, 1.0])))
    assert before.ok.all()
    again = solver.direct(before.joints)
    np.testing.assert_allclose(again.position, before.position, atol=1e-9)


def test_the_first_of_all_solutions_is_the_one_without_a_search():
    """Beyond its toggle it was a reading of the other side, called converged."""
    model = make_chain(chains.knee())
    line = brentq(toggle, 0.7, 1.0)
    r, R = bent(line - 0.2)
    alone = pc.Kinematics(model).inverse(r[0], R[0])
    every = inverse_all(model, r[0], R[0])
    assert alone.status == every.status[0] == Status.OTHER_BRANCH
    np.testing.assert_allclose(every.joints[0], alone.joints, atol=1e-9)


# ------------------------------------------------------------------ a platform that must turn

AXES, BAR, LINK, SIDES_OF_ELBOWS = np.array([[-0.05, 0.0], [0.05, 0.0]]), 0.1, 0.15, (1, -1)


def turning_five_bar(moves):
    """The five-bar of `chains`, without limits of its cranks."""
    options = chains.five_bar() | {"moves": moves, "controls": ["x", "y"]}
    for joint in options["joints"]:
        joint.pop("limits", None)
    return options


def cross(one, other):
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def crank_angles(points):
    """Angles (N, 2) of both cranks of `chains.five_bar` for points (N, 2), in the mode of home, and
    how far (N,) each point is from a singularity: the smallest sine between its links."""
    angles, sines, rods = [], [], []
    for axis, side in zip(AXES, SIDES_OF_ELBOWS, strict=True):
        away = points - axis
        distance = np.hypot(*away.T)
        cosine = (BAR**2 + distance**2 - LINK**2) / (2 * BAR * distance)
        angle = np.arctan2(away[:, 1], away[:, 0]) + side * np.arccos(np.clip(cosine, -1, 1))
        crank = np.column_stack([np.cos(angle), np.sin(angle)])
        rods.append((away - BAR * crank) / LINK)
        angles.append(angle)
        sines.append(np.where(np.abs(cosine) < 1, side * cross(rods[-1], crank), 0.0))
    return np.column_stack(angles), np.min([*sines, cross(*rods)], axis=0)


def walk_five_bar(points, home, steps=200):
    """Angles (N, 2) to which a straight path from home leads, and which paths are regular."""
    angles, room = crank_angles(home[None])
    for share in np.linspace(0, 1, steps + 1)[1:]:
        q, here = crank_angles(home + share * (points - home))
        room = np.minimum(room, here)
        angles = angles + (q - angles + np.pi) % (2 * np.pi) - np.pi
    return angles, room > 0.02


@pytest.mark.parametrize("moves", [["x", "y"], ["x", "y", "rz"]])
def test_a_pose_to_which_home_leads_is_answered_whether_or_not_the_platform_turns(moves):
    """6 of 294 were `other_branch`: each step of a path began with the rotation of home."""
    model = make_chain(turning_five_bar(moves))
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (1500, 2))
    angles, regular = walk_five_bar(points, np.array(model.mechanism.home.position[:2]))
    assert regular.sum() > 280
    found = pc.Kinematics(model).inverse(np.pad(points[regular], ((0, 0), (0, 1))))
    assert found.ok.all()
    off = np.angle(np.exp(1j * (found.joints - angles[regular])))
    np.testing.assert_allclose(off, 0.0, atol=1e-8)


@pytest.mark.parametrize(("controls", "free"), [("rx ry", 2), ("rx", 0), ("rz", 1)])
def test_a_start_turns_a_pose_only_as_the_robot_may(controls, free):
    """Of one turn that follows, only the angle about its axis is that of the start."""
    rng = np.random.default_rng(2)
    given, start = (rotation_matrix(rng.uniform(-1, 1, (5, 3))) for _ in range(2))
    mechanism = SimpleNamespace(
        controlled=[3 + "xyz".index(name[1]) for name in controls.split()],
        parasitic=[i for i in (3, 4, 5) if f"r{'xyz'[i - 3]}" not in controls.split()],
    )
    turned = turn_towards(mechanism, given, start)
    if len(mechanism.parasitic) == 1:
        w = rotation_vector(turned @ given.swapaxes(1, 2))
        np.testing.assert_allclose(np.delete(w, free, axis=1), 0.0, atol=1e-12)
        gap = np.linalg.norm(rotation_vector(start @ turned.swapaxes(1, 2)), axis=1)
        for step in (1e-3, -1e-3):
            other = rotation_matrix(step * np.eye(3)[free]) @ turned
            assert (
                np.linalg.norm(rotation_vector(start @ other.swapaxes(1, 2)), axis=1) > gap
            ).all()
    else:
        axes = mechanism.controlled[0] - 3
        w, asked, begin = (rotation_vector(R) for R in (turned, given, start))
        np.testing.assert_allclose(w[:, axes], asked[:, axes], atol=1e-12)
        rest = np.delete(w, axes, axis=1)
        np.testing.assert_allclose(rest, np.delete(begin, axes, axis=1), atol=1e-12)


# ------------------------------------------------------------------ home next to a dead point


def four_bar(crank=0.0):
    """A planar crank of 0.1 m, a coupler of 0.3 m and a rocker of 0.2 m about (0.3, 0), drawn with
    the crank `crank` rad from where it and the coupler are in line."""
    line = np.arccos((0.4**2 + 0.3**2 - 0.2**2) / (2 * 0.4 * 0.3))
    q = line + crank
    elbow = 0.1 * np.array([np.cos(q), np.sin(q)])
    reach = np.array([0.3, 0.0]) - elbow
    distance = np.hypot(*reach)
    bend = np.arccos((0.3**2 + distance**2 - 0.2**2) / (2 * 0.3 * distance))
    end = elbow + 0.3 * np.array(
        [np.cos(np.arctan2(*reach[::-1]) + bend), np.sin(np.arctan2(*reach[::-1]) + bend)]
    )
    angle = float(np.arctan2(end[1], end[0] - 0.3))
    joints = [
        revolute("crank", "base", "crank", driven=True, home=float(q), limits=[q - 1.0, q + 1.5]),
        revolute("rocker", "base", "rocker", origin=[0.3, 0, 0], home=angle),
    ]
    loops = [rod("coupler", ("crank", [0.1, 0, 0]), ("rocker", [0.2, 0, 0]), length=0.3)]
    ends = {"base": "base", "platform": "rocker", "target": [0.1, 0, 0]}
    return {**ends, "joints": joints, "loops": loops, "controls": ["rz"]}


@pytest.mark.parametrize("crank", [0.0, 1e-5, -1e-5, 1e-3, -1e-3, 0.2])
def test_inverse_keeps_to_one_side_of_a_dead_point_at_home(crank):
    """Two readings have each pose near it. It was now one, now the other, without a word."""
    model = make_chain(four_bar(crank))
    home = model.mechanism.home.joints[0]
    dead, side = home - crank, np.sign(crank) or 1.0  # the crank has more room above
    readings = dead + side * np.linspace(0.01, 0.9, 40)
    solver = pc.Kinematics(model)
    poses = solver.direct(readings[:, None])
    assert poses.ok.all()
    found = solver.inverse(poses.position, poses.rotation)
    assert found.ok.all()
    np.testing.assert_allclose(found.joints[:, 0], readings, atol=1e-6)
    said = any("dead point" in remark for remark in model.mechanism.remarks)
    assert said == (abs(crank) < 1e-4)


# ------------------------------------------------------------------ out of reach


def test_a_search_ends_soon_where_nothing_is_to_be_found():
    """It made 100 steps from each start, however little they changed."""
    model = pc.new_model("stewart42")
    solver, count = pc.Kinematics(model), 0
    problem = solver.direct_problem
    change = problem.calls.change

    class Counted:
        def __call__(self, *arguments):
            nonlocal count
            count += 1
            return change(*arguments)

    problem.calls.change = Counted()
    try:
        far = np.random.default_rng(1).uniform(-0.6, 0.8, (20, 6))
        assert not solver.direct(far).solved.any()
    finally:
        problem.calls.change = change
    assert 0 < count < 20 * 80


# ------------------------------------------------------------------ two flat parallelograms


@pytest.mark.wide
def test_each_loop_in_series_stays_on_its_own_side():
    """Two parallelograms were flat on the way from home to 3 of 200 readings: the sign of the whole
    determinant is that of home again there, and the signs of both loops are not."""
    model = make_chain(shelf.palletizer())
    home = np.array(model.mechanism.home.joints)
    q = home + 1.5 * np.random.default_rng(0).uniform(-1, 1, (200, 4))
    solver = pc.Kinematics(model)
    found, problem = solver.direct(q), solver.direct_problem
    blocks, here = problem.calls.blocks, np.array(model.mechanism.home.configuration)
    assert len(blocks) > 3
    assert found.ok.sum() > 140
    a, columns = model.condition_rows(None, 1)[0], model.mechanism.dependent_columns
    for x in found.configuration.rows[found.ok]:
        for block in blocks:
            first, last = (
                np.array(model.structure.closure_configuration(at, a, model.values)[1])[
                    np.ix_(block.rows, np.array(columns)[block.columns])
                ]
                for at in (here, x)
            )
            assert np.linalg.det(first) * np.linalg.det(last) > 0


def test_a_path_ends_where_a_parallelogram_is_flat():
    """There, an antiparallelogram crosses it, with the sign of home behind. 47 of 53 readings that
    lie behind were called converged."""
    model = make_chain(shelf.palletizer())
    home = np.array(model.mechanism.home.joints)
    q = home + 1.5 * np.random.default_rng(0).uniform(-1, 1, (200, 4))
    upper, fore = q[:, 1], q[:, 2]
    # Upper arm and crank, upper arm and the level, forearm and the vertical are not in line.
    regular = (fore < upper) & (upper < fore + np.pi) & (upper > 0) & (upper < np.pi)
    regular &= np.abs(fore) < np.pi / 2
    assert 100 < regular.sum() < 180
    found = pc.Kinematics(model).direct(q)
    np.testing.assert_array_equal(found.ok, regular)


# ------------------------------------------------------------------ closed forms


@pytest.mark.wide
def test_readings_of_an_argos_lead_where_small_steps_lead():
    """Far from home another orientation was nearer to it."""
    model = pc.new_model("argos9")
    solver = pc.Kinematics(model)
    for q in np.random.default_rng(3).uniform(-2.6, 2.6, (6, 3)):
        path = np.linspace(np.zeros(3), q, 100)
        steps, found = follow_joints(solver, path).solutions, solver.direct(path)
        here = distances(model, steps)
        regular = np.minimum.accumulate(np.minimum(here.direct, here.inverse)) > 0.05
        compared = found.rotation[: len(steps)][regular]
        np.testing.assert_allclose(compared, steps.rotation[regular], atol=1e-7)


def test_a_short_step_of_a_slide_is_one_of_its_robot():
    """It was 0.5 m, of a robot of 60 mm and of 6 m."""
    small, large = (hexaglide_of(size) for size in (1.0, 20.0))
    np.testing.assert_allclose(
        short_step(large.mechanism)[:6], 20 * short_step(small.mechanism)[:6]
    )


def hexaglide_of(size):
    ends = {"base": (0.3, [-20, 20, 100, 140, 220, 260])}
    ends |= {"platform": (0.08, [-50, 50, 70, 170, 190, 290])}
    rings = {key: {"radius": size * radius, "angles": at} for key, (radius, at) in ends.items()}
    return pc.new_model(pc.mechanisms.load("hexaglide", rod=0.4 * size, rails=[0, 0, 1], **rings))


# ------------------------------------------------------------------ exported C


@pytest.mark.wide
@pytest.mark.parametrize("name", ["ankle", "knee", "four_bar", "five_bar", "arm"])
def test_exported_c_answers_the_same_far_from_home(name, tmp_path):
    made = {"ankle": shelf.ankle_2rsu, "knee": chains.knee, "four_bar": lambda: four_bar(0.0)}
    made |= {"five_bar": lambda: turning_five_bar(["x", "y", "rz"]), "arm": shelf.palletizer}
    model = make_chain(made[name]())
    export(model, "c:poses=20,name=robot", tmp_path)
    words = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-O0", "-shared", "-fPIC"]
    subprocess.run([*words, "robot.c", "-o", "robot.so", "-lm"], cwd=tmp_path, check=True)
    library, solver = ctypes.CDLL(f"{tmp_path}/robot.so"), pc.Kinematics(model)
    n, m = len(model.joints), len(model.mechanism.passive)
    low, high = np.clip(np.array(model.mechanism.joint_limits).T, -np.pi, np.pi)
    readings = AROUND[:60] if name == "ankle" else np.linspace(low, high, 60)
    if name == "arm":
        home = np.array(model.mechanism.home.joints)
        readings = home + np.random.default_rng(0).uniform(-1.5, 1.5, (80, 4))
    poses = solver.direct(readings)
    if name == "knee":
        r, R = bent(np.linspace(0.3, 2.1, 60))
    elif name == "five_bar":
        r = np.pad(np.random.default_rng(0).uniform(-0.25, 0.25, (200, 2)), ((0, 0), (0, 1)))
        R = np.tile(np.eye(3), (len(r), 1, 1))
    elif name == "arm":  # Python alone restores its controlled turn where it tilts
        r, R = np.empty((0, 3)), np.empty((0, 3, 3))
    else:
        r, R = poses.position[poses.solved], poses.rotation[poses.solved]

    def answers(function, *given):
        answer, residual = (ctypes.c_double * (n + 12 + m))(), ctypes.c_double()
        given = [(ctypes.c_double * part.size)(*part.ravel()) for part in given]
        status = function(*given, None, None, answer, ctypes.byref(residual))
        return status, np.array(answer)

    expected = [*poses, *(solver.inverse(r, R) if len(r) else [])]
    got = [answers(library.robot_direct, q) for q in readings]
    got += [answers(library.robot_inverse, *pose) for pose in zip(r, R, strict=True)]
    for (status, x), python in zip(got, expected, strict=True):
        assert status == python.status
        if status == Status.CONVERGED:
            rows = python.configuration.rows
            np.testing.assert_allclose(x[: n + 12], rows[: n + 12], atol=1e-8)
