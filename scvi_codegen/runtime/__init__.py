"""Stepping: the integrator, the memory of a run, trajectories, events, states between steps, ensembles."""
