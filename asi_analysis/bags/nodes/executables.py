"""The executables of recorder and replay that `ros2 run asi_actuator` starts."""

from asi_common.signals import end_quietly


def recorder() -> None:
    """Run the node `asi_recorder`; end with its exit status."""
    end_quietly()
    from asi_common.executable import end_at_once, warn_in_log
    warn_in_log()
    from asi_analysis.bags.nodes.recorder_node import main
    end_at_once(main())


def replay() -> None:
    """Run the node `asi_replay`; end with its exit status."""
    end_quietly()
    from asi_common.executable import end_at_once, warn_in_log
    warn_in_log()
    from asi_analysis.bags.nodes.replay_node import main
    end_at_once(main())
