"""A node with ROS 2's life cycle, as nav2's servers have it; it starts by itself by default."""

from __future__ import annotations

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from parallel_cal.nodes.parameters import Setting

AUTOSTART = {
    "autostart": Setting(True, "become active at the start, not when a manager says", fixed=True)
}


class Managed(LifecycleNode):
    """Answers and collects only while it is `active`; inactive it keeps what it has."""

    active = False

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
