"""Indexed systems: Lagrangians and Hamiltonians that are sums over indices, with any number of coordinates."""
