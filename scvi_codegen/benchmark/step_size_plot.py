"""Plot of step sizes along an orbit, for each step-size selection."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

import numpy as np

from scvi_codegen.benchmark.cases import Array
from scvi_codegen.benchmark.picture import save_figure
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.mechanics.reparametrisation import reparametrise
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.models.problems import problem
from scvi_codegen.pictures.canvas import COLORS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_step_sizes", "step_sizes"]

ECCENTRICITY = 0.9
PERIOD = 2.0 * math.pi
REVOLUTIONS = 2.0
TRANSFORMED = 0.2
"""Step size of tau, dt = r^(3/2) dtau."""


def step_sizes() -> dict[str, tuple[Array, Array]]:
    """Return times and step sizes over two revolutions from the apocentre of a Kepler orbit of eccentricity 0.9."""
    e, span = ECCENTRICITY, REVOLUTIONS * PERIOD
    q, p = [1.0 + e, 0.0], [0.0, math.sqrt((1.0 - e) / (1.0 + e))]
    system = problem("kepler").system
    stepper = compile_stepper(system, SVI(8))
    runs = {f"tolerance {each}": stepper.integrate(q, p, t_end=span, tolerance=each).t for each in (1e-6, 1e-11)}
    runs["round-off"] = stepper.integrate(q, p, t_end=span).t
    transformed = compile_stepper(reparametrise(system, "frequency"), SVI(8))
    runs["transformed time"] = transformed.integrate(q, p, h=TRANSFORMED, t_end=span).t
    return {name: (t[:-2], np.diff(t)[:-1]) for name, t in runs.items()}


def draw_step_sizes() -> Figure:
    """Return a figure of step sizes on a logarithmic axis, against revolutions."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    for color, (name, (t, lengths)) in zip(COLORS, step_sizes().items(), strict=False):
        axes.step(t / PERIOD, lengths, where="post", color=color, label=name)
    axes.set(yscale="log", xlabel="revolutions", ylabel="step size", title=f"Kepler, e = {ECCENTRICITY:g}")
    axes.legend(loc="lower left")
    return figure


def plot_step_sizes(path: str | os.PathLike[str]) -> None:
    """Draw the figure into a file, .png or .svg; raises as :func:`~scvi_codegen.benchmark.picture.save_figure`."""
    save_figure(draw_step_sizes, path)
