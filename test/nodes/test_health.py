"""What a stream's diagnosis says of rate, loss and refusals."""

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402

from parallel_cal.nodes.health import Stream  # noqa: E402
from parallel_cal.recordings.sources import Sources  # noqa: E402


def told(stream):
    status = stream.diagnosis("node", "topic")
    return status, {item.key: item.value for item in status.values}


@pytest.mark.parametrize(
    ("lost", "level"),
    [(0, DiagnosticStatus.OK), (5, DiagnosticStatus.WARN), (500, DiagnosticStatus.ERROR)],
)
def test_loss_is_counted_by_the_publisher_s_count_and_is_a_warning_then_an_error(lost, level):
    stream = Stream()
    for sequence in range(1, 1000):
        if not 300 <= sequence < 300 + lost:
            stream.count_received(sequence)
    status, items = told(stream)
    assert status.level == level
    assert items["Lost since startup"] == str(lost)
    assert items["Events since startup"] == str(999 - lost)


def test_refused_and_skipped_messages_are_reported_with_the_reason():
    stream = Stream()
    for sequence in range(1, 101):
        stream.count_received(sequence)
    stream.count_refused("a joint is missing")
    stream.count_skipped(101)
    status, items = told(stream)
    assert status.level == DiagnosticStatus.WARN
    assert "refused" in status.message
    assert items["Last reason"] == "a joint is missing"
    assert items["Skipped since startup"] == "1"


def test_what_is_over_leaves_the_window_and_stays_in_the_total():
    stream = Stream()
    stream.count_received(1), stream.count_received(3)
    for _ in range(11):
        status, items = told(stream)
    assert status.level == DiagnosticStatus.OK
    assert items["Lost in window"] == "0"
    assert items["Lost since startup"] == "1"


def test_two_publishers_are_distinguished_and_their_losses_added():
    sources = Sources()
    a, b = sources.identify(100_000), sources.identify(1)
    assert a is not b
    assert sources.identify(100_003) is a
    assert sources.identify(2) is b
    assert sources.lost == 2
    assert sources.identify(None) is None
