"""Action of runs, and paths: stationary points of the discrete action between two positions."""
