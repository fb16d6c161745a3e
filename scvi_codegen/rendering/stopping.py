"""When iterations stop, if nothing else is said: known to the C and to those who call it."""

__all__ = ["MAX_ITERATIONS", "TOLERANCE"]

TOLERANCE = 2.0**-52
"""Relative update below which an iteration has converged, if nothing else is said: the round-off unit of binary64."""

MAX_ITERATIONS = 50
"""After which a step fails, if nothing else is said: Newton's iteration takes 3 to 6 and sweeps 5 to 20."""
