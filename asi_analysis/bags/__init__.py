"""Recordings: a run as arrays, read from and written to bags."""
