"""The robot of a campaign: moved by joint trajectories, measured by the collected samples."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from threading import Event
from typing import Any

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.base.errors import DatasetError, SolveError
from parallel_cal.campaign.cell import CellError, Sample, UnansweredError, UnseenError
from parallel_cal.campaign.checking import ARRIVAL_TOLERANCE, LIMIT_SWITCH_ADVICE
from parallel_cal.campaign.deviation import (
    MAX_PATH_DEVIATION,
    N_MOMENTS,
    compute_path_deviation,
    find_deviating_joints,
)
from parallel_cal.campaign.trajectory import Trajectory
from parallel_cal.model.model import Model
from parallel_cal.nodes.conversions import match_joints, stop_message, trajectory_message
from parallel_cal.nodes.inflow import Inflow
from parallel_cal.nodes.motion import Motion

POLL_INTERVAL_S = 0.01  # s between two checks; an unwanted motion ends that soon
DISCOVERY_TIMEOUT_S = 5.0  # s in which a node that has just started must receive joint states
FRESH_S = 1.0  # s for which a joint state tells where the robot is
# s without joint states after which a campaign ends: while the robot moves, and while it rests.
# Some drivers are silent for a while at rest, and on a busy computer every driver is.
MAX_SILENCE_MOVING_S = 10.0
MAX_SILENCE_RESTING_S = 60.0
MAX_STEP_BACK_S = 1.0  # s by which the stamps of joint states may go back
# s on the robot's clock after the planned end: at which a motion counts as failed, and in which a
# robot at rest may still start to move, because a busy computer delivers the command late.
ARRIVAL_TIMEOUT_S = 10.0
START_TIMEOUT_S = 5.0
MAX_SENDS = 3  # of a motion that the controller does not answer, while the robot stays
# s for which the stamps of joint states may stay the same, or none be read on a busy computer
MAX_STANDSTILL_S = 10.0
REST_DURATION_S = 0.15  # s for which readings must stay equal before the robot counts as at rest
REST_TOLERANCE_SIGMAS = 10.0  # sigmas of a reading by which equal readings may differ
SPEED_WINDOW_S = 0.05  # s of readings from which the speed is estimated
MAX_JOINT_STATES = 2000  # joint states that are remembered
SAMPLE_TIMEOUT_S = 20.0  # s on the robot's clock that a sample may take to arrive
# Largest share of the time spent on taking samples, for which all messages are read again.
MAX_TAKING = 0.25
MAX_PAUSE = 2.0  # s until the next attempt to take a sample, however long the last one took
REPORT_INTERVAL_S = 1.0  # s between two reports of unprocessed messages

Take = Callable[
    [Callable[[], None]], Sample
]  # function to call while waiting -> the dwell's sample


class RobotCell:
    """A Cell whose robot is connected by ROS topics.

    `motion` sends trajectories to the controller. `take` returns the sample of the current dwell,
    which must last `dwell` s. `inflow` tells how far the device's messages are processed. `say`
    publishes what the campaign is waiting for.
    """

    def __init__(
        self,
        motion: Motion,
        model: Model,
        take: Take,
        dwell: float,
        inflow: Inflow,
        say: Callable[[str], None] = lambda text: None,
    ):
        self._motion, self._model, self._take, self._dwell = motion, model, take, dwell
        self._inflow, self._say = inflow, say
        self._states: deque[tuple[float, float, np.ndarray]] = deque(maxlen=MAX_JOINT_STATES)
        self.done = Event()  # set when a person has done what was asked
        self._range = model.mechanism.joint_ranges
        self._still = REST_TOLERANCE_SIGMAS * np.where(
            model.joint_noise > 0, model.joint_noise, 1e-4 * float(self._range.min())
        )
        self._departed = self._rested = 0.0  # stamps of the last motion's start and end
        self._rested_at = 0.0  # time.monotonic() when the joint state of that end was received
        self._advanced_at = math.inf  # time.monotonic() when the stamps last changed
        self._others: list[str] = []  # received joint names that are not the model's
        # The stamp at which the present motion began, and its joints (n, nq) and velocities at
        # times (n,); None while the robot rests.
        self._moving: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None

    def on_joint_state(self, message: Any) -> None:
        """Remember a joint state; may be called in any thread."""
        try:
            q, _ = match_joints(message, self._model.joints)
        except SolveError:  # other joints, in a message of their own
            self._others = list(message.name)
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        now = time.monotonic()
        if not self._states or stamp != self._states[-1][0]:
            self._advanced_at = now
        self._states.append((stamp, now, q))

    # ------------------------------------------------------------------ the Cell of a campaign

    def joints(self) -> np.ndarray:
        return self._latest()[1]

    def move(self, trajectory: Trajectory, go_on: Callable[[], None]) -> None:
        _, start = self._latest()
        for sent in range(1, MAX_SENDS + 1):
            try:
                return self._follow(trajectory, go_on)
            except UnansweredError as error:
                # DDS loses a goal, or the answer to it, while the two ends discover each other.
                if (np.abs(self._latest()[1] - start) > self._still).any():
                    raise
                if sent == MAX_SENDS:
                    raise CellError(f"the motion was sent {sent} times: {error}") from None
                self._say(f"{error}; sending the motion again")

    def _follow(self, trajectory: Trajectory, go_on: Callable[[], None]) -> None:
        """Send a trajectory once and wait until the robot rests at its end."""
        wait = self._make_wait(go_on, self._describe_silence)
        _, planned = self._latest()
        while self._silence() > FRESH_S:  # where the robot is now must be known
            wait()
            self._latest()
            time.sleep(POLL_INTERVAL_S)
        begin, q = self._latest()
        if (moved := np.abs(q - planned) > self._still).any():
            names = ", ".join(np.array(self._model.joints)[moved])
            raise CellError(f"{names} moved while the driver was silent, before the motion began")
        path = np.vstack([q, trajectory.positions])
        self._motion.require_controller()
        self._motion.send(trajectory_message(self._model.joints, trajectory))
        times = np.concatenate([[0.0], trajectory.time])
        speeds = np.vstack([0 * q, trajectory.velocities])
        self._moving = begin, times, path, speeds
        while True:
            wait()
            stamp, q = self._latest(begin)
            if not self._motion.is_answered():
                begin = stamp  # nobody has said yet that the motion began
                self._moving = begin, times, path, speeds
            elapsed = stamp - begin  # on the robot's clock: a simulated one may be slow
            self._check_on_path(q, path[0], trajectory, elapsed)
            ended = self._motion.has_ended()
            arrived = (np.abs(q - path[-1]) < ARRIVAL_TOLERANCE * self._range).all()
            late = elapsed > trajectory.seconds + START_TIMEOUT_S
            if ended and (arrived or late) and self._rests(begin + trajectory.seconds):
                moved = np.abs(path - path[0]).max(axis=0) > self._still
                self._departed = begin if moved.any() else 0.0
                self._rested = stamp - REST_DURATION_S
                self._rested_at = self._reception_time(self._rested)
                self._moving = None
                return
            if elapsed > trajectory.seconds + ARRIVAL_TIMEOUT_S:
                if ended:
                    raise CellError(
                        f"the robot did not stop within {ARRIVAL_TIMEOUT_S:.0f} s after the "
                        "planned end of its motion"
                    )
                why = self._motion.explain_silence()
                raise CellError(
                    f"{ARRIVAL_TIMEOUT_S:.0f} s after the planned end of the motion, the "
                    f"controller's action has not ended its goal{why and f': {why}'}"
                )
            time.sleep(POLL_INTERVAL_S)

    def stop(self) -> None:
        if self._states:  # otherwise nothing was sent
            self._motion.stop(self._make_halt)
        self._moving = None

    def _make_halt(self) -> JointTrajectory:
        """Make a trajectory that stops the robot where it is now."""
        states = list(self._states)  # a copy: other threads append meanwhile
        recent = [state for state in states if state[0] > states[-1][0] - SPEED_WINDOW_S]
        (early, _, q0), (late, received, q) = recent[0], recent[-1]
        speed = (q - q0) / (late - early) if late > early else np.zeros(len(q))
        age = time.monotonic() - received
        moves = (np.abs(q - q0) > self._still).any()
        if self._moving is not None and moves and age > SPEED_WINDOW_S:
            # The robot has moved on since: to go back to where it was would be a jump.
            begin, times, path, speeds = self._moving
            lapse = received - states[0][1]
            rate = (late - states[0][0]) / lapse if lapse > 0 else 1.0  # of its clock to this one
            then, now = late - begin, late - begin + rate * age
            q = q + [np.interp(now, times, c) - np.interp(then, times, c) for c in path.T]
            speed = np.array([np.interp(now, times, column) for column in speeds.T])
        return stop_message(self._model.joints, q, speed)

    def sample(self, go_on: Callable[[], None]) -> Sample:
        """Wait for the device to measure the present dwell, then take its sample.

        While waiting, it checks joint states and counts only, because taking a sample takes longer
        the more samples there are. The target counts as lost only when the robot has rested for
        SAMPLE_TIMEOUT_S, on its own clock, and every message received by then has been processed.
        """
        limit = due = math.inf  # on the robot's clock; time.monotonic() when it got there
        why = "no pose was received while the robot rested"
        # Times of the last attempt, of the next one, and of the last measurement of an attempt.
        taken, again, used = -math.inf, -math.inf, -math.inf
        wait = self._make_wait(go_on, self._describe_waiting)
        while True:
            wait()
            now, latest = time.monotonic(), self._inflow.latest
            # A sample is due when the dwell was long enough, something was measured in it, and
            # every measurement in it has been read.
            new = latest is not None and latest >= self._rested_at and latest > used
            dwell_end, (stamp, _) = self._rested + self._dwell, self._latest(self._rested)
            limit = min(limit, stamp + SAMPLE_TIMEOUT_S)
            if stamp >= limit and due == math.inf:
                due = self._reception_time(limit)
            measured = (
                (new or self._inflow.holds)
                and stamp >= dwell_end
                and self._inflow.has_read_until(self._reception_time(dwell_end))
            )
            if measured and now >= again:
                taken, used = now, used if latest is None else latest
                taking = self._take_present(wait)
                if isinstance(taking, Sample):
                    return taking
                why, end = taking, time.monotonic()
                again = end + min(max(10 * POLL_INTERVAL_S, (end - now) / MAX_TAKING), MAX_PAUSE)
            elif (
                not new
                and stamp >= dwell_end + self._dwell  # an image comes later than a pose
                and self._inflow.unusable[0] >= self._rested_at
            ):
                raise UnseenError(self._inflow.unusable[1])
            elif now > due and self._inflow.has_read_until(due) and (taken > due or not measured):
                raise CellError(
                    f"no sample at this pose: {why}. Check that the device sees its target"
                )
            else:
                time.sleep(POLL_INTERVAL_S)

    def _take_present(self, wait: Callable[[], None]) -> Sample | str:
        """Return the sample of the present dwell, or why there is none yet."""
        try:
            sample = self._take(wait)
        except DatasetError as error:
            return str(error)
        data = sample.dataset
        begin = 1e-9 * sample.start_ns + float(data.time[0] - data.duration[0] / 2)
        # A sample that began before the last motion belongs to the previous pose.
        return sample if begin > self._departed else "the present dwell has no sample yet"

    def ask(self, words: str, conditions: Mapping[str, float], go_on: Callable[[], None]) -> None:
        while not self.done.wait(POLL_INTERVAL_S):
            go_on()
        self.done.clear()  # only now: the answer may have come before this call

    # ------------------------------------------------------------------ state of the robot

    def _latest(self, since: float = 0.0) -> tuple[float, np.ndarray]:
        """Return the latest stamp and joints (nq,), wait for the first; CellError if outdated."""
        due = time.monotonic() + DISCOVERY_TIMEOUT_S
        while not self._states and time.monotonic() < due:
            time.sleep(POLL_INTERVAL_S)
        if not self._states:
            raise CellError(self._describe_missing(DISCOVERY_TIMEOUT_S))
        stamp, received, q = self._states[-1]
        limit = MAX_SILENCE_MOVING_S if self._should_move(stamp) else MAX_SILENCE_RESTING_S
        if self._silence() > limit:
            raise CellError(self._describe_missing(limit))
        if received - self._advanced_at > MAX_STANDSTILL_S:
            raise CellError(
                f"joint states are received, but their stamp has been {stamp:.3f} s for "
                f"{MAX_STANDSTILL_S:.0f} s: expected stamps that advance with the robot's clock"
            )
        if stamp < since - MAX_STEP_BACK_S:
            raise CellError(
                f"the stamps of the joint states jumped back by {since - stamp:.3g} s: was the "
                "robot's driver restarted?"
            )
        return stamp, q

    def _describe_missing(self, seconds: float) -> str:
        words = (
            f"no joint states were received for {seconds:.0f} s: the robot's position is unknown"
        )
        if self._others:
            words += f"; joint_states contain {', '.join(self._others)}, the model has "
            words += ", ".join(self._model.joints)
        elif self._states:
            words += "; its driver must publish them also while the robot rests"
        return words

    def _should_move(self, stamp: float) -> bool:
        """Whether the robot has not yet reached the planned end of its motion, as far as known."""
        if self._moving is None:
            return False
        begin, times, _, _ = self._moving
        return stamp + self._silence() < begin + times[-1]

    def _silence(self) -> float:
        """Return for how long (s) no joint state has arrived, as far as it is known: messages that
        are not read yet because the computer is busy may have arrived, but only for a while."""
        last = self._states[-1][1]
        return max(
            self._inflow.joints_read_until() - last, time.monotonic() - last - MAX_STANDSTILL_S
        )

    def _reception_time(self, stamp: float) -> float:
        """time.monotonic() when the first joint state of this stamp or later was received."""
        states = list(self._states)
        return next((received for s, received, _ in states if s >= stamp), time.monotonic())

    def _make_wait(
        self, go_on: Callable[[], None], describe: Callable[[float], str]
    ) -> Callable[[], None]:
        """Make a function to call while waiting. It says from time to time what `describe` returns
        for the time.monotonic() of the last report: what is waited for, or nothing."""
        reported = time.monotonic()

        def wait() -> None:
            nonlocal reported
            go_on()
            now = time.monotonic()
            if now < reported + REPORT_INTERVAL_S:
                return
            if words := describe(reported):
                self._say(words)
            reported = now

        return wait

    def _describe_silence(self, since: float) -> str:
        silence = self._silence() if self._states else 0.0
        return f"no joint states for {silence:.0f} s, waiting for the driver" * (silence > FRESH_S)

    def _describe_waiting(self, since: float) -> str:
        """Describe silence, or messages that are not processed and those from before a time that
        are not read."""
        waiting, behind = self._inflow.unprocessed, not self._inflow.has_read_until(since)
        if words := self._describe_silence(since):
            return words
        if not (waiting or behind):
            return ""
        return f"{waiting} poses are not processed yet{', others are not read yet' * behind}"

    def _rests(self, since: float) -> bool:
        """Whether the readings of the last REST_DURATION_S, all after `since`, are equal."""
        recent = list(self._states)
        last = recent[-1][0]
        q = np.array([q for stamp, _, q in recent if stamp >= last - REST_DURATION_S])
        return bool(last - REST_DURATION_S >= since and (np.ptp(q, axis=0) < self._still).all())

    def _check_on_path(
        self, q: np.ndarray, start: np.ndarray, trajectory: Trajectory, elapsed: float
    ) -> None:
        """Raise CellError if the joints (nq,) are not near the path, at whatever time."""
        path = np.vstack([start, trajectory.positions])
        if compute_path_deviation(q, path, self._range) <= MAX_PATH_DEVIATION:
            return
        m = self._model.mechanism
        times = np.concatenate([[0.0], trajectory.time])
        moments = np.linspace(0.0, np.clip(elapsed, 0.0, trajectory.seconds), N_MOMENTS)
        way = np.stack([np.interp(moments, times, column) for column in path.T], axis=1)
        found = find_deviating_joints(q, way, self._range) or range(len(q))
        words = "; ".join(
            f"{m.joints[i]} left its path (at {q[i]:.4f} {m.joint_units[i]})" for i in found
        )
        raise CellError(
            f"{words}: the joint does not move, moves wrongly, or an obstacle blocks it. "
            f"{LIMIT_SWITCH_ADVICE}"
        )
