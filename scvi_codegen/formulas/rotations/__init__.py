"""Rotations, directions and spins in formulas, as functions of homogeneous coordinates."""
