"""Runs with inputs: piecewise polynomials and the segments between their breakpoints."""
