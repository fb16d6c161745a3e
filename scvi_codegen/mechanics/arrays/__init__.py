"""Array systems: Lagrangians and Hamiltonians of arrays in index notation, of any size."""
