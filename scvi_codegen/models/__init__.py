"""Models: a system with a method, an initial state and a time span; model files, ensembles, generated folders, FMUs."""
