"""Compile a symbolic Lagrangian into a fast, standalone C variational integrator."""

__version__ = "0.1.0"
