"""Experiments over ROS: what is to be run, and running it as processes."""
