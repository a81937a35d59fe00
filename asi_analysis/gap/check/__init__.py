"""The check on blind cases, and the calibration of the probabilities."""
