"""The executables of the actuator that `ros2 run asi_actuator` starts."""

from asi_common.signals import end_quietly


def actuator() -> None:
    """Run the node `asi_actuator`; end with its exit status."""
    end_quietly()
    from asi_common.executable import end_at_once, warn_in_log
    warn_in_log()
    from asi_actuator.actuator_node import main
    end_at_once(main())


def can_actuator() -> None:
    """Run the simulated firmware at the other end of the CAN bus; end with its exit status."""
    end_quietly()
    from asi_actuator.can_actuator import main
    from asi_common.executable import end_at_once
    end_at_once(main())
