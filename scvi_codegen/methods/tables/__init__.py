"""Tables of numbers in 60 digits: nodes, quadratures, cardinal functions, tableaux, spaces of curves, constants."""
