"""Plots of Kepler orbits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.reproduce.kepler.exact_flow import ellipse
from scvi_codegen.reproduce.laboratory.drawing import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_ellipse", "draw_states"]

Array = NDArray[np.float64]


def draw_states(axes: Axes, q: Array, scheme: str, label: str | None = None) -> None:
    """Draw positions of a long run as dots, rasterised also in SVG."""
    style: dict[str, Any] = {"color": COLORS[scheme], "markersize": 1.2, "rasterized": True}
    axes.plot(q[:, 0], q[:, 1], ".", label=label or scheme, **style)


def draw_ellipse(axes: Axes, e: float) -> None:
    """Draw the exact orbit."""
    axes.plot(*ellipse(e), color="black", linewidth=0.8, label="exact")
