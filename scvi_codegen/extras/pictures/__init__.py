"""Plots of trajectories: paths, conserved quantities and animations. The only package that imports matplotlib."""
