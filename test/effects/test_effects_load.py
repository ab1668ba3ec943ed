"""Effects of weight and warmth: by hand, against energies, and found in the virtual robots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
import virtual_day as vd
import virtual_effects_more as more
from datasets import measured as session
from marks import keep
from twins import hexapod, joints_near_home

from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import Seen
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import load_effects as vl
from parallel_cal.virtual import robot as vr

G = 9.81


# --------------------------------------------------------------------------- by pencil and paper


def sees(name, mechanism, numbers, conditions, q=None, r=None, gravity=None):
    """What the nominal ideal mechanism sees: (q, r, R) as arrays, geometry by name."""
    m = load_mechanism(mechanism)
    m.gravity = gravity or m.gravity
    table = load_effect(name).table(m)
    values = table.vector({f"{name}.{key}": value for key, value in numbers.items()})
    e = Named(table.names, ca.SX(ca.DM(values)))[name]
    at = Named(tuple(conditions), ca.SX(ca.DM(list(conditions.values()))))
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.nominal)))
    q, r = (m.home.joints if q is None else q), (m.home.position if r is None else r)
    seen = Seen(ca.SX(ca.DM(q)), ca.SX(ca.DM(r)), ca.SX(ca.DM.eye(3)), p)
    seen = load_effect(name).ideal(seen, e, at, m)
    geometry = {key: float(ca.DM(seen.p[key])) for key in m.parameters.names}
    return (*(np.array(ca.DM(part)).squeeze() for part in (seen.q, seen.r, seen.R)), geometry)


def test_a_horizontal_bar_twists_its_shaft_by_compliance_times_m_g_l():
    bar, h = 0.95, 0.1
    q, *_ = sees(
        "joint_compliance",
        "parallelogram_simple",
        {"joint1.compliance": 1e-4},
        {"payload": 2.0},
        [np.pi / 2],
        [bar, -h, 0],
    )
    assert q == pytest.approx(np.pi / 2 - 1e-4 * 2 * G * bar, abs=1e-12)
    hanging, *_ = sees(
        "joint_compliance",
        "parallelogram_simple",
        {"joint1.compliance": 1e-4},
        {"payload": 2.0},
        [0.0],
        [0, -bar - h, 0],
    )
    assert hanging == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(
    ("direction", "payload", "behind"), [(1, 2.0, 1), (-1, 2.0, -1), (0, 2.0, 0), (1, 0.0, 0)]
)
def test_a_horizontal_bar_stays_behind_by_lag_times_m_g_l(direction, payload, behind):
    """Its weight of 2 kg pulls at 0.95 m. Without a load, nothing rubs."""
    at = {"direction.joint1": direction, "payload": payload}
    q, *_ = sees(
        "load_friction",
        "parallelogram_simple",
        {"joint1.lag": 1e-5},
        at,
        [np.pi / 2],
        [0.95, -0.1, 0],
    )
    assert q == pytest.approx(np.pi / 2 - behind * 1e-5 * 2 * G * 0.95, abs=1e-12)


def test_a_strain_wave_gear_twists_by_the_root_of_its_cubic():
    """At twice `torque`, y + y^3 = 2 has the root 1: half the twist of a gear that stays soft."""
    load = 2 * G * 0.95
    numbers = {"joint1.compliance": 1e-4, "torque": load / 2}
    at, q, r = {"payload": 2.0}, [np.pi / 2], [0.95, -0.1, 0]
    found, *_ = sees("strain_wave_compliance", "parallelogram_simple", numbers, at, q, r)
    twist = found - np.pi / 2
    assert twist == pytest.approx(-1e-4 * load / 2, abs=1e-12)
    k1, k3 = 1e4, 1e12 / (load / 2) ** 2
    assert k1 * twist + k3 * twist**3 == pytest.approx(-load, rel=1e-9)


def test_horizontal_delta_arms_weigh_half_their_length_times_their_mass():
    numbers = {"mass.arm": 0.5, "joint2.compliance": 1e-3}
    r = [0.0, 0.0, 0.19]
    q, *_ = sees("joint_compliance", "delta54", numbers, {"payload": 0.0}, [0.0] * 3, r)
    expected = -1e-3 * 0.5 * G * 0.119963 / 2
    np.testing.assert_allclose(q, [0.0, expected, 0.0], atol=1e-12)


def test_six_legs_of_a_hexapod_share_the_weight():
    numbers = {f"leg{i}.compliance": 1e-6 for i in range(1, 7)} | {"mass.platform": 4.0}
    q, *_ = sees("joint_compliance", "stewart42", numbers, {"payload": 8.0})
    m = load_mechanism("stewart42")
    steep = 0.3 / (m.home.joints[0] + 0.25)
    shortened = 1e-6 * 12 * G / 6 / steep
    np.testing.assert_allclose(np.array(m.home.joints) - q, [shortened] * 6, rtol=1e-9)


def at_home():
    """Compression of one of six rods of the nominal Delta under 1 kg at home, by its slope."""
    angle = np.radians(30.65)
    along = np.sqrt(0.24**2 - (0.076 + 0.12 * np.cos(angle)) ** 2)
    return 0.12 * np.sin(angle) + along, G / 6 / (along / 0.24)


def test_six_rods_of_a_delta_are_shortened_by_the_weight_they_carry():
    height, push = at_home()
    numbers = {"compliance": 2e-6, "mass.platform": 1.0}
    *_, p = sees("rod_compliance", "delta_nominal", numbers, {"payload": 2.0}, r=[0, 0, height])
    assert p["Lb"] == pytest.approx(0.24 - 2e-6 * 3 * push, abs=1e-13)
    *_, p = sees(
        "rod_compliance",
        "delta_nominal",
        numbers,
        {"payload": 2.0},
        r=[0, 0, height],
        gravity=(0.0, 0.0, 1.62),
    )
    assert p["Lb"] == pytest.approx(0.24 + 2e-6 * 3 * push * 1.62 / G, abs=1e-13)


def test_a_ball_in_its_socket_goes_to_the_side_it_is_pushed_to():
    height, push = at_home()
    numbers = {"play": 30e-6, "force": 2 * push / np.log(2)}
    *_, p = sees(
        "ball_joint_clearance", "delta_nominal", numbers, {"payload": 2.0}, r=[0, 0, height]
    )
    # tanh(ln 2) = (2 - 1/2) / (2 + 1/2) = 0.6
    assert p["Lb"] == pytest.approx(0.24 - 18e-6, abs=1e-13)


def test_a_steel_rod_of_240_mm_is_2_8_um_longer_in_air_one_kelvin_warmer():
    numbers = {"rods.alpha": 11.7e-6}
    *_, p = sees("thermal_expansion", "delta24", numbers, {"temperature": 21.0})
    assert p["chain2.Lb"] - 0.24 == pytest.approx(2.808e-6, abs=1e-15)
    assert p["chain2.La_x"] == 0.119963
    numbers = {"arms.alpha": 23e-6, "base.alpha": 12e-6, "reference": 25.0}
    *_, p = sees("thermal_expansion", "delta24", numbers, {"temperature": 15.0})
    assert p["chain1.La_x"] == pytest.approx(0.119963 * (1 - 230e-6), abs=1e-15)
    assert p["chain3.D_x"] == pytest.approx(0.076 * (1 - 120e-6), abs=1e-15)
    assert (p["chain1.Lb"], p["chain1.alpha"]) == (0.24, np.pi / 2)


def test_a_frame_sinks_and_leans_towards_the_load():
    _, r, R, _ = sees("payload_sag", "delta54", {"settle": 1e-6}, {"payload": 2.0}, r=[0, 0, 0.3])
    np.testing.assert_allclose(r, [0, 0, 0.3 + 2e-6 * G], atol=1e-15)
    np.testing.assert_array_equal(R, np.eye(3))
    _, r, R, _ = sees("payload_sag", "delta54", {"tilt": 1e-5}, {"payload": 2.0}, r=[0.1, 0, 0])
    lean = 1e-5 * 0.2 * G  # about y: what is shown hangs lower than what the ideal robot holds
    np.testing.assert_allclose(r, [0.1, 0, 0.1 * lean], atol=1e-10)
    np.testing.assert_allclose(R, [[1, 0, -lean], [0, 1, 0], [lean, 0, 1]], atol=1e-9)


# --------------------------------------------------------------------------- where they apply


@pytest.mark.parametrize(
    ("effect", "mechanism", "reason"),
    [
        ("joint_compliance", "cable", "more joints than degrees of freedom"),
        ("joint_compliance", "planar_stewart", "no joint carries any of the payload's weight"),
        ("joint_compliance", "argos27", "no joint carries any of the payload's weight"),
        ("load_friction", "cable", "more joints than degrees of freedom"),
        ("load_friction", "argos27", "no joint carries any of the payload's weight"),
        ("strain_wave_compliance", "stewart42", "no revolute joint carries any of the weight"),
        ("strain_wave_compliance", "planar_stewart", "no joint carries any of the payload's"),
        ("rod_compliance", "stewart42", "it has no rods"),
        ("ball_joint_clearance", "scara16", "it has no rods"),
        ("thermal_expansion", "argos9", "no lengths"),
        ("payload_sag", "slider_crank", "does not move along gravity"),
        ("parallelogram_errors", "delta54", "not a special case"),
        ("parallelogram_errors", "delta_nominal", "delta24, its larger model, gives"),
    ],
)
def test_effects_of_load_say_where_they_make_no_sense(effect, mechanism, reason):
    with pytest.raises(ModelError, match=reason):
        new_model(mechanism).with_effect(effect)


def test_joint_compliance_applies_only_to_joints_that_lift_against_gravity():
    scara = load_mechanism("scara16")
    names = [p.name for p in load_effect("joint_compliance").parameters(scara)]
    assert names == ["joint3.compliance", "mass.platform"]
    scara.gravity = (0.0, -G, 0.0)  # the same arm on a wall
    names = [p.name for p in load_effect("joint_compliance").parameters(scara)]
    assert names == ["joint1.compliance", "joint2.compliance", "mass.platform"]


def test_a_model_file_keeps_the_direction_of_gravity():
    model = new_model("delta54")
    assert "gravity" not in dump_model(model)
    model.mechanism.gravity = (0.0, 6.9, 6.97)
    again = parse_model(dump_model(model), "file")
    assert again.mechanism.gravity == (0.0, 6.9, 6.97)
    assert again.with_effect("joint_compliance").mechanism.gravity == (0.0, 6.9, 6.97)


def test_a_model_file_may_name_the_joints_and_lay_the_robot_on_its_side():
    text = dump_model(new_model("scara16"))
    for i in (1, 2, 3):
        text = text.replace(f"joint{i}", f"axis{i}")
    text = text.replace("frames:", "gravity: [0.0, -9.81, 0.0]\nframes:")
    side = parse_model(text, "file").with_effect("joint_compliance")
    again = parse_model(dump_model(side), "file")
    own = [n for n in again.table.names if n.endswith(".compliance")]
    assert own == ["joint_compliance.axis1.compliance", "joint_compliance.axis2.compliance"]


@pytest.mark.parametrize(
    ("gravity", "error"),
    [
        ("[0.0, 0.0, -9810.0]", "gravity.*the length 9810 m/s.2, expected about 9.81"),
        ("[0.0, 0.0, -1.0]", "gravity.* 1 m/s.2"),
        ("[0.0, -9.81]", "gravity"),
        ("down", "gravity"),
    ],
)
def test_an_invalid_gravity_is_refused(gravity, error):
    text = dump_model(new_model("delta54")).replace("frames:", f"gravity: {gravity}\nframes:")
    with pytest.raises(ModelFileError, match=error):
        parse_model(text, "file")


# --------------------------------------------------------------------------- against energies

WEIGHTS = vl.Weights(platform=0.3, arm=0.2, rod=0.05)
WALL = replace(WEIGHTS, gravity=(3.0, -9.0, 1.5))
MASSES = {"mass.platform": 0.3, "mass.arm": 0.2, "mass.rod": 0.05}


@pytest.mark.parametrize("weights", [WEIGHTS, WALL], ids=["upright", "on a wall"])
def test_virtual_work_gives_the_slopes_of_the_potential_energy(weights):
    """Of a Delta off its nominal dimensions, tilted platform and all: joints and rods alike."""
    rng, robot = np.random.default_rng(4), vr.MOCK_UP
    angle, _ = robot.inverse([0, 0, 0.2] + rng.uniform(-0.06, 0.06, (10, 3)))
    payload = rng.uniform(0, 2, 10)
    mechanism = load_mechanism("delta54")
    mechanism.gravity = weights.gravity
    torque, tension = forces(mechanism, vr.TABLE_5_18, robot, angle, payload)
    np.testing.assert_allclose(torque, weights.torques(robot, angle, payload), atol=1e-6)
    expected = weights.tensions(robot, angle, payload)  # first rods, then second ones
    np.testing.assert_allclose(tension[:, ::2], expected[:, :3], atol=1e-5)
    np.testing.assert_allclose(tension[:, 1::2], expected[:, 3:], atol=1e-5)


def forces(mechanism, values, robot, angle, payload):
    """Joint torques and rod tensions at closed poses, read off compliances of 1 rad/Nm or m/N."""
    from parallel_cal.effects._statics import joint_forces, masses, rod_forces

    q, r, R9 = ca.SX.sym("q", 3), ca.SX.sym("r", 3), ca.SX.sym("R", 9)
    p = Named(mechanism.parameters.names, ca.DM(mechanism.parameters.vector(values)))
    e = Named([p.name for p in masses(mechanism)], ca.DM(list(MASSES.values())))
    load = ca.SX.sym("payload")
    seen, at = Seen(q, r, ca.reshape(R9, 3, 3).T, p), Named(["payload"], load)
    both = [f(seen, e, at, mechanism) for f in (joint_forces, rod_forces)]
    evaluate = ca.Function("forces", [q, r, R9, load], both)
    rows = zip(angle, *robot.forward(angle), payload, strict=True)
    found = [evaluate(q, r, R.ravel(), load) for q, r, R, load in rows]
    return tuple(np.array([np.array(f[k]).ravel() for f in found]) for k in (0, 1))


# --------------------------------------------------------------------------- found again


@dataclass(frozen=True)
class Robot:
    """A virtual robot off its nominal dimensions, and what a person measures it with."""

    mechanism: str
    twin: Any
    noise: vr.Noise
    heaviest: float

    def poses(self, n, seed):
        return joints_near_home(self.mechanism, self.twin, n, seed)


FINE = vr.Noise(5 * vr.ARCSEC, 3e-6, 3 * vr.ARCSEC)
DELTA = Robot("delta54", vr.MOCK_UP, FINE, 2.0)
HEXAPOD = Robot("stewart42", hexapod(), vr.Noise(2e-6, 3e-6, 3 * vr.ARCSEC), 40.0)


@dataclass(frozen=True, eq=False)
class Case:
    """What is hidden, the numbers that say so in the package's terms, and what is known of it.

    `apart` (m): how far the two tellings may differ. The package weighs the robot at the joints'
    readings; the virtual robot settles where shafts and rods have given way.
    """

    robot: Robot
    effect: str
    hidden: Any
    numbers: dict[str, float]
    known: dict[str, float]
    apart: float
    gravity: tuple[float, float, float] = vl.DOWN

    def __str__(self):
        return f"{self.effect} of {self.robot.mechanism}"


SIDE = (0.0, -G, 0.0)  # on a wall rods are pushed and pulled
HUNG = replace(WEIGHTS, gravity=SIDE)
K1 = (1000.0, 1250.0, 800.0)
LEGS = (3e-7, 2e-7, 4e-7, 3e-7, 1e-7, 3e-7)
CASES = [
    Case(
        DELTA,
        "joint_compliance",
        vl.ShaftTwist((1e-3, 0.8e-3, 1.2e-3), WEIGHTS),
        {"joint1.compliance": 1e-3, "joint2.compliance": 0.8e-3, "joint3.compliance": 1.2e-3},
        MASSES,
        1e-6,
    ),
    Case(
        HEXAPOD,
        "joint_compliance",
        vl.ShaftTwist(LEGS, vl.Weights(platform=10.0)),
        {f"leg{i}.compliance": c for i, c in enumerate(LEGS, 1)},
        {"mass.platform": 10.0},
        1e-8,
    ),
    Case(
        DELTA,
        "rod_compliance",
        vl.SoftRods(4e-6, HUNG),
        {"compliance": 4e-6},
        MASSES,
        1e-7,
        SIDE,
    ),
    Case(
        DELTA,
        "ball_joint_clearance",
        more.LooseBalls(40e-6, 1.5, HUNG),
        {"play": 40e-6},
        {"force": 1.5, **MASSES},
        1e-7,
        SIDE,
    ),
    Case(
        DELTA,
        "load_friction",
        more.RubbingGears(0.2, (1e-3, 0.8e-3, 1.2e-3), WEIGHTS),
        {"joint1.lag": 2e-4, "joint2.lag": 1.6e-4, "joint3.lag": 2.4e-4},
        MASSES,
        1e-6,
    ),
    Case(
        HEXAPOD,
        "load_friction",
        more.RubbingGears(0.15, tuple(10 * c for c in LEGS), vl.Weights(platform=10.0)),
        {f"leg{i}.lag": 1.5 * c for i, c in enumerate(LEGS, 1)},
        {"mass.platform": 10.0},
        1e-8,
    ),
    Case(
        DELTA,
        "strain_wave_compliance",
        more.StiffeningGears(K1, tuple(np.array(K1) ** 3 / 0.8**2), WEIGHTS),
        {f"joint{i}.compliance": 1 / k for i, k in enumerate(K1, 1)},
        {"torque": 0.8, **MASSES},
        1e-6,
    ),
    Case(
        DELTA,
        "thermal_expansion",
        vl.Warmth({"La": 23e-6, "Lb": 1e-6, "dLb": 1e-6, "D": 11.7e-6, "b": 11.7e-6}),
        {"arms.alpha": 23e-6, "rods.alpha": 1e-6, "base.alpha": 11.7e-6},
        {},
        1e-11,
    ),
    Case(
        HEXAPOD,
        "thermal_expansion",
        vl.Warmth({"B": 23e-6, "C": 11.7e-6, "L0": 12e-6}),
        {"platform.alpha": 23e-6, "base.alpha": 11.7e-6, "legs.alpha": 12e-6, "scales.alpha": 0.0},
        {},
        1e-11,
    ),
    Case(
        DELTA,
        "payload_sag",
        vl.SoftFrame(2e-6, 3e-5),
        {"settle": 2e-6, "tilt": 3e-5},
        {},
        1e-8,
    ),
]
each = pytest.mark.parametrize("case", CASES, ids=str)


def circumstances(case, n, seed):
    """n samples under four payloads, each joint from either side."""
    joints = len(load_mechanism(case.robot.mechanism).joints)
    direction = np.random.default_rng([seed, 13]).choice([-1.0, 1.0], (n, joints))
    return replace(vd.circumstances(n, joints, seed, case.robot.heaviest), direction=direction)


def conditions_of(case, at):
    joints = load_mechanism(case.robot.mechanism).joints
    came = {f"direction.{joint}": at.direction[:, k] for k, joint in enumerate(joints)}
    return {"payload": at.payload, "temperature": at.temperature, **came}


def measured(case, n=80, seed=1, errorless=False):
    """A dataset of the robot with its hidden physics; `errorless` instruments claim 1e-6 of it."""
    robot, factor = case.robot, 1e-6 if errorless else 1.0
    reading = robot.poses(n, seed)
    nq = reading.shape[1]
    at = circumstances(case, n, seed)
    _, r, R = vr.truth(robot.twin, [case.hidden], reading, at)
    errors = robot.noise.draw(np.random.default_rng([seed, 10]), n, nq)
    q_error, r_error, w_error = (error * (0.0 if errorless else 1.0) for error in errors)
    sigma = factor * np.repeat([robot.noise.position, robot.noise.orientation], 3)
    return Dataset.from_arrays(
        load_mechanism(robot.mechanism).joints,
        reading + q_error,
        r + r_error,
        vr.turn(w_error) @ R,
        pose_cov=np.diag(sigma**2),
        joint_sigma=factor * robot.noise.joint,
        conditions=conditions_of(case, at),
        pose_id=np.arange(n),
    )


@cache
def start(case):
    """The nominal model with the effect at zero; what is known of it is given."""
    mechanism = load_mechanism(case.robot.mechanism)
    mechanism.gravity = case.gravity
    return new_model(mechanism).with_effect(case.effect, case.known)


def true_model(case):
    """The same with the true dimensions and the true numbers of the effect."""
    model = start(case)
    numbers = {f"{case.effect}.{k}": v for k, v in (case.numbers | case.known).items()}
    return model.with_values(model.table.vector({**case.robot.twin.parameters, **numbers}))


@pytest.mark.wide
@each
def test_the_direct_problem_under_load_agrees_with_the_virtual_robot(case):
    reading = case.robot.poses(20, seed=2)
    at = circumstances(case, 20, 2)
    _, r, R = vr.truth(case.robot.twin, [case.hidden], reading, at)
    _, plain, _ = vr.truth(case.robot.twin, [], reading, at)
    answer = Kinematics(true_model(case)).direct(reading, conditions_of(case, at))
    assert answer.ok.all()
    away = np.linalg.norm(answer.position - r, axis=1)
    assert away.max() < case.apart
    assert away.max() < 0.02 * np.linalg.norm(plain - r, axis=1).max()
    np.testing.assert_allclose(answer.rotation, R, atol=50 * case.apart)


# Those that the test without noise leaves out, and one that turns joints, of a hexapod.
KEPT = [c for c in CASES if c.apart > 1e-7 or str(c) == "joint_compliance of stewart42"]


@pytest.mark.wide
@pytest.mark.parametrize("case", keep(CASES, *KEPT), ids=str)
def test_the_hidden_effect_is_found_within_its_sigma_and_predicts_held_out_poses(case):
    data, model = measured(case), start(case)
    result = fit(model, data)
    sigma = dict(zip(result.model.table.names, result.estimate.sigma, strict=True))
    seen = [sigma[f"{case.effect}.{name}"] for name in case.numbers]
    found = [result.model.value(f"{case.effect}.{name}") for name in case.numbers]
    away = np.abs(np.array(found) - list(case.numbers.values())) / seen
    assert away.max() < 4
    assert np.max(np.abs(found) / seen) > 5
    low, high = chi2_band(result.estimate.dof)
    assert low < result.estimate.chi2_per_dof < high
    assert result.held_out.summary.position_rms < 1.25 * result.noise_floor.position_rms
    without = fit(model.without_effect(case.effect), data, hold_out=0)
    assert without.estimate.chi2_per_dof > chi2_band(without.estimate.dof)[1]


@pytest.mark.wide
@pytest.mark.parametrize("case", [c for c in CASES if c.apart <= 1e-7], ids=str)
def test_without_noise_an_effect_is_found_as_exactly_as_model_and_virtual_robot_agree(case):
    result = fit(start(case), measured(case, errorless=True), hold_out=0)
    truth = true_model(case)
    own = [i for i, n in enumerate(truth.table.names) if n.startswith(case.effect)]
    apart = (result.model.values - truth.values)[own] / truth.table.tolerance[own]
    assert np.abs(apart).max() < (1e-6 if case.apart < 1e-10 else 1e-2)
    assert result.after.norms("position").max() < max(case.apart, 1e-9)


# --------------------------------------------------------------------------- a larger model


def test_the_larger_model_keeps_effects_numbers_masks_and_all_else():
    small = new_model("delta24").with_effect("encoder_gain").with_effect("thermal_expansion")
    values = small.values.copy()
    values[small.table.index_of("encoder_gain.joint2.gain")] = 1e-3
    values[small.table.index_of("chain1.Lb")] = 0.2403
    fixed = small.fixed | small.table.matching(["chain2.La_y", "encoder_gain.joint1.*"])
    small.mechanism.gravity = (0.0, 0.0, G)
    small = replace(
        small,
        values=values,
        fixed=fixed,
        noise=Noise(1e-4, 1e-5),
        history=({"step": "fit"},),
        frames={"base": "table", "platform": "tool"},
    )
    large = small.with_effect("parallelogram_errors")
    assert large.mechanism.name == "delta54"
    assert [e.name for e in large.effects] == ["encoder_gain", "thermal_expansion"]
    for name in small.table.names:
        assert large.value(name) == small.value(name)
        assert large.fixed[large.table.index_of(name)] == fixed[small.table.index_of(name)]
    new = {n.split(".")[1] for n in large.table.names if n not in small.table.names}
    assert new >= {"dalpha", "dbeta", "dC_x", "dC_y", "dC_z", "dLb"}
    p1 = [p.name for p in large.mechanism.parameters if p.group == "P1"]
    assert not large.fixed[large.table.matching(p1)].any()
    assert (large.noise, large.history, large.frames) == (small.noise, small.history, small.frames)
    assert large.mechanism.gravity == (0.0, 0.0, G)
    q, at = np.array([[0.5, 0.6, 0.4]]), {"temperature": 30.0}
    one, other = (Kinematics(m).direct(q, at).position for m in (small, large))
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_parallelogram_errors_bring_a_tilting_platform_down_to_the_noise():
    data = session(6)
    small = fit(new_model("delta24"), data)
    large = fit(small.model.with_effect("parallelogram_errors"), data)
    before, after = small.held_out.summary, large.held_out.summary
    floor = large.noise_floor
    assert before.orientation_rms > 1.5 * floor.orientation_rms
    for kind in ("position_rms", "orientation_rms"):
        seen, noise, better = (getattr(found, kind) for found in (before, floor, after))
        assert better < 1.2 * noise < 1.2 * seen


def test_a_larger_model_is_left_by_its_older_file_and_the_error_says_so():
    large = new_model("delta24").with_effect("parallelogram_errors")
    large = replace(large, history=({"step": "add", "effect": "parallelogram_errors"},))
    with pytest.raises(
        ModelError,
        match=r"changing the mechanism to delta54. To undo it, go back to the model file",
    ):
        large.without_effect("parallelogram_errors")
    with pytest.raises(ModelError, match=r"no effect 'backlash'; it has none$"):
        large.without_effect("backlash")
