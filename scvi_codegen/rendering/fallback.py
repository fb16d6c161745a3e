"""Where Newton's iteration stands, which is tried where sweeps fail.

Its kernels have second derivatives of the Lagrangian: of larger systems they are most of the text, and of the time that
deriving and compiling takes, and most runs never need them. So a text that is compiled here has sweeps alone, and
borrows the iteration from a second library, compiled when a sweep first fails; a text to be taken away has its own.
A library borrows once, for all steppers of its text: one generator makes one iteration for the same sweeps.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

__all__ = ["HEADERS", "Fallback"]

Fallback: TypeAlias = Literal["own", "borrowed", "lent", "none"]
"""Of a text: its own; that of another; its own, lent to another; or none."""

HEADERS: dict[Fallback, tuple[str, ...]] = {
    "own": ("newton_fallback",),
    "borrowed": ("fallback", "borrowed_fallback"),
    "lent": ("fallback", "newton_fallback"),
    "none": ("no_fallback",),
}
"""Support headers before the solver by sweeps, in order."""
