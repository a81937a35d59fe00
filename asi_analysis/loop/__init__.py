"""The simulated loop in one process: time domain, linear model, describing functions, cycles."""
