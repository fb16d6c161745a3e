"""Legendre transforms: Hamiltonians of Lagrangians and back, of named coordinates, rotations and arrays."""
