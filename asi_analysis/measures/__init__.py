"""Measures of one recording: step, frequency response, oscillation."""
