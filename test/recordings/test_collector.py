"""Live collection gives the samples that the bag reader gives; a person can correct them."""

import copy
import dataclasses
from itertools import islice
from pathlib import Path

import bag_writing as bw
import numpy as np
import pytest
import tied_session as ts
import virtual_setups as vs
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from parallel_cal.base.errors import DatasetError
from parallel_cal.nodes import clock_alignment
from parallel_cal.nodes import collector as collector_module
from parallel_cal.nodes.clock_alignment import ClockAlignment, JointClock
from parallel_cal.nodes.collector import Collector
from parallel_cal.recordings.gate import StampedMessage
from parallel_cal.recordings.joining import join_datasets
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.samplefile import PER_SAMPLE

BAG = Path(__file__).parents[2] / "bags" / "delta_clean"


@pytest.fixture(scope="module")
def messages():
    return messages_of(BAG)


def messages_of(bag):
    """All messages of a recording in the order of their times: (channel, log time, message)."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([bag], default_typestore=store) as reader:
        return [
            (connection.topic, log, reader.deserialize(data, connection.msgtype))
            for connection, log, data in reader.messages()
        ]


@pytest.fixture(scope="module")
def offline():
    return load_dataset(BAG)


@pytest.fixture(scope="module")
def tied_bag(tmp_path_factory):
    """A virtual Delta on a plate: 10 poses on it and on each of two spheres, no pose device."""
    path = tmp_path_factory.mktemp("tied") / "bag"
    return bw.write_bag(path, ts.messages(vs.random_delta(1), n=10))


@pytest.fixture(scope="module")
def tied(tied_bag):
    return messages_of(tied_bag)


def feed(collector, messages):
    for channel, log, message in messages:
        collector.receive(channel.strip("/"), message, log)
    collector.refresh()
    return collector


def until(messages, seconds):
    first = messages[0][1]
    return list(islice(messages, sum(log - first < seconds * 1e9 for _, log, _ in messages)))


def same(a, b):
    for name in PER_SAMPLE:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert a.conditions.keys() == b.conditions.keys()
    for name, column in a.conditions.items():
        np.testing.assert_array_equal(column, b.conditions[name], err_msg=name)


@pytest.mark.parametrize("channel", ["joint_states", "measured_pose"])
def test_one_message_ahead_of_its_time_costs_no_sample(messages, channel):
    """One message 2 s ahead in a session of 40 dwells used to leave 6 of them."""
    part = until(messages, 62)
    at = [i for i, (topic, _, _) in enumerate(part) if topic == channel][300]
    topic, log, message = part[at]
    ahead = copy.deepcopy(message)
    ahead.header.stamp.sec += 2
    spoilt = feed(Collector(), [*part[:at], (topic, log, ahead), *part[at + 1 :]])
    whole = feed(Collector(), part)
    assert len(spoilt) == len(whole) > 30
    assert (spoilt.strays, whole.strays) == (1, 0)
    assert "its stamp is +2." in spoilt.warnings()[0]


def stamped(message, seconds):
    other = copy.deepcopy(message)
    other.header.stamp.sec += seconds
    return other


@pytest.mark.wide
@pytest.mark.parametrize("by", [-5, 5])
@pytest.mark.parametrize("channel", ["joint_states", "measured_pose"])
def test_one_clock_that_is_set_while_the_other_goes_on_costs_no_sample_and_spoils_none(
    messages, channel, by
):
    """Half the samples used to go, or had the pose of another dwell without a word."""
    part = until(messages, 60)
    half = len(part) // 2
    spoilt = [
        (topic, log, stamped(m, by) if i >= half and topic == channel else m)
        for i, (topic, log, m) in enumerate(part)
    ]
    whole, found = feed(Collector(), part), feed(Collector(), spoilt)
    assert len(whole) > 30
    assert abs(len(found) - len(whole)) <= 1  # the dwell that it happened in
    (said,) = found.warnings()
    assert "measured_pose: its clock or the joints' clock was set by" in said
    true, ours = whole.collection().dataset, found.collection().dataset
    for q, r in zip(ours.q, ours.r, strict=True):
        same_dwell = np.argmin(np.abs(true.q - q).max(axis=1))
        assert np.linalg.norm(true.r[same_dwell] - r) < 1e-3


@pytest.mark.wide
@pytest.mark.parametrize("by", [-5, 5])
@pytest.mark.parametrize("channel", ["joint_states", "measured_pose"])
def test_some_messages_astray_in_a_row_do_not_end_a_session(messages, channel, by):
    """Four in a row are believed by themselves, and the other stream says that they are not."""
    part = until(messages, 60)
    wild = [i for i, (topic, _, _) in enumerate(part) if topic == channel][300:304]
    spoilt = [
        (topic, log, stamped(m, by) if i in wild else m) for i, (topic, log, m) in enumerate(part)
    ]
    assert abs(len(feed(Collector(), spoilt)) - len(feed(Collector(), part))) <= 1


def test_measurements_that_a_network_delivers_late_are_not_astray(messages):
    """Three seconds of them at once, in the order in which they were sent."""
    part = until(messages, 20)
    begin, end = part[0][1] + 10 * 10**9, part[0][1] + 13 * 10**9
    late = [
        (topic, end + i if topic == "measured_pose" and begin <= log < end else log, message)
        for i, (topic, log, message) in enumerate(part)
    ]
    found, whole = feed(Collector(), sorted(late, key=lambda m: m[1])), feed(Collector(), part)
    same(found.collection().dataset, whole.collection().dataset)
    assert found.strays == 0


@pytest.mark.parametrize("rate", [0.5, 1, 3, 10, 40])
@pytest.mark.parametrize("silent", ["joint_states", "measured_pose"])
def test_a_gap_in_a_recording_played_at_any_rate_is_no_clock_that_was_set(messages, silent, rate):
    """Played three times too fast, a gap of 5 s shifted all later poses by 2.1 s: 31 mm."""
    part = until(messages, 40)
    first = part[0][1]
    gapped = [
        (topic, log, message)
        for topic, log, message in part
        if topic != silent or not 10e9 < log - first < 15e9
    ]
    played = [(topic, first + round((log - first) / rate), m) for topic, log, m in gapped]
    found, whole = feed(Collector(), played), feed(Collector(), gapped)
    same(found.collection().dataset, whole.collection().dataset)
    assert len(found) > 20
    assert found.warnings() == whole.warnings() == []
    assert found.strays == 0


@pytest.mark.parametrize("bad", ["late", "ahead of the joints"])
def test_a_burst_of_poses_in_a_gap_of_the_joint_states_is_no_clock_that_was_set(messages, bad):
    """Poses that arrive while no joint state does tell nothing about the clocks."""
    part = until(messages, 30)
    first = part[0][1]
    begin, end = first + 10 * 10**9, first + 15 * 10**9
    gapped, k = [], 0
    for topic, log, message in part:
        if topic == "joint_states":
            if begin < log < end - 10**8:
                continue
        elif begin < log < end:  # 5 s of poses are received at once
            k += 1
            log = (end if bad == "late" else begin) + k
        gapped.append((topic, log, message))
    gapped.sort(key=lambda m: m[1])
    found = feed(Collector(), gapped)
    true = feed(Collector(), part).collection().dataset
    for q, r in zip(*(getattr(found.collection().dataset, name) for name in "qr"), strict=True):
        assert np.linalg.norm(true.r[np.argmin(np.abs(true.q - q).max(axis=1))] - r) < 1e-3
    assert len(found) >= 15
    assert found.warnings() == []


@pytest.mark.parametrize("channel", ["joint_states", "measured_pose"])
@pytest.mark.parametrize("stamp", [0, -1_927_302_106])
def test_messages_without_a_stamp_among_stamped_ones_are_dropped_and_end_no_session(
    messages, channel, stamp
):
    """500 of them after 3 dwells gave all later poses the computer's time, and negative stamps
    ended the collection of joint states: no sample more."""
    part = until(messages, 20)
    first = part[0][1]
    bad = []
    topic, log, message = next(m for m in part if m[0] == channel and m[1] - first > 5e9)
    for k in range(2000):
        unstamped = copy.deepcopy(message)
        unstamped.header.stamp.sec, unstamped.header.stamp.nanosec = stamp, 0
        bad.append((topic, log + 1 + k, unstamped))
    spoilt = sorted([*part, *bad], key=lambda m: m[1])
    simulated = [(t, log - first + 1, m) for t, log, m in spoilt]  # received at another clock
    whole = feed(Collector(), part)
    for stream in (spoilt, simulated):
        found = feed(Collector(), stream)
        same(found.collection().dataset, whole.collection().dataset)
        assert [(d.reason, d.count) for d in found.dropped() if d.count >= 2000] == [
            ("header stamp is zero or negative", 2000)
        ]


@pytest.mark.parametrize("by", [3, -3, 10, 37, -37, 1_000_000])
@pytest.mark.parametrize("seconds", [4, 6, 30])
def test_poses_on_a_clock_that_is_seconds_or_days_off_give_the_same_samples(messages, by, seconds):
    """A campaign with a tracker whose clock was 37 s off ended at its first pose. One whose clock
    was 10 s off got a pose of the previous dwell, once both streams overlapped: the order of
    reception tells the first offset, and the motion a better one."""
    part = until(messages, seconds)
    off = [(t, log, stamped(m, by) if "pose" in t else m) for t, log, m in part]
    found, whole = feed(Collector(), off), feed(Collector(), part)
    assert len(found) == len(whole) > (1 if seconds < 10 else 15)
    np.testing.assert_allclose(
        found.collection().dataset.r, whole.collection().dataset.r, atol=2e-5
    )
    np.testing.assert_allclose(
        found.collection().dataset.q, whole.collection().dataset.q, atol=1e-5
    )
    late = "later" if by > 0 else "earlier"
    assert any(f"was stamped {abs(by)}.0 s {late} than joint_states" in w for w in found.warnings())


@pytest.mark.parametrize("channel", ["joint_states", "measured_pose"])
def test_a_first_message_ahead_of_its_time_costs_no_sample(messages, channel):
    part = until(messages, 15)
    first = next(i for i, (topic, _, _) in enumerate(part) if topic == channel)
    topic, log, message = part[first]
    spoilt = [*part[:first], (topic, log, stamped(message, 5)), *part[first + 1 :]]
    found, whole = feed(Collector(), spoilt), feed(Collector(), part)
    assert len(found) == len(whole) > 5
    assert found.strays == 1


def test_samples_from_two_publishers_at_once_are_refused_with_the_reason(messages):
    """A second tracker whose clock is 5 s off, both with counts of their own."""
    collector, part = Collector(), until(messages, 30)
    counts = {"a": 0, "b": 0}
    for channel, log, message in part:
        channel = channel.strip("/")
        counts["a"] += channel == "measured_pose"
        collector.receive(channel, message, log, counts["a"] if "pose" in channel else 0)
        if channel == "measured_pose":
            counts["b"] += 1
            other = copy.deepcopy(message)
            other.header.stamp.sec += 5
            other.pose.pose.position.z += 0.1
            collector.receive(channel, other, log + 1000, counts["b"] + 500)
    collector.refresh()
    assert len(collector) == 0
    assert "two publishers are active" in collector.warnings()[0]


def test_joints_that_the_model_does_not_know_are_a_warning_and_no_samples_yet_are_none(messages):
    few = until(messages, 1)
    assert feed(Collector(), few).warnings() == []
    (said,) = feed(Collector(["hip", "knee", "foot"]), few).warnings()
    assert "hip" in said
    assert "joint1" in said


def test_millimetres_are_a_warning(messages):
    """Of them no samples are made, so that none can tell; nor will there be later."""
    collector = Collector()
    for channel, log, message in until(messages, 10):
        if channel == "measured_pose":
            message = copy.deepcopy(message)
            p = message.pose.pose.position
            p.x, p.y, p.z = 1e3 * p.x, 1e3 * p.y, 1e3 * p.z
        collector.receive(channel.strip("/"), message, log)
    collector.refresh()
    assert len(collector) == 0
    (said,) = collector.warnings()
    assert "looks like millimetres" in said


def test_a_replayed_recording_gives_exactly_the_samples_of_its_bag(messages, offline):
    collection = feed(Collector(), messages).collection()
    assert len(collection) == 94
    same(collection.dataset, offline)
    assert len(collection.dataset.sha256) == 64


@pytest.mark.wide
def test_looking_in_between_changes_nothing_and_numbers_stay(messages, offline):
    collector, seen, compared = Collector(), {}, 0
    for k in range(0, len(messages), 1500):
        feed(collector, messages[k : k + 1500])
        if len(collector):
            collection = collector.collection()
            stamps = dict(zip(collection.ids.tolist(), collection.stamps.tolist(), strict=True))
            for number in seen.keys() & stamps.keys():
                assert abs(seen[number] - stamps[number]) < 1e9
                compared += 1
            seen.update(stamps)
    assert compared > 94
    same(collector.collection().dataset, offline)


def test_every_measurement_is_counted_as_paired_or_dropped(messages):
    collector = feed(Collector(), messages)
    poses = collector.received["measured_pose"]
    assert poses == 3056
    assert collector.paired + collector.dropped_poses <= poses
    assert collector.paired >= poses - 1


def test_poses_on_another_clock_are_shifted_to_that_of_the_joints_and_the_shift_is_reported(
    messages, offline
):
    """0.4 s late: the samples, and how many measurements were paired, are those of one clock."""
    late = [
        (channel, log, copy.deepcopy(m) if "pose" in channel else m) for channel, log, m in messages
    ]
    for channel, _, message in late:
        if "pose" in channel:
            stamp = message.header.stamp
            carry, stamp.nanosec = divmod(stamp.nanosec + 400_000_000, 10**9)
            stamp.sec += carry
    collector = feed(Collector(), late)
    found = collector.collection().dataset
    assert len(found) == len(offline)
    np.testing.assert_allclose(found.r, offline.r, atol=5e-6)
    np.testing.assert_array_equal(found.q, offline.q)
    [said] = [text for text in collector.warnings() if "two clocks" in text]
    assert float(said.split(" was stamped ")[1].split()[0]) == pytest.approx(0.4, abs=1e-3)
    assert collector.paired == feed(Collector(), messages).paired


def test_a_measurement_without_joint_readings_around_it_is_dropped(messages):
    start = messages[0][1]
    gap = [
        m
        for m in messages
        if not (m[0].strip("/") == "joint_states" and 20e9 < m[1] - start < 30e9)
    ]
    collector = feed(Collector(), gap)
    assert 190 <= collector.dropped_poses <= 210
    assert 80 < len(collector) < 94


def test_a_removed_sample_stays_out_and_is_listed_with_the_reason(messages):
    collector = feed(Collector(), until(messages, 60))
    before = collector.collection()
    collector.remove(int(before.ids[3]))
    feed(collector, messages[len(until(messages, 60)) :])
    after = collector.collection()
    assert len(after) == 93
    assert before.ids[3] not in after.ids
    assert "removed by hand" in [d.reason for d in collector.dropped()]
    with pytest.raises(DatasetError, match="no sample 4711"):
        collector.remove(4711)


def test_without_auto_collect_only_what_is_taken_counts(messages):
    collector = Collector(auto=False)
    feed(collector, until(messages, 1.0))
    number = collector.take()
    assert collector.collection().ids.tolist() == [number]
    feed(collector, messages[len(until(messages, 1.0)) : len(until(messages, 20))])
    assert len(collector) == 1
    assert collector.collection().ids.tolist() == [number]


def test_samples_are_made_beside_of_messages_that_go_on_to_come(messages):
    """Another thread makes samples of a copy of the messages; they replace no newer ones."""
    early, later = until(messages, 20), until(messages, 40)
    collector = Collector()
    feed(collector, early)
    number = len(collector)
    collector.clear()
    for channel, log, message in early:
        collector.receive(channel.strip("/"), message, log)
    (snapshot,) = collector.take_snapshots()
    assert collector.take_snapshots() == []  # nothing new
    feed(collector, later[len(early) :])
    known = collector.collection()
    assert len(known) > number
    collector.adopt([(snapshot, snapshot.make_samples())])
    np.testing.assert_array_equal(collector.collection().ids, known.ids)
    assert len(snapshot.make_samples().dataset) == number


def test_a_dwell_is_taken_as_of_the_messages_that_its_samples_are_made_of(messages):
    """The robot has rested on, or moved, when the samples are made."""
    collector = Collector(auto=False)
    for channel, log, message in until(messages, 1.0):
        collector.receive(channel.strip("/"), message, log)
    (snapshot,) = collector.take_snapshots()
    for channel, log, message in messages[len(until(messages, 1.0)) : len(until(messages, 9.0))]:
        collector.receive(channel.strip("/"), message, log)
    collector.adopt([(snapshot, snapshot.make_samples())])
    number = collector.take()
    collector.refresh()
    assert collector.collection().ids.tolist() == [number]


def test_a_changed_option_counts_for_samples_that_are_being_made(messages):
    collector = Collector()
    for channel, log, message in until(messages, 20):
        collector.receive(channel.strip("/"), message, log)
    (snapshot,) = collector.take_snapshots()
    collector.configure(None, SampleOptions(min_dwell=100.0), auto=True)
    collector.adopt([(snapshot, snapshot.make_samples())])
    assert len(collector) == 0
    collector.refresh()
    assert len(collector) == 0
    collector.configure(None, SampleOptions(), auto=True)
    collector.refresh()
    assert len(collector) > 0


def test_an_inbox_is_not_closed_before_samples_of_its_last_messages_are_made(messages):
    """The clock jumps back while samples of the messages before are made."""
    early, later = until(messages, 20), until(messages, 40)
    collector = Collector()
    for channel, log, message in early:
        collector.receive(channel.strip("/"), message, log)
    snapshots = collector.take_snapshots()
    again = [(c, log + 60 * 10**9, message) for c, log, message in early]
    for channel, log, message in [*later[len(early) :], *again]:
        collector.receive(channel.strip("/"), message, log)
    collector.adopt([(one, one.make_samples()) for one in snapshots])
    first = len(collector)
    collector.refresh()
    whole = Collector()
    feed(whole, later)
    assert len(collector) == len(whole) + first


def test_taking_a_sample_while_the_robot_moves_is_refused_with_the_reason(messages):
    moving = [m for m in until(messages, 3.0) if m[0].strip("/") != "joint_states"]
    with pytest.raises(DatasetError, match="no messages received on joint_states yet"):
        feed(Collector(), moving).take()
    collector = feed(Collector(), until(messages, 1.0))
    feed(collector, [m for m in messages if 40e9 < m[1] - messages[0][1] < 40.1e9])
    with pytest.raises(DatasetError, match=r"no dwell to take.*rest"):
        collector.take()


def test_an_empty_collection_says_what_was_received():
    with pytest.raises(DatasetError, match="messages received: none"):
        Collector().collection()


def test_a_recording_played_twice_is_two_sessions(messages, offline):
    collector = feed(feed(Collector(), messages), messages)
    both = collector.collection()
    assert len(both) == 2 * 94
    assert len(set(both.ids.tolist())) == 2 * 94
    np.testing.assert_array_equal(both.dataset.q[94:], offline.q)
    assert len(np.unique(both.dataset.pose_id)) == 74


@pytest.mark.wide
def test_a_long_session_lets_messages_go_and_keeps_samples(messages, offline, monkeypatch):
    monkeypatch.setattr(collector_module, "MAX_MESSAGES", 4000)
    collector = Collector()
    for k in range(0, len(messages), 200):
        feed(collector, messages[k : k + 200])
    held = sum(len(s.raws["joint_states"].rows) for s in collector._inboxes)
    assert held < 9000
    dataset = collector.collection().dataset
    assert len(dataset) == 94
    np.testing.assert_allclose(dataset.q, offline.q, atol=2e-6)
    np.testing.assert_allclose(dataset.conditions["payload"], 0.2)
    assert len(np.unique(dataset.pose_id)) == 74


def test_saved_samples_come_back_equal_and_collecting_goes_on(messages, offline, tmp_path):
    collector = feed(Collector(), messages)
    assert collector.save(tmp_path / "samples.json") == 94
    other = feed(Collector(), until(messages, 10))
    assert other.load(tmp_path / "samples.json") == 94
    same(other.collection().dataset, offline)
    feed(other, until(messages, 10))
    assert len(other.collection()) == 94 + len(load_part(messages))
    assert other.collection().dataset.time[-1] > offline.time[-1]


def load_part(messages):
    return feed(Collector(), until(messages, 10)).collection()


def test_a_bad_sample_file_leaves_the_collection_as_it_is(messages, tmp_path):
    collector = feed(Collector(), until(messages, 10))
    count = len(collector)
    (tmp_path / "bad.json").write_text("{}")
    for name in ("bad.json", "none.json"):
        with pytest.raises(DatasetError):
            collector.load(tmp_path / name)
    assert len(collector) == count
    with pytest.raises(DatasetError, match="cannot be written"):
        collector.save(tmp_path / "no folder" / "samples.json")


def test_positions_alone_and_poses_without_covariance_are_taken_too(messages, offline):
    types = get_typestore(Stores.ROS2_JAZZY).types
    point, pose = (types[f"geometry_msgs/msg/{t}Stamped"] for t in ("Point", "Pose"))
    for channel, make, coordinates in (
        ("measured_position", lambda m: point(m.header, m.pose.pose.position), 3),
        ("measured_pose", lambda m: pose(m.header, m.pose.pose), 6),
    ):
        part = [
            (channel, log, make(m)) if name.strip("/") == "measured_pose" else (name, log, m)
            for name, log, m in messages
        ]
        dataset = feed(Collector(), part).collection().dataset
        assert len(dataset) == 94
        assert dataset.measured.sum(axis=1).tolist() == [coordinates] * 94
        np.testing.assert_array_equal(dataset.r, offline.r)


def test_a_latched_payload_received_twice_counts_once(messages):
    doubled = [m for m in messages for _ in range(2 if m[0].strip("/") == "payload" else 1)]
    collector = feed(Collector(), doubled)
    assert not collector.dropped()
    assert len(collector) == 94


# ------------------------------------------------------------------- without a pose device


def test_a_constraint_session_gives_exactly_the_samples_of_its_bag(tied, tied_bag):
    collection = feed(Collector(), tied).collection()
    assert len(collection) == 30
    same(collection.dataset, load_dataset(tied_bag))
    reading = collection.dataset.conditions["reading.sphere1"]
    assert np.flatnonzero(reading == 0.0).tolist() == list(range(10, 20))


def test_looking_in_between_changes_nothing_without_poses_either(tied, tied_bag):
    collector = Collector()
    for k in range(0, len(tied), 100):
        feed(collector, tied[k : k + 100])
    same(collector.collection().dataset, load_dataset(tied_bag))


def test_a_constraint_published_long_before_any_motion_still_applies(tied):
    first = next(m for m in tied if m[0] == "constraint")
    early = [(first[0], first[1] - 3600 * 10**9, first[2])]
    collection = feed(Collector(), early + [m for m in tied if m is not first]).collection()
    assert len(collection) == 30


def test_constraints_received_late_and_twice_change_nothing(tied, tied_bag):
    """Topics overtake each other, and what is latched is heard by two subscriptions."""
    words = [m for m in tied if m[0] == "constraint"]
    others = [m for m in tied if m[0] != "constraint"]
    shuffled = others[:500] + words[::-1] + words + others[500:]
    same(feed(Collector(), shuffled).collection().dataset, load_dataset(tied_bag))


def test_a_constraint_session_played_twice_is_two_sessions(tied):
    both = feed(feed(Collector(), tied), tied).collection().dataset
    assert len(both) == 60
    for name in ("plane", "sphere1", "sphere2"):
        assert np.isfinite(both.conditions[f"reading.{name}"]).sum() == 20


def test_sessions_on_different_spheres_keep_the_readings_of_both(tied):
    third = len(tied) // 3
    one, other = Collector(), Collector()
    feed(one, tied[:third])
    feed(other, [m for m in tied if m[0] == "constraint"][:2] + tied[third + 40 : 2 * third])
    parts = [c.collection().dataset for c in (one, other)]
    both = join_datasets(parts, [10**12, 2 * 10**12])
    assert {"reading.plane", "reading.sphere1"} <= both.conditions.keys()
    assert not both.warnings
    assert both.sha256 != join_datasets(parts[::-1], [10**12, 2 * 10**12]).sha256


def test_missing_poses_and_constraints_are_reported(tied):
    collector = feed(Collector(), [m for m in tied if m[0] == "joint_states"])
    with pytest.raises(
        DatasetError, match="no messages received on measured_pose or constraint or"
    ):
        collector.collection()


def test_a_long_constraint_session_keeps_what_holds_the_tip(tied, tied_bag, monkeypatch):
    monkeypatch.setattr(collector_module, "MAX_MESSAGES", 400)
    collector = Collector()
    for k in range(0, len(tied), 50):
        feed(collector, tied[k : k + 50])
    dataset = collector.collection().dataset
    offline = load_dataset(tied_bag)
    assert len(dataset) == 30
    for name in ("plane", "sphere1", "sphere2"):
        column = f"reading.{name}"
        np.testing.assert_array_equal(dataset.conditions[column], offline.conditions[column])


def test_distances_are_collected_as_they_are_recorded(tmp_path):
    moves = ts.session([[0.1, 0.2, 0.3], [0.4, 0.1, 0.2], [0.2, 0.5, 0.1]])
    read = [bw.distance(k + 0.1 * i, 0.2 + 0.01 * k, "probe") for k in range(3) for i in range(6)]
    bag = bw.write_bag(tmp_path / "bag", bw.joint_states(moves) + read)
    live = feed(Collector(), messages_of(bag)).collection().dataset
    same(live, load_dataset(bag))
    np.testing.assert_allclose(live.conditions["reading.probe"], [0.2, 0.21, 0.22], atol=1e-7)


def message_at(stamp, log):
    return StampedMessage(stamp, log, 0, None)


def aligned_poses(joint_seconds=4):
    """An alignment of poses that has heard joint states at 100 Hz and poses at 20 Hz, in ns."""
    joints = JointClock()
    alignment = ClockAlignment("measured_pose", joints)
    for k in range(100 * joint_seconds):
        t = 10_000_000 * (k + 100)
        joints.add(t, t + 1000)
        if k % 5 == 0:
            alignment.take([message_at(t + 1_000_000, t + 2000)])
    return alignment, joints, t


def test_a_burst_of_poses_without_joint_states_is_judged_once_each(monkeypatch):
    """Each of them was judged again with each that followed: 5000 took minutes."""
    alignment, joints, last = aligned_poses()
    asked, look = [], joints.neighbours
    monkeypatch.setattr(joints, "neighbours", lambda log: asked.append(log) or look(log))
    for k in range(3000):
        alignment.take([message_at(last + 10**10 + k, last + 10**6 + k)])
    assert len(asked) < 4 * 3000


def test_a_clock_that_is_set_after_stray_stamps_is_believed():
    """Some strays kept all later messages from agreeing, for ever."""
    alignment, joints, last = aligned_poses()
    passed = []
    for k in range(200):
        t = last + 10_000_000 * (k + 1)
        joints.add(t, t + 1000)
        if k % 5 == 0:  # strays of 50 to 450 s, then a clock that is 7 s ahead
            off = (50 + 10 * k) * 10**9 if k < 40 else 7 * 10**9
            passed += alignment.take([message_at(t + off, t + 2000)])
    assert len(passed) > 25
    assert all(abs(one.stamp - one.log) < 10**8 for one in passed)
    assert "its clock or the joints' clock was set by +6.999 s" in alignment.trouble
    assert alignment.strays == 8


def test_messages_that_never_fit_are_held_in_bounded_number(monkeypatch):
    monkeypatch.setattr(clock_alignment, "MAX_JOINT_STATES", 200)
    alignment, joints, last = aligned_poses(1)
    for k in range(2000):
        t = last + 10_000_000 * (k + 1)
        joints.add(t, t + 1000)
        alignment.take([message_at(t + (k % 7 + 3) * 10**10, t + 2000)])
    assert len(alignment._held) <= 201
    assert alignment.strays + len(alignment._held) == 2000


@pytest.mark.parametrize("channel", ["joint_states", "measured_pose"])
def test_a_flood_of_messages_on_one_topic_is_let_go_too(messages, monkeypatch, channel):
    """Only joint states were counted: poses at a high rate were kept for ever."""
    monkeypatch.setattr(collector_module, "MAX_MESSAGES", 400)
    part, collector = until(messages, 4), Collector()
    _, log, message = next(m for m in part if m[0] == channel)
    message = copy.deepcopy(message)
    for k in range(3000):
        message.header.stamp.nanosec = 100_000 * k
        collector.receive(channel, copy.deepcopy(message), log + 100_000 * k)
        if k % 100 == 99:
            collector.refresh()
    assert sum(inbox._count_messages() for inbox in collector._inboxes) < 1000
    assert len(collector._inboxes) < 3


def test_a_clock_that_jumps_often_leaves_no_empty_inboxes(messages):
    collector = feed(Collector(), until(messages, 10))
    samples, (topic, log, message) = len(collector), messages[0]
    for k in range(300):
        back = stamped(message, 10_000 - 30 * (k // 3))
        back.header.stamp.nanosec = 1000 * (k % 3)
        collector.receive(topic, back, log + 10**10 + 10**7 * k)
        if k % 10 == 9:
            collector.refresh()
    assert len(collector) == samples
    assert len(collector._inboxes) < 15


@pytest.mark.parametrize("position", [[np.nan, 0.5, 0.5], [0.5, 0.5]], ids=["nan", "short"])
def test_joint_states_without_a_reading_tell_no_time(messages, position):
    """Their stamps ran ahead; the good joint states after them were taken for another clock, and
    the poses that belong to them were lost."""
    part, good, flooded = until(messages, 20), Collector(), Collector()
    half = len(part) // 2
    joints = next(message for channel, _, message in part if "joint_states" in channel)
    bad = dataclasses.replace(joints, position=np.array(position))
    flood = [("joint_states", part[half][1], stamped(bad, 50 + k // 100)) for k in range(2000)]
    expected = feed(good, part).collection().dataset
    found = feed(flooded, [*part[:half], *flood, *part[half:]]).collection().dataset
    same(found, expected)
    reasons = [one.reason for one in found.dropped if one.count == 2000]
    assert reasons in (["joint reading is not finite"], ["position and name differ in length"])
