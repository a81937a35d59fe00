"""The executables of recorder and replay that `ros2 run asi_actuator` starts."""

from asi_common.executable import end_quietly


def recorder() -> int:
    """Run the node `asi_recorder`; return the exit status."""
    end_quietly()
    from asi_analysis.bags.nodes.recorder_node import main
    return main()


def replay() -> int:
    """Run the node `asi_replay`; return the exit status."""
    end_quietly()
    from asi_analysis.bags.nodes.replay_node import main
    return main()
