"""The executable of the controller that `ros2 run asi_actuator` starts."""

from asi_common.executable import end_quietly_while_importing


def controller() -> int:
    """Run the node `asi_controller`; return the exit status."""
    end_quietly_while_importing()
    from asi_controller.controller_node import main
    return main()
