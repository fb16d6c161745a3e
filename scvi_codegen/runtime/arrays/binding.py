"""Binding of arrays whose sizes are known at run time, with the functions of a binding of known sizes.

The C functions of arrays take the data of the problem and a run whose arrays lie in memory of the caller. Here they
have the arguments of the functions of known sizes, so that steppers, runs and trajectories are the same for both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.indices import ArrayMap
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.building import Library
from scvi_codegen.native.options import FAILURES, NOT_CONVERGED
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.envelope import envelope_of
from scvi_codegen.runtime.arrays.interface import Numbers, RunSizes
from scvi_codegen.runtime.arrays.memory import ArrayMemory
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


class _Report(SimpleNamespace):
    """Report of a call, with the messages of its failures."""

    interface: Interface

    @property
    def failures(self) -> dict[str, tuple[str, str]]:
        failures = FAILURES_BY_SOLVER.get(self.interface.solver, FAILURES)
        if (mesh := self.interface.layout.mesh) is None:
            return failures
        limit = f". The highest frequency of the mesh is at most {mesh.highest_frequency():.3g}: see its largest_step()"
        return {word: (what, remedy + limit) for word, (what, remedy) in failures.items()}


class ArrayBinding(Binding):
    """Binding of arrays of given sizes and tables; states and parameters are vectors, as for known sizes.

    Args:
        library: the compiled source.
        interface: interface of the source.
        arrays: sizes, tables and number of threads per step.
    """

    reusable = False

    def __init__(self, library: Library, interface: Interface, arrays: RunSizes) -> None:
        super().__init__(library, interface.prefix)
        self.raw = Binding(library, interface.prefix)
        self.interface, self.arrays, self._unused = interface, arrays, list[ArrayMemory]()
        self.shapes, self.fields = (
            [(array.name, array.shape(arrays.sizes)) for array in each]
            for each in (interface.layout.coordinates, interface.layout.fields)
        )
        self.count = sum(math.prod(shape) for _, shape in self.shapes)
        self.parameter_count = len(interface.parameters) + sum(math.prod(shape) for _, shape in self.fields)
        self.envelope = envelope_of(interface.layout, arrays)

    def new(self, what: str) -> Any:
        """Return memory of a run, or a report, as :meth:`Binding.new` does."""
        if what == "run *":
            return ArrayMemory(self)
        return _Report(interface=self.interface, steps=0, stored=0, iterations=0, change=0.0, t=0.0)

    def buffer(self, struct: Any) -> Any:
        """Return the memory of a run, whose bytes are readable and writable, and arrays as they are."""
        return struct

    def has(self, name: str) -> bool:
        """Return whether there is such a function."""
        if name in ("advance_to", "project"):
            return bool(super().has(name))
        return hasattr(self, f"_{name}")

    def function(self, name: str, memory: Any = None) -> Callable[..., Any]:
        """Return a function with the arguments of the C function of known sizes, bound to the memory of a run."""
        function = getattr(self, f"_{name}")
        return function if memory is None else partial(function, memory)

    def _set_parameters(self, memory: ArrayMemory, values: Numbers) -> None:
        if memory.set_parameters(values) and self.interface.layout.constraints:  # rates may jump, positions may not
            q = memory.q.copy()
            self.raw.function("project")(memory.run, memory.problem, self.null, self.raw.new("report *"))
            memory.q[:] = q

    def _start(self, memory: ArrayMemory, t: float, h: float, q: Any, p: Any) -> None:
        memory.start(t, h, self._vector(q), self._vector(p))

    def _step_error(self, memory: ArrayMemory) -> float:
        return float(self.raw.function("step_error")(memory.run))

    def _advance(self, memory: ArrayMemory, *arguments: Any) -> int:
        return self._advance_plan(memory, None, *arguments)

    def _advance_to(self, memory: ArrayMemory, t_end: float, tolerance: float, *arguments: Any) -> int:
        return self._advance_plan(memory, (t_end, tolerance), *arguments)

    def _advance_plan(
        self,
        memory: ArrayMemory,
        plan: tuple[float, float] | None,
        steps: int,
        save_every: int,
        _: Any,
        options: Any,
        t: Any,
        q: Any,
        p: Any,
        iterations: Any,
        report: Any,
        __: Any,
    ) -> int:
        """Take steps and store every ``save_every``-th state, and the state at the target time."""
        made, done, row, status = self.raw.new("report *"), 0, 0, 0
        function = self.raw.function("advance" if plan is None else "advance_to", memory.run)
        arrived = plan is not None and _arrived(memory, plan[0])
        while done < steps and not (status or arrived):
            size = min(save_every - memory.step % save_every, steps - done)
            status = function(memory.problem, *(plan or ()), size, options, made)
            done, memory.iterations = done + made.steps, memory.iterations + made.iterations
            arrived = plan is not None and _arrived(memory, plan[0])
            if not status and (memory.step % save_every == 0 or arrived):
                t[row], iterations[row] = memory.t, memory.iterations
                for target, name in ((q, "q"), (p, "p")):
                    self._ffi.memmove(target + row * self.count, getattr(memory.run, name), 8 * self.count)
                row, memory.iterations = row + 1, 0
        report.steps, report.stored, report.iterations = done, row, made.iterations
        report.change, report.t = made.change, made.t
        return status

    def _step(
        self, t: float, h: float, q: Any, p: Any, parameters: Any, options: Any, q1: Any, p1: Any, report: Any, _: Any
    ) -> int:
        with self._at(t, q, p, parameters, h) as memory:
            unused = self.numbers("double *"), self.numbers("int *")
            return self._advance(memory, 1, 1, None, options, unused[0], q1, p1, unused[1], report, None)

    def _energies(self, count: int, t: Any, q: Any, p: Any, parameters: Any, result: Any, _: Any) -> int:
        parts = np.empty((count, 3))
        self._energy_parts(count, t, q, p, parameters, self.raw.pointer(parts))
        self._vector(result, count)[:] = parts[:, 2]
        return 0

    def _energy_parts(self, count: int, t: Any, q: Any, p: Any, parameters: Any, parts: Any) -> None:
        """Compute (n, 3) kinetic, potential and total energies in double-double arithmetic; 0, H, H if given by H."""
        n = self.count
        with self._at(0.0, q, p, parameters) as memory:
            for k in range(count):
                memory.q[:], memory.p[:] = self._vector(q + k * n), self._vector(p + k * n)
                arrays = (memory.run.q, memory.run.p, memory.run.inverse_mass, parts + 3 * k)
                self.raw.function("energies")(memory.problem, t[k], *arrays)
        if self.interface.layout.velocity_formulas:  # the terms of H are no parts of the energy
            self._vector(parts, 3 * count).reshape(-1, 3)[:, :2] = np.nan

    def _velocity(self, t: float, q: Any, p: Any, parameters: Any, result: Any, _: Any) -> int:
        if self.interface.layout.momenta:
            raise StateError("velocities are unavailable for a system defined by a Hamiltonian: use the momenta p")
        if formulas := self.interface.layout.velocity_formulas:
            return self._evaluate(formulas, ("p_{}", "{}_dot"), t, q, p, parameters, result)
        with self._at(t, q, p, parameters) as memory:
            self._vector(result)[:] = memory.p * memory.numbers["inverse_mass"]
        return 0

    def _momentum(self, t: float, q: Any, v: Any, parameters: Any, result: Any, _: Any) -> int:
        if self.interface.layout.momenta:
            raise StateError("the system is defined by a Hamiltonian: give momenta p instead of velocity")
        if formulas := self.interface.layout.momentum_formulas:
            return self._evaluate(formulas, ("{}_dot", "p_{}"), t, q, v, parameters, result)
        with self._at(t, q, v, parameters) as memory:
            self._vector(result)[:] = memory.p / memory.numbers["inverse_mass"]
        return 0

    def _evaluate(
        self, formulas: Any, names: tuple[str, str], t: float, q: Any, moving: Any, parameters: Any, result: Any
    ) -> int:
        """Compute momenta from velocities, or the reverse; ``names``: of the arrays of both, as formats."""
        from scvi_codegen.formulas.numpy_values import Elements  # here, because it imports SymPy
        from scvi_codegen.formulas.symbols import TIME, symbol

        values, scalars = self._vector(parameters, self.parameter_count), len(self.interface.parameters)
        numbers: dict[Any, float] = {symbol(TIME): t}
        numbers |= {symbol(name): x for name, x in zip(self.interface.parameters, values.tolist(), strict=False)}
        arrays = by_name(self._vector(q), self.shapes) | by_name(values[scalars:], self.fields)
        arrays |= {names[0].format(name): each for name, each in by_name(self._vector(moving), self.shapes).items()}
        targets = {names[1].format(name): each for name, each in by_name(self._vector(result), self.shapes).items()}
        for force in formulas:
            elements = Elements(force.loops, self.arrays.sizes, self.arrays.places)
            for access, formula in force.targets:
                value = elements.values(formula, force.slots, arrays, numbers)
                targets[access.array.name][elements.of(access)] = value
        return 0

    def _momentum_maps(self, count: int, t: Any, q: Any, p: Any, parameters: Any, values: Any, sizes: Any) -> int:
        maps, n = self.interface.layout.maps, self.count
        for k in range(count):
            states = [by_name(self._vector(each + k * n), self.shapes) for each in (q, p)]
            absolute = [{name: np.abs(each) for name, each in state.items()} for state in states]
            for j, each in enumerate(maps):
                values[k * len(maps) + j] = momentum_of(states[0][each.array], states[1][each.array], each)
                size = momentum_of(absolute[0][each.array], absolute[1][each.array], each, absolute=True)
                sizes[k * len(maps) + j] = size
        return 0

    def _constraint_values(self, count: int, t: Any, q: Any, p: Any, parameters: Any, g: Any, rate: Any, _: Any) -> int:
        for k, memory in self._states(count, t, q, p, parameters):
            row = k * memory.constraints
            self.raw.function("constraint_values")(memory.run, memory.problem, g + row, rate + row)
        return 0

    def _multipliers(self, count: int, t: Any, q: Any, p: Any, parameters: Any, values: Any, _: Any) -> int:
        for k, memory in self._states(count, t, q, p, parameters):
            multipliers = self.raw.function("multipliers")
            if status := multipliers(memory.run, memory.problem, values + k * memory.constraints):
                return int(status)
        return 0

    def _project(self, t: float, q: Any, p: Any, parameters: Any, q1: Any, p1: Any, _: Any) -> int:
        with self._at(t, q, p, parameters) as memory:
            report = self.raw.new("report *")
            status = int(self.raw.function("project")(memory.run, memory.problem, self.null, report))
            self._vector(q1)[:], self._vector(p1)[:] = memory.q, memory.p
        return status

    def _apart(self, t: float, q: Any, p: Any, q1: Any, p1: Any, parameters: Any, result: Any, _: Any) -> int:
        """Compute the distances of two states, relative to their largest numbers."""
        for k, pair in enumerate(((q, q1), (p, p1))):
            before, after = map(self._vector, pair)
            size = float(max(np.abs(before).max(initial=0.0), np.abs(after).max(initial=0.0)))
            result[k] = float(np.abs(after - before).max(initial=0.0)) / (size or 1.0)
        return 0

    def _states(self, count: int, t: Any, q: Any, p: Any, parameters: Any) -> Iterator[tuple[int, ArrayMemory]]:
        for k in range(count):
            with self._at(t[k], q + k * self.count, p + k * self.count, parameters) as memory:
                yield k, memory

    @contextmanager
    def _at(self, t: float, q: Any, p: Any, parameters: Any, h: float = 0.0) -> Iterator[ArrayMemory]:
        """Provide memory of a run at a state; it may be used by one thread at a time."""
        try:
            memory = self._unused.pop()
        except IndexError:
            memory = ArrayMemory(self)
        memory.start(t, h, self._vector(q), self._vector(p))
        memory.set_parameters(self._vector(parameters, self.parameter_count))
        try:
            yield memory
        finally:
            self._unused.append(memory)

    def _vector(self, pointer: Any, count: int | None = None) -> Numbers:
        """Return the numbers at a pointer."""
        size = self.count if count is None else count
        return np.frombuffer(self._ffi.buffer(pointer, 8 * size)) if size else np.empty(0)


def momentum_of(q: Numbers, p: Numbers, of: ArrayMap, *, absolute: bool = False) -> float:
    """Return the value of a momentum map from the positions and momenta of its array; ``absolute``: sum of terms."""
    if of.phase:
        return float(np.sum(q**2 + p**2) / 2)
    if of.component is None:
        return float(np.sum(p))
    if of.other is None:
        return float(np.sum(p[..., of.component]))
    sign = 1.0 if absolute else -1.0
    return float(np.sum(q[..., of.component] * p[..., of.other] + sign * q[..., of.other] * p[..., of.component]))


def _arrived(memory: ArrayMemory, t_end: float) -> bool:
    return bool(memory.t == t_end and memory.t_low == 0.0)
