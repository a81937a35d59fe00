"""Hypotheses of the simulator itself: their search, their evidence, what they explain."""
