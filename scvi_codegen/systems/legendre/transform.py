"""Symbolic Legendre transforms between Lagrangians and Hamiltonians (paper, section 1.1).

Quadratic forms are transformed by matrix inverses, other functions variable by variable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.precision import mp
from scvi_codegen.common.validation import TEXTS, checks_arguments, of
from scvi_codegen.systems.constraints import constraints_of, rate_of_positions
from scvi_codegen.systems.derived_expressions import coupled_blocks, forms_of, sample_points
from scvi_codegen.systems.formulas.expressions import dot, evaluate, gradient, gradient_tuple, hessian, unsupported_part
from scvi_codegen.systems.formulas.grammar import named_tables, parse_expression
from scvi_codegen.systems.formulas.symbols import default_momenta, input_formulas, symbol
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.of_rotations import hamiltonian_of_rotations
from scvi_codegen.systems.system import MechanicalSystem

LARGEST_INVERSE = 3
"""Largest number of coupled momenta (velocities) whose quadratic form is inverted symbolically."""
LONGEST_EXPANDED = 200
"""Operations of a matrix whose determinants are expanded; those of directions take minutes."""
NEGLIGIBLE = mp.mpf(10) ** -30


def legendre_dual(system: MechanicalSystem, variables: Sequence[Symbol], duals: Sequence[Symbol]) -> Expr:
    """Return the Legendre transform x . y - f(x), where y = df/dx is solved for x; f is the system's formula."""
    # f = f0 + b . x + x . C x / 2 has the transform (y - b) . C^-1 (y - b) / 2 - f0, block by block.
    f = system.formula
    hessian_entries = hessian(f, variables)
    origin = dict.fromkeys(variables, sympy.S.Zero)
    derivatives = gradient(f, variables)
    if all(not (entry.free_symbols & set(variables)) for entry in hessian_entries.values()):
        shifted = [y - derivatives[i].xreplace(origin) for i, y in enumerate(duals)]
        forms = [
            inverse_form(hessian_entries, block, shifted) for block in coupled_blocks(hessian_entries, len(variables))
        ]
        return sympy.Add(*forms, -f.xreplace(origin))
    solution = {x: _inverse_derivative(system, derivatives[i], x, duals[i], variables) for i, x in enumerate(variables)}
    still, moving = f.as_independent(*variables, as_Add=True)
    dual = sympy.Add(*(x * y for x, y in zip(solution.values(), duals, strict=True)), -moving.xreplace(solution))
    positive = positive_parameters(system)
    return (
        sympy.simplify(dual.xreplace(positive)).xreplace({dummy: parameter for parameter, dummy in positive.items()})
        - still
    )


def energy_of_states(system: MechanicalSystem) -> Expr:
    """Return the energy as a function of coordinates and ``momentum_symbols``."""
    forms, momenta = forms_of(system), system.momentum_symbols
    if system.auxiliaries:
        return forms.energy
    if forms.inverse_mass is None:
        return legendre_dual(system, system.velocities, momenta)
    velocities = forms.inverse_mass.velocities
    return dot(momenta, velocities) - system.lagrangian.xreplace(dict(zip(system.velocities, velocities, strict=True)))


def positive_parameters(system: MechanicalSystem) -> dict[Symbol, Symbol]:
    """Return positive dummies for the parameters with positive defaults, so that roots of their squares simplify."""
    return {
        parameter: sympy.Dummy(parameter.name, positive=True)
        for parameter, value in system.constants.items()
        if value > 0
    }


def inverse_form(hessian_entries: Mapping[tuple[int, int], Expr], block: Sequence[int], y: Sequence[Expr]) -> Expr:
    """Return y . C^-1 y / 2 over one block."""
    if len(block) == 1:
        (i,) = block
        return y[i] ** 2 / (2 * hessian_entries[i, i])
    if len(block) > LARGEST_INVERSE:
        raise SystemDefinitionError(
            f"the Legendre transform couples {len(block)} variables, more than are inverted "
            f"symbolically ({LARGEST_INVERSE}). Define the other function yourself, or use the system "
            "as it is"
        )
    size = len(block)
    entries = sympy.Matrix(size, size, lambda a, b: hessian_entries.get((block[a], block[b]), 0))
    long = sympy.count_ops(tuple(entries)) > LONGEST_EXPANDED
    matrix = sympy.Matrix(size, size, lambda a, b: sympy.Dummy(f"C_{a}{b}")) if long else entries
    adjugate, determinant = matrix.adjugate(), matrix.det(method="berkowitz")
    terms = [adjugate[a, b] * y[i] * y[j] for a, i in enumerate(block) for b, j in enumerate(block)]
    return (sympy.Add(*terms) / (2 * determinant)).xreplace(dict(zip(matrix, entries, strict=True)) if long else {})


def _inverse_derivative(
    system: MechanicalSystem, derivative: Expr, x: Symbol, y: Symbol, variables: Sequence[Symbol]
) -> Expr:
    """Return the x with y = L_v(x), whose branch is checked at random points near the default parameters."""
    if derivative.free_symbols & (set(variables) - {x}):
        raise SystemDefinitionError(
            f"the Legendre transform of '{system.name}' requires the solution of coupled nonlinear "
            "equations. Define the other function yourself, or use the system as it is"
        )
    positive = positive_parameters(system)
    back = {dummy: symbol for symbol, dummy in positive.items()}
    for root in _roots(derivative.xreplace(positive) - y, x):
        solution = root.xreplace(back)
        if unsupported_part(solution) is None and _is_inverse(system, solution, derivative, x, y):
            return solution
    raise SystemDefinitionError(
        f"SymPy does not solve {y} = {derivative} for {x}, as the Legendre transform requires: define the "
        "other function yourself"
    )


def _roots(expression: Expr, x: Symbol) -> list[Expr]:
    """Return unchecked solutions of SymPy, without the formulas of Cardano and Ferrari, which take minutes."""
    try:
        return list(sympy.solve(expression, x, check=False, simplify=False, cubics=False, quartics=False))
    except (NotImplementedError, ArithmeticError, AttributeError, TypeError, ValueError, RecursionError):
        return []


def _is_inverse(system: MechanicalSystem, root: Expr, derivative: Expr, x: Symbol, y: Symbol) -> bool:
    """Return whether x = root(y) at y = derivative(x), at all random points where both are defined."""
    tried = 0
    for point in sample_points([x], (*system.coordinates, system.time), system.constants):
        try:
            value = evaluate(derivative, point)
            again = evaluate(root, point | {y: value})
        except ArithmeticError:
            continue
        tried += 1
        if abs(again - point[x]) > NEGLIGIBLE * (1 + abs(point[x])):
            return False
    return tried > 0


@checks_arguments(system=of("a LagrangianSystem", LagrangianSystem))
def hamiltonian_of(system: LagrangianSystem, *, momenta: Sequence[str] | None = None) -> HamiltonianSystem:
    """Return the Hamiltonian p . v - L of a Lagrangian, with v eliminated by p = dL/dv (paper, section 1.1).

    Args:
        system: the Lagrangian.
        momenta: names of the momenta; by default ``p_`` before the name of the coordinate.

    Raises:
        SystemDefinitionError: if SymPy finds no closed-form solution of p = dL/dv.

    The Hamiltonian of rotations with constant inertia has no energy of the length of the quaternion, and keeps them.

    >>> oscillator = LagrangianSystem.from_text(
    ...     name="oscillator", coordinates=["x"], lagrangian="m*x_dot**2/2 - k*x**2/2", parameters={"m": 1, "k": 2})
    >>> hamiltonian_of(oscillator).hamiltonian
    k*x**2/2 + p_x**2/(2*m)
    """
    if system.constrained_at_nodes:
        raise SystemDefinitionError(
            f"'{system.name}' has constraints or contacts, which are supported for Lagrangians only: keep the "
            "Lagrangian, or convert it without constraints"
        )
    if system.rotations and momenta is None and system.clock is None and (singular := hamiltonian_of_rotations(system)):
        return singular
    names = default_momenta([q.name for q in system.coordinates]) if momenta is None else tuple(momenta)
    if len(names) != system.dimension:
        raise SystemDefinitionError(
            f"there are {system.dimension} coordinates, but {len(names)} momenta: list one momentum per coordinate"
        )
    symbols = tuple(symbol(name) for name in names)
    hamiltonian = legendre_dual(system, system.velocities, symbols)
    velocities = dict(zip(system.velocities, gradient_tuple(hamiltonian, symbols), strict=True))
    return HamiltonianSystem(
        **system._common_fields,
        momenta=symbols,
        hamiltonian=hamiltonian,
        clock=system.clock,
        forces=tuple(f.xreplace(velocities) for f in system.forces),
    )


@checks_arguments(system=of("a HamiltonianSystem", HamiltonianSystem), constraints=TEXTS)
def lagrangian_of(system: HamiltonianSystem, *, constraints: Sequence[str] = ()) -> LagrangianSystem:
    """Return the Lagrangian p . v - H of a Hamiltonian, with p eliminated by v = dH/dp (paper, section 1.1).

    Args:
        system: the Hamiltonian.
        constraints: as of :meth:`LagrangianSystem.from_text`; they add G^T lambda to p' = -H_q. Momenta are those of
            the Hamiltonian.

    Raises:
        SystemDefinitionError: if d2H/dp2 is singular, or SymPy finds no closed-form solution of v = dH/dp.
    """
    lagrangian = _lagrangian_of(system)
    if not constraints:
        return lagrangian
    symbols = {x.name: x for x in (*system.coordinates, *lagrangian.velocities, system.time, *system.parameters)}
    symbols |= {name: symbol(name) for name in system.inputs} | named_tables(system.functions)
    driven = input_formulas(system.inputs, system.time)
    expressions = constraints_of(
        constraints,
        lambda g: parse_expression(g, symbols).xreplace(driven),
        lambda g: rate_of_positions(g, system.coordinates, system.time),
    )
    return replace(lagrangian, constraints=expressions)


@lru_cache(maxsize=64)
def _lagrangian_of(system: HamiltonianSystem) -> LagrangianSystem:
    if system.rotations:
        named = ", ".join(f"'{rotation.name}'" for rotation in system.rotations)
        raise SystemDefinitionError(
            f"'{system.name}' has rotations or spins ({named}), and its Hamiltonian is singular in their momenta: "
            "write the Lagrangian with rotations=.., or use the Hamiltonian"
        )
    if not system.is_regular:
        raise SystemDefinitionError(
            f"'{system.name}' has no Lagrangian: d2H/dp2 is singular, so velocities do not determine "
            "momenta. Use the Hamiltonian"
        )
    if system.clock and system.clock.rate.free_symbols & set(system.momenta):
        raise SystemDefinitionError(
            f"the time transformation of '{system.name}' depends on momenta, which is not supported for a "
            "Lagrangian: use the Hamiltonian, or a formula in coordinates only"
        )
    lagrangian = legendre_dual(system, system.momenta, system.velocities)
    momenta = dict(zip(system.momenta, gradient_tuple(lagrangian, system.velocities), strict=True))
    return LagrangianSystem(
        **system._common_fields,
        lagrangian=lagrangian,
        clock=system.clock,
        forces=tuple(f.xreplace(momenta) for f in system.forces),
    )


@lru_cache(maxsize=64)
def equivalent_lagrangian(system: MechanicalSystem) -> LagrangianSystem | None:
    """Return an equivalent Lagrangian system, possibly ``system`` itself; ``None`` if none is found."""
    if not isinstance(system, HamiltonianSystem) or forms_of(system).one_form:
        return system if isinstance(system, LagrangianSystem) else None
    try:
        return _lagrangian_of(system)
    except SystemDefinitionError:
        return None
