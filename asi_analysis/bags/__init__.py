"""Recordings: `Run`, the arrays of one recording, and its bag; nodes that record and replay."""
