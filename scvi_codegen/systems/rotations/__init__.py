"""Hamiltonian form of systems with rotations."""
