"""A new topic or reading costs one entry and one decoder: from a bag, a live stream or a table to
samples and what people see."""

import bag_writing as bw
import numpy as np
import pytest
import tied_session as ts

from parallel_cal.base.errors import BagError, DatasetError
from parallel_cal.cli.recordings import data_options
from parallel_cal.nodes.collector import Collector
from parallel_cal.recordings.channels import CHANNELS, Channel
from parallel_cal.recordings.info import info
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.reporting.blocks import as_text
from parallel_cal.reporting.recorded import describe_info

HUMID = "sensor_msgs/msg/RelativeHumidity"
STOPS = [[0.1, 0.2, 0.3], [0.4, 0.1, 0.2], [0.2, 0.5, 0.1]]


@pytest.fixture(autouse=True)
def own_channels(monkeypatch):
    """What the recipe in CONTRIBUTING says, and a second topic of distances."""
    humidity = Channel(
        "condition", (HUMID,), lambda m: (m.relative_humidity,), unit="1", plausible=(0.0, 1.0)
    )
    wire = Channel("readings", ("sensor_msgs/msg/Range",), lambda m: ("wire", m.range), True)
    monkeypatch.setitem(CHANNELS, "humidity", humidity)
    monkeypatch.setitem(CHANNELS, "wire", wire)


def humidity(t, value, topic="humidity"):
    body = bw.kind(HUMID)(bw.header(bw.ns(t)), value, 0.0)
    return topic, HUMID, bw.ns(t), body


def messages(*more):
    moves = ts.session(STOPS)
    return [*bw.joint_states(moves), *bw.poses(moves), *more]


@pytest.fixture
def samples(tmp_path):
    """Between 0.4 at the start and 0.6 after 10 s: 0.4 + 0.02 t."""
    said = [humidity(0.0, 0.4), humidity(10.0, 0.6)]
    return bw.write_bag(tmp_path / "bag", messages(*said))


def test_a_new_condition_comes_from_a_bag_to_its_samples(samples):
    dataset = load_dataset(samples)
    assert len(dataset) == 3
    np.testing.assert_allclose(dataset.conditions["humidity"], 0.4 + 0.02 * dataset.time)


def test_the_document_of_a_recording_and_its_screen_tell_of_it(samples):
    document = info(samples)
    assert document["channels"]["humidity"] == "humidity"
    assert 0.4 < document["conditions"]["humidity"]["min"] < 0.42
    assert "humidity: 0.4" in as_text(describe_info(document))


def test_a_topic_is_found_by_its_type_or_named_and_a_wrong_unit_causes_a_warning(tmp_path):
    said = [humidity(0.0, 40.0, "lab/air"), humidity(10.0, 60.0, "lab/air")]
    bag = bw.write_bag(tmp_path / "bag", messages(*said))
    found, named = load_dataset(bag), load_dataset(bag, data_options(["humidity=/lab/air"]))
    np.testing.assert_array_equal(found.conditions["humidity"], named.conditions["humidity"])
    assert any("humidity does not look like 1: it ranges from 4" in w for w in named.warnings)
    assert "humidity" not in load_dataset(bag, topics={"humidity": ""}).conditions


def test_live_collection_gives_the_same_samples(samples):
    collector = Collector()
    said = [humidity(0.0, 0.4), humidity(10.0, 0.6)]
    for topic, _, log, message in sorted(messages(*said), key=lambda m: m[2]):
        collector.receive(topic, message, log)
    collector.refresh()
    live = collector.collection().dataset
    np.testing.assert_array_equal(
        live.conditions["humidity"], load_dataset(samples).conditions["humidity"]
    )


def test_a_new_reading_is_one_more_entry(tmp_path):
    gauge = [bw.distance(k + 0.1 * i, 0.2 + 0.01 * k, "probe") for k in range(3) for i in range(6)]
    wire = [("wire", *m[1:]) for m in gauge]
    bag = bw.write_bag(tmp_path / "bag", [*bw.joint_states(ts.session(STOPS)), *gauge, *wire])
    dataset = load_dataset(bag)
    for name in ("reading.probe", "reading.wire"):
        np.testing.assert_allclose(dataset.conditions[name], [0.2, 0.21, 0.22], atol=1e-7)


def test_one_device_on_two_topics_is_refused(tmp_path):
    gauge = [bw.distance(0.1 * i, 0.2, "wire") for i in range(30)]
    both = [*bw.joint_states(ts.session(STOPS)), *gauge, *(("wire", *m[1:]) for m in gauge)]
    bag = bw.write_bag(tmp_path / "bag", both)
    with pytest.raises(BagError, match=r"wire \(wire\) is also on distance \(wire\)"):
        load_dataset(bag)


def test_a_topic_given_to_no_channel_is_refused_with_those_there_are():
    with pytest.raises(BagError, match=r"topics: \['humdity'\] unknown.*humidity"):
        ReadOptions(topics={"humdity": "lab/air"})
    with pytest.raises(DatasetError, match=r"humdity.*; known: .*stamps"):
        ReadOptions().with_values(humdity="lab/air")


def test_messages_that_its_decoder_does_not_understand_are_counted(samples, monkeypatch):
    odd = Channel("condition", (HUMID,), lambda m: (m.no_such_field,))
    monkeypatch.setitem(CHANNELS, "humidity", odd)
    dataset = load_dataset(samples)
    assert "humidity" not in dataset.conditions
    assert [(d.reason, d.count) for d in dataset.dropped] == [("message cannot be decoded", 2)]
