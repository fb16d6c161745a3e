"""Tables of the paper: costs, iterations, properties, tableaux."""
