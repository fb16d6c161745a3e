"""Kinks that no step can follow, where the argument of a unit_step or rint is 0: jumps, corners, powers, velocities.

A jump of L across a surface u(q, t) = 0 changes the momentum there (Weierstrass-Erdmann condition), and a corner of a
constraint is an impact. Runs refract momenta at surfaces that they locate (``support/run/kinks.h``); else steps do
neither: they would pass such a surface without any error estimate. The force of
|u|**k with 1 < k < 2 in L is not Lipschitz continuous, so that a motion may not be unique; a kink in velocities makes
the Legendre transform multivalued.

Each surface is examined at points that Newton's method finds on it, in 60 digits: a function jumps if the difference of
its values on both sides does not vanish with their distance. So products that are continuous, as ``unit_step(x)*x**2``
and ``positive_part(x)``, are no jumps, and neither are surfaces of time alone: forces are then finite at all times. A
force is not Lipschitz continuous if its difference quotients on one side grow without bound towards the surface.
"""

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from itertools import islice

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.precision import Number, mp
from scvi_codegen.systems.formulas.expressions import ATTEMPTS, Tape, jacobian, kinks_of, parts_of_type, shortened
from scvi_codegen.systems.formulas.intermediates import parts
from scvi_codegen.systems.formulas.kinks import Mode, rint, switching_function, unit_step
from scvi_codegen.systems.formulas.tables import table_with_corners, without_tables

POINTS, ITERATIONS = 3, 40
"""Points of a surface that are examined, and iterations of Newton's method."""
MOST_SURFACES = 64
"""Largest number of surfaces of a function that are examined: those of arrays of known sizes are alike."""
APART = (mp.mpf(10) ** -16, mp.mpf(10) ** -24)
"""Distances of the two sides, relative to the coordinate."""
NEAR = (mp.mpf(10) ** -8, *APART)
"""Distances from a surface at which difference quotients are compared."""
BESIDE = mp.mpf(10) ** -3
"""Distance from an edge at which functions of both of its sides are compared: any but 0 would do."""
VANISHING = mp.mpf(10) ** -28
"""Size of a difference relative to the values, below which it is a rounding error."""


def irregularity(
    formula: Expr,
    subject: str,
    moving: Iterable[Symbol],
    velocities: Iterable[Symbol],
    constants: Mapping[Symbol, float],
    refracting: Iterable[Symbol] = (),
) -> str | None:
    """Return why L, or H without velocities, has a kink that no step follows; not jumps where u(refracting) = 0."""
    variables = list(moving)
    if kink := kink_in_velocities(formula, velocities):
        return velocity_message(subject, *kink)
    formula = without_tables(formula)
    steps = {switching_function(step.args[0])[0] for step in parts_of_type(unit_step, formula)}
    refracting = set(refracting)
    for surface, term in jumps_of(formula, variables, constants):
        if surface not in steps or not surface.free_symbols & set(variables) <= refracting:
            return jump_message(subject, surface, term)
    slope = unbounded_slope_of(formula, variables, constants)
    return slope_message(subject, *slope) if slope else None


def jumps_of(
    formula: Expr, moving: Iterable[Symbol], constants: Mapping[Symbol, float], *, first_derivatives: bool = False
) -> Iterator[tuple[Expr, Expr]]:
    """Yield functions u and a term of a formula that jumps where u is 0.

    Args:
        formula: function of the symbols of a state, time and parameters.
        moving: symbols that vary along a motion, without time.
        constants: values of the parameters; others are tried for those that are 0. Surfaces with the mode of a kink
            were examined without it.
        first_derivatives: whether jumps of first derivatives count as well, which are corners of the formula.
    """
    variables = set(moving)
    for surface, term, whole in _surfaces(formula, variables):
        functions = [whole]
        if first_derivatives:
            functions += jacobian([whole], sorted(whole.free_symbols & variables, key=str)).values()
        if any(_jumps(function, surface, variables, constants) for function in functions):
            yield surface, term


def corner_in(formula: Expr, subject: str, moving: Iterable[Symbol], constants: Mapping[Symbol, float]) -> str | None:
    """Return why a constraint has a corner or a jump, or infinite second derivatives at a kink; ``None`` if neither."""
    if table := table_with_corners(formula):
        return (
            f"{subject} contains {table}, a table whose slope jumps, so that the velocity would jump: give it a degree "
            'of 2 or more and outside="refuse" or "linear"'
        )
    formula = without_tables(formula)
    if corner := next(jumps_of(formula, moving, constants, first_derivatives=True), None):
        return corner_message(subject, *corner)
    slope = unbounded_slope_of(formula, moving, constants)
    return slope_message(subject, *slope) if slope else None


def unbounded_slope_of(
    formula: Expr, moving: Iterable[Symbol], constants: Mapping[Symbol, float]
) -> tuple[Expr, Expr] | None:
    """Return a function u and the term of a formula whose second derivatives grow without bound where u is 0.

    Arguments as of :func:`jump_of`; terms that are infinite where u is 0 are left out.
    """
    variables = set(moving)
    powers = [part for part in parts(formula) if part.is_Pow and not part.exp.is_Integer]
    roots = [*powers, *(part for part in parts(formula) if isinstance(part, sympy.log))]
    for surface, term, whole in _surfaces(formula, variables) if roots else ():
        if not whole.has(*roots):
            continue
        crossing = sorted(surface.free_symbols & variables, key=str)
        derivatives = jacobian([whole], crossing).values()
        if any(_steepens(whole, force, surface, variables, constants) for force in derivatives):
            return surface, term
    return None


def kink_in_velocities(formula: Expr, velocities: Iterable[Symbol]) -> tuple[Expr, Expr] | None:
    """Return a function u of velocities and a term of a formula that has a kink where u is 0; ``None`` without any."""
    surfaces = _surfaces(formula, set(velocities))
    return next(((surface, term) for surface, term, _ in surfaces), None)


def changes_with(whole: Expr, formula: Expr, moving: Set[Symbol], constants: Mapping[Symbol, float]) -> bool:
    """Return whether a formula is another function beyond a place where a whole number rint(x) in it changes.

    Both functions are analytic near it, unless other kinks are there, too: they are the same if they agree at points.
    """
    n = sympy.Dummy("n", real=True)
    near = formula.xreplace({whole: n})
    beyond = near.xreplace({n: n + 1}) - near
    edges = _tapes([near, beyond], whole.args[0] - n - sympy.S.Half, moving, {**constants, n: 1.0})
    for tape, point, k in islice(edges, POINTS) if n in near.free_symbols else ():
        with suppress(ArithmeticError):
            size, change = tape(_moved(point, k, BESIDE))
            if abs(change) > VANISHING * (1 + abs(size)):
                return True
    return False


def _surfaces(formula: Expr, moving: Set[Symbol]) -> Iterator[tuple[Expr, Expr, Expr]]:
    """Yield functions u of moving symbols, a term with a kink where u is 0, and the sum of the terms with symbols of u.

    At most ``MOST_SURFACES``. Surfaces with the mode of a kink were examined without it.
    """
    if not any(isinstance(part, unit_step | rint) for part in parts(formula)):  # faster than by terms that share parts
        return
    terms = sympy.Add.make_args(formula)
    steep = [term for term in terms if any(isinstance(part, unit_step | rint) for part in parts(term))]
    kinks = {term: kinks_of([term]) for term in steep}
    for surface in sorted(set().union(*kinks.values()), key=str)[:MOST_SURFACES]:
        if not surface.free_symbols & moving or any(isinstance(free, Mode) for free in surface.free_symbols):
            continue
        near = [term for term, surfaces in kinks.items() if surface in surfaces]
        rest = [term for term in kinks if term not in near and term.free_symbols & surface.free_symbols]
        yield surface, near[0], sympy.Add(*near, *rest)


def _jumps(function: Expr, surface: Expr, moving: Set[Symbol], constants: Mapping[Symbol, float]) -> bool:
    """Return whether a function jumps at one of some points of a surface."""
    examined = 0
    for tape, point, k in _tapes([function], surface, moving, constants):
        try:
            apart = [abs(_difference(tape, point, k, distance)) for distance in APART]
            size = abs(tape(_moved(point, k, APART[0]))[0])
        except ArithmeticError:  # outside the domain of the function
            continue
        if apart[1] > max(apart[0] / 2, VANISHING * (1 + size)):
            return True
        examined += 1
        if examined == POINTS:
            break
    return False


def _steepens(
    function: Expr, force: Expr, surface: Expr, moving: Set[Symbol], constants: Mapping[Symbol, float]
) -> bool:
    """Return whether at one of some points of a surface a function is bounded, but not quotients of its force."""
    for tape, point, k in islice(_tapes([function, force], surface, moving, constants), POINTS):
        for side in (1, -1):
            try:
                near = [tape(_moved(point, k, side * distance)) for distance in (*NEAR, *(2 * d for d in NEAR))]
            except ArithmeticError:  # outside the domain of the function
                continue
            values, forces = zip(*near, strict=True)
            quotients = [abs(forces[i + 3] - forces[i]) / NEAR[i] for i in (1, 2)]
            converges = abs(values[2] - values[1]) <= abs(values[1] - values[0]) * mp.mpf("0.95") + VANISHING
            if converges and quotients[1] > quotients[0] * mp.mpf("1.001") + VANISHING * (1 + abs(forces[2])):
                return True
    return False


def _tapes(
    functions: Sequence[Expr], surface: Expr, moving: Set[Symbol], constants: Mapping[Symbol, float]
) -> Iterator[tuple[Tape, list[Number], int]]:
    """Yield the tape of functions, points on a surface, and the coordinate that leads across it there."""
    symbols = sorted(functions[0].free_symbols | surface.free_symbols, key=str)
    free = [k for k, symbol in enumerate(symbols) if symbol in moving and symbol in surface.free_symbols]
    tape = Tape(functions, symbols)
    for point, k in _points(Tape([surface], symbols), symbols, free, constants, random.Random(20250101)):
        yield tape, point, k


def _points(
    surface: Tape,
    symbols: Sequence[Symbol],
    free: Sequence[int],
    constants: Mapping[Symbol, float],
    random_: random.Random,
) -> Iterator[tuple[list[Number], int]]:
    """Yield points on a surface, and the coordinate that leads across it there."""
    for _ in range(ATTEMPTS):
        scale = 10.0 ** random_.uniform(-1.0, 2.0)
        values = [constants.get(symbol) or scale * random_.uniform(-1.0, 1.0) for symbol in symbols]
        point, k = [mp.mpf(value) for value in values], random_.choice(free)
        try:
            for _ in range(ITERATIONS):
                value = surface(point)[0]
                distance = APART[1] * (1 + abs(point[k]))
                slope = (surface(_moved(point, k, APART[1]))[0] - value) / distance
                change = value / slope
                point[k] -= change
                if abs(change) <= APART[1] ** 2 * (1 + abs(point[k])):
                    yield point, k
                    break
        except ArithmeticError:
            continue


def _moved(point: Sequence[Number], k: int, distance: Number) -> list[Number]:
    """Return a point moved along a coordinate by a relative distance."""
    return [*point[:k], point[k] + distance * (1 + abs(point[k])), *point[k + 1 :]]


def _difference(function: Tape, point: Sequence[Number], k: int, distance: Number) -> Number:
    return function(_moved(point, k, distance))[0] - function(_moved(point, k, -distance))[0]


def jump_message(subject: str, surface: Expr, term: Expr) -> str:
    """Return the message for a term of a Lagrangian or Hamiltonian that jumps."""
    return (
        f"{subject} jumps where {shortened(surface)} = 0: its term {shortened(term)} is not continuous there, so the "
        "momentum jumps, too. This requires a surface of named coordinates that runs locate: compile_stepper(..) "
        "in double precision, without time transformation. Or write a continuous function, such as "
        "positive_part, put what jumps into forces, or use an event that changes the state (impact, then=)"
    )


def corner_message(subject: str, surface: Expr, term: Expr) -> str:
    """Return the message for a constraint that has a corner."""
    return (
        f"{subject} has a corner or a jump where {shortened(surface)} = 0, in its term {shortened(term)}: the velocity "
        "would jump there, which steps do not do. Constraints must have continuous first derivatives: write "
        "positive_part(..)**2 or a smooth function, or use an event with impact"
    )


def slope_message(subject: str, surface: Expr, term: Expr) -> str:
    """Return the message for a term of a Lagrangian or Hamiltonian whose force is not Lipschitz continuous."""
    return (
        f"the force of {subject} has no bounded slope where {shortened(surface)} = 0: there the second derivatives of "
        f"its term {shortened(term)} are infinite, and motions are not unique. Use powers of abs(..) and "
        "positive_part(..) that are 2 or more (outside of constraints also 1)"
    )


def velocity_message(subject: str, surface: Expr, term: Expr) -> str:
    """Return the message for a kink of a Lagrangian in velocities."""
    return (
        f"{subject} has a kink in velocities where {shortened(surface)} = 0, in its term {shortened(term)}: its "
        "momenta do not determine the velocities there. Put friction and drag, such as -c*v*abs(v), into forces or "
        "into dissipation (Rayleigh's function)"
    )
