"""Default convergence criteria of iterations, used by the C and by its callers."""

TOLERANCE = 2.0**-52
"""Default relative update below which an iteration has converged: the round-off unit of binary64."""

MAX_ITERATIONS = 50
"""Default number of iterations after which a step fails: Newton's method takes 3 to 6, fixed-point iterations 5 to 20.
"""

ROUNDING_UNITS, INPUT_PRECISION, LARGEST_VIOLATION = 64.0, 1e-6, 1e-2
"""Limits of the constraint violation of an initial state, relative to its size.

Rounding, in units of it; precision of typed numbers, corrected silently; largest violation that is accepted.
"""
