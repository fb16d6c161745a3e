"""What the user states: formulas, Lagrangians, Hamiltonians, constraints, bodies, events; what follows from them."""
