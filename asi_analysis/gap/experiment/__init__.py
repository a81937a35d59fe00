"""Choose the next experiment: the one that best separates the remaining hypotheses."""
