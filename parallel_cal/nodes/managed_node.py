"""A lifecycle node, like the servers of nav2, that activates itself by default."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from parallel_cal.nodes.parameters import Setting

AUTOSTART = {
    "autostart": Setting(
        True, "become active at the start, without a lifecycle manager", fixed=True
    )
}


class ManagedNode(LifecycleNode):
    """Answers and collects only while it is `active`; an inactive node keeps its data."""

    active = False

    @property
    def refusal(self) -> str:
        """Why the node answers nothing at present; empty while it is active."""
        if self.active:
            return ""
        # rclpy provides the state only as a service, so its private attribute is read.
        state = self._state_machine.current_state[1]
        then = "configure it and " if state == "unconfigured" else ""
        return f"the node is {state}: {then}activate it first (ros2 lifecycle set)"

    def start(self) -> None:
        """Activate the node unless a lifecycle manager will; call this at the end of `__init__`."""
        if self.get_parameter("autostart").value:
            self.trigger_configure()
            self.trigger_activate()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = True
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = False
        return super().on_shutdown(state)
