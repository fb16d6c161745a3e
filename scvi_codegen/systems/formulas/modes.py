"""Modes of kinks: parameters of steps that decide on which side of a switching function their formulas are."""

from sympy import Symbol


class Mode(Symbol):  # type: ignore[misc]
    """Mode in unit_step(u + mode): 0, or beyond all values of u (:mod:`scvi_codegen.systems.kinks`)."""
