"""Benchmarks: computing time of the code against references, measured together (`make bench`)."""
