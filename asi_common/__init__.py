"""What physics, nodes and analysis share; here numpy and numba only."""
