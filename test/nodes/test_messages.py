"""Every interface of parallel_cal_msgs can be imported and survives the wire."""

from importlib import import_module
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros

DEFINITIONS = Path(__file__).parents[2] / "msg_defs"
PARTS = {"msg": [""], "srv": ["Request", "Response"], "action": ["Goal", "Result", "Feedback"]}
INTERFACES = sorted(
    f"{kind}/{path.stem}" for kind in PARTS for path in (DEFINITIONS / kind).iterdir()
)


@pytest.fixture(autouse=True)
def _ros():
    pytest.importorskip("rclpy")
    pytest.importorskip("parallel_cal_msgs")


def there_and_back(message):
    from rclpy.serialization import deserialize_message, serialize_message

    return deserialize_message(serialize_message(message), type(message))


def test_the_definitions_are_found():
    assert len(INTERFACES) >= 18


@pytest.mark.parametrize("full_name", INTERFACES)
def test_every_interface_is_built_and_survives_the_wire(full_name):
    kind, name = full_name.split("/")
    interface = getattr(import_module(f"parallel_cal_msgs.{kind}"), name)
    for part in PARTS[kind]:
        message = getattr(interface, part)() if part else interface()
        assert there_and_back(message) == message


def test_a_filled_message_comes_back_equal():
    from geometry_msgs.msg import Point, Pose
    from parallel_cal_msgs.msg import Solution, SolutionSet
    from parallel_cal_msgs.srv import ComputeFK

    solution = Solution(
        status=Solution.OUTSIDE_LIMITS,
        message="joint2 is at 1.9 rad, limit 1.8 rad",
        pose=Pose(position=Point(x=0.1, y=-0.2, z=-0.8)),
        joints=[0.3, 1.9, 0.5],
        residual=1e-15,
        covariance=[float(i) for i in range(36)],
    )
    response = ComputeFK.Response(
        results=[SolutionSet(solutions=[solution, Solution()], count_complex=40), SolutionSet()],
        model_hash="0" * 64,
    )
    assert there_and_back(response) == response


def test_the_status_codes_are_the_documented_ones():
    from parallel_cal_msgs.msg import Solution

    names = "CONVERGED UNREACHABLE SINGULAR OUTSIDE_LIMITS NOT_CONVERGED INVALID_INPUT".split()
    assert [getattr(Solution, name) for name in names] == [0, 1, 2, 3, 4, 5]


def test_a_status_carries_the_purpose_of_a_pose_and_typed_questions():
    from parallel_cal_msgs.action import Calibrate
    from parallel_cal_msgs.msg import CalibrationStatus, Question

    asked = Question(condition="payload", value=2.0, present=0.0, unit="kg")
    for message in (CalibrationStatus, Calibrate.Feedback):
        status = message(state="asking", purpose="", questions=[asked])
        assert there_and_back(status) == status
        assert status.questions[0].value == 2.0


def test_the_feedback_has_the_fields_of_a_campaigns_state_in_this_order():
    from parallel_cal_msgs.action import Calibrate

    fields = list(Calibrate.Feedback.get_fields_and_field_types())
    assert fields == [
        "state",
        "reason",
        "poses",
        "error_unseen",
        "verdict",
        "purpose",
        "questions",
    ]
