"""The demonstration: the paper's experiments over ROS, a withheld effect found, the report."""
