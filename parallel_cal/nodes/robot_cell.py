"""The robot of a campaign: moved by joint trajectories, measured by the samples collected here."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from threading import Event
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from parallel_cal.base.errors import DatasetError, SolveError
from parallel_cal.campaign.cell import CellError, Sample
from parallel_cal.campaign.checking import ARRIVAL_TOLERANCE
from parallel_cal.campaign.trajectory import Trajectory
from parallel_cal.model.model import Model
from parallel_cal.nodes.conversions import match_joints, stop_message
from parallel_cal.nodes.inflow import Inflow

POLL_INTERVAL_S = (
    0.01  # s between two looks, so that a motion ends at once when it is no longer wanted
)
DISCOVERY_TIMEOUT_S = 5.0  # s in which a node that has just begun must hear of the robot
JOINT_STATE_TIMEOUT_S = 1.0  # s without joint states after which nobody knows where the robot is
ARRIVAL_TIMEOUT_S = 10.0  # s more than it should take, until a motion counts as failed
START_TIMEOUT_S = 2.0  # s more, in which a robot that rests elsewhere may yet set out
REST_DURATION_S = 0.15  # s that readings stay alike before the robot rests
REST_TOLERANCE_SIGMAS = 10.0  # sigmas of a reading, within which they are alike
PATH_TOLERANCE = 0.03  # of its range, that a joint may be beside its way
SPEED_WINDOW_S = 0.05  # s of readings that the speed is told by
MAX_JOINT_STATES = 2000  # joint states to look back at
SAMPLE_TIMEOUT_S = 20.0  # s that a sample may take to come
MAX_TAKING = 0.25  # of the time: it keeps the thread busy in which messages are processed
MAX_PAUSE = 2.0  # s until it is tried again, however long it took
SAID_EVERY = 1.0  # s between two words on what is waited for

Take = Callable[[Callable[[], None]], Sample]  # what to call while it waits -> the dwell's sample


class RobotCell:
    """A Cell by ROS: `command` publishes trajectories, `take` gives the sample of the dwell going
    on, which must last `dwell` s. `inflow` tells how far the device's messages are processed, `say`
    passes on what is waited for."""

    def __init__(
        self,
        command: Any,
        model: Model,
        take: Take,
        dwell: float,
        inflow: Inflow,
        say: Callable[[str], None] = lambda text: None,
    ):
        self._command, self._model, self._take, self._dwell = command, model, take, dwell
        self._inflow, self._say = inflow, say
        self._states: deque[tuple[float, float, np.ndarray]] = deque(maxlen=MAX_JOINT_STATES)
        self.done = Event()  # what a person was asked for
        self._range = model.mechanism.joint_ranges
        self._still = REST_TOLERANCE_SIGMAS * (model.noise.joint or 1e-4 * float(self._range.min()))
        self._set_out = self._rested = 0.0  # stamps of the last motion
        self._rested_at = 0.0  # time.monotonic() when the robot was heard to have come to rest
        self._others: list[str] = []  # joints that were heard of, and are not this model's

    def on_joint_state(self, message: Any) -> None:
        """A joint state, in any thread."""
        try:
            q, _ = match_joints(message, self._model.joints)
        except SolveError:  # other joints, in a message of their own
            self._others = list(message.name)
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self._states.append((stamp, time.monotonic(), q))

    # ------------------------------------------------------------------ what a campaign asks

    def joints(self) -> np.ndarray:
        return self._latest()[1]

    def move(self, trajectory: Trajectory, go_on: Callable[[], None]) -> None:
        begin, q = self._latest()
        course = np.vstack([q, trajectory.positions])
        if not self._command.get_subscription_count():
            raise CellError(
                f"no node subscribes to {self._command.topic_name}: is a controller running?"
            )
        self._command.publish(self._message(trajectory))
        now = time.monotonic()
        late, due = (
            now + trajectory.seconds + START_TIMEOUT_S,
            now + trajectory.seconds + ARRIVAL_TIMEOUT_S,
        )
        while True:
            go_on()
            stamp, q = self._latest(begin)
            self._check_on_path(q, course)
            there = (np.abs(q - course[-1]) < ARRIVAL_TOLERANCE * self._range).all()
            if (there or time.monotonic() > late) and self._rests(begin + trajectory.seconds):
                moved = np.abs(course - course[0]).max(axis=0) > self._still
                self._set_out, self._rested = begin if moved.any() else 0.0, stamp - REST_DURATION_S
                self._rested_at = self._heard_at(self._rested)
                return
            if time.monotonic() > due:
                raise CellError(
                    f"the robot did not stop within {ARRIVAL_TIMEOUT_S:.0f} s after the "
                    "planned end of its motion"
                )
            time.sleep(POLL_INTERVAL_S)

    def stop(self) -> None:
        if not self._states:
            return
        states = list(self._states)  # at once: others append meanwhile
        recent = [state for state in states if state[0] > states[-1][0] - SPEED_WINDOW_S]
        (early, _, q0), (late, _, q) = recent[0], recent[-1]
        speed = (q - q0) / (late - early) if late > early else np.zeros(len(q))
        self._command.publish(stop_message(self._model.joints, q, speed))

    def sample(self, go_on: Callable[[], None]) -> Sample:
        """Wait for the device to measure the present dwell, then take its sample.

        Waiting looks at the dwell's own joint states and at counts only, since taking a sample
        takes longer the more there are. The target counts as lost only after all that came in has
        been processed.
        """
        due, why = (
            time.monotonic() + SAMPLE_TIMEOUT_S,
            "no pose was received while the robot rested",
        )
        taken, again, used = -math.inf, -math.inf, -math.inf
        waiting = self._waiting(go_on)
        while True:
            waiting()
            now, latest = time.monotonic(), self._inflow.latest
            new = latest is not None and latest >= self._rested_at and latest > used
            measured = self._rested_and_read() and (new or self._inflow.holds)
            if measured and now >= again:
                taken, used = now, used if latest is None else latest
                try:
                    found = self._take(waiting)
                except DatasetError as error:
                    why = str(error)
                else:
                    one = found.dataset
                    begin = 1e-9 * found.start_ns + float(one.time[0] - one.duration[0] / 2)
                    if begin > self._set_out:
                        return found
                    why = "the present dwell has no sample yet"
                end = time.monotonic()
                again = end + min(max(10 * POLL_INTERVAL_S, (end - now) / MAX_TAKING), MAX_PAUSE)
            elif now > due and self._inflow.has_read_until(due) and (taken > due or not measured):
                raise CellError(
                    f"no sample at this pose: {why}. Check that the device sees its target"
                )
            else:
                time.sleep(POLL_INTERVAL_S)

    def ask(self, words: str, conditions: Mapping[str, float], go_on: Callable[[], None]) -> None:
        while not self.done.wait(POLL_INTERVAL_S):
            go_on()
        self.done.clear()  # not before: the answer may be there by now

    # ------------------------------------------------------------------ how the robot is

    def _latest(self, since: float = 0.0) -> tuple[float, np.ndarray]:
        """Stamp and joints (nq,) now, not before a stamp; the first ones are waited for."""
        due = time.monotonic() + DISCOVERY_TIMEOUT_S
        while not self._states and time.monotonic() < due:
            time.sleep(POLL_INTERVAL_S)
        if not self._states or time.monotonic() - self._states[-1][1] > JOINT_STATE_TIMEOUT_S:
            words = (
                f"no joint states were received for {JOINT_STATE_TIMEOUT_S:.0f} s: the robot's "
                "position is unknown"
            )
            if self._others:
                words += f"; joint_states contain {', '.join(self._others)}, the model has "
                words += ", ".join(self._model.joints)
            raise CellError(words)
        stamp, _, q = self._states[-1]
        if stamp < since - JOINT_STATE_TIMEOUT_S:
            raise CellError(
                f"the stamps of the joint states jumped back by {since - stamp:.3g} s: was the "
                "robot's driver restarted?"
            )
        return stamp, q

    def _rested_and_read(self) -> bool:
        """Whether the dwell has lasted long enough, and all that was measured in it has been
        read."""
        end, (stamp, _) = self._rested + self._dwell, self._latest(self._rested)
        return stamp >= end and self._inflow.has_read_until(self._heard_at(end))

    def _heard_at(self, stamp: float) -> float:
        """When the first joint state of a stamp or later was heard."""
        return next((heard for s, heard, _ in list(self._states) if s >= stamp), time.monotonic())

    def _waiting(self, go_on: Callable[[], None]) -> Callable[[], None]:
        """A function to call while a sample is waited for, which says what is not processed yet."""
        said = time.monotonic()

        def wait() -> None:
            nonlocal said
            go_on()
            now, waiting = time.monotonic(), self._inflow.unprocessed
            if now < said + SAID_EVERY:
                return
            behind = not self._inflow.has_read_until(said)
            if waiting or behind:
                self._say(
                    f"{waiting} poses are not processed yet{', others are not read yet' * behind}"
                )
            said = now

        return wait

    def _rests(self, since: float) -> bool:
        """Whether the readings of the last STILL seconds, all `since` a stamp, are alike."""
        recent = list(self._states)
        last = recent[-1][0]
        held = np.array([q for stamp, _, q in recent if stamp >= last - REST_DURATION_S])
        return bool(last - REST_DURATION_S >= since and (np.ptp(held, axis=0) < self._still).all())

    def _check_on_path(self, q: np.ndarray, course: np.ndarray) -> None:
        """CellError where the joints are beside the way that they were sent, whenever that is."""
        scaled = course / self._range
        a, b, here = scaled[:-1], scaled[1:], q / self._range
        way = b - a
        length = np.maximum(np.sum(way**2, axis=1), 1e-18)
        share = np.clip(np.sum((here - a) * way, axis=1) / length, 0.0, 1.0)
        off = np.abs(here - a - share[:, None] * way).max(axis=1)
        if off.min() > max(PATH_TOLERANCE, ARRIVAL_TOLERANCE):
            nearest = int(np.argmin(off))
            i = int(np.argmax(np.abs(here - a - share[:, None] * way)[nearest]))
            raise CellError(
                f"{self._model.joints[i]} left its path by {off.min() * self._range[i]:.3g}: the "
                "joint does not move, moves wrongly, or an obstacle blocks it"
            )

    def _message(self, trajectory: Trajectory) -> JointTrajectory:
        points = [
            JointTrajectoryPoint(
                positions=q.tolist(),
                velocities=v.tolist(),
                time_from_start=Duration(sec=int(t), nanosec=int(1e9 * (t % 1.0))),
            )
            for t, q, v in zip(
                trajectory.time, trajectory.positions, trajectory.velocities, strict=True
            )
        ]
        return JointTrajectory(joint_names=list(self._model.joints), points=points)
