"""Follows and steers a campaign from another program."""

from __future__ import annotations

import json
from typing import Any

from action_msgs.srv import CancelGoal
from parallel_cal_msgs.action import Calibrate
from parallel_cal_msgs.msg import CalibrationStatus
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from parallel_cal.nodes.client import CALIBRATION, NodeError
from parallel_cal.nodes.parameters import LATCHED

WORDS = ("pause", "resume", "continue")


class CampaignClient:
    """Begins, pauses and stops a campaign of calibration_node, whoever began it.

    `told` is its last status as plain data; `curve` in it is a `campaign.Curve`.
    """

    def __init__(self, node: Node):
        self.told: dict[str, Any] = {"state": "", "curve": {"points": []}, "answer": ""}
        self._node = node
        node.create_subscription(
            CalibrationStatus, f"{CALIBRATION}/session_status", self._on_status, LATCHED
        )
        node.create_subscription(String, f"{CALIBRATION}/campaign_curve", self._on_curve, LATCHED)
        self._goal = ActionClient(node, Calibrate, f"{CALIBRATION}/calibrate")
        # Cancels all goals: another program, or an earlier run of this one, may have sent them.
        self._stop = node.create_client(CancelGoal, f"{CALIBRATION}/calibrate/_action/cancel_goal")
        self._say = {word: node.create_client(Trigger, f"{CALIBRATION}/{word}") for word in WORDS}

    def begin(self, **goal: Any) -> None:
        """Send a goal with these fields; `told` shows its progress. NodeError if the node does not
        answer."""
        self._require(self._goal.server_is_ready())
        self.told = {**self.told, "answer": ""}
        # In the thread that spins: rclpy drops an answer that comes before the sending returns.
        self._node.executor.create_task(self._send_goal, Calibrate.Goal(**goal))

    def send_command(self, word: str) -> None:
        """Send pause, resume, continue or stop. NodeError if the node does not answer."""
        client, request = (
            (self._stop, CancelGoal.Request())
            if word == "stop"
            else (self._say[word], Trigger.Request())
        )
        self._require(client.service_is_ready())
        client.call_async(request)

    def close(self) -> None:
        """Destroy the action client: one that outlives its context crashes the process."""
        self._goal.destroy()

    def _require(self, ready: bool) -> None:
        if not ready:
            raise NodeError(f"{CALIBRATION} does not answer: is it running?")

    def _send_goal(self, goal: Calibrate.Goal) -> None:
        self._goal.send_goal_async(goal).add_done_callback(self._on_accepted)

    def _on_accepted(self, future: Future) -> None:
        handle = future.result()
        if handle.accepted:
            handle.get_result_async().add_done_callback(
                lambda done: self._set_answer(done.result().result.message)
            )
        else:
            self._set_answer(f"{CALIBRATION} rejected the goal; see its log for the reason")

    def _set_answer(self, words: str) -> None:
        self.told = {**self.told, "answer": words}

    def _on_status(self, status: CalibrationStatus) -> None:
        fields = ("state", "reason", "poses", "error_unseen", "verdict", "folder")
        self.told = {**self.told, **{f: getattr(status, f) for f in fields}}

    def _on_curve(self, message: String) -> None:
        self.told = {**self.told, "curve": json.loads(message.data)}
