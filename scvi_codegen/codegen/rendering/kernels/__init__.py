"""Kernels and the loops around them as C: numbers, vectors, arrays."""
