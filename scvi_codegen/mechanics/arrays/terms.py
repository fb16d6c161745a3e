"""Terms of array systems: masses, potentials, forces, and constraints.

Velocities occur as m v**2/2 with a constant m that may differ between elements. Constraints g(array entries at e,
parameters, t) = 0 hold for every element e of loops,

    m q'' = F + G^T lambda,        g(q, t) = 0,        G = g_q,        hidden constraint G v + g_t = 0

with a multiplier lambda for every element. Rods between nodes ``bonds[b, 0]`` and ``bonds[b, 1]`` of a net are
``sum(k in 3, (r[bonds[b, 0], k] - r[bonds[b, 1], k])**2) = l[b]**2 for b in B``. Each constraint contains few entries,
so G M^-1 G^T is sparse; its pattern is that of the net and is known when a run begins.
"""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar

import sympy
from sympy import Add, Expr, S, Symbol

from scvi_codegen.errors import SizesRequiredError, SystemDefinitionError
from scvi_codegen.formulas.array_statements import ArrayForce
from scvi_codegen.formulas.arrays import ArrayTerm, parse_array, parse_coordinate
from scvi_codegen.formulas.expressions import gradient, gradient_tuple, unsupported_part
from scvi_codegen.formulas.symbols import DOT, symbol
from scvi_codegen.indices import Access, Array, Size

Term = TypeVar("Term", ArrayTerm, ArrayForce)


@lru_cache(maxsize=256)
def force_of(term: ArrayTerm, state: tuple[Array, ...]) -> ArrayForce:
    """Return the derivatives of a term with respect to its entries of the state."""
    moving = entries_of(term, state)
    partials = gradient_tuple(term.formula, [slot for slot, _ in moving])
    targets = tuple((access, partial) for (_, access), partial in zip(moving, partials, strict=True))
    return ArrayForce(loops=term.loops, slots=term.slots, targets=targets)


def entries_of(term: ArrayTerm | ArrayForce, arrays: Collection[Array]) -> tuple[tuple[Symbol, Access], ...]:
    """Return the accesses of certain arrays in a term, with their symbols."""
    return tuple(pair for pair in term.slots if pair[1].array in arrays)


def friction(terms: Sequence[ArrayTerm], coordinates: Mapping[Array, Array]) -> tuple[ArrayForce, ...]:
    """Return the forces -dD/dv of Rayleigh's dissipation function; ``coordinates``: by the arrays of velocities."""
    forces = []
    for term in terms:
        force = force_of(term, tuple(coordinates))
        targets = tuple((replace(access, array=coordinates[access.array]), -rate) for access, rate in force.targets)
        if not targets:
            raise SystemDefinitionError(
                f"the dissipation {term} contains no velocity: Rayleigh's function defines the forces "
                "-dD/dq_dot. Add velocities, or remove it"
            )
        forces.append(replace(force, targets=targets))
    return tuple(forces)


def friction_of(mass: ArrayForce, rate: Expr) -> ArrayForce:
    """Return the force -rate m v of a mass."""
    ((access, m),) = mass.targets
    velocity = replace(access, array=Array(access.array.name + DOT, access.array.axes))
    v = symbol(str(velocity))
    return ArrayForce(loops=mass.loops, slots=(*mass.slots, (v, velocity)), targets=((access, -rate * m * v),))


def masses_of(term: ArrayTerm, velocities: Mapping[str, Array]) -> tuple[ArrayForce, ...]:
    """Return the mass contributions of a term, one per velocity."""
    known, masses, symbols = dict(term.slots), [], velocity_symbols(term, velocities)
    for v, derivative in zip(symbols, gradient_tuple(term.formula, symbols), strict=True):
        mass = derivative.diff(v)
        free = mass.free_symbols
        slots = tuple(pair for pair in term.slots if pair[0] in free)
        access = replace(known[v], array=velocities[known[v].array.name])
        masses.append(ArrayForce(loops=term.loops, slots=slots, targets=((access, mass),)))
    return tuple(masses)


def velocity_symbols(term: ArrayTerm, velocities: Mapping[str, Array]) -> tuple[Symbol, ...]:
    """Return the symbols of a term that denote velocities."""
    return tuple(slot for slot, access in term.slots if access.array.name in velocities)


@lru_cache(maxsize=256)
def has_constant_mass(term: ArrayTerm, coordinates: tuple[Array, ...], time: Symbol) -> bool:
    """Return whether velocities occur as m v**2/2 with a constant m."""
    velocities = {array.name + DOT: array for array in coordinates}
    varies = {slot for slot, access in term.slots if access.array.name in velocities or access.array in coordinates}
    slots, known = velocity_symbols(term, velocities), dict(term.slots)
    if any(known[v].sums for v in slots):
        return False
    for v, derivative in zip(slots, gradient_tuple(term.formula, slots), strict=True):
        mass = derivative.diff(v)
        if mass.free_symbols & (varies | {time}) or sympy.expand(derivative - mass * v) != 0:
            return False
    return True


def terms_at_rest(
    terms: Sequence[ArrayTerm], velocities: Mapping[str, Array], state: Sequence[Array], *, negative: bool, moving: bool
) -> tuple[ArrayTerm, ...]:
    """Return the non-zero terms at zero velocity that depend on the state, or those that do not.

    Args:
        terms: of a Lagrangian or a Hamiltonian.
        velocities: the array of coordinates by the name of its velocities.
        state: coordinates and momenta.
        negative: whether to change the signs, as for -H.
        moving: whether to return the terms that depend on the state.
    """
    results = []
    for term in terms:
        at_rest = term.formula.xreplace(dict.fromkeys(velocity_symbols(term, velocities), S.Zero))
        free = at_rest.free_symbols
        slots = tuple(pair for pair in term.slots if pair[0] in free)
        if at_rest and moving == any(access.array in state for _, access in slots):
            results.append(replace(term, formula=-at_rest if negative else at_rest, slots=slots))
    return tuple(results)


def constraint_text(term: ArrayTerm) -> str:
    """Return the constraint as text."""
    return f"{term.formula} = 0" + (f" for {', '.join(map(str, _named(term)))}" if term.loops else "")


def _named(term: ArrayTerm) -> Iterator[object]:
    behind = {loop.behind for loop in term.loops}
    return (loop for loop in term.loops if loop.index not in behind)


def check_constraint(term: ArrayTerm, coordinates: Sequence[Array], fields: Sequence[Array], inputs: str) -> None:
    """Raise :class:`SystemDefinitionError` unless a constraint contains coordinates, and neither velocities nor inputs.

    Args:
        term: the constraint.
        coordinates, fields: arrays that it may contain.
        inputs: regular expression that matches the symbols of inputs.
    """
    shown = constraint_text(term)
    if problem := unsupported_part(term.formula):
        raise SystemDefinitionError(f"in the constraint '{shown}': {problem}")
    if moving := {access.array for _, access in term.slots} - {*coordinates, *fields}:
        name = min(array.name for array in moving)
        raise SizesRequiredError(
            f"the constraint '{shown}' contains the velocity {name}: constraints of array systems "
            "must be holonomic (coordinates and time only)"
        )
    if any(access.sums for _, access in term.slots):
        raise SizesRequiredError(f"the constraint '{shown}' contains a convolution")
    if not entries_of(term, coordinates):
        raise SystemDefinitionError(
            f"the constraint '{shown}' contains no coordinate: remove it, or write the condition in terms "
            "of the coordinates"
        )
    if inputs and any(re.fullmatch(inputs, each.name) for each in term.formula.free_symbols):
        raise SystemDefinitionError(
            f"the constraint '{shown}' depends on an input, which may be discontinuous: use a "
            "parameter or a formula in t instead"
        )


def constraint_gradient(term: ArrayTerm, coordinates: Sequence[Array], time: Symbol) -> tuple[Expr, ...]:
    """Return the row of G of one element, by its coordinates, followed by g_t."""
    return gradient_tuple(term.formula, [*(slot for slot, _ in entries_of(term, coordinates)), time])


def constraint_second_rate(
    term: ArrayTerm, coordinates: Sequence[Array], time: Symbol, velocities: Sequence[Symbol]
) -> Expr:
    """Return d^2 g / dt^2 at zero acceleration: v^T g_qq v + 2 g_qt v + g_tt."""
    variables = [*(slot for slot, _ in entries_of(term, coordinates)), time]
    rates = [*velocities, S.One]
    rate = Add(*(derivative * rates[k] for k, derivative in gradient(term.formula, variables).items()))
    return Add(*(derivative * rates[k] for k, derivative in gradient(rate, variables).items()))


def substituted(term: Term, rule: Mapping[Any, Expr]) -> Term:
    """Return a term, or forces, with expressions substituted by ``rule``."""
    if not rule:
        return term
    if isinstance(term, ArrayForce):
        return replace(term, targets=tuple((access, formula.xreplace(rule)) for access, formula in term.targets))
    return replace(term, formula=term.formula.xreplace(rule))


def table_of(text: str) -> Array:
    """Parse the declaration of an index table; one with a single axis gets one column."""
    array = parse_array(text)
    return array if len(array.axes) > 1 else replace(array, axes=(*array.axes, Size("", 1)))


def momenta_of(
    coordinates: Sequence[Array], names: Sequence[str] | None, lagrangian: str | None, hamiltonian: str | None
) -> tuple[Array, ...]:
    """Return the arrays of momenta of a Hamiltonian; none for a Lagrangian."""
    if (lagrangian is None) == (hamiltonian is None):
        raise SystemDefinitionError("give exactly one of lagrangian and hamiltonian")
    if hamiltonian is None:
        if names is not None:
            raise SystemDefinitionError(
                "momenta were given for a Lagrangian, which has velocities, q_dot[i]: leave them out, or "
                "give a hamiltonian"
            )
        return ()
    if names is None:
        return tuple(Array(f"p_{array.name}", array.axes) for array in coordinates)
    arrays = tuple(map(parse_coordinate, names))
    if [array.axes for array in arrays] != [array.axes for array in coordinates]:
        shown = ", ".join(map(str, coordinates))
        raise SystemDefinitionError(
            f"momenta must be arrays with the axes of the coordinates, {shown}, not {', '.join(names)}"
        )
    return arrays
