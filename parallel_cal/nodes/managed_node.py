"""A node with ROS 2's life cycle, as nav2's servers have it; it starts by itself by default."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from parallel_cal.nodes.parameters import Setting

AUTOSTART = {
    "autostart": Setting(
        True, "become active at the start, without a lifecycle manager", fixed=True
    )
}


class ManagedNode(LifecycleNode):
    """Answers and collects only while it is `active`; inactive it keeps what it has."""

    active = False

    @property
    def refusal(self) -> str:
        """Why nothing is answered now; empty while the node is active."""
        if self.active:
            return ""
        # rclpy's own question for the state is public only as a service
        state = self._state_machine.current_state[1]
        then = "configure it and " if state == "unconfigured" else ""
        return f"the node is {state}: {then}activate it first (ros2 lifecycle set)"

    def start(self) -> None:
        """Become active, unless a manager is to say when; called at the construction's end."""
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
