"""Fallback to Newton's method where the fixed-point iteration fails, in the same or in a second library.

Its kernels contain second derivatives of the Lagrangian: for larger systems they are most of the source, and of the
time of derivation and compilation, and most runs never need them. So a source that is compiled here has only the
fixed-point iteration and uses a second library, compiled when the iteration first fails; an exported source includes
Newton's method. The second library is set once, for all steppers of a source: one generator makes one Newton solver for
the same iteration.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

__all__ = ["Fallback"]

Fallback: TypeAlias = Literal["own", "external", "provided", "none"]
"""Fallback of a source: its own, that of another library (``external``), one for others (``provided``), or none."""
