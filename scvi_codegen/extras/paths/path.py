"""Paths: stationary points of the discrete action between two positions, and closed paths."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.api.checks import checked_count
from scvi_codegen.api.runs import Products
from scvi_codegen.api.states import Array, Parameters, States, checked_number, real_array
from scvi_codegen.api.text import summary
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import AccuracyWarning, MethodError, PathError, StateError, warn
from scvi_codegen.extras.paths import solver
from scvi_codegen.extras.paths.discretisation import Discretisation, discretisation_of, kinetic_energy_is_positive
from scvi_codegen.extras.paths.equations import Band, condensed_hessian, hessian_blocks, negative_pivots
from scvi_codegen.extras.paths.intervals import Intervals, ManyCoordinates, ReducedIntervals
from scvi_codegen.extras.paths.size import SAME, SAME_MOTION, largest_range, size_for_updates
from scvi_codegen.extras.paths.starts import curves_around, curves_at_random

if TYPE_CHECKING:
    from scvi_codegen.runs.trajectory import Trajectory

MANY_COORDINATES = 48
"""Number of coordinates from which derivatives are computed as sparse matrices."""
RANDOM_STARTS, MOST_REVOLUTIONS = 10, 10**6
"""Number of starts at random, and most revolutions."""
MOST_REPETITIONS = 1000
"""Longest period of a closed path in multiples of T."""
TOLERABLE_ERROR = 1e-3
"""Largest discretisation error without a warning."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """Path of a system between two positions, or closed path, in N steps.

    Attributes:
        t: (N + 1,) times.
        q, p: (N + 1, m) positions and momenta. Those of all steps agree, so that the states are those of a run.
        action: sum of the discrete Lagrangians; with forces and constraints that of L alone.
        residual: largest jump of the momentum between two steps, relative to the largest momentum of a velocity; at
            rest, relative to the momentum of a step of the size of the start of the search.
        error: distance to the path of the system, to first order, and the rounding error. Of positions it is relative
            to their largest range, of momenta to the largest one of a velocity; the larger of both.
        q_error, p_error: (N + 1, m) errors with their signs, computed minus exact, by the finer method of a run's
            ``error``; on manifolds their tangential parts. NaN where they are unknown.
        energy_change: range of a conserved energy over the nodes, relative to the largest p . v; else 0.
        dropped: number of stationary points of the discrete action that were found first and are no paths of the
            system, as those that pass through an attractive singularity.
        iterations: number of Newton iterations.
        repetitions: of a closed path, the number of times T after which all coordinates return, else 1; 0 if they do
            not return.
        zero_modes: of a closed path, the number of its directions in which it is not isolated.
        stepper: the compiled integrator.
        arguments: parameters, inputs and options, as arguments of ``integrate``.
        solution: the last iterate with its steps and the factors of its Hessian.
    """

    t: Array
    q: Array
    p: Array
    action: float
    residual: float
    error: float
    energy_change: float
    iterations: int
    stepper: Any = field(repr=False)
    q_error: Array = field(repr=False)
    p_error: Array = field(repr=False)
    dropped: int = 0
    repetitions: int = 1
    zero_modes: int = 0
    arguments: Mapping[str, Any] = field(default_factory=dict, repr=False)
    solution: Any = field(default=None, repr=False)

    __repr__ = summary("q", "action", "residual", "error")

    @property
    def index(self) -> int | None:
        """Morse index, the number of negative directions of the second variation; 0 for a minimum of the action.

        ``None`` with forces.

        Raises:
            MethodError: if the kinetic energy is indefinite: the index is infinite, and that of the discrete action
                depends on the steps.
        """
        return self._counts[-1] if self._counts else None

    @property
    def conjugate_times(self) -> Array:
        """(c, 2) ends of the steps that contain points conjugate to the first one, as often as their multiplicity.

        Empty for closed paths and with many coordinates. Raises as :attr:`index`.
        """
        rises = np.diff(self._counts)
        steps = np.repeat(np.arange(1, len(rises) + 1), rises)
        return np.stack([self.t[steps], self.t[steps + 1]], axis=1)

    @cached_property
    def _counts(self) -> list[int]:
        """Morse indices of [t_0, t_k], k = 1, 2, ..; that of the whole path alone if others are not known."""
        solution = self.solution
        at, intervals = solution.at, solution.intervals
        if self.stepper.interface.exchange_names:
            return []
        if not kinetic_energy_is_positive(intervals, solution.q, np.concatenate([at.p0, at.p1[-1:]])):
            raise MethodError(
                f"the kinetic energy of '{self.stepper.interface.system}' is indefinite: the action has infinitely "
                "many negative directions, so that the Morse index and conjugate times are undefined; the path itself, "
                "its action and its momenta are not affected"
            )
        if intervals.symmetry is not None or intervals.sparse:
            return [solution.factors.negative]
        return negative_pivots(*hessian_blocks(at))

    @property
    def at_rest(self) -> bool:
        """True if all positions are equal: an equilibrium."""
        return bool(self.solution.at_rest)

    @property
    def period(self) -> float:
        """Time after which a closed path repeats in all coordinates."""
        return self.repetitions * float(self.t[-1] - self.t[0])

    def run(self) -> Trajectory:
        """Return the run from the first state, of a closed path over its period.

        Unstable paths are left by it: compare ``run.q[-1]`` with ``q[-1]``.
        """
        count = len(self.t) - 1
        run: Trajectory = self.stepper.integrate(
            self.q[0],
            self.p[0],
            h=float(self.t[-1] - self.t[0]) / count,
            steps=count * max(1, self.repetitions),
            t=float(self.t[0]),
            **self.arguments,
        )
        return run

    @cached_property
    def hessian(self) -> Array:
        """(2m, 2m) Hessian of the action as a function of q0 and q1, by condensation.

        Its upper right block is -B^-1 with B = dq1/dp0 of the run; det B^-1 is the Van Vleck determinant.

        Raises:
            MethodError: for closed paths, with constraints or rotations, and with many coordinates.
        """
        intervals, factors = self.solution.intervals, self.solution.factors
        if type(intervals) is not Intervals or not isinstance(factors, Band):
            raise MethodError(
                "the Hessian by both ends is not available for closed paths, with constraints or rotations, and with "
                f"{MANY_COORDINATES} coordinates or more"
            )
        return condensed_hessian(self.solution.at, factors)


def path_of(
    stepper: Any,
    q0: States | None,
    q1: States | None,
    T: float | None,
    *,
    steps: int,
    start: ArrayOrFunction,
    revolutions: int | None,
    energy: float | None,
    closed: Any,
    t: float,
    parameters: Parameters,
    inputs: Mapping[str, Any] | None,
    options: SolverOptions | None,
) -> Path:
    """Return the path of :meth:`scvi_codegen.Stepper.path`."""
    stepper.products.require("path")
    count = checked_count(steps, "steps", least=2)
    duration, begin = _checked_duration(T), checked_number(t, "t")
    states = stepper.products.states
    kind = _kind_of_intervals(stepper, closed=closed is not None, energy=energy is not None)
    h = np.full(count, duration / count)
    times = begin + np.arange(count) * h
    intervals = kind(stepper, times, h, _parameters_of_steps(stepper, parameters, inputs, times + h / 2.0), options)
    arguments = {"parameters": parameters, "options": options, "inputs": inputs}
    nodes = _nodes_of_start(states, start, begin, duration, count)
    start_energy = None if energy is None else checked_number(energy, "energy")
    energies = partial(_energies_and_velocities, stepper, begin, intervals.parameters)
    if closed is not None:
        M = _symmetry(stepper.interface, closed)
        solution = _closed_solution(intervals, nodes, M, start_energy, energies)
        closed_path = _described(stepper, solution, begin, arguments, _checked(solution), M=M)
        _warn_at_rest(closed_path, duration)
        return closed_path
    if q0 is None or q1 is None:
        raise StateError("path: give both positions q0 and q1, or closed= and start=")
    ends = [states.vector(states.positions(q, name), name) for q, name in ((q0, "q0"), (q1, "q1"))]
    intervals.range_of_start = largest_range(np.array(ends) if nodes is None else nodes)
    if revolutions is not None:
        attempts: list[Attempt] = [
            partial(solver.continued_from_motion, intervals, curve, duration)
            for curve in _around(intervals, ends, nodes, revolutions)
        ]
    else:
        attempts = _attempts(intervals, ends, nodes, duration)
    solution, comparison, dropped = _first_motion(attempts)
    if start_energy is not None:
        solution = solver.AtEnergy(solution.intervals, start_energy, energies).solved(solution.q, solution.iterations)
        comparison = _checked(solution)
    return _described(stepper, solution, begin, arguments, comparison, dropped=dropped)


def _checked_duration(T: float | None) -> float:
    if T is None:
        raise StateError("path: give T, the duration of the path (with energy= an estimate of it)")
    duration = checked_number(T, "the duration T")
    if duration == 0:
        raise StateError("path: T must not be 0")
    return duration


def _energies_and_velocities(stepper: Any, begin: float, parameters: Array, q: Array, p: Array) -> tuple[Array, Array]:
    """Return (n,) energies and (n, m) velocities of states at the time at which a path begins."""
    t = np.full(len(q), begin)
    return np.asarray(stepper.energy(q, p, t, parameters)), np.asarray(stepper.velocity(q, p, t, parameters))


def _closed_solution(
    intervals: Intervals, nodes: Array | None, M: Array, energy: float | None, states: solver.States
) -> solver.Solution:
    """Return the closed path q(T) = M q(0) near the nodes of a start; sets ``intervals.range_of_start``.

    Without forces its equations are the gradient of the discrete action, whose Hessian is symmetric; forces enter
    beside the action (Lagrange-d'Alembert principle), so that there is neither symmetry nor a minimum to seek.
    """
    if nodes is None:
        raise StateError("closed paths require start=: an array (steps + 1, m), or a function of time")
    intervals.range_of_start = largest_range(nodes)
    variational = not intervals.stepper.interface.exchange_names
    on_manifold = isinstance(intervals, ReducedIntervals)
    unknown_nodes = nodes[: len(intervals.h)]  # q_N = M q_0 is none
    return solver.closed(
        intervals,
        unknown_nodes,
        M,
        minimise=variational and not on_manifold,
        symmetric=variational,
        energy=energy,
        states=states,
    )


def different_paths(
    stepper: Any, q0: Any, q1: Any, T: float, *, starts: int = 0, revolutions: int | None = None, **arguments: Any
) -> list[Path]:
    """Return the different paths from the straight line and from other curves, that of least action first.

    Args:
        starts: number of curves at random: the line and sine waves of the size of the distance of the ends.
        revolutions: largest number of whole revolutions, both ways, of starts around the centre of a rotation.
        arguments: further ones of :meth:`~scvi_codegen.Stepper.path`.
    """
    paths, reason = list[Path](), None
    ends = [real_array(stepper.products.states.positions(end, "the ends"), "the ends") for end in (q0, q1)]
    line = _line(ends, arguments["steps"])
    tried: list[dict[str, Any]] = [{}]
    if revolutions is not None:
        tried += [{"revolutions": turns} for turns in range(-1 - revolutions, 1 + revolutions)]
    tried += [{"start": start} for start in islice(curves_at_random(line), starts)]
    for start_arguments in tried:
        try:
            path = stepper.path(q0, q1, T, **start_arguments, **arguments)
        except PathError as error:
            reason = reason or error
            continue
        distances = (np.abs(other.q - path.q).max() + abs(other.t[-1] - path.t[-1]) for other in paths)
        if all(distance > SAME_MOTION * size_for_updates(path.q, SAME_MOTION) for distance in distances):
            paths.append(path)
    if not paths:
        raise PathError(
            f"{reason} ({len(tried) - 1} further starts were tried)" if tried[1:] else str(reason)
        ) from reason
    return sorted(paths, key=lambda path: path.action)


def _kind_of_intervals(stepper: Any, *, closed: bool, energy: bool) -> type[Intervals]:
    """Return the class of the intervals of a system; raise MethodError if it has no such paths."""
    interface = stepper.interface
    reduced = bool(interface.constraints or interface.rotations)
    if any("_dot" in formula for formula in interface.constraints):
        raise MethodError(
            "path is not available with nonholonomic constraints: two positions determine no motion; use integrate"
        )
    if any(rotation.startswith("spin") for rotation in interface.rotations):
        raise MethodError("path is not available for spins: their direction determines the motion; use integrate")
    if energy and interface.inputs:
        raise MethodError(
            "path: energy= is not available with inputs, which change the energy and whose times do not follow the "
            "duration; omit it"
        )
    if closed and energy and interface.changes_energy:
        raise MethodError(
            f"path: energy= is not available for a closed path that does not conserve it ({interface.changes_energy}); "
            "omit it and give the duration T"
        )
    if reduced:
        return ReducedIntervals
    return ManyCoordinates if stepper.dimension >= MANY_COORDINATES and not closed else Intervals


Attempt: TypeAlias = Callable[[], solver.Solution]


def _first_motion(attempts: Sequence[Attempt]) -> tuple[solver.Solution, Discretisation, int]:
    """Return the first path that is found and its discretisation error.

    The number counts the stationary points before it that are no motions.
    """
    reasons, dropped = [], 0
    for attempt in attempts:
        try:
            solution = attempt()
            comparison = discretisation_of(solution)
            if comparison.is_motion:
                return solution, comparison, dropped
            dropped += 1
        except solver.UNSOLVED as error:
            reasons.append(str(error))
    if dropped:
        reasons.append(f"{dropped} stationary points of the discrete action are no motions: finer steps leave them")
    raise PathError(
        f"no path was found ({'; '.join(dict.fromkeys(reasons))}): give start=, a path nearby, or more steps"
    )


def _attempts(intervals: Intervals, ends: Sequence[Array], nodes: Array | None, duration: float) -> list[Attempt]:
    """Return functions that search a path from a start, or from the straight line and in other ways."""
    count, in_other_ways = len(intervals.h), nodes is None
    if nodes is None:
        nodes = _line(ends, count)
    elif len(nodes) != count + 1:
        raise StateError(f"start must have {count + 1} rows, one for each node, not {len(nodes)}")
    nodes[0], nodes[-1] = ends
    nodes[1:] = intervals.on_manifold_all(nodes)[1:]
    attempts: list[Attempt] = [partial(solver.solved, intervals, nodes)]
    if in_other_ways:
        attempts.append(partial(solver.continued, intervals, nodes, duration))
    if not intervals.stepper.interface.exchange_names:  # many coordinates: quicker than the continuation
        attempts.insert(1 if intervals.sparse else len(attempts), partial(solver.descended, intervals, nodes))
    if in_other_ways and not intervals.sparse:
        around = _curves_around(intervals, nodes, 0, -1)
        attempts.extend(partial(solver.continued_from_motion, intervals, curve, duration) for curve in around)
        at_random = islice(curves_at_random(nodes), RANDOM_STARTS)
        attempts.extend(partial(_from, intervals, start) for start in at_random)
    return attempts


def _line(ends: Sequence[Array], count: int) -> Array:
    return np.asarray(ends[0] + (ends[1] - ends[0]) * np.linspace(0.0, 1.0, count + 1)[:, np.newaxis])


def _around(intervals: Intervals, ends: Sequence[Array], start: Array | None, revolutions: int) -> list[Array]:
    """Return starts around the centres of rotational symmetries; raise StateError if there is none."""
    if start is not None:
        raise StateError("path: give either start or revolutions, not both")
    turns = checked_count(revolutions, "revolutions", least=-MOST_REVOLUTIONS, most=MOST_REVOLUTIONS)
    curves = _curves_around(intervals, _line(ends, len(intervals.h)), turns)
    if not curves:
        raise StateError(
            f"path: revolutions requires a rotational symmetry that turns q0 and q1, and "
            f"'{intervals.stepper.interface.system}' has none: give start"
        )
    return curves


def _curves_around(intervals: Intervals, line: Array, *revolutions: int) -> list[Array]:
    at = float(intervals.t[0]), intervals.parameters_at_start
    curves = [curve for turns in revolutions for curve in curves_around(intervals.stepper, line, *at, turns)]
    for curve in curves:
        curve[1:-1] = intervals.on_manifold_all(curve)[1:-1]
    return curves


def _warn_at_rest(path: Path, duration: float) -> None:
    if path.at_rest:
        warn(
            "path: the closed path is at rest in path.q[0], an equilibrium, which is closed for any T. For a motion "
            f"give energy=, a start of larger amplitude, or a period of motions as T, not {duration:g}; for small "
            "amplitudes it is near 2 pi over a frequency of the equilibrium",
            AccuracyWarning,
        )


def _checked(solution: solver.Solution) -> Discretisation:
    """Return the discretisation error of a stationary point; raise PathError if it is no motion."""
    comparison = discretisation_of(solution)
    if not comparison.is_motion:
        raise PathError(
            "the stationary point of the discrete action that was found is no motion of the system: finer steps leave "
            f"it (discretisation error {comparison.error:.1e}, change of the energy {comparison.energy_change:.1e}, "
            "both relative): take more steps, or give another start"
        )
    return comparison


def _from(intervals: Intervals, start: Array) -> solver.Solution:
    """Return the path near a start, whose inner nodes are moved to the manifold."""
    start[1:-1] = intervals.on_manifold_all(start)[1:-1]
    return solver.solved(intervals, start, solver.FEW_ITERATIONS)


def _described(
    stepper: Any,
    solution: solver.Solution,
    begin: float,
    arguments: Mapping[str, Any],
    comparison: Discretisation,
    *,
    M: Array | None = None,
    dropped: int = 0,
) -> Path:
    at, intervals, forced = solution.at, solution.intervals, bool(stepper.interface.exchange_names)
    count = len(intervals.h)
    t = begin + intervals.h[0] * np.arange(count + 1)
    zero_modes, repetitions = 0, 1
    if M is not None:
        repetitions = _order(M)
        zero_modes = 0 if forced else int((~solution.factors.kept).sum())
    if not comparison.error <= TOLERABLE_ERROR and Products.warnings_wanted():
        remedy = f"take more steps than {count}, or a method of higher degree"
        known = f"about {comparison.error:.1e} (relative): {remedy}"
        warn(f"the discretisation error of the path is {comparison.reason or known}", AccuracyWarning)
    jumps = at.residual if M is None else at.p1[:-1] - at.p0[1:]
    return Path(
        t=t,
        q=stepper.named(solution.q),
        p=stepper.named(solution.momenta),
        action=float(np.sum(at.actions)),
        error=comparison.error,
        q_error=stepper.named(comparison.q),
        p_error=stepper.named(comparison.p),
        energy_change=comparison.energy_change,
        dropped=dropped,
        residual=float(np.abs(jumps).max(initial=0.0)) / (solution.size.momentum or 1.0),
        iterations=solution.iterations,
        stepper=stepper,
        repetitions=repetitions,
        zero_modes=zero_modes,
        arguments=arguments,
        solution=solution,
    )


def _parameters_of_steps(stepper: Any, parameters: Parameters, inputs: Mapping[str, Any] | None, times: Array) -> Array:
    """Return the (k,) parameters of all steps, or (N, k) with inputs, those of the piece in the middle of each step."""
    if inputs is None:
        stepper.products.check_given(parameters)
        return np.ascontiguousarray(stepper.products.parameters(parameters))
    functions = stepper.products.inputs_of(inputs)
    values = np.tile(stepper.products.parameters(parameters), (len(times), 1))
    columns = stepper.products.input_columns
    for k, time in enumerate(times.tolist()):
        values[k, columns] = np.concatenate([functions[name].parameters(time) for name in stepper.interface.inputs])
    return values


def _nodes_of_start(states: Any, start: Any, t: float, duration: float, count: int) -> Array | None:
    """Return the nodes of a start, an array or a function of time; ``None`` without one."""
    if start is None:
        return None
    if callable(start):
        call: Callable[[float], Any] = start
        start = [states.positions(call(t + duration * k / count), "start") for k in range(count + 1)]
    nodes = real_array(states.positions(start, "start"), "start")
    if nodes.ndim != 2 or nodes.shape[1] != states.dimension or len(nodes) not in (count, count + 1):
        raise StateError(
            f"start must have shape ({count + 1}, {states.dimension}), a position at each of steps + 1 times, not "
            f"{nodes.shape}"
        )
    if not np.isfinite(nodes).all():
        raise StateError("start must be finite")
    return nodes


def _symmetry(interface: Any, closed: Any) -> Array:
    """Return the orthogonal matrix M of q(T) = M q(0)."""
    names, m = interface.coordinates, interface.dimension
    if closed is True:
        return np.eye(m)
    if isinstance(closed, str):
        closed = [name.strip() for name in closed.split(",")]
    entries: Sequence[Any] = list(closed) if isinstance(closed, list | tuple) else []
    if entries and all(isinstance(entry, str) for entry in entries):
        M = np.zeros((m, m))
        elements = str.maketrans({"[": "_", "]": "", ",": "_", " ": ""})  # u[0, 1] is the coordinate u_0_1
        plain = [entry.removeprefix("-").translate(elements) for entry in entries]
        if sorted(plain) != sorted(names):
            raise StateError(
                f"closed must contain each coordinate once, {', '.join(names)}, possibly with a sign: not {entries}"
            )
        for row, (entry, name) in enumerate(zip(entries, plain, strict=True)):
            M[row, names.index(name)] = -1.0 if entry.startswith("-") else 1.0
        return M
    M = real_array(closed, "closed")
    if M.shape != (m, m) or np.abs(M @ M.T - np.eye(m)).max(initial=0.0) > SAME:
        raise StateError(
            f"closed must be True, the names of the {m} coordinates that follow after T, or an orthogonal matrix "
            f"({m}, {m})"
        )
    return M


def _order(M: Array) -> int:
    """Return the least n with M^n = 1, 0 if there is none up to ``MOST_REPETITIONS``."""
    power = M
    for n in range(1, MOST_REPETITIONS + 1):
        if np.abs(power - np.eye(len(M))).max() < SAME * n:
            return n
        power = power @ M
    return 0


ArrayOrFunction = ArrayLike | Callable[[float], ArrayLike] | None
"""Type of the start of a path."""
