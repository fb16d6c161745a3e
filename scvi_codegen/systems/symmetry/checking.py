"""Verification of a user's symmetry, given by its direction or its generator, with a proof of failure if it is none.

The gauge function f(q, t) of a symmetry: the change of the Lagrangian along it is the time derivative df/dt.
A function of (q, v, t) is a total derivative f_t + f_q . v if and only if it is affine in v and its Euler-Lagrange
expression is zero (Olver, *Applications of Lie Groups to Differential Equations*, 2nd ed. 1993, theorem 4.7); f is
then its integral along straight lines from q = 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy
from sympy import Expr, Symbol
from sympy.integrals.manualintegrate import manualintegrate

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.common.precision import mp
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.systems.constraints import with_constraint_forces
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import (
    cancel,
    derivative_along,
    dot,
    evaluated,
    gradient,
    gradient_tuple,
    unsupported_part,
)
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.symmetry.invariants import combined, conserved, gauge_columns, polynomial_in
from scvi_codegen.systems.symmetry.sampling import VERIFIED_AT, Sample, rates_of
from scvi_codegen.systems.symmetry.symmetry import MAX_SEARCHED_COORDINATES, Symmetry
from scvi_codegen.systems.system import MechanicalSystem


def integrated(system: MechanicalSystem, change: Expr) -> Expr | None:
    """Return a candidate for f, to be verified; ``None`` if SymPy does not find the integrals."""
    rest = dict.fromkeys(system.velocities, sympy.S.Zero)
    derivatives = [change.diff(v).xreplace(rest) for v in system.velocities]
    s = Symbol("s", positive=True)
    along = {q: s * q for q in system.coordinates}
    work = dot(system.coordinates, [derivative.xreplace(along) for derivative in derivatives])
    origin = change.xreplace(rest | dict.fromkeys(system.coordinates, sympy.S.Zero))
    signed = {x: sympy.Dummy(positive=True) for x in (*system.coordinates, *system.parameters)}
    primitive = manualintegrate(sympy.expand(work.xreplace(signed)), s)
    parts = ((primitive.subs(s, 1) - primitive.subs(s, 0)), manualintegrate(sympy.expand(origin), system.time))
    total = sympy.expand(sympy.Add(*parts)).xreplace({dummy: x for x, dummy in signed.items()})
    return None if unsupported_part(total) else total


def is_total_derivative(system: MechanicalSystem, change: Expr, points: Iterable[Sample]) -> bool | None:
    """Return whether such an f exists, tested in 60 digits at these points; ``None`` if there is no point."""
    q, v, t = system.coordinates, system.velocities, system.time
    derivatives = [change.diff(velocity) for velocity in v]
    conditions = [derivative.diff(velocity) for derivative in derivatives for velocity in v]
    for derivative, position in zip(derivatives, q, strict=True):
        conditions.append(derivative_along(derivative, (*q, t), (*v, sympy.S.One)) - change.diff(position))
    decided = None
    for sample in points:
        decided = True
        for condition in conditions:
            if not cancel([sample.value(term) for term in sympy.Add.make_args(condition)]):
                return False
    return decided


MAX_SHOWN_LENGTH = 300


@checks_arguments(system=MechanicalSystem.KIND)
def check_symmetry(
    system: MechanicalSystem,
    direction: Sequence[Expr | str] | None = None,
    *,
    gauge: Expr | str | None = None,
    generator: Expr | str | None = None,
    name: str = "symmetry",
) -> Symmetry:
    """Return the symmetry with the user's direction or generator, of any form, after verifying it.

    Args:
        system: the mechanical system.
        direction: xi, m expressions in coordinates, time and parameters, as SymPy or as text.
        generator: in place of a direction G(q, p, t), which moves q by G_p and p by -G_q; it is conserved if
            {G, H} + G_t = 0. Momenta of a Lagrangian are ``p_`` and the coordinate.
        gauge: f with L_q . xi + L_v . dxi/dt = df/dt; by default it is searched among those quadratic in q and, for a
            Lagrangian, integrated.
        name: name of the conserved quantity.

    Raises:
        SystemDefinitionError: with the change of L, if it is not the time derivative of f, or if that is undecided;
            with the rate of a generator that is not conserved; naming the symbol, if one is unknown.

    >>> from scvi_codegen.interfaces.models.problems import problem
    >>> print(check_symmetry(problem("kepler").system, ["-q2", "q1"]))
    symmetry = q1*p_q2 - q2*p_q1
    """
    if generator is not None:
        if direction is not None or gauge is not None:
            raise SystemDefinitionError(
                "give check_symmetry either a direction, optionally with its gauge, or a generator"
            )
        return _generated(system, _expression(system, generator, "generator"), name)
    if direction is None:
        raise SystemDefinitionError("check_symmetry requires a direction or a generator")
    if isinstance(direction, str) or len(direction) != system.dimension:
        names = ", ".join(q.name for q in system.coordinates)
        raise SystemDefinitionError(f"direction must have {system.dimension} components, one for each of {names}")
    xi = tuple(_expression(system, component) for component in direction)
    f = None if gauge is None else _expression(system, gauge, "gauge")
    p, q, t = system.momentum_symbols, system.coordinates, system.time
    product = dot(p, xi) - (f or 0)
    quadratic = system.dimension <= MAX_SEARCHED_COORDINATES
    gauges = list(gauge_columns(system.dimension, quadratic=quadratic)) if f is None else []
    rows = [row for row in conserved(system, rates_of(system), [product, *gauges]) if 0 in row]
    if not rows and f is None and not system.auxiliaries:
        f = _integrated_gauge(system, xi)
        product, gauges, rows = product - f, [], [{0: sympy.S.One}]
    if not rows:
        raise SystemDefinitionError(_defect(system, xi, f))
    terms = combined({c: x / rows[0][0] for c, x in rows[0].items() if c}, [product, *gauges])
    added = polynomial_in(system, terms)
    return Symmetry(
        name=name,
        coordinates=q,
        momenta=p,
        time=t,
        direction=xi,
        gauge=(f or sympy.S.Zero) - added,
        momentum_map=product + added,
    )


def _generated(system: MechanicalSystem, G: Expr, name: str) -> Symmetry:
    """Return the symmetry of a generator G: {G, H} + G_t = 0, direction G_p, gauge p . G_p - G."""
    motion = rates_of(system)
    q, p, t = system.coordinates, system.momentum_symbols, system.time
    if not conserved(system, motion, [G]):
        velocities = motion.transformed if motion.hamiltonian else motion.arguments[len(q) : 2 * len(q)]
        moved = (*velocities, *motion.forces, sympy.S.One)
        rate = derivative_along(G, (*q, *p, t), moved)
        rate = rate if motion.hamiltonian else rate.xreplace(dict(zip(p, motion.transformed, strict=True)))
        raise SystemDefinitionError(
            f"{G} does not generate a symmetry of '{system.name}': its rate of change, {{G, H}} + "
            f"G_t, is {_cut(rate)}, not 0"
        )
    direction = gradient_tuple(G, p)
    gauge = dot(p, direction) - G
    return Symmetry(name=name, coordinates=q, momenta=p, time=t, direction=direction, gauge=gauge, momentum_map=G)


def _integrated_gauge(system: MechanicalSystem, xi: Sequence[Expr]) -> Expr:
    """Return the gauge f of a direction, for f that are not quadratic."""
    change, motion = _change(system, xi), rates_of(system)
    f = integrated(system, change)
    if f is not None:
        product = dot(system.momentum_symbols, xi) - f
        if conserved(system, motion, [product]):
            return f
    parameters = {x: mp.mpf(value) for x, value in motion.constants.items()}
    if is_total_derivative(system, change, motion.points(parameters, VERIFIED_AT)) is False:
        raise SystemDefinitionError(_defect(system, xi, None))
    raise SystemDefinitionError(
        f"it is undecided whether ({', '.join(map(str, xi))}) is a symmetry of '{system.name}': along "
        f"it L changes by {_cut(change)}, whose gauge f was not found. Give f as gauge"
    )


def _expression(system: MechanicalSystem, value: Expr | str, role: str = "component of a direction") -> Expr:
    """Return a function of coordinates, time and parameters (generators: also momenta) from text or SymPy."""
    generates = role == "generator"
    momenta = system.momentum_symbols if generates else ()
    symbols = {x.name: x for x in (*system.coordinates, *momenta, system.time, *system.parameters)}
    if isinstance(value, str):
        return parse_expression(value, symbols)
    expression = sympy.sympify(value) if isinstance(value, int | float) else value
    if not isinstance(expression, Expr):
        raise SystemDefinitionError(f"a {role} must be text or a SymPy expression, not {value!r}")
    unknown = sorted(free.name for free in expression.free_symbols if free.name not in symbols)
    if unknown:
        kinds = "coordinate, momentum, time or parameter" if generates else "coordinate, time or parameter"
        rest = "" if generates else " Directions and gauges depend on nothing else; a generator may on momenta"
        raise SystemDefinitionError(
            f"'{unknown[0]}' is not a {kinds} of '{system.name}'{closest(unknown[0], symbols)}{rest}"
        )
    expression = evaluated(expression, {free: symbols[free.name] for free in expression.free_symbols})
    problem = unsupported_part(expression)
    if problem:
        raise SystemDefinitionError(f"in a {role}: {problem}")
    return expression


def _defect(system: MechanicalSystem, xi: Sequence[Expr], f: Expr | None) -> str:
    """Return the message with the change of L along a direction that is no symmetry."""
    change, phrase = _change(system, xi), "along it L changes by"
    if f is None:
        searched = "a polynomial f quadratic in q; any other f can be given as gauge"
        reason = f"not the time derivative of {searched if system.auxiliaries else 'any f(q, t)'}"
    else:
        change, phrase = (
            change - _rate(system, f),
            "the change of L is not the derivative of the gauge but differs by",
        )
        reason = "not 0"
    return f"({', '.join(map(str, xi))}) is not a symmetry of '{system.name}': {phrase} {_cut(change)}, {reason}"


def _cut(change: Expr) -> str:
    text = str(change)
    return text if len(text) <= MAX_SHOWN_LENGTH else f"{text[:MAX_SHOWN_LENGTH]} ..."


def _change(system: MechanicalSystem, xi: Sequence[Expr]) -> Expr:
    """Return L_q . xi + L_v . dxi/dt plus the work of forces and multipliers; for a Hamiltonian the rate of p . xi."""
    p = system.auxiliaries or forms_of(system).legendre
    sign = -1 if system.auxiliaries else 1
    terms = [sign * derivative * xi[i] for i, derivative in gradient(system.formula, system.coordinates).items()]
    applied = system.forces or (sympy.S.Zero,) * system.dimension
    forces = with_constraint_forces(system, [f - system.damping * x for f, x in zip(applied, p, strict=True)])
    return sympy.Add(*terms, dot(forces, xi), dot(p, [_rate(system, component) for component in xi]))


def _rate(system: MechanicalSystem, f: Expr) -> Expr:
    """Return f_t + f_q . v, where v = H_p for a Hamiltonian."""
    v = forms_of(system).legendre if system.auxiliaries else system.velocities
    return derivative_along(f, (*system.coordinates, system.time), (*v, sympy.S.One))
