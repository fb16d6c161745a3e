"""Warning of kinks that steps do not locate; imports no SymPy, as stepping does not."""

from typing import Any

from scvi_codegen.common.errors import MethodWarning, warn
from scvi_codegen.common.representation import clipped


def warn_of_formulas(of: Any, subject: str) -> None:
    """Warn that steps do not end at kinks of a system or an interface, other than rint and cutoffs of lists."""
    kinks = [u for u in of.kinks if not (u.startswith("cos(pi*") or of.lengths)]
    if kinks:
        u, loop, indices = kinks[0].partition(" for ")
        remedy = "Use short steps (h=, max_step=), or sizes= with at most 256 switching functions"
        if getattr(of, "temperature", None) is not None:
            remedy = "Use short steps (h=) or, with named coordinates, metropolis=True: its averages have no error of h"
        warn(
            f"{subject} does not locate the kinks of this system, such as {clipped(u, 60)} = 0{loop}{indices}: steps "
            f"across them use the formulas as they are and lose order. {remedy}",
            MethodWarning,
        )
