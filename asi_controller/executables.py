"""Executable of the controller for `ros2 run asi_actuator`."""

from asi_common.signals import end_quietly


def controller() -> None:
    """Run the node `asi_controller`; end with its exit status."""
    end_quietly()
    from asi_common.executable import end_at_once, warn_in_log
    warn_in_log()
    from asi_controller.controller_node import main
    end_at_once(main())
