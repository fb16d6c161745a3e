"""Run of an array system: its memory, steps and energy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_step
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import FAILURES, NOT_CONVERGED, SolverOptions, step_failure
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.constraints import check_reachable, constraint_values, multipliers
from scvi_codegen.runtime.arrays.interface import Numbers, read_state
from scvi_codegen.runtime.arrays.maps import momentum_of
from scvi_codegen.runtime.arrays.memory import RUN_FIELDS, STATE, ArraySnapshot, aligned, constraint_memory
from scvi_codegen.runtime.arrays.problem import ArrayProblem
from scvi_codegen.runtime.arrays.run_time_sizes import RunTimeSizes
from scvi_codegen.runtime.arrays.saving import (
    damage_as_state_error,
    read_saved,
    restore_memory,
    saved_arrays,
    saved_bytes,
)
from scvi_codegen.runtime.core.validation import missing_input
from scvi_codegen.runtime.run.descriptions import describe_run, short_title
from scvi_codegen.runtime.run.one_thread import OneThread, alone
from scvi_codegen.runtime.run.run import Run
from scvi_codegen.runtime.run.run_loop import drive
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.validation.counts import checked_count

__all__ = ["ArrayRun"]

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


class ArrayRun(OneThread, RunTimeSizes):
    """Run of an array system; made by :meth:`ArrayStepper.start`.

    Args:
        problem: problem data.
        q: positions by name, of the shapes of the problem.
        moving: momenta, velocities or ``None``, by name, and the word ``"momenta"`` or ``"velocities"``.
        h, t: step size (0 for adaptive steps) and initial time.
        plan: step plan of adaptive steps.
        options: convergence criterion of the solver.
        threads: number of threads per step.

    Attributes:
        problem: current problem data; its parameters may change during the run.
        plan, options, threads: as above.
        state: positions and momenta of all coordinates in one vector.
        iterations: total solver iterations.
    """

    COUNTERPART = Run

    def __init__(
        self,
        problem: ArrayProblem,
        q: Mapping[str, Numbers],
        moving: tuple[Any, str],
        *,
        h: float,
        t: float,
        plan: StepPlan | None = None,
        options: SolverOptions | None = None,
        threads: int = 1,
    ) -> None:
        super().__init__()
        self.problem, self.plan, self.iterations, self.threads = problem, plan, 0, threads
        self._binding, self.options = problem.binding, options
        self._options = self._binding.options(options)
        self._start(q, moving, h, t)

    def __repr__(self) -> str:
        sizes = "".join(f", {name} = {size}" for name, size in self.sizes.items())
        return describe_run(
            f"{short_title(self.interface)}{sizes}", self.interface.solver, self, unset_inputs=self.problem.unset_inputs
        )

    @property
    def interface(self) -> Interface:
        """Names and shapes of the integrator."""
        return self.problem.interface

    @property
    def sizes(self) -> dict[str, int]:
        """Values of the sizes by name."""
        return self.problem.arrays.sizes

    def _start(self, state: Mapping[str, Numbers], moving: tuple[Any, str], h: float, t: float) -> None:
        n = self.problem.count
        self.state, rest_of = aligned(2 * n), aligned(2 * n)  # Hamiltonian kernels expect p directly after q
        self._numbers = {"q": self.state[:n], "p": self.state[n:], "carry_q": rest_of[:n], "carry_p": rest_of[n:]}
        self._numbers["inverse_mass"] = aligned(n)
        self._numbers["work"] = aligned(n * self._binding.constant("WORK"))
        self._find_masses()
        self._numbers["q"][:] = self._flat(state)
        values, what = moving
        if values is not None:
            arrays = read_state(self.interface, values, what)
            for name, array in arrays.items():
                if array.shape != state[name].shape:
                    raise StateError(
                        f"{what}: '{name}' must have the shape of the positions, {state[name].shape}, not {array.shape}"
                    )
            flat = self._flat(arrays)
            self._numbers["p"][:] = flat if what == "momenta" else flat / self._numbers["inverse_mass"]
        self._run = self._binding.new("run *")
        self._run.t, self._run.h, self._run.threads = t, h, self.threads
        if self.interface.layout.constraints:
            self._numbers |= constraint_memory(self._binding, self._run, self.problem.struct, n)
        for name in self._numbers:
            setattr(self._run, name, self._pointer(name))

    def _find_masses(self) -> None:
        inverse = self._numbers["inverse_mass"]
        if self._binding.function("inverse_masses")(self.problem.struct, self._pointer("inverse_mass")):
            index = int(np.argmin(np.where((inverse > 0) & np.isfinite(inverse), 1.0, -1.0)))
            what = f"coordinate {index} of {len(inverse)}"
            raise StateError(f"{what} has no positive mass: add its kinetic energy to L, or check the parameters")

    @alone
    def update(
        self,
        *,
        parameters: Mapping[str, ArrayLike] | Sequence[float] | Numbers | None = None,
        h: float | None = None,
        plan: StepPlan | None = None,
    ) -> None:
        """Set parameters (scalars and arrays), step size or step plan; what is omitted is unchanged.

        Momenta are unchanged if masses change.

        Raises:
            StateError: if a name, shape or number is invalid.
        """
        if parameters is not None:
            self._take(self.problem.with_parameters(parameters))
        if h is not None and checked_step(h) != self.h:
            self._run.h, self._run.guess = h, 0
        self.plan = plan or self.plan

    def _take(self, problem: ArrayProblem) -> None:
        """Set another problem of equal sizes; reused forces are discarded, an extrapolated predictor is kept."""
        former, self.problem = self.problem, problem
        self._run.guess *= self.interface.layout.continued
        self._find_masses()
        if self.interface.layout.constraints:
            try:
                check_reachable(self)
            except StateError:
                self.problem = former
                raise

    @alone
    def set_inputs(self, **inputs: float) -> None:
        """Set inputs to constant values for the following steps (zero-order hold)."""
        self._take(self.problem.with_constant_inputs(inputs))

    @alone
    def copy_with_step(self, h: float, plan: StepPlan | None = None) -> ArrayRun:
        """Return an independent run from the present state, bitwise equal, with another step size or step plan."""
        shared_arguments: dict[str, Any] = {"plan": plan, "options": self.options, "threads": self.threads}
        other = ArrayRun(self.problem, self.q, (self.p, "momenta"), h=h, t=self.t, **shared_arguments)
        for name in ("carry_q", "carry_p"):
            other._numbers[name][:] = self._numbers[name]
        other._run.t_low = self._run.t_low
        return other

    @property
    def snapshot(self) -> ArraySnapshot:
        """Snapshot of the present state for :meth:`rollback`."""
        arrays = {name: self._numbers[name].copy() for name in STATE}
        run_fields = {name: getattr(self._run, name) for name in RUN_FIELDS}
        return ArraySnapshot(arrays, run_fields, self.iterations)

    @alone
    def move_to(self, other: ArrayRun) -> None:
        """Copy state and time of another run of the same problem; keep the step count, reset the predictor."""
        for name in STATE:
            self._numbers[name][:] = other._numbers[name]
        self._run.t, self._run.t_low, self._run.guess = other._run.t, other._run.t_low, 0

    @alone
    def rollback(self, snapshot: ArraySnapshot) -> None:
        """Restore a snapshot; the predictor of the next step is reset."""
        for name, values in snapshot.arrays.items():
            self._numbers[name][:] = values
        for name, value in snapshot.run_fields.items():
            setattr(self._run, name, value)
        self._run.guess, self.iterations = 0, snapshot.iterations

    def _pointer(self, name: str) -> Any:
        return self._binding.pointer(self._numbers[name])

    @staticmethod
    def _flat(state: Mapping[str, Numbers]) -> Numbers:
        return np.concatenate([array.reshape(-1) for array in state.values()])

    @property
    def t(self) -> float:
        """Current time."""
        return float(self._run.t)

    @property
    def h(self) -> float:
        """Step size."""
        return float(self._run.h)

    @property
    def steps(self) -> int:
        """Number of completed steps."""
        return int(self._run.step)

    @property
    def q(self) -> dict[str, Numbers]:
        """Copies of the positions by array name."""
        return self._arrays(self._numbers["q"])

    @property
    def p(self) -> dict[str, Numbers]:
        """Copies of the momenta by the name of the coordinate array."""
        return self._arrays(self._numbers["p"])

    @property
    def velocity(self) -> dict[str, Numbers]:
        """Velocities by the name of the coordinate array.

        Raises:
            StateError: if the system is defined by a Hamiltonian.
        """
        if self.interface.layout.momenta:
            raise StateError("velocities are unavailable for a system defined by a Hamiltonian: use the momenta p")
        return self._arrays(self._numbers["p"] * self._numbers["inverse_mass"])

    @property
    def _compensation(self) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
        """Compensation terms (compensated summation) of positions and momenta, as ``q`` and ``p``."""
        return self._arrays(self._numbers["carry_q"]), self._arrays(self._numbers["carry_p"])

    @property
    def inverse_masses(self) -> dict[str, Numbers]:
        """Copies of 1/m of every coordinate by array name; empty for a Hamiltonian."""
        return {} if self.interface.layout.momenta else self._arrays(self._numbers["inverse_mass"])

    def _arrays(self, flat: Numbers) -> dict[str, Numbers]:
        arrays, start = {}, 0
        for array in self.interface.layout.coordinates:
            shape = array.shape(self.sizes)
            size = int(np.prod(shape))
            arrays[array.name] = flat[start : start + size].reshape(shape).copy()
            start += size
        return arrays

    @property
    def energies(self) -> tuple[float, float, float]:
        """Kinetic, potential and total energy in double-double arithmetic; 0, H, H for a Hamiltonian."""
        values, pointers = np.zeros(3), map(self._pointer, ("q", "p", "inverse_mass"))
        self._binding.function("energies")(self.problem.struct, self.t, *pointers, self._binding.pointer(values))
        return (float(values[0]), float(values[1]), float(values[2]))

    @property
    def energy(self) -> float:
        """Total energy of the present state."""
        return self.energies[2]

    @property
    def momentum_maps(self) -> Numbers:
        """(count,) conserved quantities (:func:`~scvi_codegen.mechanics.arrays.symmetry.momentum_maps`)."""
        q, p = self.q, self.p
        return np.array([momentum_of(q[each.array], p[each.array], each) for each in self.interface.layout.maps])

    @property
    @alone
    def multipliers(self) -> tuple[Numbers, ...]:
        """Lagrange multipliers lambda of the forces G^T lambda, an array over the loops of each constraint.

        Raises:
            MethodError: if the system has no constraints.
        """
        return multipliers(self)

    @property
    @alone
    def constraint_values(self) -> tuple[tuple[Numbers, ...], tuple[Numbers, ...]]:
        """Constraint residuals g and rates g_q v + g_t, in the shape of the multipliers; raises as these."""
        return constraint_values(self)

    @property
    def step_error(self) -> float:
        """Estimated error of the worst step, relative to the largest coordinate."""
        return float(self._binding.function("step_error")(self._run))

    @property
    def worst_step_time(self) -> float:
        """Start time of the worst step."""
        return float(self._run.error_t)

    @property
    def rejected_steps(self) -> int:
        """Number of rejected steps."""
        return int(self._run.rejected)

    @property
    def arrived(self) -> bool:
        """Return whether the target time is reached."""
        return self.plan is not None and self.t == self.plan.t_end and self._run.t_low == 0.0

    @alone
    def checkpoint(self) -> bytes:
        """Return the whole run as bytes in NumPy's format (.npz), for :meth:`ArrayStepper.from_checkpoint`."""
        saved: dict[str, Any] = {f"state {name}": array for name, array in self.q.items()}
        saved |= {f"memory {name}": array for name, array in self._numbers.items()}
        saved |= {"moments": [float(getattr(self._run, name)) for name in RUN_FIELDS], "iterations": self.iterations}
        saved |= {"unset_inputs": np.array(self.problem.unset_inputs, dtype=str), "to a time": self.plan is not None}
        return saved_bytes(saved, self.problem.arrays, self.interface)

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (self.interface, self._binding, self.checkpoint(), self.options, self.plan, self.threads)
        return type(self).restored, arguments

    @classmethod
    def restored(
        cls,
        interface: Interface,
        binding: Binding,
        saved: bytes,
        options: SolverOptions | None,
        plan: StepPlan | None = None,
        threads: int = 1,
    ) -> Self:
        """Return the run saved by :meth:`save`.

        Raises:
            StateError: if the bytes are invalid or belong to another integrator or another kind of steps.
        """
        memory = read_saved(saved, interface, to_a_time=plan is not None)
        with damage_as_state_error():
            unset_inputs = tuple(name for name in interface.inputs if name in memory["unset_inputs"].tolist())
            problem = ArrayProblem(interface, binding, saved_arrays(memory, interface), unset_inputs)
            shared_arguments: dict[str, Any] = {"plan": plan, "options": options, "threads": threads}
            run = cls(problem, problem.arrays.state, (None, ""), h=0.0, t=0.0, **shared_arguments)
            restore_memory(run._run, run._numbers, memory)
            run.iterations = checked_count(memory["iterations"].item(), "iterations", least=0)
        return run

    @alone
    def advance(
        self,
        steps: int,
        *,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        """Take ``steps`` steps; adaptive steps end at the target time.

        Args:
            steps: number of steps.
            progress: called after each chunk with the number of steps of the run.
            stop: called as often; the run ends early if it returns true.

        Raises:
            StepFailedError: if a step fails; the run is left at the state before it.
        """
        steps, report = checked_count(steps, "steps", least=0), self._binding.new("report *")
        if steps and self.problem.unset_inputs:
            raise missing_input(self.problem.unset_inputs[0])

        def advance(size: int) -> int:
            status = self._steps(size, report)
            self.iterations += report.iterations
            if status:
                h, failures = 0.0 if self.plan else self.h, FAILURES_BY_SOLVER[self.interface.solver]
                raise step_failure(status, report, step=self.steps, h=h, failures=failures)
            return int(report.steps)

        drive(
            advance,
            steps,
            ended=lambda: self.arrived or bool(stop and stop()),
            progress=progress and (lambda _: progress(self.steps)),
        )

    def call(self, name: str, *arguments: Any) -> int:
        """Call a C function with the run as its first argument and return its status."""
        return int(self._binding.function(name)(self._run, *arguments) or 0)

    def _steps(self, size: int, report: Any) -> int:
        """Take steps and return the status of the last one."""
        problem, plan = self.problem.struct, self.plan
        if plan is None:
            return self.call("advance", problem, size, self._options, report)
        return self.call("advance_to", problem, plan.t_end, plan.tolerance, size, self._options, report)
