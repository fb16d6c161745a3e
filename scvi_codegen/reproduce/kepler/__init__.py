"""Figures of the paper on Kepler's problem."""
