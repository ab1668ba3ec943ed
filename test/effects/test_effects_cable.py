"""Build-up on spools and stretch of lines: by hand, and found in the virtual cable robot."""

import casadi as ca
import numpy as np
import pytest
from test_virtual_robots import CABLE
from virtual_cable import FALL, Line, WoundCable

from parallel_cal.base.errors import ModelError
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import Seen
from parallel_cal.model.model import new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset

MOTORS = ("motor1", "motor2", "motor3", "motor4")
NOISE = {"joint": 0.02, "position": 0.1e-3}  # rad of the motor (60 um of line), m
Q = 0.1e-3
GARDA = Line(section=Q * np.pi * 5e-3, width=5e-3)
SOFT = Line(EA=15e3)


def sees(name, numbers, q=(0, 0, 0, 0), r=(0, 0, 0), **geometry):
    """(q, r) that the ideal cable robot sees, with 2 kg hanging from it."""
    m = load_mechanism("cable")
    effect = load_effect(name)
    table = effect.table(m)
    e = table.vector({f"{name}.{key}": value for key, value in numbers.items()})
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.vector(geometry))))
    seen = Seen(ca.SX(ca.DM(q)), ca.SX(ca.DM(r)), ca.SX.eye(3), p)
    at = Named(("payload",), ca.SX(ca.DM([2.0])))
    seen = effect.ideal(seen, Named(table.names, ca.SX(ca.DM(e)))[name], at, m)
    return tuple(np.array(ca.DM(part)).squeeze() for part in (seen.q, seen.r))


def makers_line(degrees, Q, gear, advantage, radius):
    """Line let out as the machine's maker computes it."""
    k2 = -advantage * Q
    k0 = 2.0 * gear * advantage * 360 / (2 * np.pi) / k2
    return ((degrees / k0 + radius) ** 2 - radius**2) / k2


# --------------------------------------------------------------------------- by pencil and paper


def test_a_spool_of_100_mm_that_has_turned_four_radians_off_lags_by_a_tenth_of_a_radian():
    """Q = 5 mm: the radius has shrunk by Q s / 2 = 10 mm, on average 5 of 100: four times 5 %."""
    gear = {f"line{i}.gear": 10.0 for i in (1, 2, 3, 4)}
    q, _ = sees("spool_buildup", {"Q": 5e-3}, (40, -40, 0, 40), **gear, **{"spool1.R": 0.1})
    np.testing.assert_allclose(q[:3], [40 - 2, -40 - 2, 0], atol=1e-12)
    np.testing.assert_allclose(q[3], 40 - 2 * 0.1 / 0.075, atol=1e-12)


@pytest.mark.parametrize("Q", [1e-6, 0.0976e-3, 0.3e-3])
def test_build_up_is_the_makers_formula(Q):
    degrees = np.array([11240.81, -10926.45, 5669.69, -41134.57])
    q, _ = sees("spool_buildup", {"Q": Q}, np.radians(degrees))
    ours = q * 0.075 / (12.75 * np.array([2, 2, 2, 4]))
    makers = [makers_line(d, Q, 12.75, a, 0.075) for d, a in zip(degrees, (2, 2, 2, 4))]  # noqa: B905
    np.testing.assert_allclose(ours, makers, rtol=1e-9)


def test_without_build_up_the_motor_is_seen_as_it_is_read_and_its_slope_is_finite():
    model = new_model("cable").with_effect("spool_buildup")
    s = model.structure
    slope = ca.Function("slope", [s.q, s.v], [s.seen.q, ca.jacobian(s.seen.q, s.v[-1])])
    seen, by_Q = slope([100, -100, 0, 700], model.values)
    np.testing.assert_array_equal(np.array(seen).squeeze(), [100, -100, 0, 700])
    expected = -np.array([1e4, 1e4, 0, 49e4]) / (4 * 12.75 * 0.075)
    np.testing.assert_allclose(np.array(by_Q).squeeze(), expected, rtol=1e-12)


def test_four_strands_of_two_metres_give_half_as_much_as_the_sum_of_weight_over_ea_says():
    """Lines along the axes: only the third carries. 3 kg on 4 EA / 2 m: 29.43 N / 20 kN/m."""
    anchors = {f"line{i}.A_{a}": 2.0 * (i == k) for i in (1, 2, 3) for k, a in enumerate("xyz", 1)}
    far = {"line4.A_x": 1e9, "line4.A_y": 0.0, "line4.A_z": 0.0, "line3.advantage": 4.0}
    _, r = sees("line_stretch", {"compliance": 1e-4, "mass": 1.0}, **anchors, **far)
    np.testing.assert_allclose(r, [0, 0, 3 * 9.81 / 2 * 1e-4], atol=1e-12)


def test_a_plotter_on_a_wall_sags_in_its_plane():
    """Two lines of 5 m, 4 m up and 3 m aside: 29.43 N on the stiffness 2 EA (4/5)^2 / 5 m."""
    wall = load_mechanism("cable", anchors=[[-3, 0, 4], [3, 0, 4]])
    numbers = {"line_stretch.compliance": 1e-7, "line_stretch.mass": 3.0}
    model = new_model(wall, numbers, ["line_stretch"])
    r = Kinematics(model).direct(np.zeros(2), {"payload": 0.0}).position
    np.testing.assert_allclose(r, [0, 0, -3 * 9.81 * 1e-7 / 0.256], atol=1e-9)


def test_a_plotter_on_two_lines_drawn_in_x_and_y_sags_too():
    """The weight holds its lines taut, so gravity acts along y."""
    wall = load_mechanism("cable", anchors=[[-3, 4], [3, 4]])
    numbers = {"line_stretch.compliance": 1e-7, "line_stretch.mass": 3.0}
    model = new_model(wall, numbers, ["line_stretch"])
    r = Kinematics(model).direct(np.zeros(2), {"payload": 0.0}).position
    np.testing.assert_allclose(r, [0, -3 * 9.81 * 1e-7 / 0.256, 0], atol=1e-9)


def test_a_plotter_on_a_table_does_not_sag():
    table = load_mechanism("cable", anchors=[[-3, 4], [3, 4], [3, -4], [-3, -4]])
    words = r"does not move along gravity: .* state gravity .* \[0.0, -9.81, 0.0\]"
    with pytest.raises(ModelError, match=words):
        new_model(table).with_effect("line_stretch")


@pytest.mark.parametrize("name", ["spool_buildup", "line_stretch"])
def test_lines_are_where_a_cable_robot_is(name):
    with pytest.raises(
        ModelError, match=f"effect {name} does not apply to delta24: (it has )?no line"
    ):
        new_model("delta24").with_effect(name)


# --------------------------------------------------------------------------- the virtual robot


def session(line, n=60, seed=0, noise=1.0, loads=(0.0,), fall=FALL):
    """Random visits of the robot in 1 m x 1 m x 0.8 m; loads in turn (kg)."""
    rng = np.random.default_rng(seed)
    robot = WoundCable(CABLE, line, fall=fall)
    held = rng.uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8), (n, 3))
    payload = np.resize(loads, n)
    q = robot.motors(held) + noise * NOISE["joint"] * rng.normal(size=(n, 4))
    r = robot.hangs(held, payload) + noise * NOISE["position"] * rng.normal(size=(n, 3))
    sigma = [NOISE["position"]] * 3 + [np.nan] * 3
    return Dataset.from_arrays(
        MOTORS,
        q,
        r,
        pose_cov=np.diag(np.square(sigma)),
        joint_sigma=NOISE["joint"],
        conditions={"payload": payload},
        pose_id=np.arange(n),
    )


def closure(model, data):
    x = np.column_stack([data.q, data.r, np.tile(np.eye(3).ravel(), (len(data), 1))])
    at = np.column_stack([data.conditions[c] for c in model.conditions] or [np.zeros((len(x), 0))])
    return model.structure.closure_batch(x, at, model.values)[0]


def test_the_true_build_up_closes_every_line_of_the_virtual_robot():
    data = session(GARDA, noise=0.0)
    exact = new_model("cable", CABLE | {"spool_buildup.Q": Q}, ["spool_buildup"])
    assert np.abs(closure(exact, data)).max() < 1e-8
    assert np.abs(closure(new_model("cable", CABLE), data)).max() > 4e-3


def test_the_true_stretch_closes_every_line_to_the_sags_square_over_the_length():
    data = session(SOFT, noise=0.0, loads=(1.0, 4.0))
    numbers = {"line_stretch.compliance": 1 / SOFT.EA}
    exact = new_model("cable", CABLE | numbers, ["line_stretch"])
    assert np.abs(closure(exact, data)).max() < 2e-6
    assert np.abs(closure(new_model("cable", CABLE), data)).max() > 0.5e-3


def test_a_robot_whose_base_leans_hangs_aside():
    """Gravity is what the model file says it is: here 30 degrees from the base's -z."""
    fall = (9.81 * 0.5, 0.0, -9.81 * np.sqrt(0.75))
    data = session(SOFT, noise=0.0, loads=(1.0, 4.0), fall=fall)
    numbers = CABLE | {"line_stretch.compliance": 1 / SOFT.EA}
    leaning = load_mechanism("cable")
    leaning.gravity = fall
    assert np.abs(closure(new_model(leaning, numbers, ["line_stretch"]), data)).max() < 2e-6
    assert np.abs(closure(new_model("cable", numbers, ["line_stretch"]), data)).max() > 0.3e-3


def test_build_up_is_recovered_without_noise():
    found = fit(new_model("cable").with_effect("spool_buildup"), session(GARDA, noise=0.0))
    assert found.model.value("spool_buildup.Q") == pytest.approx(Q, rel=1e-5)
    assert found.model.value("spool2.R") == pytest.approx(CABLE["spool2.R"], abs=1e-7)


def test_stretch_is_recovered_without_noise():
    data = session(SOFT, noise=0.0, loads=(0.0, 1.0, 4.0))
    found = fit(new_model("cable").with_effect("line_stretch"), data)
    assert found.model.value("line_stretch.compliance") == pytest.approx(1 / SOFT.EA, rel=2e-3)


CASES = {
    "spool_buildup": (GARDA, (0.0,), "spool_buildup.Q", Q),
    "line_stretch": (SOFT, (0.0, 1.0, 4.0), "line_stretch.compliance", 1 / SOFT.EA),
}


@pytest.mark.parametrize("name", CASES)
def test_the_effect_is_found_and_brings_held_out_poses_to_the_noise(name):
    line, loads, number, truth = CASES[name]
    data = session(line, seed=3, loads=loads)
    plain, found = (fit(model, data) for model in (new_model("cable"), with_effect(name)))
    sigma = found.estimate.sigma[found.model.table.index_of(number)]
    assert found.model.value(number) == pytest.approx(truth, abs=3 * sigma)
    assert sigma < truth / 5
    low, high = chi2_band(found.estimate.dof)
    assert low < found.estimate.chi2_per_dof < high
    before, after = (f.held_out.summary.position_rms for f in (plain, found))
    assert after < 1.15 * found.noise_floor.position_rms
    assert before > 1.5 * after


def with_effect(name):
    return new_model("cable").with_effect(name)
