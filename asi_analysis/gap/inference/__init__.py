"""From recordings to probabilities: fits, hypotheses, where the gap lies."""
