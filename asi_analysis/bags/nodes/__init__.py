"""The ROS nodes that record a bag and play one back."""
