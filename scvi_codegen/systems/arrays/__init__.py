"""Array systems: Lagrangians and Hamiltonians of arrays in index notation, of run-time sizes."""
