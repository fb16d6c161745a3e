"""Compiled integrator of arrays whose sizes are those of each call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.indices import SIZES_REQUIRED
from scvi_codegen.native import building
from scvi_codegen.rendering.kernels.loop_nests import MOST_THREADS
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.runtime.arrays.bound import BoundStepper
from scvi_codegen.runtime.arrays.interface import first_state, flat, read_arrays, read_state
from scvi_codegen.runtime.arrays.saving import read_saved
from scvi_codegen.runtime.core.compiled_method import Variants
from scvi_codegen.runtime.core.stepper import RunSettings, Stepper
from scvi_codegen.runtime.run.run import Run
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.validation import MAPPING, checked_count, checks_arguments

MOST_COORDINATES = 2000
"""Largest number of coordinates that are compiled with known sizes for what requires it."""


class UnavailableError(MethodError, AttributeError):
    """Error of a feature that requires known sizes; ``hasattr`` is false."""


class ArrayStepper:
    """Compiled integrator of arrays of any size: a :class:`Stepper` is bound to the arrays of each call.

    A system or method without an integrator for arrays of any size has no source: each call uses :meth:`with_sizes`.
    Every method of :class:`Stepper` whose first argument is q is also a method of this class. Its states are arrays of
    the declared shapes, one or several by name, which determine the sizes, or vectors for :meth:`with_sizes`;
    additional arguments are ``tables`` and ``threads`` (per step). Without p and velocity the initial velocity is 0.

    Args:
        variants: source with adaptive steps, ``"controlled"``.
        of_sizes: compiles the stepper of known sizes and tables.
        reason: reason why there is no source for arrays of any size.

    Attributes:
        source: the C source; ``None`` if it is compiled with the sizes of each call.
        interface: names and shapes.
        flags: flags of the C compiler.
    """

    REQUIRES_SIZES = SIZES_REQUIRED

    def __init__(
        self,
        source: Source | None,
        interface: Interface,
        *,
        variants: Variants | None = None,
        flags: tuple[str, ...] = building.TUNED_FLAGS,
        of_sizes: Callable[..., Any] | None = None,
        reason: str = "",
    ) -> None:
        self.source, self.interface, self.flags, self._of_sizes = source, interface, flags, of_sizes
        self._reason = reason
        self._variants = Variants() if variants is None else variants
        self._known: dict[Any, Stepper] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return (_rebuild, (self.source, self.interface, self._variants, self.flags))

    def __repr__(self) -> str:
        return clipped(f"ArrayStepper({self.interface.title})", LONGEST)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or not hasattr(Stepper, name):
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        if not callable(getattr(Stepper, name)):
            raise UnavailableError(f"{name} is not available for {type(self).__name__}: {SIZES_REQUIRED}")
        return partial(self._call, name)

    def _call(
        self,
        name: str,
        q: Any,
        *arguments: Any,
        parameters: Any = None,
        tables: Mapping[str, ArrayLike] | None = None,
        **others: Any,
    ) -> Any:
        """Call a method of the stepper that is bound to the arrays of the call."""
        q, several = first_state(self.interface, q)
        bound, state = self.bind(q, parameters, tables)
        return getattr(bound, name)(state if several is None else several, *arguments, parameters=parameters, **others)

    @property
    def momentum_map_names(self) -> tuple[str, ...]:
        """Names of the conserved quantities: translations and rotations of whole arrays."""
        return tuple(each.name for each in self.interface.layout.maps)

    def prepare(self, *, adaptive: bool = True) -> None:
        """Compile now what the first run would compile; with ``adaptive`` also the variant that ``t_end=`` needs."""
        variants = (self.source, self._variants["controlled"] if adaptive and self.source else None)
        for source in filter(None, variants):
            building.load(source, flags=self.flags)

    def with_sizes(
        self,
        sizes: Mapping[str, int] | None = None,
        /,
        *,
        tables: Mapping[str, ArrayLike] | None = None,
        **named: int,
    ) -> Stepper:
        """Return the stepper compiled with these sizes, ``with_sizes(N=9)``, once; it has every feature.

        Raises:
            MethodError: if a size is missing, there are more than 2000 coordinates, or the stepper was unpickled or
                loaded from a folder and hence lacks its system.
        """
        values = {**(sizes or {}), **named}
        if missing := [name for name in self.interface.layout.sizes if name not in values]:
            raise MethodError(f"the size {missing[0]} is missing: give with_sizes({missing[0]}=...)")
        count = sum(int(np.prod(array.shape(values))) for array in self.interface.layout.coordinates)
        if count > MOST_COORDINATES:
            raise MethodError(
                f"{count} coordinates are too many to compile with known sizes, which this requires: at most "
                f"{MOST_COORDINATES}{'. ' * bool(self._reason)}{self._reason}"
            )
        if self._of_sizes is None:
            raise MethodError(f"{self!r} lacks its system: call compile_stepper(system, method, sizes={values})")
        key = (tuple(sorted(values.items())), *((name, np.asarray(x).tobytes()) for name, x in (tables or {}).items()))
        if key not in self._known:
            known: Stepper = self._of_sizes(sizes=values, tables=dict(tables) if tables else None)
            self._known[key] = known
        return self._known[key]

    def bind(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        threads: int | None = None,
    ) -> tuple[Stepper, Any]:
        """Return the stepper bound to the sizes and tables of these arrays, and the states as vectors.

        Raises:
            StateError: if a name, shape or number is invalid, or an index would leave its array.
        """
        count = checked_count(1 if threads is None else threads, "threads", least=1, most=MOST_THREADS)
        if count > 1 and self.interface.layout.constraints:
            raise MethodError("systems with constraints use one thread: omit threads")
        arrays = read_arrays(self.interface, q, parameters, tables)
        if self.source is None:
            if count > 1:
                raise MethodError(f"omit threads: this system is compiled with the sizes of each call. {self._reason}")
            return self.with_sizes(arrays.sizes, tables=arrays.places), flat(arrays.state)
        return BoundStepper(self, arrays, threads=count), flat(arrays.state)

    def _moving(self, q: Any, p: Any, velocity: Any) -> dict[str, Any]:
        """Return the validated momenta or velocities as vectors."""
        if velocity is not None and self.interface.layout.momenta:
            raise StateError("the system is defined by a Hamiltonian: give momenta p instead of velocity")
        if p is not None and velocity is not None:
            raise StateError("give either p or velocity, not both")
        if p is velocity is None:
            return {"p": np.zeros(np.shape(flat(read_state(self.interface, q, "positions"))))}
        name, what, values = ("p", "momenta", p) if velocity is None else ("velocity", "velocities", velocity)
        positions, arrays = read_state(self.interface, q, "positions"), read_state(self.interface, values, what)
        for array, each in arrays.items():
            if each.shape != (shape := positions[array].shape):
                raise StateError(f"{what}: '{array}' must have the shape of the positions, {shape}, not {each.shape}")
        return {name: flat(arrays)}

    @checks_arguments(StateError, parameters=MAPPING, tables=MAPPING)
    def start(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        threads: int | None = None,
        **settings: Any,
    ) -> Run:
        """Return a run, as :meth:`Stepper.start`; other arguments as of :meth:`integrate`."""
        bound, states = self.bind(q, parameters, tables, threads)
        return bound.start(states, **self._moving(q, p, velocity), parameters=parameters, **settings)

    @checks_arguments(StateError, parameters=MAPPING, tables=MAPPING)
    def integrate(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        threads: int | None = None,
        inputs: Mapping[str, Any] | None = None,
        **settings: Unpack[RunSettings],
    ) -> Trajectory:
        """Return the trajectory of a run, as :meth:`Stepper.integrate`, whose other arguments it has.

        Args:
            q: initial positions: an array of the declared shape, or several by name; their shapes determine the sizes.
            p, velocity: initial momenta or velocities, in the same form; by default 0.
            parameters: scalars and arrays by name; others have their defaults.
            tables: (rows, columns) whole numbers by name; (rows,) suffices for a single column.
            threads: number of threads per step, by default one; results are bitwise equal. Threads pay off if a step
                takes longer than some tens of microseconds; they are started again at every saved state.
            inputs, settings: as of :meth:`Stepper.integrate`; events are formulas in index notation, ``"q[0] - 1"``,
                ``"sum(i in N, q[i]**2) - 5"``, of coordinates, velocities, momenta, parameters and t.

        Raises:
            StateError: if a name, shape or number is invalid, or an index would leave its array; else as
                :meth:`Stepper.integrate`.
        """
        bound, states = self.bind(q, parameters, tables, threads)
        moving, given = self._moving(q, p, velocity), dict[str, Any](settings)
        return bound.integrate(states, **moving, parameters=parameters, inputs=inputs, **given)

    def project(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        t: float = 0.0,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
    ) -> tuple[Any, Any]:
        """Return the nearest state (q, p) on the constraint manifold, as :meth:`Stepper.project`."""
        bound, states = self.bind(q, parameters, tables)
        return bound.project(states, **self._moving(q, p, velocity), t=t, parameters=parameters)

    def from_checkpoint(self, saved: bytes, *, threads: int | None = None, **settings: Any) -> Run:
        """Restore a run from :meth:`Run.checkpoint` with its tables and parameters, as :meth:`Stepper.from_checkpoint`.

        Raises:
            StateError: if the bytes are no saved run or belong to another integrator.
        """
        run = read_saved(saved, self.interface, to_a_time=settings.get("t_end") is not None)
        count = checked_count(threads or 1, "threads", least=1, most=MOST_THREADS)
        bound = BoundStepper(self, run.arrays, threads=count)
        return bound.from_checkpoint(run.state, parameters=run.parameters, **settings)


def _rebuild(source: Source | None, interface: Interface, variants: Variants, flags: tuple[str, ...]) -> ArrayStepper:
    return ArrayStepper(source, interface, variants=variants, flags=flags)
