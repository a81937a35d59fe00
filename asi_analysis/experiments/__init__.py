"""Experiments over ROS: their parameters, and running them with the nodes as processes."""
