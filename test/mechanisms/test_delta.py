"""The Delta's three models: hand-worked numbers, the independent robot, round trips."""

import casadi as ca
import numpy as np
import pytest

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.all_solutions import direct_all, inverse_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.newton import newton_functions
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.virtual import robot as vr

# One chain in whole numbers. R turns (x, y, z) into (z, x, y); T turns it into (x, -z, y).
HAND = dict(  # noqa: C408
    D_x=4,
    D_y=5,
    D_z=6,
    theta=0,
    alpha=np.pi / 2,
    La_x=2,
    La_y=1,
    Lb=10,
    d_z=2,
    dalpha=0,
    dbeta=0,
    dC_x=1,
    dC_y=2,
    dC_z=3,
    dLb=2,
    b_x=1,
    b_y=2,
    b_z=3,
)
CYCLE = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
# Changed number -> (G1, G2), worked on paper: CB = (5, 10, -3) and dd = (-1, 5, -4) unchanged,
# so G1 = (134 + 42 - 104) / 20 and G2 = (57 - 20) / 10.
BY_HAND = {
    "": (0, 3.6, 3.7),
    "q": (np.pi / 2, 5.7, 5.8),
    "D_x": (5, 3.15, 3.8),
    "D_y": (6, 3.95, 4.1),
    "D_z": (7, 4.65, 4.2),
    "theta": (np.pi / 2, -2.4, -4.1),
    "alpha": (0, 0.6, -0.5),
    "La_x": (3, 3.15, 3.8),
    "La_y": (2, 3.95, 4.1),
    "Lb": (20, -5.7, 0.85),
    "d_z": (3, 4.6, 5.0),
    "dalpha": (np.pi / 2, 3.0, -0.9),
    "dbeta": (np.pi / 2, 3.0, -5.1),
    "dC_x": (2, 3.75, 3.2),
    "dC_y": (3, 4.05, 4.0),
    "dC_z": (4, 4.15, 4.7),
    "dLb": (3, 3.35, 2.7),
    "b_x": (2, 4.2, 4.3),
    "b_y": (3, 4.5, 4.0),
    "b_z": (4, 5.0, 4.6),
}


def phi(model, q, r, R, at=()):
    configuration = np.concatenate([q, r, np.asarray(R).ravel()])
    return np.array(model.structure.closure(configuration, np.array(at), model.values)[0]).ravel()


@pytest.mark.parametrize("changed", BY_HAND, ids=lambda name: name or "nothing")
@pytest.mark.parametrize("chain", [0, 1, 2])
def test_closure_of_every_chain_is_what_paper_and_pencil_say(changed, chain):
    value, g1, g2 = BY_HAND[changed]
    numbers = {**HAND, changed: value} if changed in HAND else HAND
    q = np.zeros(3)
    q[chain] = value if changed == "q" else 0.0
    model = new_model("delta54", {f"chain{chain + 1}.{k}": v for k, v in numbers.items()})
    rows = phi(model, q, [10, 0, 8], CYCLE)
    assert rows[[chain, 3 + chain]] == pytest.approx([g1, g2], abs=1e-12)


def test_every_parameter_of_model_54_has_a_number_worked_by_hand():
    names = {name.split(".")[1] for name in new_model("delta54").table.names}
    assert names == set(BY_HAND) - {"", "q"}


def strayed(name, seed):
    """A robot whose every parameter is off by its tolerance's size."""
    model = new_model(name)
    draw = np.random.default_rng(seed).standard_normal(len(model.values))
    return model.with_values(model.values + model.table.tolerance * draw)


def as_virtual(model):
    return vr.Delta(model.table.mapping(model.values))


@pytest.mark.parametrize("seed", range(3))
def test_model_54_agrees_with_the_robot_of_points_and_rods(seed):
    model = strayed("delta54", seed)
    robot, kinematics = as_virtual(model), Kinematics(model)
    targets = model.mechanism.sample(300, np.random.default_rng(seed))
    q, R = robot.inverse(targets)
    assert max(np.abs(phi(model, *x)).max() for x in zip(q, targets, R, strict=True)) < 1e-12
    answer, back = kinematics.direct(q), kinematics.inverse(targets)
    assert np.abs(answer.position - targets).max() < 1e-9
    assert np.abs(answer.rotation - R).max() < 1e-9
    assert np.abs(back.joints - q).max() < 1e-9


@pytest.mark.parametrize("name", ["delta54", "delta24", "delta_nominal"])
@pytest.mark.parametrize("compile", [False, True], ids=["virtual machine", "compiled"])
def test_ten_thousand_round_trips_return_to_where_they_began(name, compile):
    model = strayed(name, 5)
    kinematics = Kinematics(model, compile=compile)
    targets = model.mechanism.sample(10_000, np.random.default_rng(6))
    joints = kinematics.inverse(targets)
    poses = kinematics.direct(joints.joints)
    assert set(joints.status) == set(poses.status) == {Status.CONVERGED}
    assert np.abs(poses.position - targets).max() <= 1e-12
    turned = rotation_vector(poses.rotation @ joints.rotation.transpose(0, 2, 1))
    assert np.abs(turned).max() <= 1e-12


@pytest.mark.parametrize(
    ("problem", "most", "turns"), [("direct", 3100, 36), ("inverse", 3700, 39)]
)
def test_a_solve_is_as_few_instructions_as_six_microseconds_allow(problem, most, turns):
    """1.6 ns an instruction on the virtual machine; trigonometry costs ten times as much. The
    inverse problem looks on which side of the direct singularities it is."""
    solve = newton_functions(new_model("delta54").structure, problem).solve
    assert solve.n_instructions() < most
    code = [solve.instruction_id(i) for i in range(solve.n_instructions())]
    assert sum(code.count(op) for op in (ca.OP_SIN, ca.OP_COS, ca.OP_ATAN2)) <= turns


def test_mock_up_stands_at_30_65_degrees_under_its_centre():
    model = new_model("delta54", vr.TABLE_5_12)
    angles = np.degrees(Kinematics(model).inverse([0, 0, 0.2]).joints)
    assert angles == pytest.approx([30.655] * 3, abs=1e-3)


def test_nominal_values_are_those_of_table_5_12():
    table = new_model("delta54").table
    assert table.nominal == pytest.approx(table.vector(vr.TABLE_5_12))


@pytest.mark.parametrize("name", ["delta24", "delta_nominal"])
def test_small_model_widened_answers_the_same(name):
    small = strayed(name, 7)
    large = small.widen()
    q = Kinematics(small).inverse(small.mechanism.sample(200, np.random.default_rng(8))).joints
    a, b = Kinematics(small).direct(q), Kinematics(large).direct(q)
    assert np.abs(a.position - b.position).max() < 1e-13
    assert np.abs(b.rotation - np.eye(3)).max() < 1e-13


def test_model_24_has_two_poses_and_eight_joint_sets_and_all_close():
    model = strayed("delta24", 9)
    kinematics = Kinematics(model)
    q = kinematics.inverse([0.01, -0.02, 0.2]).joints
    poses, joints = (
        direct_all(kinematics.model, q),
        inverse_all(kinematics.model, [0.01, -0.02, 0.2]),
    )
    assert (len(poses), len(joints)) == (2, 8)
    assert max(poses.residual.max(), joints.residual.max()) < 1e-14
    assert poses.position[0] == pytest.approx([0.01, -0.02, 0.2], abs=1e-12)
    assert poses.position[1][2] < 0 < poses.position[0][2]


def thesis_position_problem(E, F, G, H):
    """Eqs 6.2-6.6 as printed, with the sign of 4LQ corrected; a check, not our solver."""
    c = np.cross
    N1 = c(E, F).sum()
    N2, N3, N4, N5 = c(F, G).sum(), c(F, H).sum(), -c(E, G).sum(), -c(E, H).sum()
    L = N1**2 + N2**2 + N4**2
    M = N1 * (E[0] * N2 + F[0] * N4 + G[0] * N1) + 2 * N2 * N3 + 2 * N4 * N5
    Q = N1 * (E[0] * N3 + F[0] * N5 + H[0] * N1) + N3**2 + N5**2
    z = (-M + np.array([1, -1]) * np.sqrt(M**2 - 4 * L * Q)) / (2 * L)
    return np.stack([(N2 * z + N3) / N1, (N4 * z + N5) / N1, z], axis=1)


def test_position_problem_agrees_with_the_formulas_of_the_thesis():
    model = new_model("delta24")
    q = np.array([0.5, 0.6, 0.4])
    p = model.table.mapping(model.values)
    centres, H = [], []
    for i, angle in enumerate(q, start=1):
        c = {k.split(".")[1]: v for k, v in p.items() if k.startswith(f"chain{i}.")}
        arm = c["La_x"] + 1j * c["La_y"]
        x, y = (lambda z: (z.real, z.imag))(arm * np.exp(1j * angle) + c["D_x"] + 1j * c["D_y"])
        ct, st = np.cos(c["theta"]), np.sin(c["theta"])
        centres.append([ct * x + st * c["D_z"], st * x - ct * c["D_z"], y])
        H.append(np.dot(centres[-1], centres[-1]) - c["Lb"] ** 2)
    E, F, G = -2 * np.array(centres).T
    expected = thesis_position_problem(E, F, G, np.array(H))
    found = direct_all(model, q).position
    assert np.abs(found - expected[np.argsort(-expected[:, 2])]).max() < 1e-13


def test_unknown_mechanism_is_named_with_those_that_exist():
    with pytest.raises(ModelError, match=r"no mechanism 'delta99': expected one of .*delta24"):
        load_mechanism("delta99")
