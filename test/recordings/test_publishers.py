"""Of several publishers on one topic the one that measures is used, and the others are named."""

import bag_writing as bw
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

import parallel_cal as pc
from parallel_cal.base.errors import BagError
from parallel_cal.nodes.collector import Collector

STOPS = [[0.3, -0.41], [0.523, -0.2], [0.74, 0.117], [0.3, -0.41], [0.9, 0.2], [0.52, -0.2]]
ROBOT = bw.Session(STOPS, r=np.c_[STOPS, [0.2] * 6], jitter=1e-4)
ALONE = [*bw.joint_states(ROBOT), *bw.poses(ROBOT)]
ANOTHER = "message of another publisher"


def also(change, *, every=1, after=0.002, clock=0.0, names=ROBOT.names):
    """Messages of a second publisher that makes something of every n-th reading of the robot."""
    readings = list(zip(ROBOT.time.tolist(), ROBOT.q, strict=True))[::every]
    return [
        bw.joint_state(t + after, names, change(q), stamp=bw.ns(t + after + clock))
        for t, q in readings
    ]


def count(data):
    return {d.reason: d.count for d in data.dropped}


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return pc.load_dataset(bw.write_bag(tmp_path_factory.mktemp("alone") / "bag", ALONE))


SECOND = {
    "zeros": also(np.zeros_like),
    "zeros in another order of joints": also(np.zeros_like, names=ROBOT.names[::-1]),
    "zeros ten times a second": also(np.zeros_like, every=10),
    "the pose at which a node started": also(lambda q: np.array([0.3217389, -0.4171717])),
    "commands rounded to 0.01": also(lambda q: np.round(q, 2), every=2),
    "commands rounded to 0.1 degrees": also(lambda q: np.radians(np.degrees(q).round(1))),
    "rounded commands of a clock 5 s behind": also(lambda q: np.round(q, 2), clock=-5.0),
    "rounded commands 20 ms ahead": also(lambda q: np.round(q, 2), every=2, clock=0.02),
    "targets at full precision": also(
        lambda q: np.array(STOPS)[np.abs(STOPS - q).sum(1).argmin()] + 3.1415927e-3
    ),
}


@pytest.mark.parametrize("second", SECOND)
def test_a_second_publisher_of_commands_or_constants_does_not_change_the_samples(
    second, alone, tmp_path
):
    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", [*ALONE, *SECOND[second]]))
    np.testing.assert_allclose(found.q, alone.q, atol=1e-12)
    np.testing.assert_allclose(found.r, alone.r, atol=1e-12)
    assert count(found) == {ANOTHER: len(SECOND[second])}
    (warning,) = (w for w in found.warnings if "several publishers" in w)
    assert f"{len(SECOND[second])} of {len(SECOND[second]) + len(ROBOT.time)} messages" in warning
    assert "joint_states" in warning


def test_the_words_say_what_the_dropped_messages_are(tmp_path):
    zeros = also(np.zeros_like, names=ROBOT.names[::-1])
    echo = also(lambda q: np.round(q, 2), every=2, after=0.004)
    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", [*ALONE, *zeros, *echo]))
    words = [w for w in found.warnings if "several publishers" in w]
    assert any("they never change (0 0)" in w for w in words)
    assert any("rounded to 0.01: they repeat their values" in w for w in words)


@pytest.mark.parametrize("frame", ["", "second"])
def test_two_measuring_publishers_that_disagree_are_refused(frame, tmp_path):
    rng = np.random.default_rng(1)
    second = also(lambda q: 0.7 - q + rng.normal(0, 1e-4, 2))
    for *_, message in second:
        message.header.frame_id = frame
    with pytest.raises(BagError, match="joint_states has several publishers, whose values disag"):
        pc.load_dataset(bw.write_bag(tmp_path / "bag", [*ALONE, *second]))


@pytest.mark.parametrize("names", [ROBOT.names, ROBOT.names[::-1]])
def test_a_publisher_that_sends_every_message_twice_is_no_second_one(names, alone, tmp_path):
    copies = also(lambda q: q if names == ROBOT.names else q[::-1].copy(), names=names)
    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", [*ALONE, *copies]))
    np.testing.assert_allclose(found.q, alone.q, atol=2e-5)
    assert count(found) == {}


def test_names_in_a_new_order_in_each_message_are_one_publisher(alone, tmp_path):
    rng = np.random.default_rng(2)
    orders = [rng.permutation(2) for _ in ROBOT.time]
    states = [
        bw.joint_state(t, [ROBOT.names[j] for j in order], q[order])
        for t, q, order in zip(ROBOT.time.tolist(), ROBOT.q, orders, strict=True)
    ]
    path = bw.write_bag(tmp_path / "bag", [*states, *bw.poses(ROBOT)])
    np.testing.assert_allclose(pc.load_dataset(path, joints=ROBOT.names).q, alone.q, atol=1e-12)


def test_a_coarse_encoder_that_toggles_at_rest_is_one_publisher(tmp_path):
    coarse = bw.Session(STOPS, r=ROBOT.r, jitter=1e-4)
    coarse.q = np.round(coarse.q, 4)
    found = pc.load_dataset(
        bw.write_bag(tmp_path / "bag", bw.joint_states(coarse) + bw.poses(coarse))
    )
    assert len(found) == len(STOPS)
    assert count(found) == {}


@pytest.mark.parametrize(
    ("second", "refused"),
    [
        (lambda r, rng: r + [0.0, 0.0, 0.05] + rng.normal(0, 2e-6, 3), True),
        (lambda r, rng: np.zeros(3), False),
        (lambda r, rng: np.round(r, 1), False),
    ],
)
def test_a_second_publisher_of_poses_is_dropped_or_the_recording_refused(
    second, refused, alone, tmp_path
):
    rng = np.random.default_rng(3)
    time = np.arange(0.014, ROBOT.time[-1], 1.0 / ROBOT.pose_rate)
    more = [
        bw.pose(t, second(r, rng)) for t, r in zip(time.tolist(), ROBOT.position(time), strict=True)
    ]
    path = bw.write_bag(tmp_path / "bag", [*ALONE, *more])
    if refused:
        with pytest.raises(BagError, match="measured_pose has several publishers"):
            pc.load_dataset(path)
        return
    found = pc.load_dataset(path)
    np.testing.assert_allclose(found.r, alone.r, atol=1e-12)
    assert count(found) == {ANOTHER: len(more)}


def test_temperatures_of_two_sensors_on_one_topic_are_ignored_with_the_reason(tmp_path):
    rng = np.random.default_rng(4)
    both = [bw.temperature(t, rng.normal(20, 0.1)) for t in np.arange(0.0, 9.0, 0.1).tolist()]
    both += [bw.temperature(t, rng.normal(35, 0.1)) for t in np.arange(0.05, 9.0, 0.1).tolist()]
    for k, (*_, message) in enumerate(both):
        message.header.frame_id = "arms" if k < 90 else "room"
    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", [*ALONE, *both]))
    assert "temperature" not in found.conditions
    (warning,) = (w for w in found.warnings if "temperature" in w)
    assert "frame_id arms" in warning
    assert "frame_id room" in warning


@pytest.mark.parametrize("size", [2e-3, 0.5])
@pytest.mark.parametrize("length", [1, 3])
def test_odd_messages_do_not_cut_a_dwell_in_two(size, length, alone, tmp_path):
    session = bw.Session(STOPS, r=ROBOT.r, jitter=1e-4)
    for t in (0.5, 2.1, 5.3):
        first = round(t * session.rate)
        session.q[first : first + length] += size
    states = bw.joint_states(session)
    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", [*states, *bw.poses(session)]))
    assert len(found) == len(alone) == len(STOPS)
    np.testing.assert_allclose(found.q, alone.q, atol=3e-5)
    (odd,) = found.dropped
    assert odd.count >= 3 * length
    assert odd.reason == "odd joint reading while the robot rests"
    assert "joint_states" in odd.detail


def test_a_short_move_away_and_back_gives_two_visits(tmp_path):
    """3 mrad in 0.12 s and back: an approach, no odd message."""
    session = bw.Session(STOPS, r=ROBOT.r, jitter=1e-5, dwell=2.0)
    away = np.sin(np.linspace(0, np.pi, 24))[:, None] ** 2 * 3e-3
    session.q[90:114] += away
    found = pc.load_dataset(
        bw.write_bag(tmp_path / "bag", bw.joint_states(session) + bw.poses(session))
    )
    assert len(found) == len(STOPS) + 1


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("second", ["zeros", "commands rounded to 0.01"])
def test_the_live_node_gives_the_samples_of_the_bag(second, counted, alone, tmp_path):
    path = bw.write_bag(tmp_path / "bag", [*ALONE, *SECOND[second]])
    collector, sequence = Collector(), {"robot": 0, "second": 500, "device": 0}
    own = {bw.ns(t) for t in ROBOT.time.tolist()}
    with AnyReader([path]) as reader:
        for connection, log, data in reader.messages():
            who = "device" if connection.topic == "measured_pose" else "second"
            who = "robot" if who == "second" and log in own else who
            sequence[who] += 1
            message = reader.deserialize(data, connection.msgtype)
            collector.receive(connection.topic, message, log, counted * sequence[who])
    collector.refresh()
    found = collector.collection().dataset
    np.testing.assert_allclose(found.q, alone.q, atol=1e-12)
    assert count(found) == {ANOTHER: len(SECOND[second])}
    assert any("several publishers" in warning for warning in collector.warnings())
