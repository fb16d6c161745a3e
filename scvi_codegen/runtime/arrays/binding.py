"""Binding of arrays whose sizes are known at run time, with the functions of a binding of known sizes.

The C functions of arrays take the data of the problem and a run whose arrays lie in memory of the caller: one block of
the C struct, from whose field t on the state begins, and the arrays of the state. Here they have the arguments of the
functions of known sizes, so that steppers, runs and trajectories are the same for both.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from types import SimpleNamespace
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.indices import ArrayMap
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.building import Library
from scvi_codegen.native.options import FAILURES, NOT_CONVERGED
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.envelope import envelope_of
from scvi_codegen.runtime.arrays.interface import Numbers, RunSizes
from scvi_codegen.runtime.core.validation import by_name

FAILURES_BY_SOLVER = {
    "fixed-point": FAILURES
    | {
        NOT_CONVERGED: (
            "the fixed-point iteration did not converge",
            "It converges if h times the highest frequency is below about 1 to 3. Use a smaller h, or "
            "solver='newton' if the fast modes are not excited (stiff bonds, short waves on a lattice)",
        )
    },
    "newton": FAILURES | {NOT_CONVERGED: ("Newton-GMRES did not converge", "Use a smaller h")},
    "rattle": FAILURES
    | {
        NOT_CONVERGED: ("the iteration on the constraints did not converge", "Use a smaller h"),
        "singular": (
            "the constraints are contradictory or redundant there",
            "Remove the constraints that follow from others",
        ),
    },
}


REPORTED = ("steps", "stored", "iterations", "change", "t")
"""Fields of the report of a call."""
ALIGNMENT = 64
"""Alignment in bytes, the size of the widest SIMD register."""


def aligned(count: int) -> Numbers:
    """Return ``count`` zeros, aligned to a SIMD register."""
    try:
        memory = np.zeros(count + ALIGNMENT // 8)
    except (MemoryError, ValueError) as error:
        raise StateError(f"there is not enough memory for {count} numbers") from error
    start = -memory.ctypes.data % ALIGNMENT // 8
    return memory[start : start + count]


class BoundRun(NamedTuple):
    """Arrays of a run that are not in its memory, because they are computed from the problem and not restored.

    Attributes:
        problem: C struct of the problem.
        parameters: current scalar parameters and fields, in one vector; NaN before they are set.
        computed: arrays by the name of their pointer in the C struct of the run.
        stored: memory behind the C struct of the run, from its first number to the end of the last array of the state.
    """

    problem: Any
    parameters: Numbers
    computed: dict[str, NDArray[Any]]
    stored: Any


class ArrayBinding(Binding):
    """Binding of arrays of given sizes and tables; states and parameters are vectors, as for known sizes.

    Args:
        library: the compiled source.
        interface: interface of the source.
        sizes: sizes, tables and number of threads per step.
    """

    def __init__(self, library: Library, interface: Interface, sizes: RunSizes) -> None:
        super().__init__(library, interface.prefix)
        self.interface, self.sizes, self._unused = interface, sizes, list[Any]()
        self.reusable = not interface.layout.neighbours  # their lists, and rounding errors, depend on earlier states
        self.shapes, self.fields = (
            [(array.name, array.shape(sizes.sizes)) for array in each]
            for each in (interface.layout.coordinates, interface.layout.fields)
        )
        self.count = sum(math.prod(shape) for _, shape in self.shapes)
        self.parameter_count = len(interface.parameters) + sum(math.prod(shape) for _, shape in self.fields)
        self.envelope = envelope_of(interface.layout, sizes)
        self._arrays: WeakKeyDictionary[Any, BoundRun] = WeakKeyDictionary()

    @cached_property
    def failures(self) -> dict[str, tuple[str, str]]:
        """Messages of failed steps."""
        failures, hint = FAILURES_BY_SOLVER.get(self.interface.solver, FAILURES), ""
        if mesh := self.interface.layout.mesh:
            hint = (
                f". The highest frequency is at most {mesh.highest_frequency():.3g}: choose h below "
                "mesh.largest_step(method), with the method of compile_stepper"
            )
        if names := self.interface.layout.neighbours:
            hint = f". No particle may move by a cutoff of {', '.join(map(repr, names))} in one step"
        return {word: (what, remedy + hint) for word, (what, remedy) in failures.items()}

    def new(self, what: str) -> Any:
        """Return a run with its arrays, the report of a call, or what :meth:`Binding.new` returns."""
        if what == "run *":
            return self._new_run()
        if what == "report *":
            return SimpleNamespace(failures=self.failures, steps=0, stored=0, iterations=0, change=0.0, t=0.0)
        return super().new(what)

    def _new_problem(self) -> Any:
        """Return the C struct of the problem, with its sizes, tables and lists of neighbours."""
        problem, layout = super().new("problem *"), self.interface.layout
        for k, name in enumerate(layout.sizes):
            problem.size[k] = self.sizes.sizes[name]
        for k, table in enumerate(layout.tables):
            problem.table[k] = self.pointer(self.sizes.places[table.name].reshape(-1))
        lists = [super(ArrayBinding, self).new("neighbours *") for _ in layout.neighbours]
        for name, near in zip(layout.neighbours, lists, strict=True):
            setattr(problem, f"near_{name}", near)
        if not lists:
            return problem
        release = super().function("release_neighbours")
        return self._ffi.gc(problem, lambda given, _=lists: release(given))

    def _new_run(self) -> Any:
        """Return the C struct of a run, followed in memory by the arrays of its state."""
        n, layout, problem = self.count, self.interface.layout, self._new_problem()
        first, computed = super().new("run *"), dict[str, NDArray[Any]](inverse_mass=aligned(n))
        lengths = {"q": 2 * n, "carry_q": 2 * n, "work": n * self.constant("WORK")}
        if layout.constraints:
            computed |= self._constraint_indices(first, problem)
            lengths["held"] = 11 * first.constraints + 2 * (first.entries + first.pairs)
        if self.envelope is not None:
            factors = ALIGNMENT + self.envelope.numbers * 2 * self.constant("SHIFTS")
            computed |= {"pattern": self.envelope.pattern, "compared_factors": aligned(factors)}
            lengths["factors"] = factors
        size, places = len(bytes(self._ffi.buffer(first))), dict[str, int]()
        end = -(-size // ALIGNMENT) * ALIGNMENT
        for name, length in lengths.items():
            places[name], end = end // 8, end + -(-8 * length // ALIGNMENT) * ALIGNMENT
        memory = aligned(end // 8)
        run = self._ffi.from_buffer(f"{self._prefix}_run *", memory)
        run[0] = first[0]
        for name, place in places.items():
            setattr(run, name, self.pointer(memory[place:]))
        run.p, run.carry_p, run.threads = run.q + n, run.carry_q + n, self.sizes.threads  # p directly after q
        for name, array in computed.items():
            setattr(run, name, self.pointer(array))
        parameters, head = np.full(self.parameter_count, np.nan), self._ffi.offsetof(f"{self._prefix}_run", "t")
        for k, field in enumerate(by_name(parameters[len(self.interface.parameters) :], self.fields).values()):
            problem.field[k] = self.pointer(field)
        stored = self._ffi.buffer(self._ffi.cast("char *", run) + head, end - head)
        self._arrays[run] = BoundRun(problem, parameters, computed, stored)
        return run

    def _constraint_indices(self, run: Any, problem: Any) -> dict[str, NDArray[Any]]:
        """Store the numbers of constraints, entries and pairs in a run, and return its arrays of indices."""
        super().function("constraint_sizes")(problem, run)
        count, entries = run.constraints, run.entries
        if not 0 <= count <= entries < 2**31:
            raise StateError(
                f"invalid constraints ({count} with {entries} coordinates): check the bounds of their loops"
            )
        places = np.zeros(3 * (count + entries) + self.count + 3, dtype=np.int32)
        run.places = self.pointer(places)
        run.pairs = super().function("constraint_pairs")(run, problem)
        columns = np.zeros(run.pairs + 1, dtype=np.int32)
        run.columns = self.pointer(columns)
        super().function("constraint_pairs")(run, problem)
        return {"places": places, "columns": columns}

    def vector(self, part: Any, count: int | None = None) -> Numbers:
        """Return the numbers at a pointer, by default as many as coordinates."""
        size = self.count if count is None else count
        return np.frombuffer(self._ffi.buffer(part, 8 * size)) if size else np.empty(0)

    def buffer(self, struct: Any) -> Any:
        """Return the bytes of the state of a run, or of another struct, writable."""
        return self._arrays[struct].stored if struct in self._arrays else super().buffer(struct)

    def has(self, name: str) -> bool:
        """Return whether there is such a function."""
        if name in ("advance_to", "project"):
            return super().has(name)
        return hasattr(self, f"_{name}")

    def function(self, name: str, memory: Any = None) -> Callable[..., Any]:
        """Return a function with the arguments of the C function of known sizes, bound to a run."""
        function = getattr(self, f"_{name}")
        return function if memory is None else partial(function, memory)

    def _set_parameters(self, run: Any, values: Numbers) -> None:
        """Set scalar parameters and fields; an extrapolated predictor is kept, reused forces are discarded.

        Raises:
            StateError: if a coordinate has no positive mass.
        """
        problem, parameters, computed, _ = self._arrays[run]
        changed = not np.isnan(parameters).all()
        if np.array_equal(values, parameters) and changed:
            return
        parameters[:], scalars = values, len(self.interface.parameters)
        problem.parameters[0:scalars] = parameters[:scalars].tolist()
        if changed:
            run.guess *= self.interface.layout.continued
            self._discard_factors(run)
        inverse = computed["inverse_mass"]
        if super().function("inverse_masses")(problem, run.inverse_mass):
            index = int(np.argmin(np.where((inverse > 0) & np.isfinite(inverse), 1.0, -1.0)))
            what = f"coordinate {index} of {len(inverse)}"
            raise StateError(f"{what} has no positive mass: add its kinetic energy to L, or check the parameters")
        if changed and self.interface.layout.constraints:  # rates may jump, positions may not
            q = self.vector(run.q).copy()
            super().function("project")(run, problem, self.null, super().new("report *"))
            self.vector(run.q)[:] = q

    def _discard_factors(self, run: Any) -> None:
        """Let the next step compute the factors of the linear part: their first number is their step size."""
        if self.envelope is not None:
            run.factors[0] = 0.0

    def _start(self, run: Any, t: float, h: float, q: Any, p: Any) -> None:
        """Start at a state; nothing of an earlier run remains, and the parameters are those set next."""
        self._arrays[run].parameters.fill(np.nan)
        self._set_state(run, t, h, q, p)

    def _set_state(self, run: Any, t: float, h: float, q: Any, p: Any) -> None:
        head = self._ffi.offsetof(f"{self._prefix}_run", "t")
        self._ffi.buffer(run)[head:] = bytes(self._ffi.sizeof(f"{self._prefix}_run") - head)
        run.t, run.h, self.vector(run.q)[:], self.vector(run.p)[:] = t, h, self.vector(q), self.vector(p)
        self.vector(run.carry_q, 2 * self.count)[:] = 0.0
        self._discard_factors(run)

    def _step_error(self, run: Any) -> float:
        return float(super().function("step_error")(run))

    def _advance(self, run: Any, *arguments: Any) -> int:
        return self._call_steps("advance", run, arguments)

    def _advance_to(self, run: Any, *arguments: Any) -> int:
        status = self._call_steps("advance_to", run, arguments)
        run.h = 0.0  # of the last step
        return status

    def _call_steps(self, name: str, run: Any, arguments: Sequence[Any]) -> int:
        """Call a function of C with the problem in place of parameters, and copy its report."""
        *plan, _, options, t, q, p, iterations, report, _ = arguments
        made, problem = super().new("report *"), self._arrays[run].problem
        status = super().function(name)(run, *plan, problem, options, t, q, p, iterations, made)
        for field in REPORTED:
            setattr(report, field, getattr(made, field))
        return int(status)

    def _step(
        self, t: float, h: float, q: Any, p: Any, parameters: Any, options: Any, q1: Any, p1: Any, report: Any, _: Any
    ) -> int:
        with self._at(t, q, p, parameters, h) as run:
            unused = self.numbers("double *"), self.numbers("int *")
            return self._advance(run, 1, 1, None, options, unused[0], q1, p1, unused[1], report, None)

    def _energies(self, count: int, t: Any, q: Any, p: Any, parameters: Any, result: Any, _: Any) -> int:
        parts = np.empty((count, 3))
        self._energy_parts(count, t, q, p, parameters, self.pointer(parts))
        self.vector(result, count)[:] = parts[:, 2]
        return 0

    def _energy_parts(self, count: int, t: Any, q: Any, p: Any, parameters: Any, parts: Any) -> None:
        """Compute (n, 3) kinetic, potential and total energies in double-double arithmetic; 0, H, H if given by H."""
        n, layout = self.count, self.interface.layout
        with self._at(0.0, q, p, parameters) as run:
            problem, energies, inverse_mass = self._arrays[run].problem, super().function("energies"), run.inverse_mass
            for k in range(count):
                at, moving = q + k * n, p + k * n
                if layout.momenta or layout.velocity_formulas or not layout.symmetric:  # sums read p directly after q
                    self._ffi.memmove(run.q, at, 8 * n)
                    self._ffi.memmove(run.p, moving, 8 * n)
                    at, moving = run.q, run.p
                energies(problem, t[k], at, moving, inverse_mass, parts + 3 * k)
        if self.interface.layout.velocity_formulas:  # the terms of H are no parts of the energy
            self.vector(parts, 3 * count).reshape(-1, 3)[:, :2] = np.nan

    def _velocity(self, t: float, q: Any, p: Any, parameters: Any, result: Any, _: Any) -> int:
        if self.interface.layout.momenta:
            raise StateError("velocities are unavailable for a system defined by a Hamiltonian: use the momenta p")
        if formulas := self.interface.layout.velocity_formulas:
            return self._evaluate(formulas, ("p_{}", "{}_dot"), t, q, p, parameters, result)
        with self._at(t, q, p, parameters) as run:
            self.vector(result)[:] = self.vector(p) * self.vector(run.inverse_mass)
        return 0

    def _momentum(self, t: float, q: Any, v: Any, parameters: Any, result: Any, _: Any) -> int:
        if self.interface.layout.momenta:
            raise StateError("the system is defined by a Hamiltonian: give momenta p instead of velocity")
        if formulas := self.interface.layout.momentum_formulas:
            return self._evaluate(formulas, ("{}_dot", "p_{}"), t, q, v, parameters, result)
        with self._at(t, q, v, parameters) as run:
            self.vector(result)[:] = self.vector(v) / self.vector(run.inverse_mass)
        return 0

    def _evaluate(
        self, formulas: Any, names: tuple[str, str], t: float, q: Any, moving: Any, parameters: Any, result: Any
    ) -> int:
        """Compute momenta from velocities, or the reverse; ``names``: of the arrays of both, as formats."""
        from scvi_codegen.formulas.numpy_values import Elements  # here, because it imports SymPy
        from scvi_codegen.formulas.symbols import TIME, symbol

        values, scalars = self.vector(parameters, self.parameter_count), len(self.interface.parameters)
        numbers: dict[Any, float] = {symbol(TIME): t}
        numbers |= {symbol(name): x for name, x in zip(self.interface.parameters, values.tolist(), strict=False)}
        arrays = by_name(self.vector(q), self.shapes) | by_name(values[scalars:], self.fields)
        arrays |= {names[0].format(name): each for name, each in by_name(self.vector(moving), self.shapes).items()}
        targets = {names[1].format(name): each for name, each in by_name(self.vector(result), self.shapes).items()}
        for force in formulas:
            elements = Elements(force.loops, self.sizes.sizes, self.sizes.places)
            for access, formula in force.targets:
                value = elements.values(formula, force.slots, arrays, numbers)
                targets[access.array.name][elements.of(access)] = value
        return 0

    def _momentum_maps(self, count: int, t: Any, q: Any, p: Any, parameters: Any, values: Any, sizes: Any) -> int:
        maps = self.interface.layout.maps
        states = [by_name(self.vector(each, count * self.count).reshape(count, -1), self.shapes) for each in (q, p)]
        results = [self.vector(each, count * len(maps)).reshape(count, -1) for each in (values, sizes)]
        for j, each in enumerate(maps):
            at, moving = states[0][each.array], states[1][each.array]
            results[0][:, j] = momenta_of(at, moving, each)
            results[1][:, j] = momenta_of(np.abs(at), np.abs(moving), each, absolute=True)
        return 0

    def _constraint_values(self, count: int, t: Any, q: Any, p: Any, parameters: Any, g: Any, rate: Any, _: Any) -> int:
        for k, run in self._states(count, t, q, p, parameters):
            row = k * run.constraints
            super().function("constraint_values")(run, self._arrays[run].problem, g + row, rate + row)
        return 0

    def _multipliers(self, count: int, t: Any, q: Any, p: Any, parameters: Any, values: Any, _: Any) -> int:
        for k, run in self._states(count, t, q, p, parameters):
            multipliers = super().function("multipliers")
            if status := multipliers(run, self._arrays[run].problem, values + k * run.constraints):
                return int(status)
        return 0

    def _project(self, t: float, q: Any, p: Any, parameters: Any, q1: Any, p1: Any, _: Any) -> int:
        with self._at(t, q, p, parameters) as run:
            report = super().new("report *")
            status = int(super().function("project")(run, self._arrays[run].problem, self.null, report))
            self.vector(q1)[:], self.vector(p1)[:] = self.vector(run.q), self.vector(run.p)
        return status

    def _apart(self, t: float, q: Any, p: Any, q1: Any, p1: Any, parameters: Any, result: Any, _: Any) -> int:
        """Compute the distances of two states, relative to their largest numbers."""
        for k, pair in enumerate(((q, q1), (p, p1))):
            before, after = map(self.vector, pair)
            size = float(max(np.abs(before).max(initial=0.0), np.abs(after).max(initial=0.0)))
            apart = float(np.abs(after - before).max(initial=0.0))
            rounded = k == 0 and apart <= 1024 * np.finfo(float).eps  # near q = 0, as in constraints.h
            result[k] = min(apart / (size or 1.0), 1e-6 if rounded else np.inf)
        return 0

    def _states(self, count: int, t: Any, q: Any, p: Any, parameters: Any) -> Iterator[tuple[int, Any]]:
        for k in range(count):
            with self._at(t[k], q + k * self.count, p + k * self.count, parameters) as run:
                yield k, run

    @contextmanager
    def _at(self, t: float, q: Any, p: Any, parameters: Any, h: float = 0.0) -> Iterator[Any]:
        """Provide a run at a state; it may be used by one thread at a time."""
        try:
            run = self._unused.pop()
        except IndexError:
            run = self._new_run()
        self._set_state(run, t, h, q, p)
        self._set_parameters(run, self.vector(parameters, self.parameter_count))
        try:
            yield run
        finally:
            self._unused.append(run)


def momenta_of(q: Numbers, p: Numbers, of: ArrayMap, *, absolute: bool = False) -> Numbers:
    """Return (n,) values of a momentum map from (n, ..) states of its array; ``absolute``: sums of absolute terms."""
    if of.phase:
        terms = (q**2 + p**2) / 2
    elif of.component is None:
        terms = p
    elif of.other is None:
        terms = p[..., of.component]
    else:
        sign = 1.0 if absolute else -1.0
        terms = q[..., of.component] * p[..., of.other] + sign * q[..., of.other] * p[..., of.component]
    return np.asarray(terms.reshape(len(terms), -1).sum(axis=1))
