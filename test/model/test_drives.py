"""A joint whose readings are lengths may be moved by a spool, a screw or a belt; the model file
states the drive once, and reader and effects use it."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import parallel_cal as pc
from parallel_cal.base.errors import ModelError, ModelFileError
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.explanation import Causes
from parallel_cal.effects.encoder_gain import EncoderGain
from parallel_cal.identification.fit import fit
from parallel_cal.mechanisms.stewart42 import BASE, PLATFORM, RETRACTED, Stewart42
from parallel_cal.model.drive import Drive
from parallel_cal.model.effect import Seen
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.parameters import Named
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

SPOOL = "{kind: spool, radius: 0.05, advantage: 2.0}"


def hexapod(*drives):
    mechanism = Stewart42()
    mechanism.drives = drives if len(drives) > 1 else drives * 6
    return new_model(mechanism)


def text_with(drive):
    lines = dump_model(new_model("stewart42"))
    return lines.replace("leg2: {unit: m,", f"leg2: {{unit: m, drive: {drive},")


def test_a_drive_is_read_and_written():
    model = parse_model(text_with(SPOOL))
    none = (None,) * 4
    assert model.mechanism.drives == (None, Drive("spool", radius=0.05, advantage=2.0), *none)
    assert "leg2: {unit: m, low: 0.0, high: 0.2, drive: {kind: spool, radius: 0.05, " in (
        dump_model(model)
    )
    assert dump_model(parse_model(dump_model(model))) == dump_model(model)


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ("{kind: spool}", "drive: found neither per_rev and radius"),
        ("{kind: spool, per_rev: 0.07, radius: 0.01}", "drive: found both per_rev and radius"),
        ("{kind: belt, per_rev: 0.0}", "drive.per_rev: found 0, expected the travel per turn"),
        ("{kind: screw, radius: 0.01}", "drive.radius: a screw has none; state per_rev"),
        ("{kind: chain, per_rev: 0.01}", "drive.kind: .*'spool'.*, found 'chain'"),
        ("{kind: spool, raduis: 0.01}", "drive.raduis: unknown key; did you mean 'radius'"),
        ("{kind: spool, radius: -0.01}", "drive.radius: expected a number above 0"),
    ],
)
def test_a_wrong_drive_is_an_error_with_line_and_key(drive, words):
    with pytest.raises(ModelFileError, match=rf"joints\.leg2\.{words}"):
        parse_model(text_with(drive))


def test_a_motor_whose_angle_is_read_has_no_drive():
    text = dump_model(new_model("delta24")).replace("{unit: rad,", f"{{unit: rad, drive: {SPOOL},")
    with pytest.raises(ModelFileError, match=r"joint1.drive: .* are angles \(rad\), expected a jo"):
        parse_model(text)


def ideal_lengths(drive, q, Q):
    """Lengths that the ideal hexapod sees where all legs read q."""
    model = hexapod(drive)
    m, effect = model.mechanism, load_effect("spool_buildup")
    p = Named(m.parameters.names, ca.SX(ca.DM(m.parameters.nominal)))
    seen = Seen(ca.SX(ca.DM([q] * 6)), ca.SX.zeros(3), ca.SX.eye(3), p)
    e = Named(["Q"], ca.SX(ca.DM([Q])))
    return np.array(ca.DM(effect.ideal(seen, e, Named([], ca.SX(0, 1)), m).q)).squeeze()


def test_a_spool_of_50_mm_that_moves_a_leg_by_two_lines_shrinks_as_by_hand():
    """Reading 0.1 m: the spool turns by 2 * 0.1 / 0.05 = 4 rad. Its radius falls by Q s / 2 = 10
    mm, on average by 5: it lets out 4 * 45 = 180 mm of line, and the leg moves by 90 mm."""
    out = Drive("spool", radius=0.05, advantage=2.0)
    np.testing.assert_allclose(ideal_lengths(out, 0.1, 5e-3), [0.09] * 6, atol=1e-15)
    geared = Drive("spool", per_rev=2 * np.pi * 0.05 / (2 * 3), gear=3.0, advantage=2.0)
    np.testing.assert_allclose(ideal_lengths(geared, 0.1, 5e-3), [0.09] * 6, atol=1e-15)
    wound = replace(out, line="in")
    np.testing.assert_allclose(ideal_lengths(wound, 0.1, 5e-3), [0.11] * 6, atol=1e-15)


def test_only_joints_with_a_spool_build_up():
    model = hexapod(Drive("spool", radius=0.05), *[None] * 4, Drive("screw", per_rev=5e-3))
    m, q = model.mechanism, model.with_effect("spool_buildup")
    seen = q.structure.seen.q
    assert [ca.depends_on(seen[i], q.structure.v[-1]) for i in range(6)] == [True] + [False] * 5
    gains = EncoderGain().parameters(m)
    assert gains[0].tolerance > gains[1].tolerance == gains[5].tolerance


def test_without_a_stated_spool_the_message_says_how_to_state_it():
    words = r"does not apply to stewart42: .*leg1: \{\.\.\., drive: \{kind: spool, radius: 0.05\}\}"
    with pytest.raises(ModelError, match=words):
        new_model("stewart42").with_effect("spool_buildup")
    with pytest.raises(ModelError, match="does not apply to delta24: it has no line on a spool"):
        new_model("delta24").with_effect("spool_buildup")


def test_a_stated_lead_and_the_travel_per_turn_of_a_geared_motor_are_all_that_is_tried():
    scan = load_effect("screw_pitch_error").scan
    recorded = {joint: np.array([0.0, 0.1]) for joint in Stewart42().joints}
    plain = hexapod(Drive("screw", per_rev=5e-3)).mechanism
    assert list(scan(plain, recorded)) == [{"lead": pytest.approx(5e-3)}]
    geared = hexapod(Drive("screw", per_rev=1.25e-3, gear=4.0)).mechanism
    each = [one["lead"] for one in scan(geared, recorded)]
    assert each == pytest.approx([5e-3, 1.25e-3])
    assert len(list(scan(Stewart42(), recorded))) > 10


def read_by_eccentric_drum(lengths, radius, off, phase):
    """Readings (n,) m of a drum whose axis is off, found by bisection from its lengths of line."""
    low, high = (lengths - 3 * off) / radius, (lengths + 3 * off) / radius
    for _ in range(60):
        angle = (low + high) / 2
        short = radius * angle + off * (np.sin(angle + phase) - np.sin(phase)) < lengths
        low, high = np.where(short, angle, low), np.where(short, high, angle)
    return radius * angle


@pytest.mark.wide
def test_an_eccentric_drum_is_named_by_the_turn_of_the_stated_radius():
    radius, rng = 0.012, np.random.default_rng(1)
    r = np.array([0.0, 0.0, 0.3]) + rng.uniform(-0.05, 0.05, (60, 3))
    R = vr.turn(rng.uniform(-0.15, 0.15, (60, 3)))
    lengths = np.linalg.norm(r[:, None] + np.einsum("nij,kj->nki", R, PLATFORM) - BASE, axis=2)
    q = lengths - RETRACTED
    q[:, 3] = read_by_eccentric_drum(q[:, 3], radius, 0.3e-3, 0.8)
    noise = Noise(joint=30e-6, position=30e-6, orientation=0.2e-3)
    model = replace(hexapod(Drive("spool", radius=radius)), noise=noise)
    q += noise.joint * rng.standard_normal(q.shape)
    scene = see(fit(model, Dataset.from_arrays(model.joints, q, r, R), hold_out=0))
    names = ["screw_pitch_error", "encoder_interpolation", "encoder_gain", "spool_buildup"]
    posterior, _, chosen = Causes.of(scene, names).explain()
    assert [one.name for one in chosen] == ["screw_pitch_error"]
    assert posterior.probability["screw_pitch_error"] > 0.99
    assert chosen[0].settings == {"lead": pytest.approx(2 * np.pi * radius)}


def test_what_turns_with_the_motor_of_a_gear_is_named_by_its_turn():
    """It was named a wrong interpolation of the encoder: only the pulley's turn was tried."""
    model = hexapod(Drive("belt", per_rev=10e-3, gear=3.0))
    model = replace(model, noise=Noise(joint=5e-6, position=5e-6, orientation=5e-5))
    wave = ",".join(f"leg{k}.sin=30e-6" for k in range(1, 7))
    true = [f"screw_pitch_error:lead=10e-3,{wave}"]
    data = pc.simulate(model, 60, 1, effects=true).dataset()
    scene = see(fit(model, data, hold_out=0))
    names = ["screw_pitch_error", "encoder_interpolation", "encoder_gain"]
    posterior, _, chosen = Causes.of(scene, names).explain()
    assert [one.name for one in chosen] == ["screw_pitch_error"]
    assert posterior.probability["screw_pitch_error"] > 0.99
    assert chosen[0].settings == {"lead": pytest.approx(10e-3)}


def test_a_stated_pulley_that_runs_true_does_not_hide_other_periods():
    """Its turn is no special case of a scanned period: teeth of the belt may be wrong."""
    model = hexapod(Drive("belt", per_rev=32e-3))
    model = replace(model, noise=Noise(joint=2e-6, position=3e-6, orientation=2e-5))
    teeth = "encoder_interpolation:period=3e-3," + ",".join(
        f"leg{k}.sin1=20e-6" for k in range(1, 7)
    )
    data = pc.simulate(model, 40, 1, effects=[teeth]).dataset()
    scene = see(fit(model, data, hold_out=0))
    turn = candidate(scene, "screw_pitch_error")
    assert turn.settings == {"lead": pytest.approx(32e-3)}
    assert turn.p_value > 0.01
    found = candidate(scene, "encoder_interpolation", [turn])
    assert found.testable
    assert found.settings["period"] == pytest.approx(3e-3, rel=0.02)


@pytest.mark.parametrize("line", ["out", "in"])
def test_the_build_up_of_a_hexapods_spools_is_identified(line):
    """The legs are wound numerically, layer by layer, and read by motors of constant radius."""
    radius, Q = 0.012, 0.05e-3
    rng = np.random.default_rng(0)
    r = np.array([0.0, 0.0, 0.3]) + rng.uniform(-0.05, 0.05, (60, 3))
    R = vr.turn(rng.uniform(-0.15, 0.15, (60, 3)))
    lengths = np.linalg.norm(r[:, None] + np.einsum("nij,kj->nki", R, PLATFORM) - BASE, axis=2)
    angle = np.linspace(0.0, 25.0, 200_001)
    sign = -1 if line == "out" else 1
    wound = np.zeros_like(angle)  # by the midpoint rule, from the area of the line on the spool
    step = angle[1]
    for k in range(1, len(angle)):
        half = wound[k - 1] + np.sqrt(radius**2 + sign * Q * wound[k - 1]) * step / 2
        wound[k] = wound[k - 1] + np.sqrt(radius**2 + sign * Q * half) * step
    q = radius * np.interp(lengths - RETRACTED, wound, angle)
    model = hexapod(Drive("spool", radius=radius, line=line)).with_effect("spool_buildup")
    model = replace(model, noise=Noise(joint=1e-6, position=1e-6, orientation=1e-5))
    found = fit(model, Dataset.from_arrays(model.joints, q, r, R))
    assert found.model.value("spool_buildup.Q") == pytest.approx(Q, rel=0.02)
    assert found.held_out.summary.position_rms < 5e-6
    assert found.held_out_before.summary.position_rms > 0.9e-3
