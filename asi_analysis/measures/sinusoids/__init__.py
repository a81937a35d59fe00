"""Fits of sinusoids in coloured noise to samples at any times, however many."""
