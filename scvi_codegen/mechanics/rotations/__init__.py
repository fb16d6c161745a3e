"""Rotations, directions and spins in homogeneous coordinates."""
