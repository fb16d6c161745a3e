"""Interfaces to other libraries: flows for JAX, PyTorch and CasADi, optimal control."""
