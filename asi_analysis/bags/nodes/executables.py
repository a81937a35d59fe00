"""The executables of recorder and replay that `ros2 run asi_actuator` starts."""

from typing import NoReturn

from asi_common.executable import end_at_once, end_quietly


def recorder() -> NoReturn:
    """Run the node `asi_recorder`; end with its exit status."""
    end_quietly()
    from asi_analysis.bags.nodes.recorder_node import main
    end_at_once(main())


def replay() -> NoReturn:
    """Run the node `asi_replay`; end with its exit status."""
    end_quietly()
    from asi_analysis.bags.nodes.replay_node import main
    end_at_once(main())
