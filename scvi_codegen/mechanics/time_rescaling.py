"""Time-rescaling functions g > 0 of a time transformation dt = g dtau, small where the motion is fast.

Each is a formula in the coordinates (for a Hamiltonian also in the momenta), derived from the system:

* ``"frequency"``: (sum_ij (M^-1 V_qq)_ij^2)^(-1/4), the time scale of the fastest vibration, r^(3/2) for Kepler's
  problem (constant factors, which would only rescale tau, are omitted). The first choice near 1/r singularities.
* ``"distance"``: (sum_pairs r^-3)^(-1/2) over the distances that occur in the potential: the same scale for bodies of
  similar masses, and a much shorter formula than the frequency for many of them.
* ``"potential"``: 1/(-V), for potentials that are negative everywhere.
* ``"arclength"``: (p^T M^-2 p + V_q^T V_q)^(-1/2), equal arc lengths in phase space; it contains momenta.

Sources: E. Hairer, Ch. Lubich, G. Wanner, *Geometric Numerical Integration*, VIII.2-3; V. Duruisseaux, J. Schmitt,
M. Leok, SIAM J. Sci. Comput. 43 (2021).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.derivatives import gradient, hessian
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.inputs import input_formulas
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.legendre import positive_parameters
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["TIME_RESCALINGS", "time_rescaling_function"]

MAX_SIMPLIFIED_OPERATIONS = 200
"""Maximum number of operations of a formula passed to ``simplify``, which takes about a second for so many."""


def time_rescaling_function(system: MechanicalSystem, g: str | Expr, *, in_time: bool = False) -> Expr:
    """Return the formula of a time-rescaling function, from its name, from text or from an expression.

    Args:
        system: the mechanical system.
        g: a name among ``TIME_RESCALINGS``, or a formula.
        in_time: whether it may also depend on time and on inputs.

    Raises:
        SystemDefinitionError: for a formula in other symbols, and a name that is not applicable to the system.
    """
    if isinstance(g, str) and g in TIME_RESCALINGS:
        return TIME_RESCALINGS[g](system)
    driven = input_formulas(system.inputs, system.time) if in_time else {}
    time = (system.time, *driven) if in_time else ()
    known = {symbol.name: symbol for symbol in (*system.coordinates, *system.auxiliaries, *system.parameters, *time)}
    if isinstance(g, Expr):
        formula = g.xreplace({free: known[free.name] for free in g.free_symbols if free.name in known})
    elif isinstance(g, str):
        formula = _read(g, known)
    else:
        raise SystemDefinitionError(f"time_transformation must be a name, text or a SymPy expression, not {g!r}")
    unknown = sorted(free.name for free in formula.free_symbols - set(known.values()))
    if unknown:
        kinds = "coordinates, momenta and parameters" if system.auxiliaries else "coordinates and parameters"
        raise SystemDefinitionError(
            f"the time transformation contains '{unknown[0]}': it may depend only on {kinds} of '{system.name}'"
        )
    if not formula.free_symbols & {*system.coordinates, *system.auxiliaries}:
        raise SystemDefinitionError(
            f"the time transformation {formula} is constant, so the step size would not adapt: "
            "use a formula in the coordinates"
        )
    return formula.xreplace(driven)


def _read(text: str, known: Mapping[str, Symbol]) -> Expr:
    try:
        return parse_expression(text, known)
    except SystemDefinitionError as error:
        if text.isidentifier():
            raise SystemDefinitionError(
                f"there is no time transformation '{text}'{closest(text, list(TIME_RESCALINGS))} "
                f"Use {', '.join(TIME_RESCALINGS)}, or a formula"
            ) from None
        raise error


def _potential_and_masses(system: MechanicalSystem, g: str) -> tuple[Expr, dict[int, Expr]]:
    """Return V(q) and the constant diagonal masses of T = sum m_i v_i^2 / 2."""
    motion = system.auxiliaries or system.velocities
    function = forms_of(system).energy
    rest = function.xreplace(dict.fromkeys(motion, sympy.S.Zero))
    derivatives = hessian(function, motion) if system.auxiliaries else forms_of(system).mass
    diagonal = {i: entry for (i, j), entry in derivatives.items() if i == j}
    constant = set(system.parameters)
    if len(diagonal) < len(derivatives) or any(not entry.free_symbols <= constant for entry in diagonal.values()):
        raise SystemDefinitionError(
            f"the time transformation '{g}' requires constant masses, one per coordinate, which "
            f"'{system.name}' does not have: use a formula in its coordinates"
        )
    return rest, {i: 1 / entry for i, entry in diagonal.items()} if system.auxiliaries else diagonal


def _frequency(system: MechanicalSystem) -> Expr:
    potential, masses = _potential_and_masses(system, "frequency")
    entries = hessian(potential, system.coordinates)
    if not entries:
        raise SystemDefinitionError(
            f"the forces of '{system.name}' do not depend on the position, so the time transformation 'frequency' "
            "is undefined: use a formula in its coordinates"
        )
    squares = sympy.Add(*((entry / masses[i]) ** 2 for (i, _), entry in entries.items()))
    if sympy.count_ops(squares) > MAX_SIMPLIFIED_OPERATIONS:
        return squares ** sympy.Rational(-1, 4)
    positive = positive_parameters(system)
    _, simplest = sympy.factor(sympy.simplify(squares.xreplace(positive))).as_coeff_Mul()
    root = simplest ** sympy.Rational(-1, 4)
    return sympy.powdenest(root, force=True).xreplace({stand_in: parameter for parameter, stand_in in positive.items()})


def _distance(system: MechanicalSystem) -> Expr:
    potential, _ = _potential_and_masses(system, "distance")
    squares = sorted(
        {
            power.base
            for power in potential.atoms(sympy.Pow)
            if isinstance(power.base, sympy.Add)
            and power.exp.is_negative
            and power.base.free_symbols & set(system.coordinates)
        },
        key=sympy.default_sort_key,
    )
    if not squares:
        raise SystemDefinitionError(
            f"the potential of '{system.name}' contains no distance in a denominator, so the time transformation "
            "'distance' is undefined: use a formula in its coordinates"
        )
    return sympy.Add(*(square ** sympy.Rational(-3, 2) for square in squares)) ** sympy.Rational(-1, 2)


def _potential(system: MechanicalSystem) -> Expr:
    potential, _ = _potential_and_masses(system, "potential")
    return 1 / (-potential)


def _arclength(system: MechanicalSystem) -> Expr:
    if not system.auxiliaries:
        raise SystemDefinitionError(
            "the time transformation 'arclength' contains momenta: use it with hamiltonian_of(system)"
        )
    function = forms_of(system).energy
    derivatives = gradient(function, (*system.coordinates, *system.auxiliaries)).values()
    return sympy.Add(*(derivative**2 for derivative in derivatives)) ** sympy.Rational(-1, 2)


TIME_RESCALINGS: Mapping[str, Callable[[MechanicalSystem], Expr]] = MappingProxyType(
    {"frequency": _frequency, "distance": _distance, "potential": _potential, "arclength": _arclength}
)
"""Built-in time-rescaling functions by name."""
