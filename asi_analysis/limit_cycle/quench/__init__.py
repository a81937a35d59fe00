"""Limit cycles quenched: margin of a compensator, attack on it, dither."""
