"""What the tests of nodes start does not outlive them."""

from types import SimpleNamespace

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

from conftest import (  # noqa: E402 - after the check that rclpy is there
    pytest_fixture_setup,
    pytest_runtest_call,
    pytest_runtest_teardown,
)
from ros_helpers import NodeProcess  # noqa: E402


def test_a_fixture_that_fails_leaves_none_of_its_nodes_running(tmp_path):
    """Such nodes loaded the machine until the end, and answered the tests that followed."""
    before = NodeProcess("replay_node", tmp_path, "/before")
    try:
        setup = pytest_fixture_setup()
        next(setup)
        left = NodeProcess("replay_node", tmp_path, "/left")
        with pytest.raises(TimeoutError):
            setup.throw(TimeoutError())
        assert left.ended(patience=0) != 0
        assert before._process.poll() is None
    finally:
        before.kill()


def test_a_test_that_is_skipped_leaves_none_of_its_nodes_running(tmp_path):
    item = SimpleNamespace()
    call = pytest_runtest_call(item)
    next(call)
    left = NodeProcess("replay_node", tmp_path, "/left")
    with pytest.raises(pytest.skip.Exception):
        call.throw(pytest.skip.Exception("no browser"))
    assert left._process.poll() is None  # the fixtures of the test may end it
    teardown = pytest_runtest_teardown(item)
    next(teardown)
    with pytest.raises(StopIteration):
        teardown.send(None)
    assert left.ended(patience=0) != 0
