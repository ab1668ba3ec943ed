"""Gather what running nodes publish, as plain data for the workbench."""

from __future__ import annotations

import json
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from parallel_cal_msgs.msg import CollectionStatus, CommandStatus, ModelStatus
from parallel_cal_msgs.srv import SaveSamples
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.nodes.campaign_client import CampaignClient
from parallel_cal.nodes.client import CALIBRATION, KINEMATICS, TIMEOUT_S, NodeError, Process
from parallel_cal.nodes.live_errors import MAX_WAITING_POSES, LiveErrors
from parallel_cal.nodes.parameters import LATCHED
from parallel_cal.nodes.run import type_name

NODE_TIMEOUT_S = 5.0  # s without diagnostics, which nodes publish once a second
MAX_ERRORS = 6000  # errors of measured poses: a minute at 100 Hz
# Deep, so that no pose is lost while the page is drawn.
POSES = QoSProfile(depth=MAX_WAITING_POSES, reliability=ReliabilityPolicy.BEST_EFFORT)
LEVELS = {b"\x00": "ok", b"\x01": "warn", b"\x02": "error", b"\x03": "stale"}
MEASURED = {type_name(t): t for t in (PoseWithCovarianceStamped, PoseStamped)}


class Watch:
    """Subscribes to both nodes of a namespace, in its own thread, until `close`."""

    def __init__(self, namespace: str = ""):
        self.namespace, self._processes = "/" + namespace.strip("/"), list[Process]()
        self._context, self._lock = rclpy.Context(), Lock()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(
            "workbench", namespace=self.namespace, context=self._context, enable_rosout=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._streams: dict[str, dict[str, Any]] = {}
        self._last_diagnostics: dict[str, float] = {}
        self._model: dict[str, Any] = {}
        self._samples: dict[str, Any] = {}
        self._dropped: list[dict[str, Any]] = []
        self._live_errors = LiveErrors()
        self._errors: deque[tuple[float, float]] = deque(maxlen=MAX_ERRORS)
        self._measured = ""  # the topic of the measured pose, once it is found
        listen = self._node.create_subscription
        listen(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        listen(ModelStatus, f"{KINEMATICS}/model_status", self._on_model, LATCHED)
        listen(CollectionStatus, f"{CALIBRATION}/collection_status", self._on_samples, LATCHED)
        listen(String, f"{CALIBRATION}/dropped", self._on_dropped, LATCHED)
        listen(PoseStamped, f"{KINEMATICS}/pose", self._on_predicted, POSES)
        self._node.create_timer(1.0, self._find_measured)
        self._command_status: CommandStatus | None = None
        listen(CommandStatus, f"{KINEMATICS}/command_status", self._on_command_status, 10)
        self._target = self._node.create_publisher(PoseStamped, "target_pose", 10)
        self._robot = CampaignClient(self._node)
        self._save = self._node.create_client(SaveSamples, f"{CALIBRATION}/save_samples")
        self._thread = Thread(target=self._spin, daemon=True)
        self._thread.start()

    def start(self, folder: Path, model_file: Path) -> None:
        """Start both nodes on a model file; their logs and the journal go to a folder."""
        folders = os.pathsep.join(str(f.resolve()) for f in (folder, model_file.parent))
        given = {"model_file": str(model_file.resolve()), "allowed_folders": folders}
        journal = {"journal_folder": str(folder.resolve())}
        self._processes += [
            Process(KINEMATICS, folder, self.namespace, **given),
            Process(CALIBRATION, folder, self.namespace, **given, **journal),
        ]

    def close(self) -> None:
        """Stop listening, and end the nodes that `start` started."""
        self._executor.shutdown(timeout_sec=1.0)
        self._thread.join(2.0)
        self._robot.close()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        while self._processes:
            self._processes.pop().end()

    def snapshot(self) -> dict[str, Any]:
        """Return the present state of the nodes.

        The keys are `streams`, `model`, `samples`, `dropped`, `errors` of measured poses (pairs of
        time relative to now [s] and position error [m]), `campaign`, and `trouble`.
        """
        with self._lock:
            now = time.monotonic()
            silent = {
                n for n, heard in self._last_diagnostics.items() if now - heard > NODE_TIMEOUT_S
            }
            stale = {"level": "stale", "said": "its node is silent"}
            return {
                "streams": [
                    stream | stale if stream["node"] in silent else stream
                    for stream in self._streams.values()
                ],
                "model": dict(self._model),
                "samples": dict(self._samples),
                "dropped": list(self._dropped),
                "errors": [(t - now, e) for t, e in self._errors],
                "campaign": self._robot.told,
                "trouble": list(self._trouble(now)),
            }

    def save_samples(self, path: Path) -> None:
        """Let calibration_node write its samples to a file; raise NodeError if it does not."""
        if not self._save.wait_for_service(TIMEOUT_S):
            raise NodeError(f"{CALIBRATION} in {self.namespace} does not answer: is it running?")
        future = self._save.call_async(SaveSamples.Request(path=str(path)))
        if not _wait_for(future.done):
            raise NodeError(f"{CALIBRATION} did not save its samples within {TIMEOUT_S:.0f} s")
        if not future.result().success:
            raise NodeError(f"{CALIBRATION}: {future.result().message}")

    def calibrate(self, **goal: Any) -> None:
        """Start a campaign with the given fields of the action's goal."""
        self._robot.begin(**goal)

    def steer(self, word: str) -> None:
        """Send the command pause, resume, continue or stop to the campaign."""
        self._robot.send_command(word)

    def send(self, position: Sequence[float], quaternion: Sequence[float]) -> str:
        """Send a target pose to kinematics_node and return its answer in words.

        Parameters
        ----------
        position
            x, y, z [m].
        quaternion
            x, y, z, w.

        Raises
        ------
        NodeError
            If kinematics_node does not answer.
        """
        message = PoseStamped()
        message.header.stamp = self._node.get_clock().now().to_msg()
        for key, value in zip("xyz", position, strict=True):
            setattr(message.pose.position, key, float(value))
        for key, value in zip("xyzw", quaternion, strict=True):
            setattr(message.pose.orientation, key, float(value))
        stamp, self._command_status = message.header.stamp, None
        self._target.publish(message)
        if not _wait_for(lambda: (s := self._command_status) is not None and s.stamp == stamp):
            raise NodeError(f"{KINEMATICS} did not report on the target within {TIMEOUT_S:.0f} s")
        status = self._command_status
        assert status is not None
        seconds = f"{status.time_from_start:.1f} s"
        words = {
            CommandStatus.ACCEPTED: f"sent, takes {seconds}",
            CommandStatus.SLOWED: f"sent, slowed to {seconds}: {status.message}",
        }
        return words.get(status.status, f"refused: {status.message}")

    def model_file(self, patience: float = 3.0) -> str:
        """Return the model file of kinematics_node; empty if no model is in use."""
        _wait_for(lambda: bool(self._model), patience)
        return str(self._model.get("file", ""))

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def _trouble(self, now: float) -> Iterator[str]:
        for process in self._processes:
            try:
                process.check()
            except ParallelCalError as error:
                yield f"{error}. Start this page again; the session and all samples are saved"
        for node in (KINEMATICS, CALIBRATION):
            heard = self._last_diagnostics.get(node)
            if heard is None:
                yield f"no messages from {self.namespace.rstrip('/')}/{node}: is it running?"
            elif now - heard > NODE_TIMEOUT_S:
                restart = f". If it ended, start it again: ros2 run parallel_cal {node}"
                # A node that `start` started reports its own failure above.
                advice = "" if self._processes else restart
                yield f"{node} has been silent for {now - heard:.0f} s{advice}"

    # ------------------------------------------------------------------ messages of the nodes

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        own = self.namespace.rstrip("/") + "/"
        with self._lock:
            for status in message.status:
                who, _, what = status.name.partition(": ")
                node = who.removeprefix(own)
                if not who.startswith(own) or node not in (KINEMATICS, CALIBRATION):
                    continue
                self._last_diagnostics[node] = time.monotonic()
                values = {item.key: item.value for item in status.values}
                self._streams[status.name] = {
                    "node": node,
                    "what": what,
                    "level": LEVELS.get(bytes(status.level), "error"),
                    "said": status.message,
                    "rate": values.get("Actual frequency (Hz)", ""),
                    "received": values.get("Events since startup", ""),
                    "lost": values.get("Lost since startup", ""),
                    "late": values.get("Latency p99 (ms)", ""),
                }

    def _on_model(self, message: ModelStatus) -> None:
        with self._lock:
            changed = message.hash != self._model.get("hash")
            self._model = {
                "ok": message.ok,
                "file": message.model_file,
                "hash": message.hash,
                "effects": list(message.effects),
                "source": message.source,
                "reason": message.reason,
                "since": _seconds(message.stamp) if changed else self._model["since"],
            }

    def _on_samples(self, message: CollectionStatus) -> None:
        counts = ("samples", "paired", "dropped", "lost", "strays", "journal", "last_event")
        with self._lock:
            self._samples = {key: getattr(message, key) for key in counts}
            self._samples["warnings"] = list(message.warnings)

    def _on_dropped(self, message: String) -> None:
        with self._lock:
            self._dropped = json.loads(message.data)

    def _on_command_status(self, message: CommandStatus) -> None:
        self._command_status = message

    # ------------------------------------------------------------------ predicted and measured

    def _find_measured(self) -> None:
        """Subscribe to the measured pose that calibration_node subscribes to, whatever its name."""
        if self._measured:
            return
        try:
            heard = self._node.get_subscriber_names_and_types_by_node(CALIBRATION, self.namespace)
        except NodeNameNonExistentError:
            return
        for topic, types in heard:
            for kind in set(types) & set(MEASURED):
                self._measured = topic
                self._node.create_subscription(MEASURED[kind], topic, self._on_measured, POSES)
                return

    def _on_predicted(self, message: PoseStamped) -> None:
        position = _position(message.pose)
        self._note(self._live_errors.add_predicted(_seconds(message.header.stamp), position))

    def _on_measured(self, message: Any) -> None:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        position = _position(pose)
        self._note(self._live_errors.add_measured(_seconds(message.header.stamp), position))

    def _note(self, errors: list[float]) -> None:
        now = time.monotonic()
        with self._lock:
            self._errors.extend((now, error) for error in errors)


def _wait_for(condition: Callable[[], bool], patience: float = TIMEOUT_S) -> bool:
    """Wait until a condition that another thread fulfils; return whether it was in time."""
    end = time.monotonic() + patience
    while not (fulfilled := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return fulfilled


def _position(pose: Any) -> np.ndarray:
    return np.array([pose.position.x, pose.position.y, pose.position.z])


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + 1e-9 * stamp.nanosec)
