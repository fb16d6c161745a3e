"""Checks of system definitions: errors for invalid ones, warnings for those that are probably mistakes."""

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from functools import reduce
from typing import TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning, closest, warn
from scvi_codegen.common.precision import Number, mp
from scvi_codegen.common.tangent_space import TangentSpace, tangent_space, unit_rows
from scvi_codegen.systems.checks.continuity import corner_in, irregularity
from scvi_codegen.systems.constraints import (
    constraint_jacobian,
    constraint_rates,
    forms_of_constraints,
    without_coordinate,
)
from scvi_codegen.systems.derived_expressions import (
    Entries,
    dense,
    forms_of,
    null_direction,
    sample_points,
    singular_part,
    values_at,
)
from scvi_codegen.systems.forces import check_damping
from scvi_codegen.systems.formulas.expressions import Tape, gradient, hessian, jacobian, unsupported_part
from scvi_codegen.systems.formulas.intermediates import symbols_of
from scvi_codegen.systems.formulas.kinks import Mode
from scvi_codegen.systems.formulas.symbols import DOT, PARTS, TIME, check_names, number, symbol
from scvi_codegen.systems.system import MechanicalSystem

REQUIRED = "A regular Lagrangian is required: d2L/dv2 must be invertible."
REDUNDANT = (
    "Add the missing kinetic energy, or use fewer coordinates: as many as there are independent motions with inertia"
)
SAMPLES = 16
"""Number of random positive values of the parameters at which a negative coefficient is evaluated again."""
MOST_PRODUCTS = 100 * 101 // 2
"""Products of velocities of a chain of 100 angles, whose stepper takes 37 s of a processor, and 146,000 operations."""


def warn_of_mistakes(system: MechanicalSystem, others: Iterable[Expr] = ()) -> bool:
    """Warn of parameters and inputs that occur in no formula of a system, and of negative masses; true if any.

    A mass is a diagonal entry of d2L/dv2, or of d2H/dp2. Entries that depend on coordinates or time are not examined.
    ``others`` are formulas that use parameters of the system, too.
    """
    if not system.parameters:
        return False
    formulas = (*others, system.lagrangian, *system.forces, *system.constraints, system.damping, *system.integrands)
    energy = [system.clock.energy] if system.clock else []
    function, variables = (
        ("Hamiltonian", system.auxiliaries) if system.auxiliaries else ("Lagrangian", system.velocities)
    )
    used = set[Symbol](energy).union(*(formula.free_symbols for formula in formulas))
    unused = warn_of_unused(system.name, function, system.parameters, system.inputs, used)
    entries = {} if system.is_first_order else hessian(system.in_time.formula, variables)
    masses = {f"d2{function[0]}/d{v}2": entries[i, i] for i, v in enumerate(variables) if (i, i) in entries}
    return warn_of_negative(system.name, masses, system.constants) or unused


def warn_of_unused(
    name: str, function: str, parameters: Iterable[Symbol], inputs: Iterable[str], used: Set[Symbol]
) -> bool:
    """Warn of parameters and inputs of the system ``name`` that are not among the symbols ``used``; true if any."""
    parts = {input_name: {symbol(f"{input_name}_{part}") for part in PARTS} for input_name in inputs}
    kinds = [f"input '{input_name}'" for input_name, symbols in parts.items() if not symbols & used]
    occurring = reduce(set.union, parts.values(), set[Symbol]())
    kinds += [f"parameter '{parameter}'" for parameter in parameters if parameter not in used | occurring]
    for kind in kinds:
        where = f"the {function}, the forces and the constraints of '{name}'"
        remedy = "remove it, unless events or a time transformation contain it; pass contacts that do to the system"
        warn(f"{kind} does not occur in {where}: {remedy}.", SystemDefinitionWarning)
    return bool(kinds)


def warn_of_negative(name: str, coefficients: Mapping[str, Expr], constants: Mapping[Symbol, float]) -> bool:
    """Warn of coefficients of the kinetic energy that are negative with the default parameters; true if any.

    No warning is given where a coefficient was negative for all positive values tried: the sign is then in the formula.
    """
    warned = False
    for coefficient, formula in coefficients.items():
        occurring = sorted(formula.free_symbols & constants.keys(), key=str)
        if not occurring or len(occurring) < len(formula.free_symbols):
            continue
        tape = Tape([formula], occurring)
        value = _value(tape, [constants[parameter] for parameter in occurring])
        if value is not None and value < 0 and any(sample >= 0 for sample in _positive_samples(tape, len(occurring))):
            defaults = ", ".join(f"{parameter} = {constants[parameter]:g}" for parameter in occurring)
            text = str(formula)
            shown = f"{coefficient} = {text}" if len(text) <= 60 else coefficient
            warn(
                f"{shown} of '{name}' is {float(value):g} with the default parameters ({defaults}): a negative mass. "
                "Check the signs of these parameters.",
                SystemDefinitionWarning,
            )
            warned = True
    return warned


def _positive_samples(tape: Tape, count: int) -> Iterator[Number]:
    """Yield the values of a formula at random positive values of its ``count`` symbols, always the same ones."""
    generator = random.Random(20250101)
    for _ in range(SAMPLES):
        value = _value(tape, [10.0 ** generator.uniform(-2, 2) for _ in range(count)])
        if value is not None:
            yield value


def _value(tape: Tape, numbers: Iterable[float]) -> Number | None:
    try:
        return tape([mp.mpf(number) for number in numbers])[0]
    except ArithmeticError:
        return None


def check_definition(system: MechanicalSystem, role: str, arguments: Sequence[Symbol], kinds: str) -> None:
    """Raise :class:`SystemDefinitionError` for invalid names, default values or symbols of the formulas."""
    if not isinstance(system.name, str) or not system.name.strip():
        raise SystemDefinitionError(f"the name of a system must be non-empty text, not {system.name!r}")
    if any("\ud800" <= character <= "\udfff" for character in system.name):
        raise SystemDefinitionError(
            f"the name {system.name!r} contains an unpaired surrogate, which cannot be encoded in UTF-8: remove it"
        )
    for variable in (*system.coordinates, *system.auxiliaries, system.time, *system.parameters):
        if not isinstance(variable, Mode) and variable != symbol(getattr(variable, "name", "")):
            raise SystemDefinitionError(
                f"{variable!r} is not a real symbol: build systems with from_sympy or from_text"
            )
    if system.time.name != TIME:
        raise SystemDefinitionError(f"time is called '{TIME}', not '{system.time}': build systems with from_sympy")
    coordinates, parameters, momenta = (
        [symbol.name for symbol in group] for group in (system.coordinates, system.parameters, system.auxiliaries)
    )
    check_names(coordinates, [*parameters, *system.inputs], momenta)
    if len(system.defaults) != len(system.parameters):
        raise SystemDefinitionError(
            f"there are {len(system.parameters)} parameters, but {len(system.defaults)} default "
            "values: give one value per parameter"
        )
    for parameter, value in system.constants.items():
        number(parameter.name, value)
    _check_symbols(system, role, arguments, kinds)


def _check_symbols(system: MechanicalSystem, role: str, arguments: Sequence[Symbol], kinds: str) -> None:
    """Raise an error for formulas outside the grammar, with unknown symbols, or with jumps."""
    if system.forces and len(system.forces) != system.dimension:
        raise SystemDefinitionError(
            f"there are {system.dimension} coordinates, but {len(system.forces)} forces: give one force per coordinate"
        )
    check_damping(system.name, system.damping, system.parameters)
    declared = [*system.coordinates, *arguments, system.time, *system.parameters]
    named = zip(system.coordinates, system.forces, strict=False)
    formulas = {role: system.formula, **{f"force on {q.name}": force for q, force in named}}
    formulas |= {"damping": system.damping}
    formulas |= {f"constraint {k}": g for k, g in enumerate(system.constraints, 1)}
    for where, formula in formulas.items():
        problem = unsupported_part(formula)
        if problem:
            raise SystemDefinitionError(f"in the {where} of '{system.name}': {problem}")
        unknown = sorted(free.name for free in formula.free_symbols.difference(declared))
        if unknown:
            hint = closest(unknown[0], [symbol.name for symbol in declared])
            raise SystemDefinitionError(
                f"'{unknown[0]}' in the {where} is neither a coordinate, {kinds}, time nor a parameter{hint} "
                "Give it a default value among the parameters, or list it as a coordinate"
            )
    _check_continuity(system, role, formulas, [*system.coordinates, *arguments])


def _check_continuity(
    system: MechanicalSystem, role: str, formulas: Mapping[str, Expr], moving: Sequence[Symbol]
) -> None:
    """Raise :class:`SystemDefinitionError` for kinks of L or H that no step follows, and for corners of constraints."""
    velocities = system.velocities if role == "Lagrangian" else ()
    subject, q = f"the {role} of '{system.name}'", system.coordinates
    if not system.lengths and (  # lists end at a cutoff
        problem := irregularity(formulas[role], subject, moving, velocities, system.constants, q)
    ):
        raise SystemDefinitionError(problem)
    for name, g in zip(system.constraint_texts if system.constraints else (), system.constraints, strict=True):
        if corner := corner_in(g, f"the constraint '{name}' of '{system.name}'", moving, system.constants):
            raise SystemDefinitionError(corner)


def checked_gauge(system: MechanicalSystem) -> Expr:
    """Return the energy of the rates of constraints that L needs for a regular mass matrix, 0 if its own is regular."""
    check_definition(system, "Lagrangian", system.velocities, "a velocity")
    if system.constraints:
        _check_constraints(system)
    elif forms_of(system).inverse_mass:
        return sympy.S.Zero
    _warn_of_products(system)
    singular = _singular_velocities(system, system.lagrangian)
    if singular is None:
        return sympy.S.Zero
    gauge, free = gauge_of_rates(system) if system.constraints else (sympy.S.Zero, ())
    if gauge == 0 or _singular_velocities(system, system.lagrangian + gauge):
        raise SystemDefinitionError(_singular_message(system, *singular, free))
    return gauge


def _warn_of_products(system: MechanicalSystem) -> None:
    """Warn of a mass matrix with so many entries that making a stepper takes minutes, before it is derived.

    Row i of the lower triangle has at most as many entries as dL/dv_i has velocities among v_0, .., v_i.
    """
    velocities = system.velocities
    if len(velocities) * (len(velocities) + 1) // 2 <= MOST_PRODUCTS:
        return
    momenta = gradient(system.lagrangian, velocities)
    count = sum(len(symbols_of(momentum).intersection(velocities[: i + 1])) for i, momentum in momenta.items())
    if count > MOST_PRODUCTS:
        warn(
            f"the kinetic energy of '{system.name}' couples {count:,} pairs of velocities, more than the "
            f"{MOST_PRODUCTS:,} of a chain of 100 angles: deriving and compiling it takes minutes. State bodies and "
            "joints in a robot file (from_mjcf, from_urdf), whose equations are derived body by body; arrays, q[N], "
            "whose loops are not written out; or positions with constraints, which couple neighbours only.",
            SystemDefinitionWarning,
        )


def _singular_velocities(system: MechanicalSystem, lagrangian: Expr) -> tuple[tuple[Symbol, ...], Entries] | None:
    """Return :func:`singular_part` of L, with an empty block for velocities that do not occur in it."""
    occurring = lagrangian.free_symbols
    if missing := tuple(velocity for velocity in system.velocities if velocity not in occurring):
        return missing, {}
    return singular_part(lagrangian, system.velocities, (*system.coordinates, system.time), system.constants)


def _singular_message(
    system: MechanicalSystem, velocities: Sequence[Symbol], block: Entries, free: Sequence[str]
) -> str:
    """Return the error message for velocities with a singular block of the mass matrix.

    ``free``: massless coordinates that the constraints do not determine.
    """
    names = ", ".join(velocity.name for velocity in velocities)
    if velocities and not block:
        return _degenerate_message(system, velocities, free)
    subject = f"the mass matrix d2L/dv2 of '{system.name}'"
    if not block:
        return (
            f"{subject} is singular: some velocities occur only in products with too few others. "
            f"{REQUIRED} Give each coordinate its own kinetic energy"
        )
    occurring = set[Symbol]().union(*(entry.free_symbols for entry in block.values()))
    used = {parameter: value for parameter, value in system.constants.items() if parameter in occurring}
    zero = " and ".join(parameter.name for parameter, value in used.items() if value == 0)
    values = " with the default parameters" if used else ""
    direction = null_direction(block, velocities)
    motion = f": a motion with ({direction}) has no kinetic energy" if direction else ""
    names_of_velocities = {velocity.name for velocity in velocities}
    for rotation in system.rotations:
        if not zero and names_of_velocities & {name + DOT for name in rotation.coordinates}:
            return (
                f"the inertia of the rotation '{rotation.name}' of '{system.name}' is singular{values}: turning about "
                "some axis has no kinetic energy. Give all three moments of inertia positive values, or declare the "
                "axis of a thin rod as a unit vector instead: directions=['n']"
            )
    remedy = f"{zero} = 0 is the default: give it a positive value" if zero else REDUNDANT
    remedy += _undetermined(free)
    return f"{subject} in {names} is singular at every sampled point{values}{motion}. {REQUIRED} {remedy}"


def _degenerate_message(system: MechanicalSystem, velocities: Sequence[Symbol], free: Sequence[str]) -> str:
    """Return the error message for coordinates whose velocities occur at most linearly in L."""
    names = [velocity.name[: -len(DOT)] for velocity in velocities]
    if not hessian(system.lagrangian, system.velocities):
        every = " and ".join(velocity.name for velocity in system.velocities)
        return (
            f"the Lagrangian of '{system.name}' is degenerate: it is at most linear in {every} (no kinetic energy). "
            f"{REQUIRED} Add the missing kinetic energy, such as m*{velocities[0]}**2/2"
        )
    occurs = velocities[0] in system.lagrangian.free_symbols
    how = "occurs only linearly in L" if occurs else "does not occur in the Lagrangian"
    derivative = sympy.expand(system.lagrangian.diff(symbol(names[0])))
    multiplies = derivative.has(*system.coordinates) and not derivative.has(symbol(names[0]), *system.velocities)
    hint = f"; if {names[0]} is a Lagrange multiplier, give constraints=['{system.text_of(derivative)}'] in its place"
    return (
        f"coordinate '{names[0]}' of '{system.name}' has no kinetic energy: velocity '{velocities[0]}' {how}. "
        f"{REQUIRED} Add the missing term, such as m*{velocities[0]}**2/2{hint if multiplies else ''}; if {names[0]} "
        "is a known function of time, make it an input or write the function out"
        f"{_undetermined(free)}"
    )


def _undetermined(free: Sequence[str]) -> str:
    """Return the remark of a message that constraints do not determine the velocities of massless coordinates."""
    return f". The constraints leave {', '.join(free)} free where all bodies with mass rest" if free else ""


def _check_constraints(system: MechanicalSystem) -> None:
    """Raise :class:`SystemDefinitionError` for constraints that are dependent or nonlinear in velocities."""
    names = system.constraint_texts
    for name, g in zip(names, system.constraints, strict=True):
        if g.free_symbols.isdisjoint((*system.coordinates, *system.velocities)):
            raise SystemDefinitionError(without_coordinate(f"{name} = 0"))
    for k, i in jacobian(list(constraint_jacobian(system).values()), system.velocities):
        name = names[list(constraint_jacobian(system))[k][0]]
        raise SystemDefinitionError(
            f"the constraint '{name}' is not linear in the velocity {system.velocities[i]}: "
            f"constraints must have the form {forms_of_constraints()}"
        )
    always = len(names) - len(system.reactions)
    if always > system.dimension:
        raise SystemDefinitionError(
            f"there are {always} constraints, but only {system.dimension} coordinates of '{system.name}': the "
            "mechanism is overconstrained. At most as many independent constraints as coordinates are required "
            "(as many prescribe the motion). Leave out redundant constraints"
        )
    if dependent := _dependent(system):
        raise SystemDefinitionError(
            f"the constraint '{names[dependent]}' is redundant: it depends on the constraints before it. Remove it"
        )


def _dependent(system: MechanicalSystem) -> int:
    """Return the index of the first constraint dependent on earlier ones at every sampled point, or 0.

    Constraints that are imposed in some modes only may be dependent.
    """
    count, first = len(system.constraints) - len(system.reactions), 0
    derivatives = {place: entry for place, entry in constraint_jacobian(system).items() if place[0] < count}
    points = sample_points(system.coordinates, (system.time,), system.constants)
    for values in values_at(points, list(derivatives.values())):
        matrix = dense(derivatives, values, (count, system.dimension))
        if tangent_space(matrix).rank == count:
            return 0
        first = max(first, next(k for k in range(count) if tangent_space(matrix[: k + 1]).rank <= k))
    return first


Array: TypeAlias = NDArray[np.float64]
SHARE = 1e-6
"""Smallest entry of a motion of length 1 by which a coordinate takes part in it, and smallest rate of a constraint that
hinders it."""


def gauge_of_rates(system: MechanicalSystem) -> tuple[Expr, tuple[str, ...]]:
    """Return U of the constraints that hinder massless motions, and the coordinates that move in the others.

    The sum of masses is that of the constant ones, if there are any. U is 0 without masses, and if the formulas have no
    value at any sampled point.
    """
    mass, jacobian = hessian(system.lagrangian, system.velocities), constraint_jacobian(system)
    rates = constraint_rates(system)
    diagonal = [entry for (i, j), entry in mass.items() if i == j]
    constant = [entry for entry in diagonal if entry.free_symbols <= set(system.parameters)]
    m = system.dimension
    points = sample_points(system.velocities, (*system.coordinates, system.time), system.constants)
    for values in values_at(points, [*mass.values(), *jacobian.values()]):
        motions = tangent_space(dense(mass, values[: len(mass)], (m, m))).basis
        hindered = unit_rows(dense(jacobian, values[len(mass) :], (len(rates), m))) @ motions
        used = [rate for rate, row in zip(rates, hindered, strict=True) if np.abs(row).max(initial=0.0) > SHARE]
        moving = np.abs(motions @ TangentSpace(hindered).basis).max(axis=1, initial=0.0) > SHARE
        free = tuple(q.name for q, moves in zip(system.coordinates, moving, strict=True) if moves)
        return sympy.Add(*(constant or diagonal)) / 2 * sympy.Add(*(rate**2 for rate in used)), free
    return sympy.S.Zero, ()
