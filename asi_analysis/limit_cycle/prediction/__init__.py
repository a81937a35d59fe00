"""Limit cycles predicted from the model: describing functions, harmonic balance, Floquet."""
