"""Semi-discrete Lagrangian or Hamiltonian of a density on a tensor product of axes, in index notation.

Terms of the density without derivatives in space are summed over points, terms with derivatives along some axes over
the cells of these axes and the points of the others, which keeps the cost of tensor products. Momenta b of a
Hamiltonian density are p_i = W_i b_i at points with the weights W_i: sum_i dq_i ^ dp_i is the symplectic form.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import mul
from typing import Any, TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Add, Expr, Float, Rational, Symbol

from scvi_codegen.api.formulas import DOT, TIME, Array, symbol
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.fields.axes import Axis, Cells, fixed_place, rational, same, span
from scvi_codegen.extras.fields.density import Density, place_text
from scvi_codegen.extras.fields.mesh import Mesh, MeshSystem

Slot: TypeAlias = Any
"""Number of a point within a cell, or in the general term of a sum its index as text."""
Summed: TypeAlias = tuple[tuple[Any, ...], Expr]
SHOWN_DENOMINATOR = 10**6
"""Largest denominator of fractions that texts contain; other numbers are decimal."""


class InnerSum(Expr):  # type: ignore[misc]  # SymPy has no types
    """Sum over the points of a cell: its index, its general term, which is printed, and its terms."""

    def doit(self, **hints: bool) -> Expr:
        """Return the sum of the terms."""
        return Add(*(term.doit(**hints) for term in self.args[2:]))

    def scaled(self, number: Expr) -> InnerSum:
        """Return the sum with each term multiplied by a number."""
        return InnerSum(self.args[0], *(number * term for term in self.args[1:]))

    def _sympystr(self, printer: Any) -> str:
        index, general, *terms = self.args
        return f"sum({index} in {len(terms)}, {printer._print(general)})"


class Assembly:
    """Terms of a semi-discrete Lagrangian, and the arrays that they use."""

    def __init__(self, system: Density, axes: Mapping[str, Axis]) -> None:
        self.system = system
        self.axes = axes
        self.sizes = tuple(Array.size(f"N{axis}") for axis in axes)
        self.here = {axis: Array.place(index=f"i{axis}") for axis in axes}
        self.used: dict[str, tuple[tuple[Any, ...], Any]] = {}
        self.accesses: dict[Symbol, Any] = {}

    def result(self, discretisation: Mapping[str, Any]) -> MeshSystem:
        """Return the semi-discrete system of the density on the tensor product of the axes."""
        system = self.system
        coordinates = (*(Array(field, self.sizes) for field in system.fields), *(Array(x, ()) for x in system.scalars))
        momenta = tuple(Array(momentum, self.sizes) for momentum in system.momenta)
        function = "hamiltonian" if momenta else "lagrangian"
        summed = [*self.kinetic(), *self.in_space(), *self.at_places()]
        texts: dict[str, Any] = {"coordinates": [*map(str, coordinates)], "momenta": [*map(str, momenta)]}
        texts |= {function: "\n+ ".join(map(text_of, summed))}
        forces: list[Any] = []
        if system.dissipation != 0:
            damped = self.over_points(system.dissipation, lambda part: [self.at_points(part, system.rates)])
            velocities = {Array(coordinate.name + DOT, coordinate.axes): coordinate for coordinate in coordinates}
            forces += ArraySystem.rayleigh(self.terms([damped]), velocities)
            texts["dissipation"] = text_of(damped)
        terms = self.terms(summed)
        tables = self.tables()
        texts |= {"tables": [*map(str, tables)]}
        mesh = self.mesh(discretisation)
        values = {name: entries for name, (_, entries) in self.used.items()}
        assembled = ArraySystem.assembled(
            name=system.name,
            coordinates=coordinates,
            momenta=momenta,
            time=symbol(TIME),
            parameters=system.parameters,
            defaults=system.defaults,
            fields=tuple(Array(name, sizes) for name, (sizes, _) in self.used.items()),
            field_defaults=(1.0,) * len(self.used),
            tables=tuple(tables),
            terms=terms,
            forces=tuple(forces),
            definition={key: text for key, text in texts.items() if text},
            data=values | {table.name: rows for table, rows in tables.items()},
            mesh=Mesh(**mesh),
        )
        return MeshSystem(system=assembled, **mesh)

    def tables(self) -> dict[Array, NDArray[np.int64]]:
        """Return the tables of points by cell and by edge that the terms use, with their entries."""
        used = {place.table for access in self.accesses.values() for place in access.places}
        tables = [(f"nodes_{x}", f"E{x}", axis.table) for x, axis in self.axes.items()]
        tables += [(f"edges_{x}", f"F{x}", axis.edges.table) for x, axis in self.axes.items() if axis.edges]
        return {
            Array(name, (Array.size(rows), Array.size("", entries.shape[1]))): entries
            for name, rows, entries in tables
            if name in used and entries is not None
        }

    def mesh(self, discretisation: Mapping[str, Any]) -> dict[str, Any]:
        """Return the attributes of the :class:`Mesh`: weights are products of those of the axes."""
        grids = np.meshgrid(*(axis.points for axis in self.axes.values()), indexing="ij")
        weights = np.meshgrid(*(axis.weights for axis in self.axes.values()), indexing="ij")
        return {
            "field_system": self.system,
            "axes": tuple(self.axes.values()),
            "points": dict(zip(self.axes, grids, strict=True)),
            "weights": np.prod(weights, axis=0),
            "discretisation": discretisation,
        }

    def terms(self, summed: Sequence[Summed]) -> tuple[Any, ...]:
        """Return one term for each tuple of loops, with all sums over the points of a cell carried out."""
        by_loops: dict[tuple[Any, ...], list[Expr]] = {}
        for loops, formula in sorted(summed, key=lambda pair: not pair[0]):
            by_loops.setdefault(loops, []).append(formula.doit())
        return tuple(ArraySystem.term(loops, Add(*parts), self.accesses) for loops, parts in by_loops.items())

    def entry(self, name: str, sizes: tuple[Any, ...], places: Sequence[Any], *sums: Any) -> Symbol:
        """Return the symbol of an entry of an array, or of convolutions of it."""
        indices = (place_of(place) if isinstance(place, str | int) else place for place in places)
        access = Array(name, sizes).at(*indices, sums=sums)
        slot = symbol(str(access))
        self.accesses[slot] = access
        return slot

    def value(self, name: str, sizes: tuple[Any, ...], values: Any, *places: Any) -> Symbol:
        """Return the symbol of an entry of an array of numbers."""
        self.used[name] = (sizes, values)
        return self.entry(name, sizes, places)

    def common(self, name: str, size: str, values: Any, place: Any) -> Expr:
        """Return an entry of an array, or its number if all entries are equal."""
        number = same(values)
        return self.value(name, (Array.size(size),), values, place) if number is None else rational(number)

    def weight(self, axis: str) -> Expr:
        """Return the weight of a point along an axis."""
        return self.common(f"weight_{axis}", f"N{axis}", self.axes[axis].weights, self.here[axis])

    def at(self, name: str, places: Mapping[str, Any], *sums: Any) -> Expr:
        """Return a field at a point; a momentum is divided by the weight of the point."""
        entry = self.entry(name, self.sizes, [*places.values()], *sums)
        if name not in self.system.momenta:
            return entry
        inverse_weights = [
            self.common(f"per_weight_{axis}", f"N{axis}", 1 / self.axes[axis].weights, place)
            for axis, place in places.items()
        ]
        return reduce(mul, [*inverse_weights, entry])

    def at_points(self, formula: Expr, rates: Sequence[Symbol] = ()) -> Expr:
        """Return a formula of fields, their velocities and places at a point."""
        velocities = {rate: self.entry(f"{rate.name[:-2]}{DOT}", self.sizes, [*self.here.values()]) for rate in rates}
        fields = {symbol(u): self.at(u, self.here) for u in self.names_in(formula, self.system.variables)}
        places = {symbol(axis): self.coordinate(axis) for axis in self.names_in(formula, self.axes)}
        return formula.xreplace(velocities | fields | places)

    def names_in(self, formula: Expr, names: Iterable[str]) -> list[str]:
        """Return the names that a formula contains."""
        return [name for name in names if symbol(name) in formula.free_symbols]

    def coordinate(self, axis: str) -> Expr:
        """Return the coordinate of a point along an axis."""
        return self.value(f"{axis}_points", (Array.size(f"N{axis}"),), self.axes[axis].points, self.here[axis])

    def kinetic(self) -> Iterator[Summed]:
        """Yield the kinetic energy of each field: the density is m u_t^2/2 with m = d^2 L/du_t^2."""
        if self.system.momenta:
            return
        for field, rate in zip(self.system.fields, self.system.rates, strict=True):
            velocity = self.entry(field + DOT, self.sizes, [*self.here.values()])

            def energy(mass: Expr, velocity: Symbol = velocity) -> list[Expr]:
                return [self.at_points(mass), velocity**2, Rational(1, 2)]

            yield self.over_points(self.system.density.diff(rate, 2), energy)

    def at_places(self) -> Iterator[Summed]:
        """Yield the point Lagrangians."""
        for place, formula in self.system.point_lagrangians:
            # u(x, y) = sum_ij l_i(x) l_j(y) u_ij with the interpolation coefficients l of the axes.
            rows = [self.axes[axis].interpolation(coordinate).items() for axis, coordinate in place.items()]
            points = [([k for k, _ in row], math.prod(x for _, x in row)) for row in itertools.product(*rows)]
            values: dict[Symbol, Expr] = {}
            for scalar in self.system.scalars:
                values |= {symbol(scalar): self.entry(scalar, (), ())}
                values |= {symbol(f"{scalar}_{TIME}"): self.entry(scalar + DOT, (), ())}
            for field in self.system.fields:
                if (rate := symbol(f"{field}_{TIME}")) in formula.free_symbols and len(points) > 1:
                    raise SystemDefinitionError(
                        f"the point Lagrangian at {place_text(place)} contains {field}_{TIME}, but no point of the "
                        'mesh is there: choose points= such that one is, or "spectral-elements", whose elements '
                        "end there"
                    )
                values[rate] = self.entry(field + DOT, self.sizes, points[0][0])
                values[symbol(field)] = Add(*(rational(x) * self.entry(field, self.sizes, k) for k, x in points))
            rates = [symbol(f"{coordinate}_{TIME}") for coordinate in (*self.system.fields, *self.system.scalars)]
            rest = formula.xreplace(dict.fromkeys(rates, sympy.S.Zero))
            yield from (((), part.xreplace(values)) for part in (sympy.expand(formula - rest), rest) if part != 0)

    def over_points(self, formula: Expr, at_point: Callable[[Expr], list[Expr]]) -> Summed:
        """Return the quadrature over all points of the factors that ``at_point`` returns for a formula."""
        loops = tuple(span(f"i{axis}", f"N{axis}") for axis in self.axes)
        return loops, self.weighted(formula, [*self.axes], at_point)

    def weighted(self, formula: Expr, axes: Sequence[str], at_point: Callable[[Expr], list[Expr]]) -> Expr:
        """Return the factors that ``at_point`` returns for a formula times the weights of a point along some axes.

        At a common end of two elements functions that jump there have a value in each, with the weight of the element.
        """
        jumps = self.system.jumps_in(formula)
        sided = [axis for axis in axes if self.axes[axis].one_sided and any(self.names_in(f, [axis]) for f in jumps)]
        parts = []
        for sides in itertools.product((0, 1), repeat=len(sided)):
            side_along = dict(zip(sided, sides, strict=True))
            places = {symbol(axis): self.beside(axis, "points", side) for axis, side in side_along.items()}
            weights = [
                self.beside(axis, "weights", side_along[axis]) if axis in side_along else self.weight(axis)
                for axis in axes
            ]
            part = formula.xreplace({jump: jump.xreplace(places) for jump in jumps}) if places else formula
            parts.append(reduce(mul, [*weights, *at_point(part)]))
        return Add(*parts)

    def beside(self, axis: str, kind: str, side: int) -> Symbol:
        """Return the coordinate or the weight of a point within the element to the left, 0, or to the right, 1."""
        values = getattr(self.axes[axis].one_sided, kind)[side]
        return self.value(
            f"{axis}_{kind}_{('left', 'right')[side]}", (Array.size(f"N{axis}"),), values, self.here[axis]
        )

    def in_space(self) -> Iterator[Summed]:
        """Yield the sums of the terms without velocities, grouped by the axes of their derivatives."""
        derivatives = self.system.derivatives
        groups: dict[tuple[str, ...], Expr] = {}
        for term in Add.make_args(sympy.expand_mul(self.system.potential)):
            names = {factor.name for factor in term.free_symbols}
            along = {axis for name, (_, orders) in derivatives.items() if name in names for axis in orders}
            key = tuple(axis for axis in self.axes if axis in along)
            groups[key] = groups.get(key, sympy.S.Zero) + term
        for key, term in groups.items():
            if not term.free_symbols & {symbol(variable) for variable in (*self.system.variables, *derivatives)}:
                continue
            if any(self.axes[axis].pairs for axis in key):
                yield from self.over_pairs(term)
            elif key:
                yield from self.over_cells(key, term)
            else:
                yield self.over_points(term, lambda part: [self.at_points(part)])

    def over_pairs(self, term: Expr) -> Iterator[Summed]:
        """Yield the terms of Fourier axes: sums over pairs of points of quadratic terms, then those of derivatives."""
        # int u_x^2/2 dx = sum_(i<j) K_ij (u_i - u_j)^2/2 (see Axis.pairs).
        rest = term
        for name, (field, orders) in self.system.derivatives.items():
            factor = term.diff(symbol(name), 2)
            if factor == 0 or len(orders) > 1 or factor.free_symbols - set(self.system.parameters):
                continue
            ((axis, order),) = orders.items()
            rest -= factor * symbol(name) ** 2 / 2
            values, i, j = self.axes[axis].pairs[order - 1], f"i{axis}", f"j{axis}"
            pair = (
                (Array.place(index=i), Array.place(index=j)) if values.ndim == 2 else (Array.place(index=j, minus=i),)
            )
            others = [a for a in self.axes if a != axis]
            loops = (*(span(f"i{a}", f"N{a}") for a in others), span(i, f"N{axis}"))
            matrix = self.value(f"pairs{order}_{axis}", (Array.size(f"N{axis}"),) * values.ndim, values, *pair)
            difference = self.at(field, self.here) - self.at(field, self.here | {axis: Array.place(index=j)})
            factors = [factor, *map(self.weight, others), matrix, difference**2, Rational(1, 2)]
            yield (*loops, replace(span(j, f"N{axis}"), behind=i)), reduce(mul, factors)
        if sympy.expand(rest) != 0:
            derivatives = {
                symbol(name): self.fourier_derivative(rest, *self.system.derivatives[name])
                for name in self.names_in(rest, self.system.derivatives)
            }
            yield self.over_points(rest, lambda part: [self.at_points(part).xreplace(derivatives)])

    def fourier_derivative(self, term: Expr, field: str, orders: Mapping[str, int]) -> Expr:
        """Return a Fourier derivative of a field at a point, by convolutions or dense matrices."""
        sums, dense = [], {}
        for position, axis in enumerate(self.axes):
            order = orders.get(axis, 0)
            discretised = self.axes[axis]
            count = len(self.axes[axis].points)
            if order and discretised.pairs[0].ndim == 1:
                array = Array(f"derivative_{axis}", (Array.size(f"N{axis}"),))
                self.used[array.name] = (array.axes, discretised.rates)
                sums += [array.convolution(position, f"{letter}{axis}") for letter in "jk"[:order]]
            elif order and count > (most := ArraySystem.MAX_UNROLLED_TERMS):
                raise SystemDefinitionError(
                    f"derivative=\"dense\" of more than {most} points of '{axis}' needs densities "
                    "that are quadratic in derivatives along one axis with constant factors, not "
                    f'{sympy.expand(term)}: use derivative="fft"'
                )
            elif order:
                dense[axis] = np.linalg.matrix_power(discretised.differentiated(np.eye(count), 0), order)

        def value(places: Mapping[str, Any], left: Sequence[str]) -> Expr:
            """Return the sums over the axes that are left, the last one outermost."""
            if not left:
                return self.at(field, places, *sums)
            *others, axis = left
            name, size = f"derivatives{orders[axis]}_{axis}", Array.size("", len(dense[axis]))

            def summand(k: Slot) -> Expr:
                factor = self.value(name, (size, size), dense[axis], Array.place(index=f"i{axis}"), k)
                return factor * value({**places, axis: place_of(k)}, others)

            return total(f"j{axis}", size.number, summand)

        return value(self.here, [*dense])

    def over_cells(self, key: tuple[str, ...], term: Expr) -> Iterator[Summed]:
        """Yield the sums over cells of the axes of the derivatives, and over the points of the other axes."""
        others = [axis for axis in self.axes if axis not in key]
        for cells in itertools.product(*(self.kinds(axis, term) for axis in key)):
            cells_of = dict(zip(key, cells, strict=True))
            loops = (*(kind.loop for kind in cells if kind.loop), *(span(f"i{axis}", f"N{axis}") for axis in others))
            factors = [factor for axis, kind in cells_of.items() for factor in self.size(axis, kind)]

            def in_cells(part: Expr, cells_of: Mapping[str, Cells] = cells_of, factors: Any = factors) -> list[Expr]:
                return [*factors, self.quadrature(cells_of, others, part, {})]

            yield loops, self.weighted(term, others, in_cells)

    def kinds(self, axis: str, term: Expr) -> list[Cells]:
        """Return the cells of an axis, of elements with their edges if a term has second derivatives along it."""
        discretised, derivatives = self.axes[axis], self.system.derivatives
        second = [name for name in self.names_in(term, derivatives) if derivatives[name][1].get(axis) == 2]
        if discretised.edges is None or not second:
            return [*discretised.cells]
        return [*(replace(cells, interior=True) for cells in discretised.cells), *discretised.edges.cells]

    def size(self, axis: str, cells: Cells) -> list[Expr]:
        """Return the factors of the Jacobian of a cell, or of the weight of an edge."""
        discretised = self.axes[axis]
        if cells.edge and discretised.edges:
            return [self.common(f"edge_weight_{axis}", f"F{axis}", discretised.edges.weights, cells.index)]
        size = self.common(f"jacobian_{axis}", self.extent(axis), discretised.jacobians, cells.index)
        return [size] if cells.weight == 1 else [rational(cells.weight), size]

    def extent(self, axis: str) -> str:
        """Return the size that counts the cells of an axis."""
        return f"N{axis}" if self.axes[axis].table is None and self.axes[axis].periodic else f"E{axis}"

    def quadrature(
        self, cells_of: Mapping[str, Cells], others: Sequence[str], term: Expr, node: Mapping[str, Slot]
    ) -> Expr:
        """Return the weighted sum of a term over the points of a cell; ``node``: those along axes summed already."""
        if left := [axis for axis in cells_of if axis not in node]:
            axis, cells = left[0], cells_of[left[0]]
            count = 1 if cells.edge else len(self.axes[axis].quadrature)

            def part(k: Slot) -> Expr:
                return self.quadrature(cells_of, others, term, {**node, axis: k})

            return total(f"a{axis}", count, part) if cells.table else Add(*map(part, range(count)))
        system = self.system
        within = [axis for axis in node if not cells_of[axis].edge]
        for axis in [axis for axis in node if axis not in within]:
            term = self.at_jumps(axis, cells_of[axis], term)
        values = {symbol(u): self.combined(u, {}, cells_of, node) for u in self.names_in(term, system.variables)}
        for name in self.names_in(term, system.derivatives):
            field, orders = system.derivatives[name]
            values[symbol(name)] = self.derivative(field, orders, cells_of, node)
        weights = [self.quadrature_weight(axis, cells_of[axis], node[axis]) for axis in within]
        jumps = self.system.jumps_in(term)
        inner = {
            symbol(axis): self.in_cells(axis, cells_of[axis], node[axis], inside=True)
            for axis in within
            if self.axes[axis].one_sided and any(self.names_in(f, [axis]) for f in jumps)
        }
        term = term.xreplace({jump: jump.xreplace(inner) for jump in jumps}) if inner else term
        for axis in self.names_in(term, [*others, *node]):
            inside = axis in node
            values[symbol(axis)] = self.in_cells(axis, cells_of[axis], node[axis]) if inside else self.coordinate(axis)
        return reduce(mul, [*weights, term.xreplace(values)])

    def at_jumps(self, axis: str, cells: Cells, term: Expr) -> Expr:
        """Return a term at an edge, with the coefficients of second derivatives that jump there.

        The moment c u_xx is continuous, so that an edge with the shares a, b of its weight in both elements has the
        energy of the coefficient 1/(a/c_left + b/c_right) (mixed formulation).
        """
        edges = self.axes[axis].edges
        assert edges is not None
        for name in self.system.second_derivatives(term, axis):
            factor = term.diff(name, 2)
            inverse = sympy.S.Zero
            for side, text in enumerate(("left", "right")):
                place, share = (
                    self.value(f"{axis}_{kind}_{text}_of_edges", (Array.size(f"F{axis}"),), values[side], cells.index)
                    for kind, values in (("points", edges.sides), ("shares", edges.shares))
                )
                jumps = {jump: jump.xreplace({symbol(axis): place}) for jump in self.system.jumps_in(factor)}
                inverse += share / factor.xreplace(jumps)
            term = sympy.expand_mul(term - factor * name**2 / 2) + name**2 / inverse / 2
        return term

    def in_cells(self, axis: str, cells: Cells, k: Slot, *, inside: bool = False) -> Expr:
        """Return the coordinate of a quadrature point of a cell, slightly ``inside`` of its ends, or of an edge."""
        discretised = self.axes[axis]
        if inside and discretised.one_sided:
            sizes = (Array.size(self.extent(axis)), Array.size("", len(discretised.quadrature)))
            return self.value(f"{axis}_inside_cells", sizes, discretised.one_sided.cells, cells.index, k)
        if cells.edge and discretised.edges:
            return self.value(f"{axis}_at_edges", (Array.size(f"F{axis}"),), discretised.edges.points, cells.index)
        sizes = (Array.size(self.extent(axis)), Array.size("", len(discretised.quadrature)))
        return self.value(f"{axis}_in_cells", sizes, discretised.cell_points, cells.index, k)

    def coefficient(self, order: int | None, axis: str, index: tuple[Slot, ...], cells: Cells) -> Expr:
        """Return an entry of the operator of a derivative, or of the quadrature for ``None``."""
        operators = cells.operators or self.axes[axis].operators
        entries: Any = self.axes[axis].quadrature if order is None else operators[order]
        if self.axes[axis].table is None:
            for k in index:
                entries = entries[k]
            return rational(entries)
        name = {None: "weights", 1: "D"}.get(order, f"D{order}") + f"_{axis}"
        values = np.array(entries, dtype=float)
        return self.value(name, sizes_of(values), self.used.get(name, ((), values))[1], *index)

    def quadrature_weight(self, axis: str, cells: Cells, k: Slot) -> Expr:
        """Return a quadrature weight, 0 at the ends of elements if these are edges."""
        if not cells.interior:
            return self.coefficient(None, axis, (k,), cells)
        values = np.array([0.0, *map(float, self.axes[axis].quadrature[1:-1]), 0.0])
        return self.value(f"interior_weights_{axis}", sizes_of(values), values, k)

    def at_edge(self, axis: str, order: int, cells: Cells, values: Sequence[Expr]) -> Expr:
        """Return a derivative at an edge from the values to the left and to the right."""
        edges, half, sides = self.axes[axis].edges, len(values) // 2, []
        assert edges is not None
        rows, scales = edges.rows[order], edges.scales[order]
        for side, part in enumerate((values[:half], values[half:])):
            terms = [
                self.value(f"edge_rows{order}_{axis}", sizes_of(rows), rows, side, b) * x for b, x in enumerate(part)
            ]
            factors = (Array.size(f"F{axis}"), Array.size("", 2)), scales, cells.index, side
            sides.append(self.value(f"edge_factors{order}_{axis}", *factors) * Add(*terms))
        return Add(*sides)

    def derivative(
        self, field: str, orders: Mapping[str, int], cells_of: Mapping[str, Cells], node: Mapping[str, Slot]
    ) -> Expr:
        """Return a derivative of a field at a quadrature point of a cell."""
        factor = sympy.S.One
        for axis, order in orders.items():
            if not cells_of[axis].edge:
                inverse = 1 / self.axes[axis].jacobians
                factor *= self.common(f"inverse_{axis}", self.extent(axis), inverse, cells_of[axis].index) ** order
        value = self.combined(field, orders, cells_of, node)
        return value.scaled(factor) if isinstance(value, InnerSum) and factor.is_number else factor * value

    def combined(
        self,
        field: str,
        orders: Mapping[str, int],
        cells_of: Mapping[str, Cells],
        node: Mapping[str, Slot],
        slots: Mapping[str, Slot] | None = None,
    ) -> Expr:
        """Return sums over the points of a cell of coefficients times the values of a field.

        Args:
            field: its name.
            orders: order of the derivative by axis; along others values are interpolated.
            cells_of, node: kind of cells and index of the quadrature point by axis.
            slots: index of the point within the cell along the axes that are summed already.
        """
        slots = slots or {}
        left = [axis for axis in cells_of if axis not in slots]
        if not left:
            return self.in_cell(field, cells_of, slots)
        axis = left[0]
        cells, order = cells_of[axis], orders.get(axis, 0)

        def inner(slot: Slot) -> Expr:
            return self.combined(field, orders, cells_of, node, {**slots, axis: slot})

        def summand(slot: Slot) -> Expr:
            return self.coefficient(order, axis, (node[axis], slot), cells) * inner(slot)

        count = len(cells.places)
        if cells.edge:
            return self.at_edge(axis, order, cells, [*map(inner, range(count))]) if order else inner(count // 2 - 1)
        if order == 0 and self.axes[axis].table is not None:
            return inner(node[axis])
        return total(f"b{axis}", count, summand) if cells.table else Add(*map(summand, range(count)))

    def in_cell(self, field: str, cells_of: Mapping[str, Cells], slots: Mapping[str, Slot]) -> Expr:
        """Return a field at a point of a cell, or its prescribed value at an end."""
        places = {**self.here}
        for axis, cells in cells_of.items():
            if cells.table:
                places[axis] = Array.place(index=cells.index.index, table=cells.table, column=slots[axis])
            elif not isinstance(place := cells.places[slots[axis]], int):
                places[axis] = place
            else:
                prescribed: Expr = self.system.boundary[axis][place][field]
                return prescribed
        return self.at(field, places)


def total(index: str, count: int, summand: Callable[[Slot], Expr]) -> Expr:
    """Return the sum of terms 0, 1, .., count - 1."""
    return InnerSum(symbol(index), summand(index), *map(summand, range(count)))


def place_of(slot: Slot) -> Any:
    """Return a number or an index as an index expression."""
    return Array.place(index=slot) if isinstance(slot, str) else fixed_place(slot)


def sizes_of(values: Any) -> tuple[Any, ...]:
    """Return the shape of an array."""
    return tuple(Array.size("", n) for n in values.shape)


def text_of(summed: Summed) -> str:
    """Return a sum in index notation, with decimal numbers."""
    loops, formula = summed
    numbers = {x: Float(x, 25) for x in formula.atoms(Rational) if x.q > SHOWN_DENOMINATOR}
    behind = {loop.behind for loop in loops}
    text = ArraySystem.formula_text(formula.xreplace(numbers))
    if not loops:
        return f"({text})"
    # An index that others begin behind, i < j, is printed with these.
    ranges = ", ".join(str(loop) for loop in loops if loop.index not in behind)
    return f"sum({ranges}, {text})"
