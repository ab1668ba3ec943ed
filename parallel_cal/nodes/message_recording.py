"""The parameter `record`: begins and ends a recording of the received messages."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rclpy.node import Node
from rclpy.parameter import Parameter

from parallel_cal.nodes.jobs import Say
from parallel_cal.nodes.run import type_name
from parallel_cal.nodes.subscriptions import ReceivedMessage

if TYPE_CHECKING:
    from parallel_cal.nodes.recorder import Recorder


class MessageRecording:
    """Records messages while it is wanted; an error on disk ends the recording, not the node."""

    def __init__(self, node: Node, folder: Path, say: Say):
        self._node, self._folder, self._say = node, folder, say
        self._recorder: Recorder | None = None

    def follow(self, wanted: bool) -> None:
        """Begin or end a recording as the parameter says."""
        if not wanted:
            self.stop()
        if not wanted or self._recorder is not None:
            return
        from parallel_cal.nodes.recorder import Recorder  # importing rosbags takes half a second

        try:
            self._recorder = Recorder(self._folder)
            self._say(f"recording to {self._recorder.path}")
        except OSError as error:
            self._node.set_parameters([Parameter("record", value=False)])
            self._say(f"cannot record to {self._folder}: {error.strerror}")

    def write(self, received: ReceivedMessage) -> None:
        """Append a message to the recording, if any."""
        if self._recorder is None:
            return
        channel, message = received.channel, received.message
        try:
            kind = type_name(type(message))
            self._recorder.write(channel, kind, message, received.received_ns)
        except OSError as error:
            self.stop(f": {error.strerror}")

    def stop(self, why: str = "") -> None:
        """End the recording, if any."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return
        with suppress(OSError):
            recorder.close()
        if self._node.context.ok():  # otherwise nothing can be published any more
            self._say(f"recording ended{why}: {recorder.path}")
