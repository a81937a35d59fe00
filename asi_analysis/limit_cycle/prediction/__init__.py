"""Prediction of limit cycles from the model: describing functions, harmonic balance, Floquet."""
