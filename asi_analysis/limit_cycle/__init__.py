"""Limit cycles: detected in recordings, predicted, attributed to a nonlinearity, quenched."""
