"""Exact discrete Lagrangian (6) and exact flow to many digits, which every variational integrator approximates.

    L_d^E(q0, q1) = integral of L(q(t), q'(t), t) from t to t + h, q the solution of (2) with q(t) = q0, q(t + h) = q1.

Its derivatives are the momenta of that solution at its ends, p0 = -D_1 L_d^E and p1 = D_2 L_d^E, which yield the exact
discrete Legendre transforms and the exact flow. The solution is computed by :mod:`scvi_codegen.extras.exact.curve` on
successively finer grids, until two in a row agree to the requested digits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.api.checks import Kind, checked_count, checks_arguments
from scvi_codegen.api.formulas import Number, mp
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.extras.exact.arrays import unrolled_at
from scvi_codegen.extras.exact.curve import Curve, Grid
from scvi_codegen.extras.exact.newton import Array, NotConvergedError, largest
from scvi_codegen.extras.exact.solution import ExactMotion
from scvi_codegen.systems.lagrangian import LagrangianSystem

MOST_DIGITS = 50
POINTS = (10, 15, 22, 32)
"""Gauss points per piece; all are tried on the fewest pieces for which a solution is found, then only the last."""
PIECES = (1, 2, 4, 8, 16)
MAX_STRAIGHT_PIECES = 2
"""Maximum number of pieces for which the straight line is the initial guess; more have not helped."""

Values = Mapping[str, Any] | Sequence[Any] | None
LAGRANGIAN_OR_ARRAYS = Kind(
    "a LagrangianSystem",
    lambda system: isinstance(system, LagrangianSystem) or (isinstance(system, ArraySystem) and not system.momenta),
)
VALUES = Kind(
    "values by name or a list of all", lambda value: Kind.MAPPING.accepts(value) or Kind.NUMBERS.accepts(value)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExactStep:
    """Step of an exact trajectory; numbers are ``mpmath`` numbers of 60 digits, correct to about ``error``.

    Attributes:
        q0, q1: m positions at t and t + h.
        p0, p1: m momenta there: the exact discrete Legendre transforms are F-: (q0, q1) -> (q0, p0) and
            F+: (q0, q1) -> (q1, p1), the exact flow is (q0, p0) -> (q1, p1).
        v0, v1: m velocities there.
        action: L_d^E(q0, q1), paper (6).
        error: estimated error, relative to the size of the position, of the momentum and of the integral of ``|L|``.
    """

    q0: tuple[Number, ...]
    q1: tuple[Number, ...]
    p0: tuple[Number, ...]
    p1: tuple[Number, ...]
    v0: tuple[Number, ...]
    v1: tuple[Number, ...]
    action: Number
    error: Number

    __repr__ = summary("action", "error")


@checks_arguments(system=LAGRANGIAN_OR_ARRAYS, parameters=VALUES)
def exact_discrete_lagrangian(
    system: LagrangianSystem,
    q0: Sequence[Any],
    q1: Sequence[Any],
    h: Any,
    *,
    t: Any = 0.0,
    parameters: Values = None,
    digits: int = 30,
    guess: Sequence[Any] | None = None,
) -> ExactStep:
    """Solve the Euler-Lagrange boundary-value problem from q0 at t to q1 at t + h; paper (6).

    The solution need not be unique (a pendulum can rotate); Newton's iteration starts from the straight line, or from
    the trajectory with the initial velocity ``guess``.

    Args:
        system: any regular Lagrangian without forces and constraints.
        q0, q1: m positions each, or arrays by name. Floats are used with their exact binary values; strings such as
            ``"0.1"``, integers, fractions, mpmath and SymPy numbers are converted to 60 digits.
        h: step size, negative for a step backward in time.
        t: initial time.
        parameters: by name (others keep their defaults) or all in order; coefficients for inputs.
        digits: requested digits, 1 to 50.
        guess: m initial velocities near those of the desired solution.

    Raises:
        StateError: for invalid numbers, wrong shapes or names, inputs without values, and systems with forces or
            constraints; if no solution is found; if q1 is conjugate to q0, where the solution is not unique.
    """
    system, parameters = unrolled_at(system, q0, parameters)
    if system.forces:
        raise StateError(
            f"forces act on '{system.name}', so its momenta are not derivatives of an action: use exact_map"
        )
    problem = _Problem(system, h, t, parameters, digits)
    start, end = problem.vector(q0, "q0"), problem.vector(q1, "q1")
    velocity = None if guess is None else problem.vector(guess, "guess")

    def solve(grid: Grid) -> Curve:
        nonlocal velocity
        motion, times = problem.motion, (problem.t, problem.h)
        if velocity is None and grid.pieces > MAX_STRAIGHT_PIECES:
            raise NotConvergedError("Newton's iteration from the straight line does not converge")
        if velocity is None:
            first = Curve.straight(motion, grid, *times, start, end)
        else:
            first = Curve.launched(motion, grid, *times, start, velocity, digits)
        curve = first.joined_to(end, digits)
        velocity = curve.velocity
        return curve

    hint = "give guess, the initial velocity, or use a smaller step size"
    return problem.answer(solve, f"no trajectory from q0 = {_shown(start)} to q1 = {_shown(end)} was found: {hint}")


@checks_arguments(system=LAGRANGIAN_OR_ARRAYS, parameters=VALUES)
def exact_map(
    system: LagrangianSystem,
    q0: Sequence[Any],
    p0: Sequence[Any],
    h: Any,
    *,
    t: Any = 0.0,
    parameters: Values = None,
    digits: int = 30,
) -> ExactStep:
    """Compute the exact trajectory from (q0, p0) at t to t + h: the map that L_d^E generates by (5).

    Args:
        system: any regular Lagrangian without constraints; forces are supported.
        q0, p0: m positions and m momenta, or arrays by name.
        h, t, parameters, digits: as in :func:`exact_discrete_lagrangian`.

    Raises:
        StateError: for invalid numbers, wrong shapes or names, inputs without values, and systems with constraints; if
            the trajectory does not exist up to t + h, or is not smooth enough for 16 pieces.
    """
    system, parameters = unrolled_at(system, q0, parameters)
    problem = _Problem(system, h, t, parameters, digits)
    start, momenta = problem.vector(q0, "q0"), problem.vector(p0, "p0")
    origin = f"the trajectory from q0 = {_shown(start)}, p0 = {_shown(momenta)}"
    try:
        velocity = problem.motion.velocity(start, momenta, problem.t, digits)
    except (ArithmeticError, StateError) as failure:
        raise StateError(f"{origin}: no velocity has this momentum ({failure})") from failure

    def solve(grid: Grid) -> Curve:
        return Curve.launched(problem.motion, grid, problem.t, problem.h, start, velocity, digits)

    return problem.answer(solve, f"{origin} was not found up to h = {mp.nstr(problem.h, 8)}: use a smaller step size")


class _Problem:
    """Validated arguments, and the search for a sufficiently fine grid."""

    def __init__(self, system: LagrangianSystem, h: Any, t: Any, parameters: Values, digits: int) -> None:
        checked_count(digits, "digits", least=1, most=MOST_DIGITS)
        Discretisation.check_continuity(system)
        self.names = [coordinate.name for coordinate in system.coordinates]
        self.arrays = [array.name for array in system.arrays] or self.names
        self.digits, self.t, self.h = digits, _number(t, "t"), _number(h, "the step h")
        if self.h == 0:
            raise StateError("the step size h is 0: it must be positive or negative")
        if system.constraints or system.has_contacts:
            raise StateError(
                f"'{system.name}' has {'constraints' if system.constraints else 'contacts'}, which exact steps do not "
                "support: use coordinates without them"
            )
        self.motion = ExactMotion(system, list(_parameter_values(system, parameters).values()))

    def vector(self, values: Any, name: str) -> Array:
        if isinstance(values, Mapping):
            arrays = [values[name] for name in self.arrays if name in values]
            values = [entry for array in arrays for entry in np.asarray(array, dtype=object).flat]
        entries = [values] if isinstance(values, str) or not hasattr(values, "__len__") else list(values)
        if len(entries) != len(self.names):
            raise StateError(f"{name} must be {len(self.names)} numbers ({', '.join(self.names[:6])}), not {values!r}")
        numbers = [_number(entry, f"{name}[{index}] ({self.names[index]})") for index, entry in enumerate(entries)]
        return np.array(numbers, dtype=object)

    def answer(self, solve: Callable[[Grid], Curve], complaint: str) -> ExactStep:
        """Return the solution on the first grid that agrees with the previous one."""
        coarse, reason = None, ""
        for pieces in PIECES:
            for points in POINTS if coarse is None else POINTS[-1:]:
                try:
                    fine = solve(Grid.of(points, pieces))
                    error = mp.inf if coarse is None else _difference(coarse, fine)
                except ArithmeticError as failure:
                    reason = str(failure)
                    break
                if error <= mp.mpf(10) ** -self.digits:
                    return _step(fine, error)
                coarse = fine
                reason = f"{points} points in each of {pieces} pieces give only {mp.nstr(error, 2)}"
        raise StateError(f"{complaint} ({reason})")


def _step(curve: Curve, error: Number) -> ExactStep:
    ends = {"q": curve.ends(), "v": curve.end_velocities(), "p": curve.end_momenta()}
    named = {f"{name}{index}": tuple(values) for name, pair in ends.items() for index, values in enumerate(pair)}
    return ExactStep(**named, action=curve.action(), error=error)


def _difference(coarse: Curve, fine: Curve) -> Number:
    """Return the largest difference of action, ends and momenta, relative to their sizes along the curve."""
    differences = (
        abs(fine.action() - coarse.action()),
        largest(np.array(fine.ends()) - np.array(coarse.ends())),
        largest(np.array(fine.end_momenta()) - np.array(coarse.end_momenta())),
    )
    return max(error / size if error else mp.zero for error, size in zip(differences, fine.sizes(), strict=True))


def _number(value: Any, name: str) -> Number:
    try:
        number = mp.mpf(mp.convert(str(value.evalf(mp.dps)) if hasattr(value, "evalf") else value))
    except (TypeError, ValueError, ArithmeticError) as error:
        raise StateError(f"{name} must be a real number, not {value!r}") from error
    if not mp.isfinite(number):
        raise StateError(f"{name} is {number}")
    return number


def _parameter_values(system: LagrangianSystem, parameters: Values) -> dict[str, Number]:
    """Return the value of each parameter by name; those of inputs must be set."""
    names = [parameter.name for parameter in system.parameters]
    if parameters is None or isinstance(parameters, Mapping):
        by_name = dict(zip(names, system.defaults, strict=True)) | dict(parameters or {})
        for name in system.inputs:
            if f"{name}_0" not in (parameters or {}):
                raise StateError(f"the input {name} is not set: give its value as parameters={{'{name}_0': ...}}")
    elif len(parameters) == len(names):
        by_name = dict(zip(names, parameters, strict=True))
    else:
        raise StateError(f"parameters must be {len(names)} numbers ({', '.join(names)}), not {len(parameters)}")
    for name in by_name:
        if name not in names:
            raise StateError(
                f"there is no parameter '{name}'{closest(name, names)} Known: {', '.join(names) or 'none'}"
            )
    return {name: _number(value, f"the parameter {name}") for name, value in by_name.items()}


def _shown(values: Array) -> str:
    return f"({', '.join(mp.nstr(value, 6) for value in values)})"
