"""The numbers a method is made from, in 60 digits: nodes, quadratures, cardinal functions, tableaux, spaces."""
