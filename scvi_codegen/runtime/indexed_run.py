"""A run over arrays of any size: its memory, steps, energy."""

from __future__ import annotations

import io
import time
import zipfile
from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StateError
from scvi_codegen.indices import IndexedMap
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions, step_failure
from scvi_codegen.runtime.indexed_interface import (
    IndexedInterface,
    Numbers,
    read_arrays,
    read_state,
)
from scvi_codegen.runtime.portions import SLICE_SECONDS

__all__ = ["IndexedRun"]

ADVICE = {
    "not converged": "sweeps contract while h times the highest frequency is less than about 1 to 3: try a smaller h",
    "not finite": "the Lagrangian is undefined there, or the step is far too large",
}
MOMENTS = ("t", "t_low", "h", "step", "guess", "turn", "error", "error_t")
"""Of a run, beside its arrays."""

ALIGNMENT = 64
"""Bytes: those of the widest vector."""


class IndexedRun:
    """The memory of a run; made by :meth:`IndexedStepper.start`.

    Attributes:
        iterations: sweeps of all steps yet.
        sizes: value of each size.
    """

    def __init__(
        self,
        interface: IndexedInterface,
        binding: Binding,
        *,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None,
        h: float,
        t: float,
        parameters: Mapping[str, ArrayLike] | None,
        tables: Mapping[str, ArrayLike] | None,
        options: SolverOptions | None,
    ) -> None:
        self.interface, self._binding, self.iterations = interface, binding, 0
        self._options = binding.options(options)
        given = read_arrays(interface, q, parameters, tables)
        self.sizes, self._kept = given.sizes, (given.places, given.fields)
        self._problem = self._new_problem(given.numbers)
        self._start(given.state, self._momenta(p, velocity), checked_step(h), checked_number(t, "t"))

    def __repr__(self) -> str:
        return f"<IndexedRun of {self.interface.title}: {self.sizes}, t = {self.t:g} after {self.steps} steps>"

    def _new_problem(self, numbers: list[float]) -> Any:
        places, fields = self._kept
        problem = self._binding.new("problem *")
        for k, name in enumerate(self.interface.sizes):
            problem.size[k] = self.sizes[name]
        for k, array in enumerate(self.interface.fields):
            problem.field[k] = self._binding.pointer(fields[array.name].reshape(-1))
        for k, table in enumerate(self.interface.tables):
            problem.table[k] = self._binding.pointer(places[table.name].reshape(-1))
        for k, value in enumerate(numbers):
            problem.parameters[k] = value
        return problem

    def _momenta(self, p: Any, velocity: Any) -> tuple[Any, str]:
        if velocity is not None and self.interface.momenta:
            raise StateError("where a Hamiltonian is given, momenta p are the start, not the velocity")
        if p is not None and velocity is not None:
            raise StateError("give momenta p or the velocity, not both")
        return (p, "momenta") if velocity is None else (velocity, "velocities")

    def _start(self, state: Mapping[str, Numbers], moving: tuple[Any, str], h: float, t: float) -> None:
        n = self._binding.function("coordinates")(self._problem)
        state_of, rest_of = aligned(2 * n), aligned(2 * n)  # of a Hamiltonian momenta stand behind positions
        self._numbers = {"q": state_of[:n], "p": state_of[n:], "carry_q": rest_of[:n], "carry_p": rest_of[n:]}
        self._numbers["inverse_mass"] = aligned(n)
        self._numbers["work"] = aligned(n * self._binding.constant("WORK"))
        inverse = self._numbers["inverse_mass"]
        if self._binding.function("inverse_masses")(self._problem, self._pointer("inverse_mass")):
            place = int(np.argmin(np.where((inverse > 0) & np.isfinite(inverse), 1.0, -1.0)))
            raise StateError(f"coordinate {place} of {n} has no positive mass: every one needs a kinetic energy")
        self._numbers["q"][:] = self._flat(state)
        given, what = moving
        if given is not None:
            values = read_state(self.interface, given, what)
            for name, array in values.items():
                if array.shape != state[name].shape:
                    raise StateError(f"{what}: '{name}' has the shape {array.shape}, positions {state[name].shape}")
            self._numbers["p"][:] = self._flat(values) if what == "momenta" else self._flat(values) / inverse
        self._run = self._binding.new("run *")
        self._run.t, self._run.h = t, h
        for name in self._numbers:
            setattr(self._run, name, self._pointer(name))

    def _pointer(self, name: str) -> Any:
        return self._binding.pointer(self._numbers[name])

    @staticmethod
    def _flat(state: Mapping[str, Numbers]) -> Numbers:
        return np.concatenate([array.reshape(-1) for array in state.values()])

    @property
    def t(self) -> float:
        """Time."""
        return float(self._run.t)

    @property
    def h(self) -> float:
        """The step."""
        return float(self._run.h)

    @property
    def steps(self) -> int:
        """Steps yet."""
        return int(self._run.step)

    @property
    def q(self) -> dict[str, Numbers]:
        """Positions by the name of their array, copies."""
        return self._arrays(self._numbers["q"])

    @property
    def p(self) -> dict[str, Numbers]:
        """Momenta by the name of the array of their coordinates, copies."""
        return self._arrays(self._numbers["p"])

    @property
    def velocity(self) -> dict[str, Numbers]:
        """Velocities by the name of the array of their coordinates.

        Raises:
            StateError: where a Hamiltonian is given.
        """
        if self.interface.momenta:
            raise StateError("where a Hamiltonian is given, a state is positions and momenta: velocities are not known")
        return self._arrays(self._numbers["p"] * self._numbers["inverse_mass"])

    @property
    def carries(self) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
        """What rounding cut off positions and momenta, as ``q`` and ``p``."""
        return self._arrays(self._numbers["carry_q"]), self._arrays(self._numbers["carry_p"])

    @property
    def inverse_masses(self) -> dict[str, Numbers]:
        """1/m of every coordinate by the name of its array, copies; nothing where a Hamiltonian is given."""
        return {} if self.interface.momenta else self._arrays(self._numbers["inverse_mass"])

    def _arrays(self, flat: Numbers) -> dict[str, Numbers]:
        found, start = {}, 0
        for array in self.interface.coordinates:
            shape = array.shape(self.sizes)
            size = int(np.prod(shape))
            found[array.name] = flat[start : start + size].reshape(shape).copy()
            start += size
        return found

    @property
    def energies(self) -> tuple[float, float, float]:
        """Kinetic and potential energy of the present state, and their sum, in twice the precision; 0, H and H."""
        found, pointers = np.zeros(3), map(self._pointer, ("q", "p", "inverse_mass"))
        self._binding.function("energies")(self._problem, self.t, *pointers, self._binding.pointer(found))
        return (float(found[0]), float(found[1]), float(found[2]))

    @property
    def energy(self) -> float:
        """Their sum."""
        return self.energies[2]

    @property
    def momentum_maps(self) -> Numbers:
        """What symmetries conserve (:func:`~scvi_codegen.mechanics.indexed.symmetry.momentum_maps`), (count,)."""
        q, p = self.q, self.p
        return np.array([_momentum(q[each.array], p[each.array], each) for each in self.interface.maps])

    @property
    def step_error(self) -> float:
        """An estimate of the error of the end of the worst step, relative to the largest coordinate."""
        return float(self._binding.function("step_error")(self._run))

    @property
    def step_error_t(self) -> float:
        """When that step began."""
        return float(self._run.error_t)

    def save(self) -> bytes:
        """All of it, arrays and tables, for :meth:`IndexedStepper.restore`: a file of NumPy's (.npz)."""
        places, fields = self._kept
        numbers = [self._problem.parameters[k] for k in range(len(self.interface.parameters))]
        moments = [getattr(self._run, name) for name in MOMENTS]
        saved: dict[str, Any] = {f"table {name}": array for name, array in places.items()}
        saved |= {f"field {name}": array for name, array in fields.items()}
        saved |= {f"state {name}": array for name, array in self.q.items()}
        saved |= {f"memory {name}": array for name, array in self._numbers.items()}
        file = io.BytesIO()
        title = np.array(self.interface.title)
        np.savez(file, title=title, parameters=numbers, moments=moments, iterations=self.iterations, **saved)
        return file.getvalue()

    @classmethod
    def restored(
        cls, interface: IndexedInterface, binding: Binding, saved: bytes, options: SolverOptions | None
    ) -> Self:
        """The run that :meth:`save` gave.

        Raises:
            StateError: for other bytes, and for a run of another integrator.
        """
        try:
            found = dict(np.load(io.BytesIO(saved), allow_pickle=False))
            if str(found["title"]) != interface.title:
                raise StateError(f"this is a run of '{found['title']}', not of '{interface.title}'")
            moments = dict(zip(MOMENTS, found["moments"].tolist(), strict=True))
            run = cls(
                interface,
                binding,
                q={array.name: found[f"state {array.name}"] for array in interface.coordinates},
                p=None,
                velocity=None,
                h=moments["h"],
                t=moments["t"],
                parameters=dict(zip(interface.parameters, found["parameters"].tolist(), strict=True))
                | {field.name: found[f"field {field.name}"] for field in interface.fields},
                tables={table.name: found[f"table {table.name}"] for table in interface.tables},
                options=options,
            )
            for name, array in run._numbers.items():
                array[:] = found[f"memory {name}"]
            for name, value in moments.items():
                setattr(run._run, name, type(getattr(run._run, name))(value))
            run.iterations = int(found["iterations"])
        except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
            if isinstance(error, StateError):
                raise
            raise StateError(f"these bytes are no saved run: {error}") from error
        return run

    def advance(
        self,
        steps: int,
        *,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        """So many steps.

        Args:
            steps: their number.
            progress: called now and then with the number of steps of the run.
            stop: asked as often whether to end before.

        Raises:
            StepFailedError: if one fails; the run stands before it.
        """
        steps, done, portion = checked_count(steps, "steps", least=0), 0, 1
        report = self._binding.new("report *")
        while done < steps and not (stop and stop()):
            size, began = min(portion, steps - done), time.perf_counter()
            status = self._binding.function("advance")(self._run, self._problem, size, self._options, report)
            done += report.steps
            self.iterations += report.iterations
            if status:
                raise step_failure(status, report, step=self.steps, h=self.h, advice=ADVICE)
            if progress is not None:
                progress(self.steps)
            elapsed = max(time.perf_counter() - began, 1e-6)
            portion = max(1, int(min(2.0 * size, size * SLICE_SECONDS / elapsed)))


def aligned(count: int) -> Numbers:
    """So many zeros, the first on the boundary of a vector."""
    try:
        memory = np.zeros(count + ALIGNMENT // 8)
    except (MemoryError, ValueError) as error:
        raise StateError(f"{count} numbers do not fit into the memory") from error
    start = -memory.ctypes.data % ALIGNMENT // 8
    return memory[start : start + count]


def _momentum(q: Numbers, p: Numbers, of: IndexedMap) -> float:
    if of.phase:
        return float(np.sum(q**2 + p**2) / 2)
    if of.component is None:
        return float(np.sum(p))
    if of.other is None:
        return float(np.sum(p[..., of.component]))
    return float(np.sum(q[..., of.component] * p[..., of.other] - q[..., of.other] * p[..., of.component]))
