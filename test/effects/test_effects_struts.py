"""Struts on universal joints: by hand, against LinuxCNC's formula, and in the virtual hexapod."""

import casadi as ca
import numpy as np
import pytest
from twins import hexapod
from virtual_struts import JointedHexapod, UniversalJoints

from parallel_cal.base.errors import ModelError
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.model.drive import Drive
from parallel_cal.model.effect import Seen
from parallel_cal.model.model import new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect, load_mechanism
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

LEGS = tuple(f"leg{i}" for i in range(1, 7))
NOISE = vr.Noise(joint=2e-6, position=5e-6, orientation=10 * vr.ARCSEC)
# Distances that the second axes stand off the fixed ones; a size of 1 is about 1 sigma of the pose.
FOOT = tuple(1e-3 * np.array([0.7, 0.9, -0.5, -1.1, 0.6, 0.8]))
HEAD = tuple(1e-3 * np.array([-0.5, 0.8, 0.7, -0.6, -1.0, 0.9]))
SCREWS, JOINTS = UniversalJoints(lead=0.7e-3), UniversalJoints(foot=FOOT, head=HEAD)


def ideal_readings(effect, numbers, r, R=None, mechanism="stewart42"):
    """The readings of a hexapod with one upright strut, leg1 from the origin, and readings zero."""
    m, shelf = load_mechanism(mechanism), load_effect(effect)
    table = shelf.table(m)
    e = table.vector({f"{effect}.{name}": value for name, value in numbers.items()})
    upright = {f"leg1.{end}_{axis}": 0.0 for end in "BC" for axis in "xyz"}
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.vector(upright))))
    R = np.eye(3) if R is None else R
    seen = Seen(ca.SX.zeros(6), ca.SX(ca.DM(r)), ca.SX(ca.DM(R)), p)
    e = Named(table.names, ca.SX(ca.DM(e)))[effect]
    return np.array(ca.DM(shelf.ideal(seen, e, Named((), ca.SX()), m).q)).ravel()


# --------------------------------------------------------------------------- by pencil and paper

UPRIGHT = {f"leg1.{end}_{a}": float(a == "y") for end in ("base", "platform") for a in "xyz"}


def test_a_strut_that_twists_by_a_twelfth_of_a_turn_is_shorter_by_a_twelfth_of_its_lead():
    R = vr.turn([0, 0, np.pi / 6])
    q = ideal_readings("strut_rotation", {"lead": 6e-3, **UPRIGHT}, (0, 0, 0.3), R)
    assert q[0] == pytest.approx(-0.5e-3, abs=1e-15)


def test_a_platform_that_moves_without_turning_twists_a_strut_only_by_its_joints():
    """Axes along y: a strut that tilts about y or x keeps the direction of its joints."""
    for r in ((0.1, 0.0, 0.3), (0.0, 0.1, 0.3)):
        q = ideal_readings("strut_rotation", {"lead": 6e-3, **UPRIGHT}, r)
        assert q[0] == pytest.approx(0.0, abs=1e-15)


def test_an_offset_axis_follows_the_strut_about_the_fixed_axis_only():
    """Axis along y, 10 mm off. A strut of 3:4:5 m that tilts about y keeps 10 mm of its length:
    5 m - 4.99 m. One that tilts about x has 10 mm along z: 5 m - |(3, 3.99)| m."""
    q = ideal_readings("universal_joint_offset", {"leg1.foot": 0.01, **UPRIGHT}, (3, 0, 4))
    assert q[0] == pytest.approx(0.01, abs=1e-14)
    q = ideal_readings("universal_joint_offset", {"leg1.foot": 0.01, **UPRIGHT}, (0, 3, 4))
    assert q[0] == pytest.approx(5 - np.hypot(3, 3.99), abs=1e-14)
    q = ideal_readings("universal_joint_offset", {"leg1.head": 0.01, **UPRIGHT}, (0, 3, 4))
    assert q[0] == pytest.approx(5 - np.hypot(3, 3.99), abs=1e-14)


@pytest.mark.parametrize("name", ["strut_rotation", "universal_joint_offset"])
def test_fixed_axes_are_by_default_horizontal_and_across_the_strut_at_home(name):
    m = load_mechanism("stewart42")
    table = load_effect(name).table(m)
    value = dict(zip(table.names, table.nominal, strict=True))
    twin = hexapod()
    nominal = dict(zip(m.parameters.names, m.parameters.nominal, strict=True))
    drawn = type(twin)(nominal)
    along = drawn.platform + drawn.home - drawn.base
    for i, leg in enumerate(LEGS):
        for end in ("base", "platform"):
            axis = [value[f"{name}.{leg}.{end}_{a}"] for a in "xyz"]
            assert axis[2] == 0
            assert np.dot(axis, along[i]) == pytest.approx(0, abs=1e-12)
            assert np.linalg.norm(axis) == pytest.approx(1, abs=1e-12)


# --------------------------------------------------------------------------- where they apply


@pytest.mark.parametrize("name", ["strut_rotation", "universal_joint_offset"])
@pytest.mark.parametrize("mechanism", ["linear_delta", "delta54", "cable", "planar_stewart"])
def test_effects_of_struts_apply_to_hexapods_only(name, mechanism):
    with pytest.raises(ModelError, match="its joints are no struts to a moving platform"):
        new_model(mechanism).with_effect(name)


def test_struts_that_spools_or_belts_move_have_no_screw_that_turns():
    m = load_mechanism("stewart42")
    m.drives = (Drive("belt", per_rev=0.04),) * 6
    assert "the model file states other drives" in load_effect("strut_rotation").applies(m)
    m.drives = (Drive("screw", per_rev=5e-3),) * 6
    assert load_effect("strut_rotation").applies(m) == ""


# --------------------------------------------------------------------------- the virtual hexapod


def poses(n, seed=0):
    rng = np.random.default_rng(seed)
    r = np.array([0.0, 0.0, 0.3]) + rng.uniform(-0.05, 0.05, (n, 3))
    return r, vr.turn(rng.uniform(-0.2, 0.2, (n, 3)))


def closure_errors(model, q, r, R):
    x = np.column_stack([q, r, R.reshape(-1, 9)])
    return model.structure.closure_batch(x, np.zeros((len(x), 0)), model.values)[0]


def firmware_correction(lead, b, a, foot, head, R):
    """What genhexkins adds to a strut's length, by its documentation: the lead times the turns
    between the planes that each joint's fixed axis spans with the strut (kins(9), genhexkins)."""
    u = (head - foot) / np.linalg.norm(head - foot)
    normal = np.cross(R @ a, u)  # of the platform joint's plane
    in_plane = b - u * (b @ u)  # in that of the base joint, across the strut
    sine = normal @ in_plane / np.linalg.norm(normal) / np.linalg.norm(in_plane)
    return lead * np.arcsin(sine) / (2 * np.pi)


def test_the_correction_is_that_of_linuxcnc_for_any_axes():
    rng, (r, R), lead = np.random.default_rng(4), poses(40), 4.7e-3
    twin = hexapod()
    base = np.column_stack([*rng.uniform(-0.3, 0.3, (2, 6)), np.ones(6)])
    flat = np.cross(base, rng.uniform(-1, 1, (6, 3)))
    base = flat / np.linalg.norm(flat, axis=1)[:, None]
    platform = base + rng.uniform(-0.2, 0.2, (6, 3))
    platform /= np.linalg.norm(platform, axis=1)[:, None]
    heads = r[:, None] + np.einsum("nij,kj->nki", R, twin.platform)
    axes = {
        f"strut_rotation.{leg}.{end}_{a}": float(directions[i, k])
        for end, directions in (("base", base), ("platform", platform))
        for i, leg in enumerate(LEGS)
        for k, a in enumerate("xyz")
    }
    numbers = {**twin.parameters, **axes, "strut_rotation.lead": lead}
    model = new_model("stewart42", numbers, effects=["strut_rotation"])
    correction = np.array(
        [
            [
                firmware_correction(lead, base[k], platform[k], twin.base[k], heads[n, k], R[n])
                for k in range(6)
            ]
            for n in range(len(r))
        ]
    )
    assert np.abs(correction).max() > 0.2e-3
    q = twin.leg_lengths(r, R) - twin.offset + correction
    assert np.abs(closure_errors(model, q, r, R)).max() < 1e-9


@pytest.mark.parametrize(
    ("name", "effect", "numbers"),
    [
        ("strut_rotation", UniversalJoints(lead=5e-3), {"lead": 5e-3}),
        (
            "universal_joint_offset",
            UniversalJoints(foot=FOOT, head=HEAD),
            {f"{leg}.foot": FOOT[i] for i, leg in enumerate(LEGS)}
            | {f"{leg}.head": HEAD[i] for i, leg in enumerate(LEGS)},
        ),
        (
            "universal_joint_offset",
            UniversalJoints(foot=(15e-3,) * 6, head=(-10e-3,) * 6),
            {f"{leg}.foot": 15e-3 for leg in LEGS} | {f"{leg}.head": -10e-3 for leg in LEGS},
        ),
    ],
)
def test_the_true_numbers_close_every_strut_of_the_virtual_hexapod(name, effect, numbers):
    twin, (r, R) = hexapod(), poses(40)
    nominal = new_model("stewart42").table
    drawn = dict(zip(nominal.names, nominal.nominal, strict=True))
    built = JointedHexapod(twin.parameters, effect.lead, effect.foot, effect.head, drawn=drawn)
    q = built.leg_lengths(r, R) - built.offset
    given = {f"{name}.{key}": value for key, value in numbers.items()}
    model = new_model("stewart42", {**twin.parameters, **given}, effects=[name])
    assert np.abs(closure_errors(model, q, r, R)).max() < 1e-9
    plain = closure_errors(new_model("stewart42", twin.parameters), q, r, R)
    assert np.abs(plain - plain.mean(axis=0)).max() > 10e-6


def session(effect, seed=0, n=120, again=30, noise=1.0):
    """Poses of the virtual hexapod, some visited twice; noise 0 is without errors."""
    rng, built = np.random.default_rng([seed, 1]), hexapod()
    if effect:
        built = effect.loaded_robot(built, None, None)
    pose = rng.permutation(np.r_[np.arange(n), rng.choice(n, again, replace=False)])
    r, R = (part[pose] for part in poses(n, seed))
    q = built.leg_lengths(r, R) - built.offset
    dq, dr, dw = (noise * part for part in NOISE.draw(rng, len(pose), 6))
    sigma = np.repeat([NOISE.position, NOISE.orientation], 3)
    return Dataset.from_arrays(
        LEGS,
        q + dq,
        r + dr,
        vr.turn(dw) @ R,
        pose_cov=np.diag(sigma**2),
        joint_sigma=NOISE.joint,
        conditions={"time": 10.0 * np.arange(len(pose))},
        pose_id=pose,
    )


def test_the_lead_is_recovered_without_noise():
    found = fit(new_model("stewart42").with_effect("strut_rotation"), session(SCREWS, noise=0.0))
    assert found.model.value("strut_rotation.lead") == pytest.approx(SCREWS.lead, rel=1e-2)


@pytest.mark.wide
@pytest.mark.parametrize(
    ("name", "effect"), [("strut_rotation", SCREWS), ("universal_joint_offset", JOINTS)]
)
def test_an_effect_of_about_one_sigma_is_named_alone(name, effect):
    found = diagnose(new_model("stewart42"), session(effect, seed=3))
    assert found.verdict.word == "explained"
    assert found.effects == (name,)
    assert found.swaps == {}


@pytest.mark.wide
def test_struts_on_ball_joints_have_neither_effect():
    found = diagnose(new_model("stewart42"), session(None, seed=3))
    assert (found.verdict.word, found.effects) == ("at_noise", ())
