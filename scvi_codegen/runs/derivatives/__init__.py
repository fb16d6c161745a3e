"""Derivatives of steps and trajectories."""
