"""Mechanical systems: Lagrangians, Hamiltonians, expressions derived from them, conserved quantities."""
