"""The executables of the actuator that `ros2 run asi_actuator` starts."""

from asi_common.executable import end_quietly


def actuator() -> int:
    """Run the node `asi_actuator`; return the exit status."""
    end_quietly()
    from asi_actuator.actuator_node import main
    return main()


def can_actuator() -> int:
    """Run the simulated firmware at the other end of the CAN bus; return the exit status."""
    end_quietly()
    from asi_actuator.can_actuator import main
    return main()
