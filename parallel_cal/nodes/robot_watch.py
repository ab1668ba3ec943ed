"""Follow the robot of a node through its joint states: diagnostics, and the topic ~/watch."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from threading import Thread

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from parallel_cal.base.confidence import format_percent
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.live_watch import STATE_SUFFIX, LiveWatch
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.model_server import ModelServer, ServedModel
from parallel_cal.nodes.parameters import LATCHED, Setting, overridable
from parallel_cal.nodes.run import WorkerThreadGroup
from parallel_cal.nodes.stream_memory import Memory
from parallel_cal.nodes.tally import diagnostics
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting.watching import summarize_watch
from parallel_cal.watch.watch import DAY, FALSE_ALARM_DAYS, Watch

STATES = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
RATES = ("velocity.", "acceleration.")  # a robot at rest has none
ROBOT_WATCH = {
    "watch": Setting(
        False,
        "say if a part of the robot has changed; needs redundant or passive encoders",
        fixed=True,
    ),
    "watch_interval": Setting(3600.0, "time that one recording of the watch covers, s", (0, 1e6)),
    "watch_rests": Setting(
        20, "least number of places at which the robot rests in a recording of the watch", (1, 1000)
    ),
    "watch_false_alarm_days": Setting(
        FALSE_ALARM_DAYS, "mean time between false alarms of the watch, days", (1e-6, 1e6)
    ),
}


class RobotWatch:
    """Samples the joint states at rest; a thread follows the robot through each interval."""

    def __init__(self, node: ManagedNode, server: ModelServer, memory: Memory):
        self._node, self._server, self._memory = node, server, memory
        self._live: LiveWatch | None = None
        self._served: ServedModel | None = None
        self._thread: Thread | None = None
        self._trouble = ""
        self._publisher = node.create_publisher(DiagnosticStatus, "~/watch", LATCHED)
        # The thread only triggers: publishing would fail in it once ROS has shut down.
        self._news = node.create_guard_condition(self._publish)
        node.create_subscription(
            JointState,
            "joint_states",
            self._on_joints,
            STATES,
            callback_group=WorkerThreadGroup(),
            qos_overriding_options=overridable(),
        )

    def diagnose(self, name: str) -> DiagnosticStatus:
        """The state of the watch: WARN if a part has changed, ERROR if it cannot watch."""
        live, level = self._live, DiagnosticStatus
        watch = live.watch if live else None
        if self._trouble:
            return diagnostics(f"{name}: watch", level.ERROR, self._trouble, {})
        if live is None or watch is None or not watch.trend:
            count = {"Rests collected": str(len(live) if live else 0)}
            return diagnostics(f"{name}: watch", level.OK, "no recording yet", count)
        items = {
            "Recordings": str(len(watch.trend)),
            "Rests collected": str(len(live)),
            "Statistic (days)": f"{watch.trend[-1].statistic / DAY:.3g}",
            "Mean time between false alarms (days)": f"{watch.false_alarm_days:g}",
        }
        words = list(summarize_watch(watch))
        if watch.alarm:
            parts = list(watch.parts.items())[:5]
            items |= {f"Probability of {part}": format_percent(p) for part, p in parts}
        changed = level.WARN if watch.alarm else level.OK
        return diagnostics(f"{name}: watch", changed, "; ".join(words), items)

    def end(self) -> None:
        """Wait for the recording that is being evaluated."""
        if self._thread is not None:
            self._thread.join()

    def _on_joints(self, message: JointState) -> None:
        served = self._server.current
        if served is None or not self._node.active:
            return
        if self._served is None or self._served.hash != served.hash:
            self._begin(served)
        if self._live is None:
            return
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        readings = dict(zip(message.name, message.position, strict=False))
        conditions = {
            name: value
            for name, value in self._memory.heard.copy().items()
            if not name.startswith(RATES)
        }
        directions = self._memory.tracker.direction.copy()
        conditions |= {f"direction.{joint}": sign for joint, sign in directions.items()}
        dataset = self._live.collect(stamp, readings, conditions)
        if dataset is not None:
            self.end()  # an interval takes longer than its evaluation
            work = partial(self._evaluate, self._live, dataset)
            self._thread = Thread(target=work, daemon=True)
            self._thread.start()

    def _begin(self, served: ServedModel) -> None:
        """Watch another model, from the state beside its file."""
        self.end()
        self._served, self._live, self._trouble = served, None, ""
        value = {name: self._node.get_parameter(name).value for name in ROBOT_WATCH}
        path = Path(served.path)
        try:
            self._live = LiveWatch(
                served.model,
                path.with_name(path.stem + STATE_SUFFIX),
                value["watch_interval"],
                value["watch_rests"],
                self._memory.tracker.threshold,
                value["watch_false_alarm_days"],
            )
        except (ParallelCalError, OSError) as error:
            self._report_trouble(error)

    def _evaluate(self, live: LiveWatch, dataset: Dataset) -> None:
        before = live.watch.alarm
        try:
            watch: Watch = live.add(dataset)
        except (ParallelCalError, OSError) as error:
            self._report_trouble(error)
            return
        self._trouble = ""
        if watch.alarm and not before:
            self._node.get_logger().warning("; ".join(summarize_watch(watch)))
        self._news.trigger()

    def _report_trouble(self, error: Exception) -> None:
        self._trouble = f"the robot is not watched: {error}"
        self._node.get_logger().error(self._trouble)
        self._news.trigger()

    def _publish(self) -> None:
        self._publisher.publish(self.diagnose(self._node.get_fully_qualified_name()))
