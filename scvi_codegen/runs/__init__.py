"""From a compiled method to results: states, steps, runs, events, ensembles, trajectories, recordings."""
