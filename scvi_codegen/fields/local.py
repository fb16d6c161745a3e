"""Conserved densities, their fluxes and the residuals of local conservation laws along a run.

Derivatives in space are those of the interpolant, on elements element by element with the prescribed values at ends.
Values at end points that elements share are means weighted by length.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Add, Derivative, Expr

from scvi_codegen.errors import StateError, closest
from scvi_codegen.fields.axes import NATURAL, PERIODIC, Axis
from scvi_codegen.fields.laws import ConservationLaw, names_of
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.representation import summary

Array = NDArray[np.float64]

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
            polynomial through 9 neighbouring states, the derivatives in space are spectral.
        total: (n,) integral of the density over space.
    """

    law: ConservationLaw
    t: Array
    density: Array
    flux: Mapping[str, Array]
    residual: Array
    total: Array

    __repr__ = summary("law")


def local_laws(mesh: Any, laws: Iterable[ConservationLaw], run: Any) -> dict[str, LocalLaw]:
    """Return the values of conservation laws along a run by name."""
    fields = FieldHistory(mesh, run)
    result = {}
    for law in laws:
        density, flux = fields.values(law.density), {axis: fields.values(part) for axis, part in law.flux.items()}
        divergence = fields.values(Add(*(part.diff(symbol(axis)) for axis, part in law.flux.items())).doit())
        result[law.name] = LocalLaw(
            law=law,
            t=fields.t,
            density=fields.at_points(density),
            flux={axis: fields.at_points(part) for axis, part in flux.items()},
            residual=fields.at_points(time_derivative(fields.t, density) + divergence),
            total=fields.integral(density),
        )
    return result


def chosen_laws(laws: Iterable[ConservationLaw], names: Iterable[str]) -> list[ConservationLaw]:
    """Return the laws of these names, all without names."""
    known = {law.name: law for law in laws}
    for name in names:
        if name not in known:
            raise StateError(f"there is no conservation law '{name}'{closest(name, known)} Known: {', '.join(known)}")
    return [known[name] for name in names] or [*known.values()]


def time_derivative(t: Array, values: Array) -> Array:
    """Return the derivative in time of values (n, ..), by polynomials through neighbouring states."""
    if (count := len(t)) < 2:
        raise StateError("the residual of a conservation law needs at least two states")
    width = min(WINDOW, count)
    result = np.empty_like(values)
    for k in range(count):
        first = min(max(k - width // 2, 0), count - width)
        window = slice(first, first + width)
        distance = t[window] - t[k]
        scaled = distance / np.abs(distance).max()
        moments = np.zeros(width)
        moments[1] = 1 / np.abs(distance).max()
        weights = np.linalg.solve(np.vander(scaled, increasing=True).T, moments)
        result[k] = np.tensordot(weights, values[window], 1)
    return result


class FieldHistory:
    """Fields and their derivatives along a run, (n, points of the axes); points of elements one after the other."""

    def __init__(self, mesh: Any, run: Any) -> None:
        if run.observed is not None:
            raise StateError("a run with observe saves only its first and last state: run it without observe")
        self.mesh = mesh
        self.run = run
        self.t = np.asarray(run.t, float)
        self.found: dict[tuple[str, str], Array] = {}

    @cached_property
    def scalars(self) -> dict[Expr, Any]:
        """Values of the parameters."""
        by_name = self.run.stepper.parameters_by_name(self.run.parameters)
        return {each: by_name[str(each)] for each in self.mesh.field_system.parameters}

    @cached_property
    def places(self) -> dict[Expr, Array]:
        """Times and coordinates of the points."""
        count = len(self.mesh.axes)
        result = {symbol(TIME): self.t.reshape(-1, *(1,) * count)}
        for k, axis in enumerate(self.mesh.axes):
            points = axis.points if axis.table is None else axis.cell_points.ravel()
            result[symbol(axis.name)] = points.reshape(-1, *(1,) * (count - 1 - k))
        return result

    def values(self, formula: Expr) -> Array:
        """Return a formula in functions and their derivatives."""
        names = names_of(formula)
        arguments: dict[Expr, Any] = {name: self.function(each) for each, name in names.items()}
        result: Array = self._evaluated(formula.xreplace(names), {**arguments, **self.places})
        return result

    def function(self, each: Expr) -> Array:
        """Return a field, or a derivative of it of order one in time and any order in space."""
        if not isinstance(each, Derivative):
            return self._field(str(each.func), "")
        orders = {str(axis): int(order) for axis, order in each.variable_count}
        values = self._field(str(each.expr.func), TIME * orders.pop(TIME, 0))
        for axis, order in orders.items():
            for _ in range(order):
                values = self.derivative(values, axis)
        return values

    def _field(self, name: str, order: str) -> Array:
        """Return a field or its velocity; a momentum of a Hamiltonian density is divided by the weights."""
        if (name, order) not in self.found:
            system, weights = self.mesh.field_system, self.mesh.weights
            if name in system.momenta:
                values = self.run.p[system.fields[system.momenta.index(name)]] / weights
            elif order:
                mass = system.density.diff(symbol(f"{name}_{TIME}"), 2)
                points = {symbol(axis): at for axis, at in self.mesh.points.items()}
                values = self.run.p[name] / (weights * self._evaluated(mass, points))
            else:
                values = self.run.q[name]
            for k, axis in enumerate(self.mesh.axes):
                values = self._in_elements(values, k, axis, name, order)
            self.found[name, order] = values
        return self.found[name, order]

    def _evaluated(self, formula: Expr, arguments: Mapping[Expr, Any]) -> Any:
        known = {**arguments, **self.scalars}
        return sympy.lambdify([*known], formula, "numpy")(*known.values())

    def _in_elements(self, values: Array, position: int, axis: Axis, name: str, order: str) -> Array:
        """Return values at the points of all elements, (n, .., elements * points, ..)."""
        if axis.table is None:
            return values
        local = np.moveaxis(values, position + 1, -1)[..., axis.table]
        boundary = self.mesh.field_system.boundary[axis.name]
        for end in (0, 1) if boundary != PERIODIC else ():
            if boundary[end] != NATURAL:
                formula = boundary[end][name].diff(symbol(TIME)) if order else boundary[end][name]
                prescribed = np.broadcast_to(self._evaluated(formula, {symbol(TIME): self.t}), self.t.shape)
                local[..., -end, -end] = prescribed.reshape(-1, *(1,) * (local.ndim - 3))
        flat = local.reshape(*local.shape[:-2], -1)
        return np.moveaxis(flat, -1, position + 1)

    def derivative(self, values: Array, name: str) -> Array:
        """Return the derivative along an axis."""
        position = [each.name for each in self.mesh.axes].index(name)
        axis: Axis = self.mesh.axes[position]
        if axis.table is None:
            return axis.differentiated(values, position + 1)
        matrix = np.array([[float(x) for x in row] for row in axis.operators[1]])
        array = np.moveaxis(values, position + 1, -1)
        local = array.reshape(*array.shape[:-1], *axis.table.shape) @ matrix.T / axis.jacobians[:, None]
        return np.moveaxis(local.reshape(array.shape), -1, position + 1)

    def _weights(self, axis: Axis) -> Array:
        return axis.weights if axis.table is None else np.outer(axis.jacobians, [float(w) for w in axis.quadrature])

    def integral(self, values: Array) -> Array:
        """Return the integral over space, (n,)."""
        result = self._complete(values)
        for axis in reversed(self.mesh.axes):
            result = result @ self._weights(axis).ravel()
        return result

    def at_points(self, values: Array) -> Array:
        """Return values at the points of the mesh, (n, shape of the fields)."""
        result = self._complete(values)
        for k, axis in enumerate(self.mesh.axes):
            if axis.table is None:
                continue
            array = np.moveaxis(result, k + 1, -1)
            local = array.reshape(*array.shape[:-1], *axis.table.shape) * self._weights(axis)
            summed = np.zeros((*array.shape[:-1], len(axis.points)))
            for entry in range(axis.table.shape[1]):  # a point occurs once in each column of the table
                elements = axis.inside[:, entry]
                summed[..., axis.table[elements, entry]] += local[..., elements, entry]
            result = np.moveaxis(summed / axis.weights, -1, k + 1)
        return result

    def _complete(self, values: Array) -> Array:
        """Return values of the shape of the fields, those that do not depend on some axes repeated along them."""
        return np.broadcast_to(values, np.broadcast_shapes(*(each.shape for each in self.places.values())))
