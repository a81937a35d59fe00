"""Every published fact beside what the simulator says."""
