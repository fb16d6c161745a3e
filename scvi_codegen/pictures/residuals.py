"""Plot of the residuals of a fit."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.pictures.canvas import color, panel, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ResidualPlot:
    """Plot ``fit.plot()``: measured minus computed values over time, with bands of two standard deviations.

    Attributes:
        t: (n,) times.
        residuals: (n, c), NaN where nothing was measured.
        deviations: (c,) standard deviations of the noise.
        names: names of the quantities.
    """

    t: Array
    residuals: Array
    deviations: Array
    names: tuple[str, ...]

    def __call__(self, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None) -> Axes:
        """Draw on the axes ``ax`` or on new ones; write a .png or .svg if a path is passed."""
        with panel(path, ax) as drawn:
            curves = zip(self.names, self.residuals.T, self.deviations, strict=True)
            for number, (name, column, deviation) in enumerate(curves):
                drawn.plot(self.t, column, ".", markersize=4, color=color(number), label=plain(name))
                drawn.axhspan(-2.0 * deviation, 2.0 * deviation, color=color(number), alpha=0.1, linewidth=0)
            drawn.axhline(0.0, color="black", linewidth=0.6)
            drawn.set(xlabel="t", title="measured minus computed; bands of two standard deviations")
            drawn.legend(loc="best", fontsize=8)
        return drawn
