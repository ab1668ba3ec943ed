"""An encoder on a passive joint of a closed chain is one more measured channel."""

from dataclasses import replace

import chains
import numpy as np
import pytest
from bag_writing import Session, joint_states, poses, write_bag

import parallel_cal as pc
from parallel_cal.base.errors import BagError, ModelError
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.model.shelf import load_sensor
from parallel_cal.nodes.collector import Collector
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions

ZERO = "passive_encoder.left_elbow.zero"
NOISE = pc.Noise(joint=1e-6, position=1e-5)


def with_encoder(joints=("left_elbow",), **options):
    """The five-bar with an encoder on an elbow."""
    sensor = load_sensor("passive_encoder", joints=joints, **options)
    chain = pc.mechanisms.load("chain", **chains.five_bar(base=0.1, crank=0.1, bar=0.15))
    return replace(pc.new_model(chain, sensors=[sensor]), noise=NOISE)


def off_the_drawing(model, seed=0):
    """The model with errors of half a tolerance."""
    size = 0.5 * model.table.tolerance * ~np.asarray(model.fixed)
    return model.with_values(model.values + size * np.random.default_rng(seed).standard_normal(
        len(size)))  # fmt: skip


def test_an_elbow_reads_its_angle_minus_the_zero_of_the_encoder():
    """Both cranks upright: elbows at (-0.05, 0.1) and (0.05, 0.1); the rods of 0.15 m meet at
    (0, 0.1 + sqrt(0.02)). The left one is turned against its crank, which points along y."""
    model = with_encoder()
    model = model.with_values(model.table.vector({ZERO: 0.01}))
    upright = np.radians([[90.0, 90.0]] * 4)
    read = pc.simulate(model, 4, quiet=True, targets=upright + [[0], [0.1], [0], [0.1]]).dataset()
    at_rest = np.arctan2(np.sqrt(0.02), 0.05) - np.pi / 2
    assert read.conditions["reading.left_elbow"][[0, 2]] == pytest.approx(at_rest - 0.01, abs=1e-9)


def test_an_angle_of_a_passive_joint_is_within_half_a_turn_of_home():
    """Long first steps turned an elbow by a whole turn near a stretched arm."""
    model = off_the_drawing(with_encoder())
    rng = np.random.default_rng(1)
    q = np.array(model.mechanism.home.joints) + rng.uniform(-0.6, 0.6, (400, 2))
    found = pc.Kinematics(model).direct(q)
    away = found.passive[found.solved] - model.mechanism.home.passive
    assert np.abs(away).max() < np.pi


def test_a_fit_uses_the_encoder_and_ends_at_the_noise():
    true = off_the_drawing(with_encoder(sigma=1e-5))
    found = pc.fit(with_encoder(sigma=1e-5), pc.simulate(true, 40, seed=1).dataset())
    assert found.estimate.chi2_per_dof == pytest.approx(1, abs=0.4)
    assert found.model.value(ZERO) == pytest.approx(true.value(ZERO), abs=3e-4)
    unseen = pc.simulate(true, 30, seed=2).dataset()
    before, after = (
        errors(m, observe(m, unseen)).summary for m in (with_encoder(sigma=1e-5), found.model)
    )
    assert before.reading_rms > 0.2e-3  # m: an arc at the characteristic length
    assert after.reading_rms < 3e-5 * true.mechanism.length


def test_motors_and_two_elbows_calibrate_a_five_bar_without_a_device():
    """Angles do not show the size: with one rod known, the poses follow."""
    both = ("left_elbow", "right_elbow")
    model, true = with_encoder(both, sigma=1e-6), off_the_drawing(with_encoder(both, sigma=1e-6))
    session = pc.simulate(true, 60, seed=1).dataset()
    blind = replace(session, measured=np.zeros_like(session.measured))
    found = pc.fit(model, blind)
    unseen = pc.simulate(true, 30, seed=2, quiet=True).dataset()
    before, after = (errors(m, observe(m, unseen)).summary for m in (model, found.model))
    assert after.reading_rms < 0.01 * before.reading_rms


def test_a_recording_holds_what_the_encoder_reads(tmp_path):
    model = with_encoder()
    session = pc.simulate(model, 6, seed=1)
    pc.write_bag(session, tmp_path / "bag")
    again = pc.load_dataset(tmp_path / "bag", joints=model.joints)
    read, known = (d.conditions["reading.left_elbow"] for d in (again, session.dataset()))
    assert read == pytest.approx(known, abs=2e-7)  # single precision
    pc.write_model(model, tmp_path / "robot.yaml")
    assert pc.read_model(tmp_path / "robot.yaml").structure.channels == ("left_elbow",)


@pytest.mark.parametrize("mode", ["dwell", "continuous"])
def test_a_passive_joint_among_the_joint_states_is_read_by_its_name(tmp_path, mode):
    """As joint_state_broadcaster publishes them: motors and the elbow in one message."""
    mechanism, names = with_encoder().mechanism, ("left_elbow", "right", "wheel", "left")
    elbow, right, left = [-1.4, -1.3, -1.5], [0.9, 1.0, 0.8], [2.2, 2.1, 2.3]
    stops = np.column_stack([elbow, right, [0.0, 0.5, 1.0], left])
    moves = Session(stops, r=np.zeros((3, 3)), names=names)
    path = write_bag(tmp_path / "bag", joint_states(moves) + poses(moves))
    read = pc.load_dataset(path, mechanism=mechanism, mode=mode)
    assert read.joint_names == ("left", "right")
    expected = elbow
    if mode == "continuous":
        # The joints move together: the elbow is where the left motor is on the way.
        expected = np.interp(read.q[:, 0], [2.1, 2.2, 2.3], [-1.3, -1.4, -1.5])
    assert read.conditions["reading.left_elbow"] == pytest.approx(expected, abs=2e-4)
    assert "reading.wheel" not in read.conditions
    options = ReadOptions(joints=mechanism.joints, mechanism=mechanism)
    notes = [note for note in read_bag(path, options).notes if "ignored joints" in note]
    assert len(notes) == 1
    assert notes[0].endswith(": wheel")


@pytest.mark.wide
def test_a_diagnosis_with_the_encoder_names_a_backlash():
    model = with_encoder(sigma=2e-5)
    session = pc.simulate(model, 60, effects=["backlash:left.width=0.0006"], seed=1)
    found = pc.diagnose(model, session.dataset())
    assert "backlash" in found.verdict.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joints": ("left",)}, "'left' is no passive coordinate of chain, expected some of left_"),
        ({"unit": "m"}, "joint 'left_elbow' has the unit rad, not m"),
        ({"unit": "deg"}, "unit is 'deg', expected rad or m"),
    ],
)
def test_an_encoder_that_does_not_fit_the_robot_is_refused(options, message):
    with pytest.raises(ModelError, match=message):
        with_encoder(**options)


@pytest.mark.parametrize("device", [True, False])
def test_live_samples_hold_the_encoder_as_a_recording_does(tmp_path, device):
    """Without a pose device, encoders alone make samples."""
    mechanism, names = with_encoder().mechanism, ("left_elbow", "right", "left")
    stops = np.array([[-1.4, 0.9, 2.2], [-1.3, 1.0, 2.1], [-1.5, 0.8, 2.3]])
    moves = Session(stops, r=np.zeros((3, 3)), names=names)
    messages = joint_states(moves) + (poses(moves) if device else [])
    path = write_bag(tmp_path / "bag", messages)
    live, loaded = (Collector(mechanism.joints, passive=mechanism.passive) for _ in range(2))
    for topic, _, log, message in sorted(messages, key=lambda message: message[2]):
        live.receive(topic.strip("/"), message, log)
    live.refresh()
    loaded.load(path)
    recorded = pc.load_dataset(path, mechanism=mechanism)
    for dataset in (recorded, live.collection().dataset, loaded.collection().dataset):
        assert dataset.joint_names == ("left", "right")
        assert dataset.conditions["reading.left_elbow"] == pytest.approx(stops[:, 0], abs=2e-4)
        assert bool(dataset.measured.any()) == device


def test_a_recording_of_motors_alone_is_refused(tmp_path):
    moves = Session(np.array([[0.9, 2.2], [1.0, 2.1]]), r=np.zeros((2, 3)), names=("right", "left"))
    path = write_bag(tmp_path / "bag", joint_states(moves))
    with pytest.raises(BagError, match="no messages on topic 'measured_pose'"):
        pc.load_dataset(path, mechanism=with_encoder().mechanism)
