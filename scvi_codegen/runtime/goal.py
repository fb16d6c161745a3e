"""Where a run goes whose steps choose their own length."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.errors import StateError
from scvi_codegen.given.counts import check_tolerance
from scvi_codegen.native.arguments import checked_number, checked_step

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
        check_tolerance(allowed)
        return cls(t_end=checked_number(t_end, "t_end"), tolerance=allowed)

    @classmethod
    def monitored(cls, monitor: str, h: float | None, t_end: float | None, tolerance: float | None) -> Goal:
        """Where a run leads whose steps a monitor chooses."""
        if h is None or t_end is None or tolerance is not None:
            raise StateError(
                f"the monitor {monitor} chooses how long steps are: give their length h in the time that it transforms "
                "to, and t_end, where they lead"
            )
        tau = checked_step(h)
        if tau < 0.0:
            raise StateError(f"steps of h = {h:g} in the time of a monitor are positive; t_end says where they lead")
        return cls(t_end=checked_number(t_end, "t_end"), tau=tau)
