"""Where a run goes whose steps choose their own length."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number

__all__ = ["Goal"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """The time to reach, and how steps are chosen.

    Attributes:
        t_end: the time.
        tolerance: the relative error allowed to the end of each step, 0: round-off.
        tau: in place of it the length of steps where a monitor chooses what they last.
    """

    t_end: float
    tolerance: float = 0.0
    tau: float = 0.0

    @classmethod
    def checked(cls, t_end: float, tolerance: float | None) -> Goal:
        """As users give it; StateError for anything but a time and a relative error."""
        if tolerance is None:
            return cls(t_end=checked_number(t_end, "t_end"))
        allowed = checked_number(tolerance, "the tolerance")
        if not 0.0 < allowed < 1.0:
            raise StateError(f"the tolerance is a relative error between 0 and 1, not {allowed:g}")
        return cls(t_end=checked_number(t_end, "t_end"), tolerance=allowed)
