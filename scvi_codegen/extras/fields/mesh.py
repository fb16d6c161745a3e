"""Mesh of a density: points, quadrature, derivatives, frequencies, resolution; and its semi-discrete system."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.formulas import TIME, symbol
from scvi_codegen.api.methods import Method
from scvi_codegen.api.program import Derivation
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.extras.fields.axes import NATURAL, PERIODIC, Axis
from scvi_codegen.extras.fields.density import Density
from scvi_codegen.extras.fields.laws import (
    FieldDerivation,
    FieldHistory,
    LocalLaw,
    chosen_laws,
    derivation_of,
    local_law,
)
from scvi_codegen.methods import as_method
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem

Array = NDArray[np.float64]


CONTRACTION = 0.32
"""Fixed-point iterations of s points converge for h times frequency below about 1 + 0.32 s (measured for SVI)."""
MOST_PHASE = 16.0
"""Largest product of step size and frequency that is searched for the stability limit of an explicit method."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """Points of the fields of a density, with quadrature, derivatives and frequencies.

    Attributes:
        field_system: the density.
        axes: discretisations of the axes.
        points: coordinates of the points by axis, in the shape of the fields, (Nx,), (Nx, Ny), ..
        weights: quadrature weights at the points, in the same shape.
        discretisation: its method and options.
    """

    field_system: Density
    axes: tuple[Axis, ...]
    points: Mapping[str, Array]
    weights: Array
    discretisation: Mapping[str, Any]

    __repr__ = summary("field_system")

    def fields_of(self, q: Array, p: Array, velocity: Array | None = None) -> dict[str, Array]:
        """Return fields at the points, (n, shape of the fields), by name, of states (n, m).

        Momenta of a Hamiltonian density are those of the density; velocities u_t are included if given.
        """
        system, shape = self.field_system, self.weights.shape

        def split(states: Array, names: Sequence[str]) -> dict[str, Array]:
            parts = states[:, : len(names) * self.weights.size].reshape(len(states), len(names), *shape)
            return {name: parts[:, k] for k, name in enumerate(names)}

        result = split(q, system.fields)
        if system.momenta:
            return result | {name: values / self.weights for name, values in split(p, system.momenta).items()}
        return result if velocity is None else result | split(velocity, [str(rate) for rate in system.rates])

    def to_section(self) -> dict[str, Any]:
        """Return the section ``[field]`` of a model file: the density as text, and its discretisation."""
        density = self.field_system

        def end_text(end: Any) -> Any:
            return NATURAL if end == NATURAL else {name: ArraySystem.formula_text(value) for name, value in end.items()}

        boundary = {
            axis: PERIODIC if ends == PERIODIC else [*map(end_text, ends)] for axis, ends in density.boundary.items()
        }
        section: dict[str, Any] = {"name": density.name, "fields": [*density.fields]}
        section |= {"momenta": [*density.momenta]} if density.momenta else {}
        section |= {"space": {axis: [*ends] for axis, ends in density.space.items()}, "boundary": boundary}
        section["hamiltonian" if density.momenta else "density"] = ArraySystem.formula_text(density.density)
        section |= {} if density.dissipation == 0 else {"dissipation": ArraySystem.formula_text(density.dissipation)}
        if density.point_lagrangians:
            section["scalars"] = [*density.scalars]
            places = [
                {**place, "lagrangian": ArraySystem.formula_text(formula)}
                for place, formula in density.point_lagrangians
            ]
            section["point_lagrangians"] = places
        return {**section, "discretisation": _plain(self.discretisation)}

    def integral(self, values: ArrayLike) -> Any:
        """Return the integral over space of values at the points, (.., shape of the fields), by quadrature."""
        return np.sum(self.weights * self._at_points(values), axis=tuple(range(-len(self.axes), 0)))

    def derivative(
        self, values: ArrayLike, axis: str, *, ends: tuple[ArrayLike | None, ArrayLike | None] | None = None
    ) -> Array:
        """Return the derivative along an axis at the points, (.., shape of the fields), of the spectral interpolant.

        Elements share end points, at which the mean of both derivatives is returned, weighted by length.

        Args:
            values: at the points, without ends where they are prescribed.
            axis: name of the axis.
            ends: values at the lower and the upper end where they are prescribed, numbers or (.., shape without the
                axis); by default 0.

        Raises:
            StateError: if ends are omitted and the system prescribes values that are not 0.
        """
        position = self._position(axis)
        if ends is None and any(value != 0 for value in self._prescribed(axis)):
            raise StateError(
                f"'{self.field_system.name}' prescribes values other than 0 at an end of {axis}: give them by "
                "ends=(lower, upper), None for an end without prescribed values"
            )
        prescribed = [None if end is None else np.asarray(end, dtype=float) for end in ends or (None, None)]
        return self.axes[position].differentiated(self._at_points(values), position - len(self.axes), prescribed)

    def _prescribed(self, axis: str) -> list[sympy.Expr]:
        """Return the values of fields that are prescribed at the ends of an axis."""
        ends = self.field_system.boundary[axis]
        return [] if ends == PERIODIC else [value for end in ends if end != NATURAL for value in end.values()]

    def unresolved(self, values: ArrayLike) -> Any:
        """Return the part of the squared amplitude in the highest sixth of the modes, (...), the largest of all axes.

        The modes are Legendre polynomials on each element, or Fourier modes; constant parts do not count. A field is
        resolved if it is small, and the error of the discretisation is about its square root. On elements it is
        relative to the largest element.
        """
        array = self._at_points(values)
        count, parts = len(self.axes), []
        size = np.abs(array).max(tuple(range(-count, 0)), keepdims=True)
        array = array / np.where(size > 0, size, 1.0)
        for k, axis in enumerate(self.axes):
            others = tuple(range(-count, -1))
            modes = axis.modes(np.moveaxis(array, k - count, -1))
            closed = axis.closed
            prescribed = any(value != 0 for value in self._prescribed(axis.name))
            # Elements at an end whose prescribed value is not known here do not count.
            if prescribed and closed and axis.table is not None:
                modes[..., ~closed.inside.reshape(axis.table.shape).all(axis=1), :] = 0
            highest = modes[..., -max(1, modes.shape[-1] // 6) :].sum(-1).sum(others)
            every = modes.sum(-1).sum(others)
            largest = every.max(-1)
            parts.append(highest.max(-1) / np.where(largest > 0, largest, 1.0))
        return np.max(parts, axis=0)[()]

    def derive(self) -> FieldDerivation:
        """Return the equations and conservation laws of the density."""
        return derivation_of(self.field_system)

    def local_laws(self, run: Any, *names: str) -> dict[str, LocalLaw]:
        """Return density, flux and residual of the conservation laws of the density along a run, by name.

        Args:
            run: trajectory of ``system``; between states that are far apart in time the residual takes dense output.
            names: of some laws, ``"energy"``, ``"momentum_x"``; by default all.

        Raises:
            StateError: for an unknown name, and for a run with ``observe``.
        """
        history = FieldHistory(self, run)
        return {law.name: local_law(history, law) for law in chosen_laws(self.field_system, names)}

    def conserved(self, run: Any, *names: str) -> dict[str, Array]:
        """Return (n,) integrals over space of the conserved densities along a run, by name; see :meth:`local_laws`.

        They are constant in the solution if the fluxes at the ends vanish or the axes are periodic (boosts depend on
        position and are not constant on periodic axes).
        """
        history, laws = FieldHistory(self, run), chosen_laws(self.field_system, names)
        return {law.name: history.integral(history.values(law.density)) for law in laws}

    def highest_frequency(self, **parameters: float) -> float:
        """Return an upper bound of the highest frequency of the equations linearised about u = 0 at t = 0.

        Explicit methods of second order are stable for h below 2/frequency; fixed-point iterations converge for h times
        frequency below about 1 to 3. The bound is the sum over axes of the largest factors of u_x**2 and u_xx**2 times
        the largest eigenvalues of the derivatives on an element, plus that of u**2. Point Lagrangians add the sum of
        their factors of squares of coordinates by the masses of these.

        Args:
            parameters: values of parameters that differ from the defaults.
        """
        system = self.field_system
        defaults = dict(zip(map(str, system.parameters), system.defaults, strict=True))
        for name in parameters:
            if name not in defaults:
                raise StateError(f"'{system.name}' has no parameter '{name}'{closest(name, defaults)}")
        values = {symbol(name): value for name, value in {**defaults, **parameters}.items()} | {symbol(TIME): 0.0}
        at_rest = {symbol(variable): 0 for variable in (*system.variables, *system.derivatives)}
        places = [symbol(axis) for axis in self.points]

        def largest(formula: sympy.Expr) -> float:
            evaluated = sympy.lambdify(places, formula.xreplace(at_rest).xreplace(values), "numpy")
            return float(np.max(np.abs(evaluated(*self.points.values()))))

        by_name = {axis.name: axis for axis in self.axes}
        total = {variable: largest(system.density.diff(symbol(variable), 2)) for variable in system.variables}
        for name, (variable, orders) in system.derivatives.items():
            if symbol(name) in system.density.free_symbols:
                powers = [by_name[axis].stiffness[order - 1] for axis, order in orders.items()]
                total[variable] += largest(system.density.diff(symbol(name), 2)) * float(np.prod(powers))
        # omega^2 = H_uu H_pp of an oscillator H(u, p), and L_uu/m of L = m u_t^2/2 - V(u).
        if system.momenta:
            pairs = zip(system.fields, system.momenta, strict=True)
            return max(float(np.sqrt(total[u] * total[p])) for u, p in pairs)
        masses = [1 / largest(1 / system.density.diff(rate, 2)) for rate in system.rates]
        squared = max(total[field] / mass for field, mass in zip(system.fields, masses, strict=True))
        return float(np.sqrt(squared + self._point_terms(dict(zip(system.fields, masses, strict=True)), values)))

    def _point_terms(self, densities: Mapping[str, float], values: Mapping[Any, float]) -> float:
        """Return the sum of second derivatives of point Lagrangians by coordinates, relative to their masses."""
        system = self.field_system
        rest = {symbol(coordinate): 0 for coordinate in (*system.fields, *system.scalars)} | dict(values)

        def second(formula: sympy.Expr, name: str) -> float:
            return float(formula.diff(symbol(name), 2).xreplace(rest))

        every = [formula for _, formula in system.point_lagrangians]
        inverse = {scalar: 1 / sum(second(part, f"{scalar}_{TIME}") for part in every) for scalar in system.scalars}
        total = 0.0
        for place, formula in system.point_lagrangians:
            rows = [(axis, axis.interpolation(place[axis.name])) for axis in self.axes]
            share = float(np.prod([sum(x * x / axis.weights[k] for k, x in row.items()) for axis, row in rows]))
            inverse |= {field: share / mass for field, mass in densities.items()}
            total += sum(factor * abs(second(formula, coordinate)) for coordinate, factor in inverse.items())
        return total

    def largest_step(self, method: Method | str, **parameters: float) -> float:
        """Return the largest step size by the bound :meth:`highest_frequency`: of stability or of convergence.

        Explicit methods are stable for smaller steps. The fixed-point iteration of other methods converges for smaller
        steps; ``solver="newton"`` has no such limit.

        Args:
            method: the method in time, or its name.
            parameters: as of :meth:`highest_frequency`.
        """
        oscillator: Any = LagrangianSystem.from_text("oscillator", ["x"], "x_dot**2/2 - x**2/2")
        if self.field_system.momenta:  # of no special form
            oscillator = HamiltonianSystem.from_text("oscillator", ["x"], "(x**2 + p_x**2)**2")
        program = Derivation(oscillator, as_method(method, oscillator)).program
        if program.splitting:
            phase = _stability_limit(*(program.splitting.numbers[name] for name in ("KICK", "DRIFT")))
        else:
            phase = 1 + CONTRACTION * program.fixed_point.points if program.fixed_point else np.inf
        frequency = self.highest_frequency(**parameters)
        return phase / frequency if frequency else np.inf

    def _at_points(self, values: ArrayLike) -> Array:
        array = np.asarray(values, float)
        if array.shape[array.ndim - self.weights.ndim :] != self.weights.shape:
            raise StateError(f"values at the points must have the shape (.., {self.weights.shape}), not {array.shape}")
        return array

    def _position(self, axis: str) -> int:
        names = [discretised.name for discretised in self.axes]
        if axis not in names:
            raise StateError(f"there is no axis '{axis}'{closest(axis, names)}")
        return names.index(axis)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshSystem(Mesh):
    """Semi-discrete system of a density.

    Attributes:
        system: system of arrays ``u[Nx]``, ``u[Nx, Ny]``, .. for :func:`~scvi_codegen.compile_stepper`. The momenta of
            a Hamiltonian density are the densities at the points times ``weights``.
    """

    system: Any

    __repr__ = summary("system")

    def derive(self) -> FieldDerivation:
        """Return the equations and conservation laws of the density, with the semi-discrete L and its energy."""
        return derivation_of(self.field_system, self.system)


def _plain(value: Any) -> Any:
    return {key: _plain(x) for key, x in value.items()} if isinstance(value, Mapping) else np.asarray(value).tolist()


def _stability_limit(kicks: Sequence[Any], drifts: Sequence[Any]) -> float:
    """Return the largest product of step size and frequency with stable steps: products of shears with |trace| <= 2."""
    z = np.linspace(0.0, MOST_PHASE, 2**14 + 1)
    state = np.tile(np.eye(2), (len(z), 1, 1))
    for kick, drift in zip(kicks, drifts, strict=True):
        state[:, 1] -= (float(kick) * z)[:, None] * state[:, 0]
        state[:, 0] += (float(drift) * z)[:, None] * state[:, 1]
    unstable = np.abs(np.trace(state, axis1=1, axis2=2)) > 2 + 1e-9
    return float(z[np.argmax(unstable) - 1]) if unstable.any() else np.inf
