"""When iterations stop, if nothing else is said: known to the C and to those who call it."""

__all__ = ["MAX_ITERATIONS", "NEAR", "ROUNDED", "TOLERANCE", "TYPED"]

TOLERANCE = 2.0**-52
"""Relative update below which an iteration has converged, if nothing else is said: the round-off unit of binary64."""

MAX_ITERATIONS = 50
"""After which a step fails, if nothing else is said: Newton's iteration takes 3 to 6 and sweeps 5 to 20."""

ROUNDED, TYPED, NEAR = 64.0, 1e-6, 1e-2
"""How far an initial state may be off constraints, as a part of its size: by rounding, in units of it; by what people
type, moved without a word; beyond which it is refused."""
