"""Fits of hypotheses to recordings, their probabilities, and the location of the gap."""
