"""Of a stream of messages those that stray are dropped and counted; a clock that jumps is not."""

from itertools import pairwise
from random import Random

import pytest

from parallel_cal.recordings.gate import MIN_AGREEING_MESSAGES, Gate

S = 1_000_000_000


def through(stream):
    """Names of the messages that go on, of (name, stamp s, received s, sequence)."""
    gate = Gate("topic")
    passed = []
    for name, stamp, log, sequence in stream:
        passed += gate.take(int(stamp * S), int(log * S), sequence, name)
    passed += gate.flush()
    return [said.message for said in passed], gate


def steady(names, begin=0.0, log=None, sequence=1, every=0.01):
    log = begin if log is None else log
    return [(n, begin + every * i, log + every * i, sequence + i) for i, n in enumerate(names)]


@pytest.mark.parametrize("off", [2.0, -2.0, 3600.0, -1e9])
@pytest.mark.parametrize("numbered", [0, 1])
def test_one_wild_stamp_is_dropped_and_counted(off, numbered):
    stream = steady(range(100), begin=5000.0)
    stream[40] = (40, stream[40][1] + off, stream[40][2], stream[40][3])
    stream = [(n, stamp, log, numbered * sequence) for n, stamp, log, sequence in stream]
    passed, gate = through(stream)
    assert passed == [n for n in range(100) if n != 40]
    assert gate.strays == 1
    assert "1 messages dropped" in gate.trouble


@pytest.mark.parametrize("off", [2.0, 5.0, -5.0, 1e6, -1e6])
def test_a_wild_stamp_at_the_very_beginning_is_dropped_too(off):
    stream = steady(range(100), begin=5e6)
    stream[0] = (0, stream[0][1] + off, *stream[0][2:])
    passed, gate = through(stream)
    assert passed == list(range(1, 100))
    assert gate.strays == 1


@pytest.mark.parametrize("jump", [-50.0, 50.0])
def test_a_clock_that_jumps_is_accepted_when_several_stamps_agree_and_nothing_is_lost(jump):
    stream = steady(range(100), begin=100)
    stream = [(n, s + jump * (n >= 50), log, i) for n, s, log, i in stream]
    passed, gate = through(stream)
    assert passed == list(range(100))
    assert gate.strays == 0


def test_a_slow_device_is_no_jumping_clock():
    passed, gate = through(steady(range(20), every=5.0, begin=1))
    assert passed == list(range(20))
    assert gate.strays == 0


def test_messages_of_two_simultaneous_publishers_whose_clocks_differ_are_not_used():
    a, b = steady("a" * 300), steady("b" * 300, begin=5.0, log=0.005, sequence=700)
    passed, gate = through(sorted(a + b, key=lambda m: m[2]))
    assert len(passed) <= 2 * MIN_AGREEING_MESSAGES
    assert "two publishers" in gate.trouble


def test_messages_of_two_publishers_on_one_clock_pass_with_the_number_of_their_publisher():
    gate, passed = Gate("topic"), []
    a, b = steady("a" * 300), steady("b" * 300, log=0.005, sequence=700)
    for name, stamp, log, sequence in sorted(a + b, key=lambda m: m[2]):
        passed += gate.take(int(stamp * S), int(log * S), sequence, name)
    assert gate.strays == 0
    assert [m.message for m in passed] == ["a", "b"] * 300
    numbers = {name: {m.source.number for m in passed[10:] if m.message == name} for name in "ab"}
    assert len(numbers["a"]) == len(numbers["b"]) == 1
    assert numbers["a"] != numbers["b"]


def test_publishers_whose_clocks_differ_are_distinguished_with_equal_counts_too():
    a, b = steady("a" * 300), steady("b" * 300, begin=5.0, log=0.005)
    passed, gate = through(sorted(a + b, key=lambda m: m[2]))
    assert len(passed) <= 2 * MIN_AGREEING_MESSAGES
    assert gate.strays > 590


def test_a_publisher_that_replaces_another_is_accepted_after_a_while():
    a, b = steady(range(50)), steady(range(50, 150), begin=0.6, sequence=1)
    passed, gate = through(a + b)
    assert passed == list(range(150))
    assert gate.strays == 0


def test_what_never_came_is_counted():
    stream = steady(range(100))
    passed, gate = through(stream[:30] + stream[37:60] + stream[61:])
    assert len(passed) == 92
    assert gate.lost == 8
    assert all(b > a for a, b in pairwise(passed))


def test_random_stamps_in_a_fast_stream_never_pass_and_the_stream_goes_on():
    """Of 500 joint states with random stamps, 389 passed: two that ascended were believed, and so
    was any that came after one without a stamp."""
    random = Random(3)
    stamps = [random.choice([0, random.uniform(1, 4e9)]) for _ in range(500)]
    bad = [("bad" if t else "bare", t, 101 + 2e-4 * k, 101 + k) for k, t in enumerate(stamps)]
    after = steady(range(100, 200), begin=112.0, log=102.5, sequence=601)
    passed, gate = through([*steady(range(100), begin=100.0), *bad, *after])
    assert [name for name in passed if name != "bare"] == list(range(200))
    assert gate.strays == sum(t > 0 for t in stamps)
