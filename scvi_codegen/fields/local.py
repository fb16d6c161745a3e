"""Conserved densities, their fluxes and the residuals of local conservation laws along a run.

Derivatives in space are those of the interpolant, on elements element by element with the prescribed values at ends.
Values at end points that elements share are means weighted by length.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Add, Expr

from scvi_codegen.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.fields.axes import NATURAL, PERIODIC, Axis
from scvi_codegen.fields.laws import ConservationLaw, names_of
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.representation import summary

Array = NDArray[np.float64]

RESOLVED, DOUBTFUL = 1e-9, 1e-3
"""Relative errors of derivatives in time up to which states suffice, and from which there is a warning."""
WINDOW = 9
"""States of the differences in time, of order 8 between equidistant states."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalLaw:
    """Values of a conservation law d/dt density + d/dx flux = 0 along a run of n states.

    Attributes:
        law: symbolic density and fluxes.
        t: (n,) times.
        density: (n, shape of the fields) conserved density at the points.
        flux: of the same shape, by axis.
        residual: d/dt density + sum over axes of d/dx flux, of the same shape; the derivative in time is that of the
            polynomial through 9 neighbouring states, or states of dense output where these are too far apart; the
            derivatives in space are spectral.
        total: (n,) integral of the density over space.
    """

    law: ConservationLaw
    t: Array
    density: Array
    flux: Mapping[str, Array]
    residual: Array
    total: Array

    __repr__ = summary("law")


def local_law(history: FieldHistory, law: ConservationLaw) -> LocalLaw:
    """Return the values of a conservation law along a run."""
    density = history.values(law.density)
    divergence = history.values(Add(*(part.diff(symbol(axis)) for axis, part in law.flux.items())).doit())
    return LocalLaw(
        law=law,
        t=history.t,
        density=history.at_points(density),
        flux={axis: history.at_points(history.values(part)) for axis, part in law.flux.items()},
        residual=history.at_points(_rate(history, law, density) + divergence),
        total=history.integral(density),
    )


def _rate(history: FieldHistory, law: ConservationLaw, density: Array) -> Array:
    """Return the derivative of a density in time: by the states if they are close enough, else by dense output."""
    rate = time_derivative(history.t, density)
    error = np.abs(rate - time_derivative(history.t, density, WINDOW - 2)).max()
    largest = np.abs(rate).max()
    if error <= RESOLVED * largest:
        return rate
    try:
        times, between = history.between
    except (StateError, StepFailedError) as failure:
        if error > DOUBTFUL * largest:
            warn(
                f"the residual of the law '{law.name}' is uncertain by {error:.1e}: the states are too far apart in "
                f"time, and there is no dense output ({failure})",
                AccuracyWarning,
            )
        return rate
    values = between.values(law.density).reshape(*times.shape, *density.shape[1:])
    return np.array([_derivative(*each) for each in zip(times, values, history.t, strict=True)])


def time_derivative(t: Array, values: Array, most: int = WINDOW) -> Array:
    """Return the derivative in time of values (n, ..), by polynomials through ``most`` neighbouring states."""
    if (count := len(t)) < 2:
        raise StateError("the residual of a conservation law needs at least two states")
    width = min(most, count)
    firsts = [min(max(k - width // 2, 0), count - width) for k in range(count)]
    windows = [slice(first, first + width) for first in firsts]
    return np.array([_derivative(t[each], values[each], at) for each, at in zip(windows, t, strict=True)])


def _derivative(t: Array, values: Array, at: float) -> Array:
    """Return the derivative at a time of the polynomial through values (k, ..) at times (k,)."""
    distance = t - at
    scaled = distance / np.abs(distance).max()
    moments = np.zeros(len(t))
    moments[1] = 1 / np.abs(distance).max()
    weights = np.linalg.solve(np.vander(scaled, increasing=True).T, moments)
    return np.asarray(np.tensordot(weights, values, 1))


class FieldHistory:
    """Fields and their derivatives along a run, (n, points of the axes); points of elements one after the other."""

    def __init__(self, mesh: Any, run: Any) -> None:
        if run.observed is not None:
            raise StateError("a run with observe saves only its first and last state: run it without observe")
        self.mesh, self.system, self.run = mesh, mesh.field_system, run
        self.t = np.asarray(run.t, float)
        velocity = None if self.system.momenta else np.asarray(run.velocity)
        self.fields: dict[str, Array] = mesh.fields_of(np.asarray(run.q), np.asarray(run.p), velocity)
        by_name = run.stepper.parameters_by_name(run.parameters)
        self.known: dict[Expr, Any] = {each: by_name[str(each)] for each in self.system.parameters}
        self.axes: dict[str, tuple[int, Axis]] = {axis.name: (k + 1, axis) for k, axis in enumerate(mesh.axes)}
        coordinates = {TIME: self.t} | {axis.name: (axis.closed or axis).points for axis in mesh.axes}
        self.known |= zip(map(symbol, coordinates), np.ix_(*coordinates.values()), strict=True)
        self.shape = tuple(len(values) for values in coordinates.values())

    @cached_property
    def between(self) -> tuple[Array, FieldHistory]:
        """Times (n, 9) near each state, a twentieth of the distance of states apart, and the history at these times.

        Raises:
            StateError: if the run has no dense output.
            StepFailedError: if a partial step fails.
        """
        if not hasattr(self.run, "at") or self.run.pieces:
            raise StateError("recordings and runs with inputs have none here")
        count = len(self.t)
        steps = np.arange(WINDOW) - np.where(np.arange(count) == 0, 0, WINDOW // 2)[:, np.newaxis]
        steps[-1] -= WINDOW // 2
        gaps = np.diff(self.t)
        before, after = np.append(gaps[:1], gaps), np.append(gaps, gaps[-1:])
        spacing = np.where(np.abs(before) < np.abs(after), before, after) / 20
        times = self.t[:, np.newaxis] + steps * spacing[:, np.newaxis]
        q, p = self.run.at(times.ravel())
        changed = {"t": times.ravel(), "q": q, "p": p, "tau": None, "step_sizes": np.full(times.size, np.nan)}
        return times, FieldHistory(self.mesh, replace(self.run, **changed, iterations=np.zeros(times.size, np.int32)))

    def values(self, formula: Expr) -> Array:
        """Return a formula in functions and their derivatives."""
        names = names_of(formula)
        known = {name: self._function(each) for each, name in names.items()} | self.known
        return np.broadcast_to(sympy.lambdify([*known], formula.xreplace(names), "numpy")(*known.values()), self.shape)

    def _function(self, each: Any) -> Array:
        """Return a field, or a derivative of it of order one in time and any order in space."""
        orders = {str(axis): int(order) for axis, order in getattr(each, "variable_count", ())}
        name, rate = str(getattr(each, "expr", each).func), orders.pop(TIME, 0)
        values = self.fields[f"{name}_{TIME}" if rate else name]
        for along, axis in self.axes.values():
            values = axis.in_elements(values, along, self._at_ends(axis.name, name, rate, values.ndim))
        for letter, order in orders.items():
            along, axis = self.axes[letter]
            for _ in range(order):
                values = axis.derivative(values, along)
        return values

    def _at_ends(self, axis: str, name: str, rate: int, dimension: int) -> list[Array | None]:
        """Return the prescribed values at both ends of an axis, (n, 1, ..) with one dimension less than fields."""
        result: list[Array | None] = []
        for end in () if self.system.boundary[axis] == PERIODIC else self.system.boundary[axis]:
            result.append(None)
            if end != NATURAL:
                formula = end[name].diff(symbol(TIME), rate)
                values = sympy.lambdify([*self.known], formula, "numpy")(*self.known.values())
                result[-1] = np.broadcast_to(values, (len(self.t), *(1,) * (dimension - 1)))[..., 0]
        return result

    def integral(self, values: Array) -> Array:
        """Return the integral over space, (n,)."""
        for _, axis in reversed(self.axes.values()):
            values = values @ (axis.closed or axis).weights
        return values

    def at_points(self, values: Array) -> Array:
        """Return values at the points of the mesh, (n, shape of the fields)."""
        for along, axis in self.axes.values():
            values = axis.from_elements(values, along)
        return values
