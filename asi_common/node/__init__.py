"""What all ROS nodes share: parameters, messages, topics, executor, diagnostics."""
