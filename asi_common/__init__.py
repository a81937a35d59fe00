"""Shared by physics, nodes and analysis: parameters, parameter files, compilation, files."""
