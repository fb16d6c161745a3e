"""Memory of runs over arrays: C structs, SIMD-aligned vectors, index arrays and workspace of constraints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.binding import Binding
from scvi_codegen.runtime.arrays.interface import Numbers
from scvi_codegen.runtime.core.validation import by_name
from scvi_codegen.validation import LARGEST_COUNT

STEP_CONTROL_FIELDS = (
    "grid_level",
    "change",
    "change_before",
    "direction",
    "rejected",
    "failed",
    "avoiding",
    "error_before",
    "steps_to_compare",
)
"""Fields of the C struct that control adaptive steps."""
RUN_FIELDS = (
    *("t", "t_low", "h", "step", "guess", "turn", "error", "error_t"),
    *("largest_q", "largest_p", "steps_from_rest", *STEP_CONTROL_FIELDS),
)
"""Scalar fields of the C struct of a run."""
REAL_FIELDS = ("t", "t_low", "h", "error", "error_t", "largest_q", "largest_p", "error_before")
"""Those of them that are no whole numbers."""
COMPUTED = ("inverse_mass", "places", "columns", "pattern", "compared_factors")
"""Arrays computed from the problem and not restored: foreign indices could address memory out of bounds."""
STATE = ("q", "p", "carry_q", "carry_p")
"""Arrays of the state: positions, momenta and their compensation terms."""
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


def constraint_memory(binding: Binding, run: Any, problem: Any, n: int) -> dict[str, NDArray[Any]]:
    """Allocate the memory of constraints, by the name of its pointer in the C struct.

    Args:
        binding: binding of the integrator.
        run, problem: C structs; the counts of constraints, entries and pairs are stored in ``run``.
        n: number of coordinates.
    """
    binding.function("constraint_sizes")(problem, run)
    count, entries = run.constraints, run.entries
    if not 0 <= count <= entries < 2**31:
        raise StateError(f"invalid constraints ({count} with {entries} coordinates): check the bounds of their loops")
    indices = np.zeros(3 * (count + entries) + n + 3, dtype=np.int32)
    run.places = binding.pointer(indices)
    run.pairs = binding.function("constraint_pairs")(run, problem)
    columns = np.zeros(run.pairs + 1, dtype=np.int32)
    run.columns = binding.pointer(columns)
    binding.function("constraint_pairs")(run, problem)
    return {"places": indices, "columns": columns, "held": aligned(11 * count + 2 * (entries + run.pairs))}


class ArrayMemory:
    """Memory of a run over n coordinates: the C structs of problem and run, and the arrays to which they point.

    Its bytes are readable and assignable as a whole, as those of a C struct.

    Attributes:
        run, problem: the C structs; scalar fields of ``run`` are also attributes of the memory.
        numbers: arrays of ``run`` by name.
        iterations: solver iterations since the last saved state.
        adaptive: whether steps are adaptive; ``h`` is then 0.
        parameters: current scalar parameters and fields, in one vector.
        ready: whether they are set.
    """

    binding: Any
    run: Any
    problem: Any
    numbers: dict[str, NDArray[Any]]
    parameters: Numbers
    iterations: int
    adaptive: bool
    ready: bool

    def __init__(self, binding: Any) -> None:
        n, vector = binding.count, dict[str, NDArray[Any]]()
        run, problem = binding.raw.new("run *"), binding.raw.new("problem *")
        self.__dict__.update(binding=binding, run=run, problem=problem, iterations=0, adaptive=False)
        for k, name in enumerate(binding.interface.layout.sizes):
            problem.size[k] = binding.arrays.sizes[name]
        for k, table in enumerate(binding.interface.layout.tables):
            problem.table[k] = binding.raw.pointer(binding.arrays.places[table.name].reshape(-1))
        state, rest_of = aligned(2 * n), aligned(2 * n)  # Hamiltonian kernels expect p directly after q
        vector |= {"q": state[:n], "p": state[n:], "carry_q": rest_of[:n], "carry_p": rest_of[n:]}
        vector |= {"inverse_mass": aligned(n), "work": aligned(n * binding.raw.constant("WORK"))}
        if binding.interface.layout.constraints:
            vector |= constraint_memory(binding.raw, run, problem, n)
        if (coupled := binding.envelope) is not None:
            width = 2 * binding.raw.constant("SHIFTS")
            size = ALIGNMENT + (n + coupled.entries) * width
            vector |= {"pattern": coupled.pattern, "factors": aligned(size), "compared_factors": aligned(size)}
        for name, array in vector.items():
            setattr(run, name, binding.raw.pointer(array))
        run.threads = binding.arrays.threads
        self.__dict__.update(numbers=vector, parameters=np.zeros(binding.parameter_count), ready=False)

    def __getattr__(self, name: str) -> Any:
        if name in STATE:
            return self.numbers[name]
        if name == "h" and self.adaptive:
            return 0.0
        return getattr(self.run, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__:
            self.__dict__[name] = value
        else:
            setattr(self.run, name, value)

    def set_parameters(self, values: Numbers) -> bool:
        """Set scalar parameters and fields; return whether there were others.

        Reused forces are then discarded; an extrapolated predictor is kept.

        Raises:
            StateError: if a coordinate has no positive mass.
        """
        binding, problem = self.binding, self.problem
        changed = self.ready
        if changed and np.array_equal(values, self.parameters):
            return False
        self.parameters[:], self.ready = values, True
        scalars = len(binding.interface.parameters)
        problem.parameters[0:scalars] = self.parameters[:scalars].tolist()
        for k, field in enumerate(by_name(self.parameters[scalars:], binding.fields).values()):
            problem.field[k] = binding.raw.pointer(field)
        if changed:
            self.run.guess *= binding.interface.layout.continued
            self._forget_factors()
        inverse = self.numbers["inverse_mass"]
        if binding.raw.function("inverse_masses")(problem, self.run.inverse_mass):
            index = int(np.argmin(np.where((inverse > 0) & np.isfinite(inverse), 1.0, -1.0)))
            what = f"coordinate {index} of {len(inverse)}"
            raise StateError(f"{what} has no positive mass: add its kinetic energy to L, or check the parameters")
        return changed

    def start(self, t: float, h: float, q: Numbers, p: Numbers) -> None:
        """Start at a state; nothing of an earlier run remains."""
        for name in RUN_FIELDS:
            setattr(self.run, name, 0)
        self.run.t, self.run.h, self.iterations, self.adaptive = t, h, 0, h == 0.0
        self.numbers["q"][:], self.numbers["p"][:] = q, p
        self.numbers["carry_q"][:] = self.numbers["carry_p"][:] = 0.0
        self._forget_factors()

    def _forget_factors(self) -> None:
        """Let the next step compute the factors of the linear part: their first number is their step size."""
        if "factors" in self.numbers:
            self.numbers["factors"][0] = 0.0

    def __len__(self) -> int:
        return 8 * (len(RUN_FIELDS) + 2) + sum(array.nbytes for array in self._stored())

    def __bytes__(self) -> bytes:
        fields = np.array([float(getattr(self.run, name)) for name in RUN_FIELDS] + [self.iterations, self.adaptive])
        return b"".join([fields.tobytes(), *(array.tobytes() for array in self._stored())])

    def __setitem__(self, _: slice, saved: bytes) -> None:
        fields = np.frombuffer(saved, count=len(RUN_FIELDS) + 2)
        for name, value in zip((*RUN_FIELDS, "iterations", "adaptive"), fields.tolist(), strict=True):
            if name not in REAL_FIELDS and not (value.is_integer() and abs(value) <= LARGEST_COUNT):
                raise StateError(f"invalid saved run: {name} is {value:g}, which is no count")
            setattr(self, name, value if name in REAL_FIELDS else int(value))
        first = fields.nbytes
        for array in self._stored():
            array[:] = np.frombuffer(saved, array.dtype, array.size, first)
            first += array.nbytes

    def _stored(self) -> list[NDArray[Any]]:
        return [array for name, array in self.numbers.items() if name not in COMPUTED]
