"""The executables of the actuator that `ros2 run asi_actuator` starts."""

from typing import NoReturn

from asi_common.executable import end_at_once, end_quietly


def actuator() -> NoReturn:
    """Run the node `asi_actuator`; end with its exit status."""
    end_quietly()
    from asi_actuator.actuator_node import main
    end_at_once(main())


def can_actuator() -> NoReturn:
    """Run the simulated firmware at the other end of the CAN bus; end with its exit status."""
    end_quietly()
    from asi_actuator.can_actuator import main
    end_at_once(main())
