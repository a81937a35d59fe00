"""Executable of the controller for `ros2 run asi_actuator`."""

from asi_common.executable import end_quietly


def controller() -> int:
    """Run the node `asi_controller`; return the exit status."""
    end_quietly()
    from asi_controller.controller_node import main
    return main()
