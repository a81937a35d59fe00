"""Shared by physics, nodes and analysis: parameters, their files, the topics, compilation."""
