"""Models of the closed loop: simulation, linear model, describing functions, harmonic balance."""
