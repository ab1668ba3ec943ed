"""What the calibration node tells of its collection: log, status and diagnostics."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from parallel_cal_msgs.msg import CollectionStatus
from rclpy.node import Node
from std_msgs.msg import String

from parallel_cal.base.keyed_warning import warning_key
from parallel_cal.nodes import calibration_messages as messages
from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.journal import Journal
from parallel_cal.nodes.parameters import LATCHED
from parallel_cal.nodes.run import foreign_publishers, rival_publishers
from parallel_cal.nodes.tally import diagnostics
from parallel_cal.recordings.channels import list_channels
from parallel_cal.recordings.recording import Dropped


class CollectionReport:
    """Publishes `~/collection_status`, `~/dropped` and `/diagnostics`, and writes the log.

    `event` is the last thing that happened; `trouble` says why samples are not safe on disk, and
    is empty while they are.
    """

    def __init__(self, node: Node, collector: Collector, journal: Journal | None):
        self._node, self._collector, self._journal = node, collector, journal
        self.event = self.trouble = ""
        self._warnings: list[str] = []
        self._published_drops: list[Dropped] = []
        self._status = node.create_publisher(CollectionStatus, "~/collection_status", LATCHED)
        self._dropped = node.create_publisher(String, "~/dropped", LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._dropped.publish(messages.dropped_message([]))

    def say(self, event: str) -> None:
        """Log an event and publish it with the status."""
        self.event = event
        self._node.get_logger().info(event)
        self.publish()

    def warn(self, event: str) -> None:
        """Log an event that deserves attention; the next status contains it."""
        self.event = event
        self._node.get_logger().warning(event)

    def set_trouble(self, trouble: str) -> None:
        """Log why samples are not safe on disk, once."""
        if trouble != self.trouble:
            self.trouble = self.event = trouble
            self._node.get_logger().error(trouble)

    def note_changes(self, samples_before: int, trouble_before: str) -> None:
        """Set the event after a refresh of the collection; of several, the last below counts."""
        dropped, trouble = self._collector.dropped(), self._collector.trouble
        if len(self._collector) != samples_before:
            self.event = f"{len(self._collector)} samples"
        if len(dropped) > len(self._published_drops):
            last = dropped[-1]
            self.event = f"dropped at {last.time:.2f} s: {last.reason} ({last.detail})"
        if trouble and trouble != trouble_before:
            self.event = trouble

    def update_warnings(self, about_samples: list[str]) -> None:
        """Log the warnings that are new, about topics and samples, and publish a change."""
        before = self._warnings
        self._warnings = [
            *foreign_publishers(self._node),
            *rival_publishers(self._node, list_channels("joints", "poses")),
            *about_samples,
        ]
        known = set(map(warning_key, before))
        for text in self._warnings:
            if warning_key(text) not in known:
                self.warn(text)
        if self._warnings != before:
            self.publish()

    def publish(self) -> None:
        """Publish the status, and the dropped messages if they changed."""
        self._status.publish(self.status())
        dropped = self._collector.dropped()
        if dropped != self._published_drops:
            self._dropped.publish(messages.dropped_message(dropped))
        self._published_drops = dropped

    def status(self) -> CollectionStatus:
        """Return the status message of the collection as it is now."""
        c = self._collector
        return CollectionStatus(
            stamp=self._node.get_clock().now().to_msg(),
            joint_states_received=c.received["joint_states"],
            poses_received=sum(c.received[name] for name in list_channels("poses", "images")),
            paired=c.paired,
            dropped=c.dropped_poses,
            samples=len(c),
            lost=c.lost,
            strays=c.strays,
            warnings=self._warnings,
            journal=self._journal.path if self._journal else "",
            last_event=self.event,
        )

    def publish_diagnostics(self, *others: Any) -> None:
        """Publish a DiagnosticStatus of the samples, followed by others of the node."""
        level = DiagnosticStatus.OK
        if self._warnings:
            level = DiagnosticStatus.WARN
        if self.trouble:
            level = DiagnosticStatus.ERROR
        text = "; ".join(filter(None, [self.trouble, *self._warnings])) or "OK"
        status = self.status()
        counts = ("samples", "paired", "dropped", "lost", "strays", "journal", "last_event")
        items = {key: str(getattr(status, key)) for key in counts}
        name = f"{self._node.get_fully_qualified_name()}: samples"
        message = DiagnosticArray(status=[diagnostics(name, level, text, items), *others])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(message)
