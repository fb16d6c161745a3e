"""Lagrangian or Hamiltonian density of fields: symbols, derivatives, and the parts of a Lagrangian density."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import sympy
from sympy import Add, Expr, S, Symbol

from scvi_codegen.api.formulas import TIME, jacobian, parse_expression, symbol
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import SystemDefinitionError

Boundary = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Density:
    """Lagrangian density L(u, u_t, u_x, .., x, .., t; parameters) or Hamiltonian density of fields in space.

    A Hamiltonian density H(u, p, u_x, p_x, ..) describes fields of first order in time, u_t = dH/dp, p_t = -dH/du, with
    variational derivatives.

    Attributes:
        name: name of the system.
        fields: names of the fields.
        momenta: of a Hamiltonian density, names of the conjugate fields; else empty.
        space: lower and upper bound by axis.
        boundary: by axis ``"periodic"`` or, for the lower and upper end, ``"natural"`` or the prescribed value as a
            formula in t by field.
        parameters, defaults: adjustable numbers and their default values.
        dissipation: Rayleigh density D of velocities, whose forces are -dD/du_t.
        scalars: names of further coordinates, which are functions of time.
        point_lagrangians: place by axis, and the Lagrangian of fields, scalars and velocities there, which is added to
            the integral of the density.
        density: L or H; ``u_t``, ``u_x``, ``u_xx``, ``u_xy`` are the derivatives of ``u``.
    """

    name: str
    fields: tuple[str, ...]
    momenta: tuple[str, ...] = ()
    space: Mapping[str, tuple[float, float]]
    boundary: Boundary
    parameters: tuple[Symbol, ...]
    defaults: tuple[float, ...]
    density: Expr
    dissipation: Expr = S.Zero
    scalars: tuple[str, ...] = ()
    point_lagrangians: tuple[tuple[Mapping[str, float], Expr], ...] = ()

    __repr__ = summary("name", "fields", "space")

    def __post_init__(self) -> None:
        if not self.momenta:
            self._check_regular()

    def _check_regular(self) -> None:
        """Raise an error unless the kinetic part is a sum of m u_t^2/2 with m > 0 of position and parameters."""
        rates = self.rates
        for step in self.density.atoms(sympy.Function):
            if type(step).__name__ == "unit_step" and not step.free_symbols.isdisjoint(rates):
                raise SystemDefinitionError(
                    f"the density of '{self.name}' has a kink in velocities where {step.args[0]} = 0: its momenta do "
                    "not determine the velocities there. Put friction and drag, such as -c*v*abs(v), into dissipation "
                    "(Rayleigh's function)"
                )
        masses = self._masses()
        for (i, j), entry in masses.items():
            if i != j:
                raise SystemDefinitionError(
                    f"the density of '{self.name}' contains {rates[i]}*{rates[j]}: velocities are supported as "
                    "m*u_t**2/2 only, with m a function of position and parameters"
                )
            allowed = {symbol(axis) for axis in self.space} | set(self.parameters)
            if wrong := sorted(map(str, entry.free_symbols - allowed)):
                raise SystemDefinitionError(
                    f"the density of '{self.name}' contains {rates[i]}**2 with a factor that depends on {wrong[0]}; "
                    "it may depend on position and parameters only"
                )
        for i, rate in enumerate(rates):
            if (i, i) not in masses:
                raise SystemDefinitionError(
                    f"the density of '{self.name}' is not regular in {rate}: add a kinetic term such as {rate}**2/2, "
                    "or describe fields of first order in time by hamiltonian="
                )
        linear = self.density - self.kinetic - self.potential
        if sympy.expand(linear) != 0:
            raise SystemDefinitionError(
                f"the density of '{self.name}' has terms linear in velocities, {sympy.expand(linear)}, which are not "
                "supported"
            )

    def jumps_in(self, formula: Expr) -> list[Expr]:
        """Return the functions of a formula that jump at places: ``unit_step`` and ``rint`` of axes and parameters."""
        places = {symbol(axis) for axis in self.space}
        moving = {*map(symbol, (*self.variables, *self.scalars, *self.derivatives, TIME)), *self.rates}
        steps = (part for part in formula.atoms(sympy.Function) if type(part).__name__ in ("unit_step", "rint"))
        jumps = [jump for jump in steps if jump.free_symbols & places]
        return [jump for jump in jumps if not jump.free_symbols & moving]

    def second_derivatives(self, formula: Expr, axis: str) -> list[Symbol]:
        """Return the second derivatives along an axis whose coefficients in a formula jump along it."""
        names = [symbol(name) for name, (_, orders) in self.derivatives.items() if orders.get(axis) == 2]
        return [
            name
            for name in names
            if any(symbol(axis) in jump.free_symbols for jump in self.jumps_in(formula.diff(name, 2)))
        ]

    @property
    def rates(self) -> tuple[Symbol, ...]:
        """Symbols of the derivatives of the fields in time."""
        return tuple(symbol(f"{field}_{TIME}") for field in self.fields)

    @property
    def derivatives(self) -> dict[str, tuple[str, dict[str, int]]]:
        """Field, and order by axis, of each derivative in space by its name: ``u_x``, ``u_xx``, ``u_xy``."""
        return derivatives_of(self.variables, [*self.space])

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the fields and momenta."""
        return (*self.fields, *self.momenta)

    def _masses(self) -> dict[tuple[int, int], Expr]:
        """Return the second derivatives by velocities that are not 0."""
        momenta = {k: slope for (_, k), slope in jacobian([self.density], self.rates).items()}
        return jacobian(momenta, self.rates, symmetric=True)

    @property
    def kinetic(self) -> Expr:
        """Kinetic part of the density."""
        masses = self._masses()
        return Add(*(masses[i, i] * rate**2 / 2 for i, rate in enumerate(self.rates)))

    @property
    def potential(self) -> Expr:
        """Density at zero velocities, minus the density of the potential energy."""
        return parse_expression(self.density, dict.fromkeys(self.rates, S.Zero))


def derivatives_of(fields: Sequence[str], axes: Sequence[str]) -> dict[str, tuple[str, dict[str, int]]]:
    """Return field and order by axis of the derivatives in space of order one and two."""
    orders: dict[str, dict[str, int]] = {axis: {axis: 1} for axis in axes}
    orders |= {axis * 2: {axis: 2} for axis in axes}
    orders |= {first + second: {first: 1, second: 1} for first, second in combinations(axes, 2)}
    return {f"{field}_{name}": (field, order) for field in fields for name, order in orders.items()}


def place_text(place: Mapping[str, float]) -> str:
    """Return a place as text, ``x = 0.5, y = 1``."""
    return ", ".join(f"{axis} = {value:g}" for axis, value in place.items())
