"""Screws and scales that expand: by hand, in old model files, and found in virtual robots."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import virtual_effects_more as more
from marks import as_slow

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.exporting.targets import c
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.answers import parse_conditions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.effect import Seen, list_substitutes
from parallel_cal.model.file.modelfile import parse_model
from parallel_cal.model.file.writer import dump_model
from parallel_cal.model.model import new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import add
from parallel_cal.virtual import load_effects as vl
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual import stewart as vt
from parallel_cal.virtual.linear_delta import LinearDelta

NAME, BY_PART = "thermal_expansion", "thermal_expansion_by_part"
STEEL, ALUMINIUM = 11e-6, 23e-6
HEIGHT, STROKE = 0.6, 0.058  # m
LEGS = tuple(f"leg{i}" for i in range(1, 7))
BODIES = ("base", "platform", "legs", "scales")
NOISE = vr.Noise(joint=1e-6, position=5e-6, orientation=10e-6)
WARM = 40.0  # degC; the sessions below are between 13 and 27


# --------------------------------------------------------------------------- by hand


def ideal(effect, mechanism, numbers, conditions, q):
    """What the readings and lengths of the nominal mechanism become."""
    m = load_mechanism(mechanism)
    table = load_effect(effect).table(m)
    values = table.vector({f"{effect}.{k}": v for k, v in numbers.items()})
    e = Named(table.names, ca.SX(ca.DM(values)))[effect]
    at = Named(tuple(conditions), ca.SX(ca.DM(list(conditions.values()))))
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.nominal)))
    seen = Seen(ca.SX(ca.DM(q)), ca.SX.zeros(3), ca.SX.eye(3), p)
    seen = load_effect(effect).ideal(seen, e, at, m)
    return np.array(ca.DM(seen.q)).ravel(), seen.p


def test_a_steel_screw_10_kelvin_warmer_moves_6_4_um_further_on_58_mm():
    q, p = ideal(
        NAME,
        "stewart42",
        {"scales.alpha": STEEL},
        {"temperature": 30.0},
        [STROKE, -STROKE, 0, 0, 0, 0],
    )
    np.testing.assert_allclose(q - [STROKE, -STROKE, 0, 0, 0, 0], [6.38e-6, -6.38e-6, 0, 0, 0, 0])
    assert float(ca.DM(p["leg1.L0"])) == 0.25


def test_by_part_the_scales_have_a_temperature_of_their_own():
    numbers = {"scales.alpha": 8e-6, "rods.alpha": ALUMINIUM}
    degrees = {"temperature.scales": 25.0, "temperature.rods": 20.0, "temperature.base": 90.0}
    q, p = ideal(BY_PART, "linear_delta", numbers, degrees, [0.5, 0.0, 0.25])
    np.testing.assert_allclose(q - [0.5, 0, 0.25], [20e-6, 0, 10e-6], atol=1e-15)
    assert float(ca.DM(p["chain1.Lb"])) == 0.25


def test_a_slide_grows_and_the_angles_beside_it_do_not():
    q, _ = ideal(NAME, "scara16", {"scales.alpha": STEEL}, {"temperature": 30.0}, [1.0, 2.0, 0.1])
    np.testing.assert_allclose(q - [1.0, 2.0, 0.1], [0, 0, 11e-6], atol=1e-15)


def bodies(mechanism, effect=NAME):
    table = load_effect(effect).table(load_mechanism(mechanism))
    return {n.split(".")[1] for n in table.names if n.endswith(".alpha")}


@pytest.mark.parametrize("mechanism", ["delta24", "delta54", "delta_nominal", "cable", "rssr"])
def test_revolute_joints_have_no_scales(mechanism):
    assert "scales" not in bodies(mechanism)


@pytest.mark.parametrize("mechanism", ["stewart42", "planar_stewart", "linear_delta", "scara16"])
def test_prismatic_joints_have_one_expansion_for_all(mechanism):
    assert "scales" in bodies(mechanism) & bodies(mechanism, BY_PART)


def test_without_a_sensor_of_their_own_the_scales_have_the_general_temperature():
    model = new_model("stewart42", {f"{BY_PART}.scales.alpha": STEEL}, [BY_PART])
    one = new_model("stewart42", {f"{NAME}.scales.alpha": STEEL}, [NAME])
    q = np.array([0.05, 0.08, 0.1, 0.12, 0.07, 0.06])
    air = Kinematics(model).direct(q, {"temperature": 31.0}).position
    expected = Kinematics(one).direct(q, {"temperature": 31.0}).position
    np.testing.assert_allclose(air, expected, atol=1e-15)
    own = parse_conditions(model, ["temperature=31", "temperature.scales=45"])
    assert np.abs(Kinematics(model).direct(q, own).position - expected).max() > 5e-6


def test_scales_without_a_sensor_are_as_warm_as_the_legs_that_carry_them():
    assert list_substitutes("temperature.scales") == [
        "temperature.legs",
        "temperature",
        "temperature.base",
    ]
    model = new_model("stewart42", effects=[BY_PART])
    rows = model.condition_rows({"temperature": 21.0, "temperature.legs": 30.0}, 1)[0]
    assert dict(zip(model.conditions, rows, strict=True)) == {
        "temperature.base": 21.0,
        "temperature.platform": 21.0,
        "temperature.legs": 30.0,
        "temperature.scales": 30.0,
    }


def test_a_session_with_a_sensor_on_every_body_but_none_on_the_scales_can_be_tested():
    data = session(hexapod(1), growth(STEEL), 1)
    air = data.conditions["temperature"]
    parts = {f"temperature.{body}": air for body in ("base", "platform", "legs")}
    result = fit(hexapod_model([BY_PART]), replace(data, conditions=parts), hold_out=0)
    sigma = dict(zip(result.model.table.names, result.estimate.sigma, strict=True))
    name = f"{BY_PART}.scales.alpha"
    assert abs(result.model.value(name) - STEEL) < 3 * sigma[name] < 12e-6


def test_exported_c_has_the_temperature_of_the_scales():
    files = c.files(new_model("stewart42", effects=[BY_PART]), "robot")
    header = next(text for name, text in files.items() if name.endswith(".h"))
    assert "double temperature_scales; /* degC, 20 */" in header


# --------------------------------------------------------------------------- files of before


def old_file(model):
    """The text that an earlier release wrote: nothing of the scales."""
    return "".join(
        line for line in dump_model(model).splitlines(keepends=True) if "scales.alpha" not in line
    )


@pytest.mark.parametrize("effect", [NAME, BY_PART])
def test_a_file_without_the_scales_means_what_it_meant(effect):
    known = {f"{effect}.legs.alpha": 12e-6, f"{effect}.base.alpha": 5e-6}
    model = new_model("stewart42", known, [effect])
    text = old_file(model)
    assert "scales" not in text
    again = parse_model(text, "file")
    assert again.table.names == model.table.names
    np.testing.assert_array_equal(again.values, model.values)
    assert again.value(f"{effect}.scales.alpha") == 0.0
    assert not again.fixed[again.table.index_of(f"{effect}.scales.alpha")]
    assert parse_model(dump_model(again), "file").table.names == model.table.names


def test_in_a_file_whose_expansions_are_known_that_of_the_scales_is_known_to_be_0():
    fixed = new_model("stewart42", effects=[NAME])
    text = dump_model(fixed).replace('unit: "1/K"', 'unit: "1/K", fixed: true')
    again = parse_model("".join(x for x in text.splitlines(True) if "scales" not in x), "file")
    assert again.fixed[again.table.index_of(f"{NAME}.scales.alpha")]


def test_other_parameters_may_still_not_be_missing():
    text = dump_model(new_model("stewart42", effects=[NAME]))
    text = "".join(line for line in text.splitlines(True) if "legs.alpha" not in line)
    with pytest.raises(Exception, match=r"parameters missing: legs\.alpha"):
        parse_model(text, "file")


# --------------------------------------------------------------------------- a hexapod


def hexapod_model(effects=()):
    mechanism = load_mechanism(
        "stewart42",
        base={"radius": 0.35, "angles": [-8, 8, 112, 128, 232, 248]},
        platform={"radius": 0.2, "angles": [-50, 50, 70, 170, 190, 290]},
        height=HEIGHT,
        limits=[-0.06, 0.06],
        tolerance=0.5e-3,
    )
    return new_model(mechanism, effects=effects)


def hexapod(seed):
    """The virtual robot, 0.35 mm off its drawing."""
    model = hexapod_model()
    off = 0.35e-3 * np.random.default_rng([seed, 1]).standard_normal(len(model.values))
    return vt.Stewart(model.table.mapping(model.values + off))


def readings(twin, n, rng):
    """Readings (n, 6) within the stroke, at poses in all orientations."""
    found = []
    while len(found) < n:
        r = np.array([0, 0, HEIGHT]) + rng.uniform(-1, 1, 3) * [0.06, 0.06, 0.04]
        q = twin.leg_lengths(r, vr.turn(np.radians(9) * rng.uniform(-1, 1, 3))) - twin.offset
        if np.abs(q).max() < STROKE:
            found.append(q)
    return np.array(found)


def growth(scales, base=0.0):
    """Legs of steel; what measures them grows by `scales` (1/K)."""
    return vl.Warmth({"L0": STEEL, "C": base}, scales)


def poses_of(twin, effect, q, temperature):
    n = len(q)
    at = vr.SampleConditions(np.zeros(n), temperature, np.zeros(n), np.zeros((n, 6)))
    home = np.tile([0.0, 0.0, HEIGHT], (n, 1)), np.tile(np.eye(3), (n, 1, 1))
    return vr.truth(twin, [effect], q, at, home)[1:]


def session(twin, effect, seed, n=120):
    """A day between 13 and 27 degC."""
    rng = np.random.default_rng([seed, 2])
    temperature = 20 + 6 * np.sin(7 * np.arange(n) / n) + 0.5 * rng.standard_normal(n)
    q = readings(twin, n, rng)
    r, R = poses_of(twin, effect, q, temperature)
    dq, dr, dw = NOISE.draw(rng, n, 6)
    return Dataset.from_arrays(
        LEGS,
        q + dq,
        r + dr,
        vr.turn(dw) @ R,
        pose_cov=np.diag(np.repeat([NOISE.position, NOISE.orientation], 3) ** 2),
        joint_sigma=NOISE.joint,
        conditions={"temperature": temperature, "time": 60.0 * np.arange(n)},
        pose_id=np.arange(n),
    )


def expansions(result):
    """Value and sigma of every body's expansion, 1/K."""
    sigma = dict(zip(result.model.table.names, result.estimate.sigma, strict=True))
    names = {body: f"{NAME}.{body}.alpha" for body in BODIES}
    return {body: (result.model.value(n), sigma[n]) for body, n in names.items()}


def warm_errors(model, twin, effect):
    """True and promised rms position error (m) at WARM, at other poses."""
    q = readings(twin, 60, np.random.default_rng(77))
    r, _ = poses_of(twin, effect, q, np.full(len(q), WARM))
    k, at = Kinematics(model), {"temperature": WARM}
    found = k.direct(q, at)
    variance = np.trace(k.direct_covariance(found, at)[:, :3, :3], axis1=1, axis2=2)
    return tuple(np.sqrt(np.mean(v)) for v in (np.sum((found.position - r) ** 2, axis=1), variance))


@pytest.mark.parametrize("scales", [STEEL, 0.0, 8e-6], ids=["screw", "constant", "glass"])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_expansions_of_a_hexapod_are_right_whatever_measures_its_legs(scales, seed):
    twin, effect = hexapod(seed), growth(scales)
    result = fit(hexapod_model([NAME]), session(twin, effect, seed), hold_out=0)
    assert 0.8 < result.estimate.chi2_per_dof < 1.2
    truth = {"base": 0.0, "platform": 0.0, "legs": STEEL, "scales": scales}
    for body, (value, sigma) in expansions(result).items():
        assert abs(value - truth[body]) < 3 * sigma, body
        assert sigma < 4e-6
    true, promised = warm_errors(result.model, twin, effect)
    assert true < 1.6 * promised
    assert promised < 6e-6


@pytest.mark.wide
def test_the_sigmas_of_the_expansions_are_honest():
    """Errors in sigmas of 16 hexapods have a size of one."""
    pulls = []
    for seed in range(10, 26):
        result = fit(
            hexapod_model([NAME]), session(hexapod(seed), growth(STEEL, 5e-6), seed), hold_out=0
        )
        truth = {"base": 5e-6, "platform": 0.0, "legs": STEEL, "scales": STEEL}
        pulls.append([(v - truth[b]) / s for b, (v, s) in expansions(result).items()])
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert rms.min() > 0.5
    assert rms.max() < 1.5
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.8


@pytest.mark.wide
@pytest.mark.parametrize("scales", [STEEL, as_slow(0.0)], ids=["screw", "constant"])
def test_the_verdict_on_a_warm_hexapod_is_explained_and_then_at_noise(scales):
    data = session(hexapod(3), growth(scales), 3)
    plain = fit(hexapod_model(), data).model
    found = diagnose(plain, data)
    assert (found.verdict.word, found.effects) == ("explained", (NAME,))
    assert "larger than usual" not in found.verdict.text
    added = add(plain, NAME, data).model
    assert diagnose(added, data).verdict.word == "at_noise"


@pytest.mark.wide
def test_a_refit_of_an_old_model_gives_the_screws_their_expansion():
    data = session(hexapod(4), growth(STEEL), 4)
    model = hexapod_model([NAME])
    old = fit(model, data, hold_out=0, fix=("*.scales.alpha",)).model
    text = "".join(line for line in dump_model(old).splitlines(True) if "scales" not in line)
    again = parse_model(text, "file")
    np.testing.assert_allclose(again.values, old.values)
    value, sigma = expansions(fit(again, data, hold_out=0))["scales"]
    assert abs(value - STEEL) < 3 * sigma


# --------------------------------------------------------------------------- a linear Delta


def rails():
    model = new_model("linear_delta")
    draw = np.random.default_rng(5).standard_normal(len(model.values))
    return LinearDelta(model.table.mapping(model.values + 0.3 * model.table.tolerance * draw))


@pytest.mark.parametrize("effect", [NAME, BY_PART])
def test_the_direct_problem_with_warm_screws_agrees_with_the_virtual_linear_delta(effect):
    twin, rng, n = rails(), np.random.default_rng(6), 20
    q = twin.inverse([0, 0, 0.1] + rng.uniform(-0.05, 0.05, (n, 3)))[0]
    air, screws = 20 + 8 * np.sin(np.arange(n)), 30 + 5 * np.cos(np.arange(n))
    at = vr.SampleConditions(np.zeros(n), air, np.zeros(n), np.zeros((n, 3)))
    grown = {"Lb": (ALUMINIUM, air), "dLb": (ALUMINIUM, air)}
    warmth = more.PartsWarmth(grown, (STEEL, screws if effect == BY_PART else air))
    _, r, R = vr.truth(twin, [warmth], q, at)
    numbers = {f"{effect}.rods.alpha": ALUMINIUM, f"{effect}.scales.alpha": STEEL}
    model = new_model("linear_delta", {**twin.parameters, **numbers}, [effect])
    conditions = {"temperature": air, "temperature.scales": screws}
    found = Kinematics(model).direct(
        q, {k: conditions[k] for k in conditions if effect == BY_PART or k == "temperature"}
    )
    np.testing.assert_allclose(found.position, r, atol=1e-10)
    np.testing.assert_allclose(found.rotation, R, atol=1e-9)
