"""The comparison of every published fact with the simulator: `asi reproduce`."""
