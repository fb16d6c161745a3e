"""First-order systems: degenerate Lagrangians L = theta(z, t) . z' - H(z, t), linear in all velocities.

Guiding centres, point vortices, massless charged particles and Lotka-Volterra equations have such Lagrangians. Their
equations of motion, omega z' = H_z + theta_t with omega = d theta, are of first order: positions are the whole state.
A Galerkin method applied to L itself has parasitic modes, or loses half of its order. If half of the coordinates, y,
satisfy omega(y_i, y_j) = 0, then theta_y is a gradient in y, and subtracting dF/dt with F_y = theta_y from L gives

    L = theta_x(x, y, t) . x' - H(x, y, t),

Hamilton's principle in phase space with the momenta theta_x(x, y, t) as functions of y (C. L. Ellison et al.,
*Degenerate variational integrators for magnetic field line flow and guiding center trajectories*, Phys. Plasmas 25
(2018), call these systems properly degenerate). Variational integrators take y as auxiliary variables at the points of
a step, have their full order, and preserve the two-form omega.

:func:`first_order_form` finds such coordinates and integrates theta_y. Whether an expression is zero is decided by its
values at random points in 60 digits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, islice, permutations
from typing import Any

import numpy as np
import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.representation import counted, summary
from scvi_codegen.common.tangent_space import tangent_space
from scvi_codegen.systems.checks.continuity import irregularity
from scvi_codegen.systems.formulas.expressions import SAMPLES, Tape, dot, gradient, sums_to_zero
from scvi_codegen.systems.formulas.intermediates import written_out
from scvi_codegen.systems.formulas.symbols import DOT, inputs_by_name, symbol
from scvi_codegen.systems.formulas.translation import format_expression
from scvi_codegen.systems.hamiltonian import HamiltonianSystem

MOST_SHEARED = 6
"""Largest number of coordinates of which shears are tried."""
MOST_SHOWN = 12
"""Largest number of operations of an entry of the two-form in a message."""
MOST_CHOICES = 8
"""Largest number of choices of y whose gauge is integrated; the shortest result is used."""


UNSUPPORTED = {
    "constraints": "half of the variables are momenta of the others, so that a constraint acts on momenta",
    "forces": "half of the variables are auxiliary, without momenta on which a force acts; a gradient belongs into H",
    "damping": "half of the variables are auxiliary, without momenta that decrease",
    "bath": "half of the variables are auxiliary, without momenta on which noise acts",
}
"""Arguments that a first-order system does not support, with the reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstOrderSystem(HamiltonianSystem):
    """System of a Lagrangian that is linear in all velocities, whose coordinates are its whole state.

    :meth:`LagrangianSystem.from_text` and :meth:`LagrangianSystem.from_sympy` return it for such a Lagrangian. Initial
    states are values of all coordinates, without velocities, by name or in the order of ``variables``;
    ``Trajectory.variables`` has the states in this order.

    Attributes:
        coordinates: the half x of the coordinates whose velocities remain in L.
        momenta: the other half y, auxiliary variables of the action.
        hamiltonian: H(x, y, t).
        variables: all coordinates in the order of the user.
        one_form: theta_x(x, y, t), the momenta conjugate to x.
        integrated: F, whose time derivative was subtracted from the Lagrangian of the user.
    """

    variables: tuple[Symbol, ...]
    one_form: tuple[Expr, ...]
    integrated: Expr = field(default=sympy.S.Zero, compare=False)

    __repr__ = summary("name", "variables")

    @property
    def lagrangian(self) -> Expr:
        """Integrand theta_x . v - H of Hamilton's principle."""
        return dot(self.one_form, self.velocities) - self.hamiltonian

    def halves(self, values: Mapping[str, float] | Sequence[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the values of ``coordinates`` and of ``momenta``, from values by name or in the order of the user.

        Raises:
            SystemDefinitionError: if a variable is missing or unknown.
        """
        names = [variable.name for variable in self.variables]
        by_key = dict(values) if isinstance(values, Mapping) else dict(enumerate(values))
        if set(by_key) != set(names) and list(by_key) != list(range(len(names))):
            raise SystemDefinitionError(
                f"the state of '{self.name}' must have the values of {', '.join(names)}, by name or in this order, not "
                f"{by_key}"
            )
        by_name = by_key if isinstance(values, Mapping) else dict(zip(names, by_key.values(), strict=True))
        q, y = ([by_name[variable.name] for variable in half] for half in (self.coordinates, self.momenta))
        return tuple(q), tuple(y)

    def joined(self, q: Sequence[float], y: Sequence[float]) -> dict[str, float]:
        """Return the values of all variables by name, in the order of the user."""
        values = dict(zip((*self.coordinates, *self.momenta), (*q, *y), strict=True))
        return {variable.name: values[variable] for variable in self.variables}

    @property
    def is_first_order(self) -> bool:
        """True."""
        return True

    @property
    def is_canonical(self) -> bool:
        """True if theta_x = y, so that the system is an ordinary Hamiltonian one."""
        return self.one_form == self.momenta

    @property
    def is_regular(self) -> bool:
        """False unless the system is canonical with regular H."""
        return self.is_canonical and HamiltonianSystem.is_regular.fget(self)  # type: ignore[attr-defined]


def is_first_order(lagrangian: Expr, velocities: Sequence[Symbol]) -> bool:
    """Return whether L is linear in the velocities, contains some of them, and has several coordinates."""
    occurring = lagrangian.free_symbols & set(velocities)
    if len(velocities) == 1 or not occurring:
        return False
    return not any(gradient(momentum, velocities) for momentum in gradient(lagrangian, velocities).values())


@dataclass(frozen=True)
class OneForm:
    """The one-form theta and the function H of a Lagrangian that is linear in its velocities.

    Attributes:
        name: of the system, for messages.
        lagrangian: theta . v - H.
        coordinates, velocities, time: its symbols; all others are parameters.
    """

    name: str
    lagrangian: Expr
    coordinates: tuple[Symbol, ...]
    velocities: tuple[Symbol, ...]
    time: Symbol

    @cached_property
    def theta(self) -> tuple[Expr, ...]:
        """Coefficients of the velocities."""
        return tuple(self.lagrangian.diff(v) for v in self.velocities)

    @cached_property
    def hamiltonian(self) -> Expr:
        """H, minus the terms without velocities."""
        return -self.lagrangian.xreplace(dict.fromkeys(self.velocities, sympy.S.Zero))

    def at(self, places: Mapping[Symbol, Expr]) -> "OneForm":
        """Return the form in the coordinates a z + b of ``places``, with the names of z."""
        moved: dict[Expr, Expr] = {}
        for z, v in zip(self.coordinates, self.velocities, strict=True):
            factor = places[z].diff(z)
            moved |= {v: v / factor, z: (z - places[z]) / factor + z, places[z]: z}
        return replace(self, lagrangian=self.lagrangian.xreplace(moved))

    def omega(self, i: int, j: int) -> Expr:
        """Return the entry d theta_j / d z_i - d theta_i / d z_j of the two-form d theta."""
        return self.theta[j].diff(self.coordinates[i]) - self.theta[i].diff(self.coordinates[j])

    def is_zero(self, expression: Expr) -> bool:
        """Return whether an expression is zero identically."""
        return sums_to_zero(sympy.Add.make_args(expression))

    @cached_property
    def vanishing(self) -> frozenset[tuple[int, int]]:
        """The pairs i < j with omega_ij = 0."""
        n = len(self.coordinates)
        return frozenset((i, j) for i in range(n) for j in range(i + 1, n) if self.is_zero(self.omega(i, j)))

    def rank(self) -> int:
        """Return the largest rank of omega at the points."""
        n = len(self.coordinates)
        entries = [self.omega(i, j) for i in range(n) for j in range(n)]
        matrices = (np.array(values, dtype=float).reshape(n, n) for values in islice(Tape.samples(entries), SAMPLES))
        return max((tangent_space(matrix).rank for matrix in matrices), default=0)

    def choices(self, auxiliary: tuple[int, ...] = (), first: int = 0) -> Iterator[tuple[int, ...]]:
        """Yield the choices of half of the coordinates between which omega vanishes."""
        n = len(self.coordinates)
        if 2 * len(auxiliary) == n:
            yield auxiliary
            return
        for j in range(first, n):
            if all((i, j) in self.vanishing for i in auxiliary):
                yield from self.choices((*auxiliary, j), j + 1)

    def integral(self, auxiliary: Sequence[int]) -> Expr | None:
        """Return F with F_y = theta_y, or ``None`` if no closed form is found."""
        total: Expr = sympy.S.Zero
        for j in auxiliary:
            rest = sympy.expand(self.theta[j] - total.diff(self.coordinates[j]))
            if rest == 0:
                continue
            part = sympy.integrate(rest, self.coordinates[j], manual=True)
            if part.has(sympy.Integral, sympy.Piecewise):
                return None
            total += part
        remaining = [self.theta[j] - total.diff(self.coordinates[j]) for j in auxiliary]
        return total if all(map(self.is_zero, remaining)) else None

    def check(self) -> None:
        """Raise :class:`SystemDefinitionError` unless omega is regular."""
        n, rank = len(self.coordinates), self.rank()
        missing = f"{counted(n - rank, 'combination')} of the coordinates {'has' if n - rank == 1 else 'have'}"
        if rank < n:
            raise SystemDefinitionError(
                f"the Lagrangian of '{self.name}' is linear in the velocities, and its two-form d theta has rank "
                f"{rank} in {n} coordinates: {missing} no equation of motion. A regular two-form is required. "
                "Eliminate conserved combinations (Casimirs), or add the missing kinetic energy, such as "
                f"m*{self.velocities[0]}**2/2"
            )


def system_of(kind: Any, **fields: Any) -> Any:
    """Return a system of these fields: of a Lagrangian that is linear in velocities a :class:`FirstOrderSystem`."""
    return (first_order_system(fields) if "lagrangian" in fields else None) or kind(**fields)


def first_order_system(fields: Mapping[str, Any]) -> FirstOrderSystem | None:
    """Return the first-order system of the fields of a :class:`LagrangianSystem`; ``None`` if L is not linear in v."""
    coordinates, lagrangian = fields["coordinates"], fields["lagrangian"]
    velocities = tuple(symbol(q.name + DOT) for q in coordinates)
    if fields.get("rotations") or not is_first_order(lagrangian, velocities):
        return None
    name = fields["name"]
    for key, reason in UNSUPPORTED.items():
        if fields.get(key):
            raise SystemDefinitionError(
                f"the Lagrangian of '{name}' is linear in the velocities (a first-order system) and does not support "
                f"{key}: {reason}. Leave it out, or add the missing kinetic energy, such as "
                f"m*{velocities[0]}**2/2"
            )
    moving, constants = (*coordinates, *velocities), dict(zip(fields["parameters"], fields["defaults"], strict=True))
    if problem := irregularity(lagrangian, f"the Lagrangian of '{name}'", moving, velocities, constants):
        raise SystemDefinitionError(problem)
    form = OneForm(name, lagrangian, coordinates, velocities, fields["time"])
    common = {
        key: fields[key] for key in ("name", "time", "parameters", "defaults", "functions", "inputs") if key in fields
    }
    inputs = fields.get("inputs", ())
    shown = format_expression(inputs_by_name(written_out(lagrangian), inputs))
    text = {"coordinates": [q.name for q in coordinates], "lagrangian": shown, **({"inputs": inputs} if inputs else {})}
    return FirstOrderSystem(**common, **first_order_form(form), definition=fields.get("definition") or text)


def places(form: OneForm) -> dict[Symbol, Expr]:
    """Return for each coordinate z the expression a z + b in which theta contains it most often, or z itself.

    a and b depend on parameters alone. Of equally frequent ones z is preferred, then the first.
    """
    kinds: dict[Symbol, dict[Expr, list[Expr]]] = {z: {} for z in form.coordinates}  # by their zero
    variables = {*form.coordinates, form.time}

    def collect(expression: Expr) -> None:
        occurring = expression.free_symbols & variables
        if len(occurring) == 1 and (z := next(iter(occurring))) in kinds:
            factor = expression.diff(z)
            if not factor.has(z):
                zero = sympy.expand(z - expression / factor)
                kinds[z].setdefault(zero, []).append(expression if zero else z)
                return
        for argument in expression.args if occurring else ():
            collect(argument)

    for component in form.theta:
        collect(component)
    most = {
        z: max(kind.values(), key=lambda forms: (len(forms), forms[0] == z), default=[z]) for z, kind in kinds.items()
    }
    return {z: max(expressions, key=expressions.count) for z, expressions in most.items()}


def first_order_form(form: OneForm) -> dict[str, Any]:
    """Return the fields of a :class:`FirstOrderSystem` that its one-form determines.

    Integrals are expanded about the origins and in the units in which theta is written, x - 1000 or x/l + c:
    expanded about x = 0, momenta there would be small differences of large terms.

    Raises:
        SystemDefinitionError: if omega is singular, does not vanish between any half of the coordinates, or theta_y has
            no integral in closed form.
    """
    form.check()
    candidates: list[tuple[int, tuple[int, ...], Expr, tuple[Expr, ...]]] = []
    refused: list[tuple[int, ...]] = []
    z, n = form.coordinates, len(form.coordinates)
    placed = form.at(expressions := places(form))
    if not any(placed.integral(auxiliary) is not None for auxiliary in islice(placed.choices(), MOST_CHOICES)):
        placed = form.at(expressions := {symbol: symbol for symbol in z})
    for auxiliary in islice(placed.choices(), MOST_CHOICES):
        integral = placed.integral(auxiliary)
        if integral is None:
            refused.append(auxiliary)
            continue
        rest = [i for i in range(n) if i not in auxiliary]
        theta = tuple(
            sympy.expand(placed.theta[i] - integral.diff(z[i])) if integral else placed.theta[i] for i in rest
        )
        candidates.append((int(sympy.count_ops(theta)), auxiliary, integral, theta))
        if integral == 0:
            break
    if not candidates:
        raise SystemDefinitionError(_refusal(form, refused))
    _, auxiliary, integral, theta = min(candidates, key=lambda candidate: candidate[:2])
    integral = integral.xreplace(expressions)
    rest = [i for i in range(n) if i not in auxiliary]
    theta = tuple(
        expressions[z[i]].diff(z[i]) * component.xreplace(expressions) if integral else form.theta[i]
        for i, component in zip(rest, theta, strict=True)
    )
    y = tuple(z[i] for i in auxiliary)
    order = sorted(range(len(y)), key=lambda k: theta.index(y[k])) if set(theta) == set(y) else range(len(y))
    return {
        "coordinates": tuple(z[i] for i in rest),
        "momenta": tuple(y[k] for k in order),
        "hamiltonian": form.hamiltonian + integral.diff(form.time),
        "variables": z,
        "one_form": theta,
        "integrated": integral,
    }


def shear(form: OneForm) -> tuple[Symbol, Expr, tuple[str, ...], Expr] | None:
    """Return s, g and half of the variables between which omega vanishes if s - g(z) is put in the place of s.

    The fourth value is omega(s, u): the shear is valid where it is not 0.
    This replaces omega(k, u) by omega(k, u) - g_k omega(s, u), which is zero if g_k is the ratio of the two and does
    not depend on u and s: b_k / b_s of a guiding centre with the parallel velocity u.
    """
    z, v = form.coordinates, form.velocities
    cyclic_first = sorted(range(len(z)), key=lambda i: form.lagrangian.has(z[i]))
    for s, u, k in permutations(cyclic_first, 3) if len(z) <= MOST_SHEARED else ():
        pairs = tuple(sorted((s, u))), tuple(sorted((k, u)))
        ratio = sympy.S.Zero if form.vanishing.intersection(pairs) else form.omega(k, u) / form.omega(s, u)
        if ratio == 0 or not all(form.is_zero(ratio.diff(z[i])) for i in (s, u)):
            continue
        g = sympy.integrate(ratio.xreplace({z[u]: sympy.S.One, z[s]: sympy.S.One}), z[k], manual=True)
        if g.has(sympy.Integral, sympy.Piecewise):
            continue
        rate = v[s] - dot([g.diff(q) for q in z], v)
        sheared = replace(form, lagrangian=form.lagrangian.subs({z[s]: z[s] - g, v[s]: rate}, simultaneous=True))
        for auxiliary in sheared.choices():
            if sheared.integral(auxiliary) is not None:
                return z[s], g, tuple(z[i].name for i in auxiliary), form.omega(s, u)
    return None


def _refusal(form: OneForm, refused: Sequence[Sequence[int]]) -> str:
    """Return the message for a two-form without a suitable half of the coordinates, with a shear if one serves."""
    z, half = form.coordinates, len(form.coordinates) // 2
    start = f"the Lagrangian of '{form.name}' is linear in the velocities, theta . v - H. "
    if refused:
        sets = " or ".join("(" + ", ".join(z[j].name for j in auxiliary) + ")" for auxiliary in refused)
        return (
            f"{start}The two-form d theta vanishes between {sets}, but no integral of these components of theta was "
            "found in closed form. Subtract a time derivative from L by hand, so that the velocities of these "
            "coordinates no longer occur in it"
        )
    pairs = ", ".join(f"({z[i]}, {z[j]})" for i, j in sorted(form.vanishing))
    entries = {
        (z[i], z[j]): form.omega(i, j) for i, j in combinations(range(len(z)), 2) if (i, j) not in form.vanishing
    }
    shown = [
        f"omega{pair} = {format_expression(entry)}" for pair, entry in entries.items() if entry.count_ops() < MOST_SHOWN
    ]
    sheared = shear(form)
    remedy = "Use other coordinates, such as flux coordinates of a magnetic field, or canonical ones"
    if sheared:
        s, g, auxiliary, pivot = sheared
        remedy = (
            f"Put {format_expression(s - g)} in the place of {s}, and its time derivative in that of {s}_dot: then "
            f"omega vanishes between {' and '.join(auxiliary)}"
        )
        if pivot.free_symbols & {*z} and pivot.count_ops() < MOST_SHOWN:
            remedy += f". This is valid as long as {format_expression(pivot)} is not 0 along the trajectory"
    where = f"only between {pairs}" if pairs else "between no two coordinates"
    others = f": {', '.join(shown[:3])}" if shown else ""
    return (
        f"{start}{half} coordinates are required between which the two-form omega = d theta vanishes; it vanishes "
        f"{where}{others}. {remedy}"
    )


def translations(system: FirstOrderSystem) -> list[tuple[int, ...]]:
    """Return sets of coordinates whose common translation leaves L unchanged: single ones, and ``x1, x2, ..``."""
    force = [system.lagrangian.diff(q) for q in system.coordinates]
    form = OneForm(system.name, system.lagrangian, (*system.coordinates, *system.momenta), (), system.time)
    cyclic = [i for i, derivative in enumerate(force) if derivative == 0]
    groups: dict[str, list[int]] = {}
    for i, q in enumerate(system.coordinates):
        if i not in cyclic:
            groups.setdefault(q.name.rstrip("0123456789_"), []).append(i)
    common = [
        moved for moved in groups.values() if len(moved) > 1 and form.is_zero(sympy.Add(*(force[i] for i in moved)))
    ]
    return [*((i,) for i in cyclic), *map(tuple, common)]
