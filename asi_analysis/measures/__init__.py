"""Measures of one recording: step response, frequency response, oscillation, data quality."""
