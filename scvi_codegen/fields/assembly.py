"""Semi-discrete Lagrangian or Hamiltonian of a density on a tensor product of axes, in index notation.

Terms of the density without derivatives in space are summed over points, terms with derivatives along some axes over
the cells of these axes and the points of the others, which keeps the cost of tensor products. Momenta b of a
Hamiltonian density are p_i = W_i b_i at points with the weights W_i: sum_i dq_i ^ dp_i is the symplectic form.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sympy
from sympy import Add, Expr

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.fields.axes import Axis, Cells, digits, same
from scvi_codegen.fields.density import Density, place_text
from scvi_codegen.fields.mesh import Mesh, MeshSystem
from scvi_codegen.formulas.array_statements import array_text
from scvi_codegen.formulas.arrays import MAX_UNROLLED_TERMS
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.tables.precision import mp

NAME = re.compile(r"[A-Za-z_]\w*")


class Assembly:
    """Texts of the sums of a semi-discrete Lagrangian, and the arrays that they use."""

    def __init__(self, system: Density, axes: Mapping[str, Axis]) -> None:
        self.system = system
        self.axes = axes
        self.used: dict[str, tuple[str, Any]] = {}

    def result(self, discretisation: Mapping[str, Any]) -> MeshSystem:
        """Return the semi-discrete system of the density on the tensor product of the axes."""
        system = self.system
        sizes = ", ".join(f"N{axis}" for axis in self.axes)
        terms = [*self.kinetic(), *self.in_space(), *self.at_places()]
        dissipation = None
        if system.dissipation != 0:
            here = {axis: f"i{axis}" for axis in self.axes}
            rates = {rate.name: self.at(f"{rate.name[:-2]}_dot", here) for rate in system.rates}
            dissipation = self.over_points(
                f"({self.written(system.dissipation, rates | self.at_points([*self.axes]))})"
            )
        tables = {f"nodes_{name}": axis.table for name, axis in self.axes.items() if axis.table is not None}
        tables |= {f"edges_{name}": axis.edges.table for name, axis in self.axes.items() if axis.edges is not None}
        text = "\n+ ".join(terms)
        tables = {name: table for name, table in tables.items() if f"{name}[" in text}
        conjugate = [f"{each}[{sizes}]" for each in system.momenta]
        arguments: dict[str, Any] = {
            "name": system.name,
            "coordinates": [*(f"{each}[{sizes}]" for each in system.fields), *system.scalars],
            "parameters": {
                **dict(zip(map(str, system.parameters), system.defaults, strict=True)),
                **{f"{name}[{size}]": values for name, (size, values) in self.used.items()},
            },
            "tables": {
                f"{name}[{'F' if name.startswith('edges') else 'E'}{name[6:]}, {table.shape[1]}]": table
                for name, table in tables.items()
            },
        }
        if conjugate:
            assembled: Any = HamiltonianSystem.from_text(**arguments, momenta=conjugate, hamiltonian=text)
        else:
            assembled = LagrangianSystem.from_text(**arguments, lagrangian=text, dissipation=dissipation)
        grids = np.meshgrid(*(axis.points for axis in self.axes.values()), indexing="ij")
        masses = np.meshgrid(*(axis.weights for axis in self.axes.values()), indexing="ij")
        parts: dict[str, Any] = {
            "field_system": system,
            "axes": tuple(self.axes.values()),
            "points": dict(zip(self.axes, grids, strict=True)),
            "weights": np.prod(masses, axis=0),
            "discretisation": discretisation,
        }
        return MeshSystem(system=replace(assembled, mesh=Mesh(**parts)), **parts)

    def array(self, name: str, size: str, values: Any, index: str) -> str:
        """Return the text of an entry of an array, or its number if all entries are equal."""
        if (value := same(values)) is not None:
            return digits(mp.mpf(value))
        self.used[name] = (size, values)
        return f"{name}[{index}]"

    def weight(self, axis: str) -> str:
        """Return the text of the weight of a point along an axis."""
        return self.array(f"weight_{axis}", f"N{axis}", self.axes[axis].weights, f"i{axis}")

    def at_points(self, axes: Sequence[str]) -> dict[str, str]:
        """Return the texts of the coordinates of points along axes."""
        return {axis: f"{axis}_points[i{axis}]" for axis in axes}

    def at(self, each: str, indices: Mapping[str, str]) -> str:
        """Return the text of a field at a point; that of a momentum is divided by the weight of the point."""
        entry = f"{each}[{', '.join(indices.values())}]"
        if each not in self.system.momenta:
            return entry
        inverse = [
            self.array(f"per_weight_{axis}", f"N{axis}", 1 / self.axes[axis].weights, index)
            for axis, index in indices.items()
        ]
        return f"{'*'.join(inverse)}*{entry}"

    def kinetic(self) -> Iterator[str]:
        """Yield the kinetic energy of each field."""
        if self.system.momenta:
            return
        for each, rate in zip(self.system.fields, self.system.rates, strict=True):
            mass = self.system.density.diff(rate, 2)
            here = ", ".join(f"i{axis}" for axis in self.axes)
            yield self.over_points(f"({self.written(mass, self.at_points([*self.axes]))})*{each}_dot[{here}]**2/2")

    def at_places(self) -> Iterator[str]:
        """Yield the point Lagrangians."""
        for place, formula in self.system.point_lagrangians:
            rows = [self.axes[axis].interpolation(at).items() for axis, at in place.items()]
            terms = [
                (", ".join(str(k) for k, _ in row), math.prod(x for _, x in row)) for row in itertools.product(*rows)
            ]
            known = {each.name for each in formula.free_symbols}
            texts = {f"{each}_{TIME}": f"{each}_dot" for each in self.system.scalars}
            for each in self.system.fields:
                if f"{each}_{TIME}" in known and len(terms) > 1:
                    raise SystemDefinitionError(
                        f"the point Lagrangian at {place_text(place)} contains {each}_{TIME}, but no point of the mesh "
                        'is there: choose points= such that one is, or "spectral-elements", whose elements end there'
                    )
                texts[f"{each}_{TIME}"] = f"{each}_dot[{terms[0][0]}]"
                texts[each] = " + ".join(f"{digits(x)}*{each}[{index}]" for index, x in terms)
            rates = [symbol(f"{each}_{TIME}") for each in (*self.system.fields, *self.system.scalars)]
            rest = formula.xreplace(dict.fromkeys(rates, sympy.S.Zero))
            yield from (f"({self.written(part, texts)})" for part in (sympy.expand(formula - rest), rest) if part != 0)

    def over_points(self, body: str) -> str:
        """Return the text of the quadrature of a body over all points."""
        loops = ", ".join(f"i{axis} in N{axis}" for axis in self.axes)
        return f"sum({loops}, {'*'.join(map(self.weight, self.axes))}*{body})"

    def in_space(self) -> Iterator[str]:
        """Yield the sums of the terms without velocities, grouped by the axes of their derivatives."""
        derivatives = self.system.derivatives
        groups: dict[tuple[str, ...], Expr] = {}
        for term in Add.make_args(sympy.expand_mul(self.system.potential)):
            names = {each.name for each in term.free_symbols}
            along = {axis for name, (_, orders) in derivatives.items() if name in names for axis in orders}
            key = tuple(axis for axis in self.axes if axis in along)
            groups[key] = groups.get(key, sympy.S.Zero) + term
        for key, term in groups.items():
            if not term.free_symbols & {symbol(each) for each in (*self.system.variables, *derivatives)}:
                continue
            if any(self.axes[axis].pairs for axis in key):
                yield from self.over_pairs(term)
            elif key:
                yield from self.over_cells(key, term)
            else:
                here = {axis: f"i{axis}" for axis in self.axes}
                texts = {each: self.at(each, here) for each in self.system.variables} | self.at_points([*self.axes])
                yield self.over_points(f"({self.written(term, texts)})")

    def over_pairs(self, term: Expr) -> Iterator[str]:
        """Yield the terms of Fourier axes: sums over pairs of points of quadratic terms, then those of derivatives."""
        rest = term
        for name, (each, orders) in self.system.derivatives.items():
            factor = term.diff(symbol(name), 2)
            if factor == 0 or len(orders) > 1 or factor.free_symbols - set(self.system.parameters):
                continue
            ((axis, order),) = orders.items()
            rest -= factor * symbol(name) ** 2 / 2
            matrix, values = f"pairs{order}_{axis}", self.axes[axis].pairs[order - 1]
            pair = f"i{axis}, j{axis}" if values.ndim == 2 else f"j{axis}-i{axis}"
            self.used[matrix] = (", ".join([f"N{axis}"] * values.ndim), values)
            others = [a for a in self.axes if a != axis]
            loops = ", ".join([*(f"i{a} in N{a}" for a in others), f"i{axis} < j{axis} in N{axis}"])
            one, two = (self.at(each, {a: f"{letter if a == axis else 'i'}{a}" for a in self.axes}) for letter in "ij")
            factors = "*".join([f"({self.written(factor, {})})", *map(self.weight, others), f"{matrix}[{pair}]"])
            yield f"sum({loops}, {factors}*({one} - {two})**2/2)"
        if sympy.expand(rest) != 0:
            yield self.over_points(f"({self.written(rest, self.fourier_derivatives(rest))})")

    def fourier_derivatives(self, term: Expr) -> dict[str, str]:
        """Return the texts of fields and their Fourier derivatives at a point, by convolutions or dense matrices."""
        here = {axis: f"i{axis}" for axis in self.axes}
        texts = {each: self.at(each, here) for each in self.system.variables} | self.at_points([*self.axes])
        for name, (each, orders) in self.system.derivatives.items():
            if symbol(name) not in term.free_symbols:
                continue
            texts[name] = self.at(each, {axis: f"j{axis}" if axis in orders else f"i{axis}" for axis in self.axes})
            for axis, order in orders.items():
                discretised, count = self.axes[axis], len(self.axes[axis].points)
                if discretised.pairs[0].ndim == 1:
                    self.used[f"derivative_{axis}"] = (f"N{axis}", discretised.rates)
                    j, others = f"j{axis}", [f"k{axis}"] * (order - 1)
                    for before, index in itertools.pairwise([j, *others, f"i{axis}"]):
                        by = f"derivative_{axis}[{before}-{index}]"
                        texts[name] = f"sum({before} in N{axis}, {by}*{texts[name]})"
                    continue
                if count > MAX_UNROLLED_TERMS:
                    raise SystemDefinitionError(
                        f"derivative=\"dense\" of more than {MAX_UNROLLED_TERMS} points of '{axis}' needs densities "
                        "that are quadratic in derivatives along one axis with constant factors, not "
                        f'{sympy.expand(term)}: use derivative="fft"'
                    )
                matrix = f"derivatives{order}_{axis}"
                first = discretised.differentiated(np.eye(count), 0)
                self.used[matrix] = (f"{count}, {count}", np.linalg.matrix_power(first, order))
                texts[name] = f"sum(j{axis} in {count}, {matrix}[i{axis}, j{axis}]*{texts[name]})"
        return texts

    def over_cells(self, key: tuple[str, ...], term: Expr) -> Iterator[str]:
        """Yield the sums over cells of the axes of the derivatives, and over the points of the other axes."""
        others = [axis for axis in self.axes if axis not in key]
        for cells in itertools.product(*(self.kinds(axis, term) for axis in key)):
            chosen = dict(zip(key, cells, strict=True))
            loops = [each.loop for each in cells if each.loop] + [f"i{axis} in N{axis}" for axis in others]
            factors = [self.size(axis, each) for axis, each in chosen.items()]
            factors += map(self.weight, others)
            body = f"{'*'.join(factors)}*({self.quadrature(chosen, others, term)})"
            yield f"sum({', '.join(loops)}, {body})" if loops else f"({body})"

    def kinds(self, axis: str, term: Expr) -> list[Cells]:
        """Return the cells of an axis, of elements with their edges if a term has second derivatives along it."""
        discretised, derivatives = self.axes[axis], self.system.derivatives
        second = [name for name, (_, orders) in derivatives.items() if orders.get(axis) == 2]
        if discretised.edges is None or not any(symbol(name) in term.free_symbols for name in second):
            return [*discretised.cells]
        return [*(replace(each, interior=True) for each in discretised.cells), *discretised.edges.cells]

    def size(self, axis: str, cells: Cells) -> str:
        """Return the text of the Jacobian of a cell, or of the weight of an edge."""
        discretised = self.axes[axis]
        if cells.edge and discretised.edges:
            return self.array(f"edge_weight_{axis}", f"F{axis}", discretised.edges.weights, cells.index)
        size = self.array(f"jacobian_{axis}", self.extent(axis), discretised.jacobians, cells.index)
        return size if cells.weight == 1 else f"{digits(cells.weight)}*{size}"

    def extent(self, axis: str) -> str:
        """Return the size that counts the cells of an axis."""
        return f"N{axis}" if self.axes[axis].table is None and self.axes[axis].periodic else f"E{axis}"

    def quadrature(self, chosen: Mapping[str, Cells], others: Sequence[str], term: Expr) -> str:
        """Return the text of the weighted sum of a term over the quadrature points of a cell.

        Along an axis whose cells have as many points as quadrature points, all of them unknown, this is a sum over an
        index, ``ax``; otherwise the terms are written out.
        """
        nodes: list[list[str]] = []
        sums: list[str] = []
        for name, cells in chosen.items():
            count = 1 if cells.edge else len(self.axes[name].quadrature)
            alike = cells.rule is not None
            nodes.append([f"a{name}"] if alike else [str(k) for k in range(count)])
            sums += [f"a{name} in {count}"] * alike
        parts = []
        for node in itertools.product(*nodes):
            at = dict(zip(chosen, node, strict=True))
            texts = self.at_points(others)
            for name, k in at.items():
                edge, index = chosen[name].edge, chosen[name].index
                texts[name] = f"{name}_at_edges[{index}]" if edge else f"{name}_in_cells[{index}, {k}]"
            texts |= {each: self.combined(each, {}, chosen, at) for each in self.system.variables}
            for name, (each, orders) in self.system.derivatives.items():
                if set(orders) <= set(chosen) and symbol(name) in term.free_symbols:
                    texts[name] = self.derivative(each, orders, chosen, at)
            weights = ["1" if chosen[name].edge else self.quadrature_weight(name, chosen, k) for name, k in at.items()]
            parts.append("*".join([*(each for each in weights if each != "1"), f"({self.written(term, texts)})"]))
        body = " + ".join(parts)
        for each in reversed(sums):
            body = f"sum({each}, {body})"
        return body

    def coefficient(self, order: int | None, axis: str, index: tuple[str, ...], cells: Cells) -> str:
        """Return the text of an entry of the operator of a derivative, or of the quadrature for ``None``."""
        operators = cells.operators or self.axes[axis].operators
        entries: Any = self.axes[axis].quadrature if order is None else operators[order]
        if self.axes[axis].table is None:
            for k in index:
                entries = entries[int(k)]
            return digits(entries)
        name = f"weights_{axis}" if order is None else f"D{order if order > 1 else ''}_{axis}"
        if name not in self.used:
            values = np.array([list(map(float, row)) for row in entries] if order else list(map(float, entries)))
            self.used[name] = (", ".join(map(str, values.shape)), values)
        return f"{name}[{', '.join(index)}]"

    def quadrature_weight(self, axis: str, chosen: Mapping[str, Cells], k: str) -> str:
        """Return the text of a quadrature weight, 0 at the ends of elements if these are edges."""
        if not chosen[axis].interior:
            return self.coefficient(None, axis, (k,), chosen[axis])
        values = np.array([0.0, *map(float, self.axes[axis].quadrature[1:-1]), 0.0])
        self.used[f"interior_weights_{axis}"] = (str(len(values)), values)
        return f"interior_weights_{axis}[{k}]"

    def at_edge(self, axis: str, order: int, cells: Cells, values: Sequence[str]) -> str:
        """Return the text of a derivative at an edge from the values to the left and to the right."""
        edges, half, sides = self.axes[axis].edges, len(values) // 2, []
        assert edges is not None
        name, factor = f"edge_rows{order}_{axis}", f"edge_factors{order}_{axis}"
        self.used |= {name: (f"2, {half}", edges.rows[order]), factor: (f"F{axis}, 2", edges.scales[order])}
        for side, part in enumerate((values[:half], values[half:])):
            terms = [f"{name}[{side}, {b}]*{value}" for b, value in enumerate(part) if value != "0"]
            sides.append(f"{factor}[{cells.index}, {side}]*({' + '.join(terms) or '0'})")
        return f"({' + '.join(sides)})"

    def derivative(
        self, each: str, orders: Mapping[str, int], chosen: Mapping[str, Cells], at: Mapping[str, str]
    ) -> str:
        """Return the text of a derivative of a field at a quadrature point of a cell."""
        factors = []
        for axis, order in orders.items():
            discretised = self.axes[axis]
            if chosen[axis].edge:
                continue
            by = self.array(f"inverse_{axis}", self.extent(axis), 1 / discretised.jacobians, chosen[axis].index)
            factors += [by] * order
        return "*".join([*factors, f"({self.combined(each, orders, chosen, at)})"])

    def combined(
        self,
        each: str,
        orders: Mapping[str, int],
        chosen: Mapping[str, Cells],
        at: Mapping[str, str],
        slots: Mapping[str, str] | None = None,
    ) -> str:
        """Return the text of sums over the points of a cell of coefficients times the values of a field.

        Args:
            each: the field.
            orders: order of the derivative by axis; along others values are interpolated.
            chosen, at: kind of cells and index of the quadrature point by axis.
            slots: index of the point within the cell along the axes that are summed already.
        """
        slots = slots or {}
        left = [axis for axis in chosen if axis not in slots]
        if not left:
            return self.entry(each, chosen, slots)
        axis = left[0]
        cells, order = chosen[axis], orders.get(axis, 0)
        if cells.edge:
            count = len(cells.places)
            if order == 0:
                return self.combined(each, orders, chosen, at, {**slots, axis: str(count // 2 - 1)})
            known = (self.combined(each, orders, chosen, at, {**slots, axis: str(b)}) for b in range(count))
            return self.at_edge(axis, order, cells, [*known])
        if order == 0 and self.axes[axis].table is not None:
            return self.combined(each, orders, chosen, at, {**slots, axis: at[axis]})
        if cells.rule is not None:
            index = f"b{axis}"
            inner = self.combined(each, orders, chosen, at, {**slots, axis: index})
            factor = self.coefficient(order, axis, (at[axis], index), cells)
            return f"sum({index} in {len(cells.places)}, {factor}*{inner})"
        terms = []
        for slot in map(str, range(len(cells.places))):
            value = self.combined(each, orders, chosen, at, {**slots, axis: slot})
            factor = self.coefficient(order, axis, (at[axis], slot), cells)
            if "0" not in (value, factor):
                terms.append(f"({factor})*({value})")
        return " + ".join(terms) or "0"

    def entry(self, each: str, chosen: Mapping[str, Cells], at: Mapping[str, str]) -> str:
        """Return the text of a field at the points ``at`` of a cell, or of its prescribed value at an end."""
        indices: dict[str, str] = {}
        for axis in self.axes:
            if axis not in chosen:
                indices[axis] = f"i{axis}"
            elif chosen[axis].rule is not None:
                indices[axis] = f"{chosen[axis].rule}, {at[axis]}]"
            else:
                place = chosen[axis].places[int(at[axis])]
                if place.index is None:
                    prescribed = self.system.boundary[axis][place.end][each]
                    return "0" if prescribed == 0 else f"({self.written(prescribed, {})})"
                indices[axis] = place.index
        return self.at(each, indices)

    def written(self, formula: Expr, texts: Mapping[str, str]) -> str:
        """Return a formula as text, with texts in place of names; arrays that it uses are recorded."""

        def replaced(match: re.Match[str]) -> str:
            name = match[0]
            if name not in texts:
                return name
            if name in self.axes:
                axis = self.axes[name]
                if texts[name].startswith(f"{name}_at_edges") and axis.edges:
                    self.used[f"{name}_at_edges"] = (f"F{name}", axis.edges.points)
                    return f"({texts[name]})"
                self.used |= (
                    {f"{name}_points": (f"N{name}", axis.points)}
                    if texts[name].startswith(f"{name}_points")
                    else {f"{name}_in_cells": (f"{self.extent(name)}, {len(axis.quadrature)}", axis.cell_points)}
                )
            return f"({texts[name]})"

        return NAME.sub(replaced, array_text(formula))
