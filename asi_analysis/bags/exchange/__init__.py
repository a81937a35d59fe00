"""Import of recordings of other systems (CSV, MAT, rosbag2, ...), and export as tables."""
