"""Limit cycles: detection in recordings, prediction, attribution to a nonlinearity, quenching."""
