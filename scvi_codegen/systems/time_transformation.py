"""Time transformations dt = g dtau: a fixed step size in fictitious time tau, a varying one in t.

With g > 0, Poincare's transformation K = g (H - E) of an autonomous Hamiltonian has the same orbits on the energy
surface K = 0, that is H = E, parametrised by tau, and its steps stay symplectic. If g depends on the coordinates only,
its Lagrangian is

    L^(q, q') = g(q) (L(q, q'/g(q)) + E),                                       p = dL^/dq' = dL/dv unchanged,

which is regular wherever L is. Every method and solver applies to it; E is a parameter, the energy of the initial
state. Time is the integral of g along the curve, computed by the method's own quadrature. Alternatively g may leave the
system unchanged and control the step sizes of its runs: see :mod:`scvi_codegen.methods.controllers`.

g is small where the motion is fast: a formula in the coordinates (for a Hamiltonian also in the momenta), or by name

* ``"frequency"``: (sum_ij (M^-1 V_qq)_ij^2)^(-1/4), the time scale of the fastest vibration, r^(3/2) for Kepler's
  problem (constant factors, which would only rescale tau, are omitted). The first choice near 1/r singularities.
* ``"distance"``: (sum_pairs r^-3)^(-1/2) over the distances that occur in the potential: the same scale for bodies of
  similar masses, and a much shorter formula than the frequency for many of them.
* ``"potential"``: 1/(-V), for potentials that are negative everywhere.
* ``"arclength"``: (p^T M^-2 p + V_q^T V_q)^(-1/2), equal arc lengths in phase space; it contains momenta.

Sources: S. Reich, SIAM J. Numer. Anal. 36 (1999); E. Hairer, Appl. Numer. Math. 25 (1997); E. Hairer, Ch. Lubich,
G. Wanner, *Geometric Numerical Integration*, VIII.2-3; V. Duruisseaux, J. Schmitt, M. Leok, SIAM J. Sci. Comput. 43
(2021), where the singular p_t direction of K = g (H + p_t) rules a Lagrangian out; with p_t = -E constant it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.array_statements import formula_of_entries, is_indexed, momentum_arrays
from scvi_codegen.systems.formulas.expressions import gradient, hessian
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.intermediates import without_abs
from scvi_codegen.systems.formulas.rotations import RotationNames
from scvi_codegen.systems.formulas.symbols import input_formulas, symbol
from scvi_codegen.systems.formulas.translation import format_expression
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import positive_parameters
from scvi_codegen.systems.system import MechanicalSystem, TimeTransformation

ENERGY_NAMES = ("E", "E_0", "energy", "initial_energy")
"""Candidate names of the energy parameter; the first that is unused is taken."""
REVERSIBLE = 'the reversible controller: compile_stepper(time_transformation=...), controller = "reversible" in [run]'


@checks_arguments(system=MechanicalSystem.KIND)
def reparametrise(system: MechanicalSystem, time_transformation: str | Expr) -> MechanicalSystem:
    """Return the system in a fictitious time tau with dt = g dtau; holonomic constraints are unchanged.

    Args:
        system: an autonomous Lagrangian or Hamiltonian system.
        time_transformation: g > 0, as text or expression in the coordinates (for a Hamiltonian also in the momenta), or
            ``"frequency"``, ``"distance"``, ``"potential"``, ``"arclength"``.

    Returns:
        A system of the same kind with one more parameter, the energy, and a ``clock``, the rate dt/dtau = g.

    Raises:
        SystemDefinitionError: if the system depends on time, has forces, damping or nonholonomic constraints, or is
            transformed already, and for an invalid ``time_transformation``.

    >>> kepler = LagrangianSystem.from_text(
    ...     name="Kepler", coordinates=["r", "phi"], lagrangian="(r_dot**2 + r**2*phi_dot**2)/2 + 1/r")
    >>> expected = LagrangianSystem.from_text(
    ...     name="expected", coordinates=["r", "phi"], parameters={"E": 0},
    ...     lagrangian="r_dot**2/(2*r) + r*phi_dot**2/2 + 1 + E*r")
    >>> sympy.simplify(reparametrise(kepler, "r").lagrangian - expected.lagrangian)
    0
    """
    _check_transformable(system)
    taken = {symbol.name for symbol in (*system.coordinates, *system.auxiliaries, *system.parameters)}
    energy_symbol = symbol(next(name for name in ENERGY_NAMES if name not in taken))
    rate = time_rescaling_function(system, time_transformation)
    named = replace(
        system,
        name=f"{system.name} in transformed time",
        parameters=(*system.parameters, energy_symbol),
        defaults=(*system.defaults, 0.0),
        clock=TimeTransformation(
            rate=rate,
            energy=energy_symbol,
            time_transformation=time_transformation
            if isinstance(time_transformation, str)
            else format_expression(rate),
            plain=system,
        ),
    )
    # g (H - E) in tau has the motions of H with energy E in t; g (L(q, v/g) + E) is its Lagrangian.
    if isinstance(named, HamiltonianSystem):
        return replace(named, hamiltonian=_distributed(rate, named.hamiltonian - energy_symbol))
    assert isinstance(named, LagrangianSystem)
    slowed = named.lagrangian.xreplace({v: v / rate for v in named.velocities})
    return replace(named, lagrangian=_distributed(rate, slowed + energy_symbol))


def _check_transformable(system: MechanicalSystem) -> None:
    """Raise an error for a system whose energy is not conserved, or whose steps in tau are not supported."""
    if system.clock is not None:
        raise SystemDefinitionError(
            f"'{system.name}' has a time transformation already, dt = {system.clock.rate} dtau: apply only one"
        )
    if system.depends_on_time:
        raise SystemDefinitionError(
            f"'{system.name}' depends on time, so its energy is not conserved, which the symplectic "
            f"time transformation requires. Use adaptive steps (t_end=...), or {REVERSIBLE}"
        )
    if system.forces or system.damping != 0:
        cause = "forces act" if system.forces else "damping acts"
        raise SystemDefinitionError(
            f"{cause} on '{system.name}', so its energy is not conserved, which the symplectic time "
            f"transformation requires. Use adaptive steps (t_end=...), or {REVERSIBLE}"
        )
    if system.is_rolling:
        raise SystemDefinitionError(
            f"'{system.name}' has nonholonomic constraints, which a symplectic time transformation "
            f"does not support. Use adaptive steps (t_end=...), or {REVERSIBLE}"
        )


def _distributed(factor: Expr, total: Expr) -> Expr:
    """Return factor * total with the factor multiplied into every term, so that its powers combine."""
    return sympy.Add(*(factor * term for term in sympy.Add.make_args(total)))


MAX_SIMPLIFIED_OPERATIONS = 200
"""Maximum number of operations of a formula passed to ``simplify``, which takes about a second for so many."""


def time_rescaling_function(system: MechanicalSystem, g: str | Expr, *, in_time: bool = False) -> Expr:
    """Return the formula of a time-rescaling function, from its name, from text or from an expression.

    ``in_time``: it may also depend on time and on inputs. SystemDefinitionError for other symbols and names.
    """
    if in_time and forms_of(system).one_form:
        raise SystemDefinitionError(
            f"the reversible controller is not available for the first-order system '{system.name}': use "
            "reparametrise(system, g), or adaptive steps (t_end without h)"
        )
    if isinstance(g, str) and g in TIME_RESCALINGS:
        return TIME_RESCALINGS[g](system)
    driven = {system.time: system.time, **input_formulas(system.inputs, system.time)} if in_time else {}
    symbols = {free.name: free for free in (*system.coordinates, *system.auxiliaries, *system.parameters, *driven)}
    names = RotationNames(system.rotations)
    readable = symbols | names.symbols
    if isinstance(g, Expr):
        formula = g.xreplace({free: readable[free.name] for free in g.free_symbols if free.name in readable})
    elif isinstance(g, str):
        formula = _read(system, g, readable)
    else:
        raise SystemDefinitionError(f"time_transformation must be a name, text or a SymPy expression, not {g!r}")
    formula = names.in_coordinates(formula)
    unknown = sorted(free.name for free in formula.free_symbols - set(symbols.values()))
    if unknown:
        kinds = "coordinates, momenta" if system.auxiliaries else "coordinates"
        kinds += ", parameters, time and inputs" if in_time else " and parameters"
        raise SystemDefinitionError(
            f"the time transformation contains '{unknown[0]}': it may depend only on {kinds} of '{system.name}'"
        )
    if not formula.free_symbols & {*system.coordinates, *system.auxiliaries}:
        raise SystemDefinitionError(
            f"the time transformation {formula} is constant, so the step size would not adapt: "
            "use a formula in the coordinates"
        )
    return formula.xreplace(driven)


def _read(system: MechanicalSystem, text: str, symbols: Mapping[str, Symbol]) -> Expr:
    """Return the expression of a text, with entries of arrays in index notation."""
    if is_indexed(text) and system.arrays:
        momenta = momentum_arrays(system.arrays, (momentum.name for momentum in system.auxiliaries))
        return formula_of_entries(text, (*system.arrays, *momenta), symbols)
    try:
        return parse_expression(text, symbols)
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
    made = sympy.powdenest(root, force=True).xreplace({stand_in: parameter for parameter, stand_in in positive.items()})
    moving = {*system.coordinates, system.time}
    zero = next((root.args[0] for root in made.atoms(sympy.Abs) if root.free_symbols & moving), None)
    if zero is not None:
        raise SystemDefinitionError(
            f"the time transformation 'frequency' of '{system.name}' is infinite where its stiffness is 0, {zero} = 0: "
            "use a formula in its coordinates that is positive everywhere"
        )
    return without_abs(made)


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


def _arclength(system: MechanicalSystem) -> Expr:
    if not system.auxiliaries:
        raise SystemDefinitionError(
            "the time transformation 'arclength' contains momenta: use it with hamiltonian_of(system)"
        )
    function = forms_of(system).energy
    derivatives = gradient(function, (*system.coordinates, *system.auxiliaries)).values()
    return sympy.Add(*(derivative**2 for derivative in derivatives)) ** sympy.Rational(-1, 2)


TIME_RESCALINGS: Mapping[str, Callable[[MechanicalSystem], Expr]] = MappingProxyType(
    {
        "frequency": _frequency,
        "distance": _distance,
        "potential": lambda system: -1 / _potential_and_masses(system, "potential")[0],
        "arclength": _arclength,
    }
)
"""Built-in time-rescaling functions by name."""
