"""The virtual robot is the truth for other tests, so it is held to hand-worked numbers itself."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from virtual_day import dwell_samples, plan, record, targets

from parallel_cal.virtual.robot import (
    ARCSEC,
    COLUMNS,
    MOCK_UP,
    NOMINAL,
    TABLE_5_12,
    TABLE_5_18,
    Backlash,
    Delta,
    Effect,
    EncoderEccentricity,
    Noise,
    Parameters,
    SampleConditions,
    truth,
    turn,
)

CUBE = np.random.default_rng(0).uniform(-0.06, 0.06, (74, 3)) + [0, 0, 0.2]
ECCENTRIC = EncoderEccentricity(sin=(1e-3, 0, 0), cos=(0, 2e-3, 0))
PLAY = Backlash(width=(2e-4, 3e-4, 0))

# A robot for pencil and paper: at q = 0 its arms lie flat, and arm end, platform and height make
# a 3-4-5 triangle: the arms' balls stand 0.05 + 0.10 m further out than the platform's.
PAPER = {f"chain{i}.{name}": 0.0 for i in (1, 2, 3) for name in COLUMNS}
for i in (1, 2, 3):
    PAPER |= {f"chain{i}.theta": np.radians(120 * (i - 1)), f"chain{i}.alpha": np.pi / 2}
    PAPER |= {f"chain{i}.D_x": 0.05, f"chain{i}.La_x": 0.10, f"chain{i}.Lb": 0.25}
    PAPER |= {f"chain{i}.b_x": 0.03, f"chain{i}.d_z": 0.02}


def circumstances(n: int, direction: float = 1.0) -> SampleConditions:
    return SampleConditions(np.zeros(n), np.full(n, 20.0), np.zeros(n), np.full((n, 3), direction))


# --- geometry ---------------------------------------------------------------------------------


def test_turn_is_a_rotation_about_its_vector() -> None:
    w = np.random.default_rng(1).normal(size=(100, 3))
    w[0] = 0
    np.testing.assert_allclose(turn(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-15)


def test_flat_arms_hold_the_paper_robot_at_the_height_of_a_3_4_5_triangle() -> None:
    r, R = Delta(PAPER).forward(np.zeros(3))
    np.testing.assert_allclose(r, [0, 0, 0.20], atol=1e-14)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-14)


def test_upright_arms_hold_it_higher_by_the_arm_and_the_steeper_rod() -> None:
    r, _ = Delta(PAPER).forward(np.full(3, np.pi / 2))
    np.testing.assert_allclose(r, [0, 0, 0.10 + np.sqrt(0.25**2 - 0.05**2)], atol=1e-14)


# First chain of the paper robot: x0 points outwards (x), y0 up (z), z0 along -y. A millimetre or
# a milliradian of each parameter moves the balls C_1, C_2, B_1, B_2 by these mm (by hand), or
# changes the rods: C_1 is at (0.18, -0.02, 0) m, B_1 at (0.03, -0.02, 0.2) m.
X, Y, Z, O = np.array([1, 0, 0]), np.array([0, 1, 0]), np.array([0, 0, 1]), np.zeros(3)
BY_HAND = {
    "D_x": (X, X, O, O),
    "D_y": (Z, Z, O, O),
    "D_z": (-Y, -Y, O, O),
    "theta": (0.18 * Y + 0.02 * X, 0.18 * Y - 0.02 * X, 0.03 * Y + 0.02 * X, 0.03 * Y - 0.02 * X),
    "alpha": (-0.02 * Z, 0.02 * Z, -0.02 * Z, 0.02 * Z),
    "La_x": (X, X, O, O),
    "La_y": (Z, Z, O, O),
    "Lb": (O, O, O, O),
    "d_z": (-Y, Y, -Y, Y),
    "dalpha": (-0.02 * Z, 0.02 * Z, O, O),
    "dbeta": (0.02 * X + 0.10 * Y, -0.02 * X + 0.10 * Y, O, O),
    "dC_x": (X, -X, O, O),
    "dC_y": (Z, -Z, O, O),
    "dC_z": (-Y, Y, O, O),
    "dLb": (O, O, O, O),
    "b_x": (X, X, X, X),
    "b_y": (Z, Z, Z, Z),
    "b_z": (-Y, -Y, -Y, -Y),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_every_parameter_moves_the_balls_as_worked_out_by_hand(name: str) -> None:
    pose = [0, 0, 0.2], np.eye(3)

    def balls(change: float) -> np.ndarray:
        robot = Delta(PAPER | {f"chain1.{name}": PAPER[f"chain1.{name}"] + change})
        both = robot.joint_points(np.zeros(3)), robot.platform_points(*pose)
        return np.concatenate([points[[0, 3]] for points in both])

    moved = (balls(1e-6) - balls(-1e-6)) / 2e-6
    np.testing.assert_allclose(moved, np.array(BY_HAND[name]), atol=1e-9)


def test_the_forearms_parameters_are_their_mean_length_and_half_the_difference() -> None:
    robot = Delta(PAPER | {"chain2.Lb": 0.3, "chain2.dLb": 0.001})
    np.testing.assert_allclose(robot.lengths(np.zeros(3)), [0.25, 0.301, 0.25, 0.25, 0.299, 0.25])


def test_a_positive_joint_angle_lifts_the_arm() -> None:
    raised = Delta(PAPER).joint_points(np.array([0.3, 0, 0]))
    np.testing.assert_allclose(raised[0], [0.08 + 0.1 * np.cos(0.3), -0.02, 0.1 * np.sin(0.3)])


@pytest.mark.parametrize("robot", [NOMINAL, MOCK_UP])
def test_rods_have_their_lengths_wherever_the_robot_stands(robot: Delta) -> None:
    q, R = robot.inverse(CUBE)
    assert np.abs(robot.gaps(q, CUBE, R)).max() < 1e-13
    q = q + np.random.default_rng(2).normal(size=q.shape) * 0.05
    assert np.abs(robot.gaps(q, *robot.forward(q))).max() < 1e-13


@pytest.mark.parametrize("robot", [NOMINAL, MOCK_UP])
def test_forward_undoes_inverse(robot: Delta) -> None:
    q, R = robot.inverse(CUBE)
    there, turned = robot.forward(q)
    np.testing.assert_allclose(there, CUBE, atol=1e-13)
    np.testing.assert_allclose(turned, R, atol=1e-12)


def test_a_pose_out_of_reach_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be assembled there: its rods do not meet"):
        NOMINAL.inverse([0, 0, 0.5])


# --- the thesis -------------------------------------------------------------------------------


def test_the_mock_up_stands_at_the_centre_with_arms_near_30_65_degrees() -> None:
    for robot in (NOMINAL, MOCK_UP):
        np.testing.assert_allclose(np.degrees(robot.inverse([0, 0, 0.2])[0]), 30.65, atol=0.25)
    np.testing.assert_allclose(np.degrees(NOMINAL.inverse([0, 0, 0.2])[0]), 30.65, atol=0.006)


def test_the_nominal_platform_never_tilts() -> None:
    np.testing.assert_allclose(
        NOMINAL.inverse(CUBE)[1], np.broadcast_to(np.eye(3), (74, 3, 3)), atol=1e-13
    )


def test_the_uncalibrated_mock_up_misses_its_targets_as_table_5_15_measured() -> None:
    r, _ = MOCK_UP.forward(NOMINAL.inverse(CUBE)[0])
    error = (r - CUBE) * 1e6
    np.testing.assert_allclose(error.mean(axis=0), [270, 409, -318], atol=1)
    assert np.linalg.norm(error, axis=1).mean() == pytest.approx(594, abs=1)
    # and the same in joints, where the thesis measured (12, 11, -4) arcmin
    joints = (NOMINAL.inverse(CUBE)[0] - NOMINAL.inverse(r)[0]) / ARCSEC / 60
    np.testing.assert_allclose(joints.mean(axis=0), [12, 11, -4], atol=2)


# --- hidden physics ---------------------------------------------------------------------------


def test_an_eccentric_disc_adds_one_wave_a_turn() -> None:
    angle, _, _ = truth(MOCK_UP, [ECCENTRIC], np.full((1, 3), np.pi / 6), circumstances(1))
    expected = [0.5e-3, 2e-3 * np.sqrt(3) / 2, 0]
    np.testing.assert_allclose(angle[0] - np.pi / 6, expected, atol=1e-15)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_with_play_the_arm_lags_half_the_width_behind_the_motor(direction: float) -> None:
    angle, _, _ = truth(MOCK_UP, [PLAY], np.full((1, 3), 0.5), circumstances(1, direction))
    np.testing.assert_allclose(angle[0] - 0.5, -direction * np.array([1e-4, 1.5e-4, 0]), atol=1e-15)


def test_effects_act_in_order_and_on_the_pose_through_the_true_geometry() -> None:
    reading, at = np.full((1, 3), 0.5), circumstances(1)
    angle, r, _ = truth(MOCK_UP, [ECCENTRIC, PLAY], reading, at)
    expected = PLAY.arm(ECCENTRIC.arm(reading, MOCK_UP, at), MOCK_UP, at)
    np.testing.assert_array_equal(angle, expected)
    np.testing.assert_array_equal(r, MOCK_UP.forward(expected)[0])


def test_geometry_may_differ_from_sample_to_sample() -> None:
    class Growth(Effect):
        def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
            grown = 1 + 1e-5 * (at.temperature - 20)
            return {**parameters, "chain1.La_x": parameters["chain1.La_x"] * grown}

    at = SampleConditions(np.zeros(2), np.array([20.0, 30.0]), np.zeros(2), np.ones((2, 3)))
    _, r, _ = truth(MOCK_UP, [Growth()], np.full((2, 3), 0.5), at)
    longer = Delta(TABLE_5_18 | {"chain1.La_x": TABLE_5_18["chain1.La_x"] * 1.0001})
    np.testing.assert_allclose(r[0], MOCK_UP.forward([0.5] * 3)[0], atol=1e-14)
    np.testing.assert_allclose(r[1], longer.forward([0.5] * 3)[0], atol=1e-14)


# --- session ----------------------------------------------------------------------------------


def test_poses_fill_the_cube_evenly() -> None:
    octants = (targets(74, 0) > [0, 0, 0.2]) @ [1, 2, 4]
    assert np.bincount(octants, minlength=8).min() >= 7
    assert np.abs(targets(74, 0) - [0, 0, 0.2]).max() < 0.06


@pytest.mark.parametrize("seed", range(5))
def test_every_pose_is_visited_and_replicates_come_from_another_side(seed: int) -> None:
    session = plan(seed=seed)
    direction = np.sign(session.ways)
    again = [np.flatnonzero(session.pose_index == pose) for pose in range(74)]
    assert sorted(map(len, again)) == [1] * 54 + [2] * 20
    for first, second in (visits for visits in again if len(visits) == 2):
        assert second > first + 1
        assert (direction[first] != direction[second]).any()


def test_dwells_scatter_by_the_instruments_accuracy_and_by_nothing_else() -> None:
    draws = [dwell_samples(seed=s) for s in range(10)]
    truth_q, truth_r = draws[0]["reading"], draws[0]["true_r"]
    assert np.std([d["q"] - truth_q for d in draws]) == pytest.approx(25 * ARCSEC, rel=0.05)
    assert np.std([d["r"] - truth_r for d in draws]) == pytest.approx(10e-6, rel=0.05)
    turns = [Rotation.from_matrix(d["R"]) * Rotation.from_matrix(d["true_R"]).inv() for d in draws]
    assert np.std([t.as_rotvec() for t in turns]) == pytest.approx(15 * ARCSEC, rel=0.05)


def test_a_recordings_dwells_average_to_the_dwell_samples() -> None:
    data, dwells = record(seed=4, effects=[PLAY]), dwell_samples(seed=4, effects=[PLAY])
    for clock, name, jitter in (("joint_time", "q", 5 * ARCSEC), ("pose_time", "r", 2e-6)):
        for k in (0, 40, 93):
            held = (data[clock] > data["arrive"][k]) & (data[clock] < data["leave"][k])
            spread = jitter / np.sqrt(held.sum())
            mean = data[name][held].mean(axis=0)
            np.testing.assert_allclose(mean, dwells[name][k], atol=5 * spread)


def test_joints_move_smoothly_and_one_way_between_dwells() -> None:
    session = plan()
    time = np.linspace(session.leave[3], session.arrive[4], 100)
    q = session.follow(time, session.reading, session.home)
    assert (np.diff(q, axis=0) * np.sign(session.ways[4]) >= 0).all()
    np.testing.assert_allclose(q[[0, -1]], session.reading[3:5], atol=1e-15)


def test_without_noise_a_session_is_exact() -> None:
    d = dwell_samples(noise=Noise(0, 0, 0))
    np.testing.assert_allclose(d["r"], MOCK_UP.forward(d["q"])[0], atol=1e-14)


# --- recordings -------------------------------------------------------------------------------

make_bags = pytest.importorskip("make_bags", reason="writing recordings needs rosbags")
ALL = list(make_bags.RECORDINGS)
JOINTS = "joint_states"


def data_file(name: str) -> Path:
    return next(f for f in (make_bags.BAGS / name).iterdir() if f.name != "metadata.yaml")


@pytest.mark.wide
def test_a_recording_regenerates_identically() -> None:
    assert make_bags.check("delta_clean")


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_every_recording_regenerates_identically(name: str) -> None:
    assert make_bags.check(name)


def test_a_recording_of_something_else_is_noticed() -> None:
    clean, play = (make_bags.BAGS / f"delta_{what}" for what in ("clean", "backlash"))
    assert not make_bags.same(clean, play)


def test_sqlite3_and_mcap_hold_the_same_messages() -> None:
    one, other = (make_bags.read(make_bags.BAGS / f"delta_clean{s}") for s in ("", "_sqlite"))
    assert sorted(one) == sorted(other)


@pytest.mark.parametrize("name", ALL)
def test_a_recording_has_its_topics_types_and_rates(name: str) -> None:
    clocks = make_bags.RECORDINGS[name].clocks
    with make_bags.Reader(make_bags.BAGS / name) as reader:
        seconds = reader.duration * 1e-9
        rates = {c.topic: c.msgcount / seconds for c in reader.connections}
        assert {c.topic: c.msgtype for c in reader.connections} == make_bags.TYPES
        changes = reader.topics["payload"].msgcount
    assert changes == (4 if name == "delta_compliance" else 1)
    assert rates["joint_states"] == pytest.approx(1 / clocks.joint, rel=0.01)
    assert rates["measured_pose"] == pytest.approx(1 / clocks.pose, rel=0.01)
    assert rates["temperature"] == pytest.approx(1 / clocks.slow, rel=0.01)


def test_messages_are_stamped_with_their_log_time_and_say_what_the_interface_asks() -> None:
    last = {}
    for stamp, topic, raw in make_bags.read(make_bags.BAGS / "delta_clean"):
        message = make_bags.ROS.deserialize_cdr(raw, make_bags.TYPES[topic])
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        last[topic] = message
    joints, pose = last["joint_states"], last["measured_pose"]
    assert joints.name == ["joint1", "joint2", "joint3"]
    assert len(joints.position) == 3
    assert len(joints.velocity) == 0
    assert pose.header.frame_id == "base"
    assert last["payload"].inertia.m == 0.2
    sigma = np.sqrt(np.diag(pose.pose.covariance.reshape(6, 6)))
    np.testing.assert_allclose(sigma, [10e-6] * 3 + [15 * ARCSEC] * 3)


def test_the_last_dwell_reads_as_the_session_drew_it() -> None:
    dwells = dwell_samples(seed=1, pose_seed=1)
    *_, (_, _, raw) = (m for m in make_bags.read(make_bags.BAGS / "delta_clean") if m[1] == JOINTS)
    q = make_bags.ROS.deserialize_cdr(raw, make_bags.TYPES[JOINTS]).position
    np.testing.assert_allclose(q, dwells["q"][-1], atol=5 * 5 * ARCSEC)


@pytest.mark.parametrize("name", ALL)
def test_the_page_beside_the_recordings_lists_their_hashes_and_they_are_small(name: str) -> None:
    content = data_file(name).read_bytes()
    assert hashlib.sha256(content).hexdigest() in (make_bags.BAGS / "README.md").read_text()
    assert len(content) <= 2_000_000


def test_the_page_is_what_the_program_writes() -> None:
    assert (make_bags.BAGS / "README.md").read_text() == make_bags.readme(make_bags.BAGS)


@pytest.mark.wide
@pytest.mark.parametrize("name", ALL)
def test_what_is_hidden_is_written_down(name: str) -> None:
    hidden = yaml.safe_load((make_bags.BAGS / "truth" / f"{name}.yaml").read_text())
    assert hidden == make_bags.truth_of(make_bags.RECORDINGS[name])
    if name.startswith("delta"):
        assert hidden["controller_parameters"] == TABLE_5_12
