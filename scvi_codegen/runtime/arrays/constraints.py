"""Constraints of runs over arrays: residuals, projection, Lagrange multipliers, initial consistency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from scvi_codegen.errors import AccuracyWarning, MethodError, StateError, warn
from scvi_codegen.indices import Loop
from scvi_codegen.native.options import REASONS, STATUS, SolverOptions
from scvi_codegen.rendering.convergence import INPUT_PRECISION, LARGEST_VIOLATION, ROUNDING_UNITS
from scvi_codegen.runtime.arrays.interface import Numbers
from scvi_codegen.runtime.arrays.problem import ArrayProblem
from scvi_codegen.runtime.constraints.rank import rank_deficiency

__all__ = ["check_reachable", "consistent", "constraint_values", "multipliers", "project"]


MOST_DENSE = 64
"""Largest numbers of coordinates and of constraints for which the rank of the dense Jacobian is checked."""


class ConstrainedRun(Protocol):
    """Interface required of a run.

    Attributes:
        problem: the problem.
        options: solver options.
        state: positions and momenta in one vector.
    """

    problem: ArrayProblem
    options: SolverOptions | None
    state: Numbers

    @property
    def inverse_masses(self) -> dict[str, Numbers]:
        """1/m of every coordinate by the name of its array."""
        ...

    @property
    def t(self) -> float:
        """Current time."""
        ...

    def call(self, name: str, *arguments: Any) -> int:
        """Call a C function with the current state and return its status."""
        ...


def constraint_values(run: ConstrainedRun) -> tuple[tuple[Numbers, ...], tuple[Numbers, ...]]:
    """Return g and its rate for each constraint, as arrays over its loops."""
    values = np.zeros(_count(run)), np.zeros(_count(run))
    run.call("constraint_values", run.problem.struct, *map(run.problem.binding.pointer, values))
    return _apart(run, values[0]), _apart(run, values[1])


def multipliers(run: ConstrainedRun) -> tuple[Numbers, ...]:
    """Return the multipliers lambda of the forces G^T lambda of each constraint, as arrays over its loops."""
    values = np.zeros(_count(run))
    if status := run.call("multipliers", run.problem.struct, run.problem.binding.pointer(values)):
        raise StateError(f"the multipliers of '{run.problem.interface.system}' are undefined here: {REASONS[status]}")
    return _apart(run, values)


def consistent(run: ConstrainedRun) -> None:
    """Project the initial state of a run onto the constraints; warn unless rounding explains the distance.

    Raises:
        StateError: if the state is far from the constraints, or the projection fails.
    """
    g, rate = constraint_values(run)
    before, moved = project(run)
    if wrong := _dependent(run):
        raise StateError(wrong)
    if max(moved) <= ROUNDING_UNITS * np.finfo(float).eps:
        run.state[:] = before
    if max(moved) <= INPUT_PRECISION:
        return
    largest = [max(float(np.abs(each).max(initial=0.0)) for each in values) for values in (g, rate)]
    message = (
        f"the initial state violates the constraints by {max(moved):.1e} (relative): they are up to {largest[0]:.3g}, "
        f"their rates up to {largest[1]:.3g}, not 0"
    )
    if max(moved) > LARGEST_VIOLATION:
        raise StateError(f"{message}. Use stepper.project(q, p) for the nearest consistent state")
    warn(f"{message}. It was projected onto the constraints", AccuracyWarning)


def project(run: ConstrainedRun) -> tuple[Numbers, tuple[float, float]]:
    """Project the state onto the constraints; return the previous state and the relative changes of q and of p.

    Raises:
        StateError: if the projection fails.
    """
    before, report = run.state.copy(), run.problem.binding.new("report *")
    status = run.call("project", run.problem.struct, run.problem.binding.options(run.options), report)
    if status:
        if wrong := _dependent(run, nearest=True):
            raise StateError(wrong)
        same = "check for redundant or contradictory constraints"
        hint = f"; {same if 'singular' in STATUS[status] else 'give positions closer to them'}"
        raise StateError(
            f"the constraints of '{run.problem.interface.system}' cannot be satisfied: {REASONS[status]}{hint}"
        )
    half = len(before) // 2
    return before, (_relative(before[:half], run.state[:half]), _relative(before[half:], run.state[half:]))


def check_reachable(run: ConstrainedRun) -> None:
    """Raise :class:`StateError` if changed parameters move position constraints; momenta follow rates that jump."""
    before, (moved, _) = project(run)
    if moved > INPUT_PRECISION:
        run.state[:] = before
        raise StateError(
            f"at t = {run.t:g} the position constraints jump by {moved:.1e} (relative): parameters in position "
            "constraints must be continuous in time"
        )
    run.state[: len(before) // 2] = before[: len(before) // 2]


def _dependent(run: ConstrainedRun, *, nearest: bool = False) -> str:
    """Return the message of :func:`rank_deficiency`; "" if the system is too large for dense linear algebra."""
    n, count = len(run.state) // 2, _count(run)
    if max(n, count) > MOST_DENSE:
        return ""
    state, pointer = run.state.copy(), run.problem.binding.pointer
    masses = 1.0 / np.concatenate([each.ravel() for each in run.inverse_masses.values()])

    def at(q: Numbers) -> tuple[Numbers, Numbers]:
        g, rates = np.zeros(count), np.zeros((n + 1, count))
        run.state[:n] = q
        for k, rate in enumerate(rates):
            run.state[n:] = 0.0
            run.state[n:][k - 1 : k] = masses[k - 1 : k]  # k = 0: velocity 0, the slice is empty
            run.call("constraint_values", run.problem.struct, pointer(g), pointer(rate))
        return g, (rates[1:] - rates[0]).T

    names = [
        f"constraint {number}" + (str(list(map(int, index))) if shape else "")
        for number, shape in enumerate(_shapes(run), 1)
        for index in np.ndindex(*shape)
    ]
    try:
        return rank_deficiency(names, state[:n].copy(), at, nearest=nearest)
    finally:
        run.state[:] = state


def _count(run: ConstrainedRun) -> int:
    if not run.problem.interface.layout.constraints:
        raise MethodError(f"'{run.problem.interface.system}' has no constraints")
    return sum(int(np.prod(shape)) for shape in _shapes(run))


def _shapes(run: ConstrainedRun) -> list[list[int]]:
    """Return the shape of the loops of each constraint."""
    return [_shape(loops, run.problem.arrays.sizes) for loops in run.problem.interface.layout.constraints]


def _apart(run: ConstrainedRun, values: Numbers) -> tuple[Numbers, ...]:
    """Split a vector into one array per constraint."""
    parts, start = [], 0
    for shape in _shapes(run):
        size = int(np.prod(shape))
        parts.append(values[start : start + size].reshape(shape))
        start += size
    return tuple(parts)


def _shape(loops: Sequence[Loop], sizes: Mapping[str, int]) -> list[int]:
    """Return one axis per loop; the two loops of a pair share one axis."""
    outer = {loop.behind for loop in loops}
    spans = [(loop, loop.end.at(sizes) - loop.first.at(sizes)) for loop in loops if loop.index not in outer]
    return [span * (span - 1) // 2 if loop.behind else span for loop, span in spans]


def _relative(before: Numbers, after: Numbers) -> float:
    size = float(max(np.abs(before).max(initial=0.0), np.abs(after).max(initial=0.0)))
    return float(np.abs(after - before).max(initial=0.0)) / size if size > 0.0 else 0.0
