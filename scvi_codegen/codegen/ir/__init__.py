"""Intermediate representation: kernels, stage groups, fixed-point iterations, the program; expressions to kernels."""
