"""Time stepping: integrators, runs, trajectories, events, dense output, ensembles."""
