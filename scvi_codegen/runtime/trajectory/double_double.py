"""Steppers and runs in double-double arithmetic: states of two words each, 31 digits.

Numbers go in as floats, text (``"0.1"`` is one tenth), fractions, mpmath numbers or ``numpy.longdouble``, and come out
as arrays of high and of low words, or as mpmath numbers. In C a vector is its high words, followed by its low words.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from numbers import Rational
from typing import Any

import numpy as np
from mpmath import mp
from numpy.typing import NDArray

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.native import building
from scvi_codegen.native.arguments import checked_number, checked_step, empty_array
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import REASONS, SolverOptions, step_failure
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.runtime.core.features import OPERATIONS, Support, check_features
from scvi_codegen.runtime.core.validation import check_named
from scvi_codegen.runtime.run.chunks import drive
from scvi_codegen.runtime.run.times import steps_to, times_after
from scvi_codegen.validation import checked_count

Array = NDArray[np.float64]
DIGITS, SHOWN_DIGITS = 40, 32
"""Digits of mpmath numbers, more than two words have; of states in reports."""


def two_words(value: Any, name: str) -> tuple[float, float]:
    """Return the nearest double to a number, and the nearest double to the rest.

    Raises:
        StateError: for anything but a finite real number.
    """
    try:
        if isinstance(value, bool | np.bool_ | complex) or value is None:
            raise TypeError("not a real number")
        with mp.workdps(DIGITS + 20):
            if isinstance(value, Rational):
                exact: Any = mp.mpf(value.numerator) / mp.mpf(value.denominator)
            else:
                exact = mp.mpf(value) if isinstance(value, str) else value
            high = float(exact)
            rest = exact - type(exact)(high) if np.isfinite(high) else 0.0  # exact for longdouble, 60 digits of mpf
            low = float(rest)
    except OverflowError:
        high = low = np.inf
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise StateError(f"{name} must be a real number, not {repr(value)[:60]}: {error}") from error
    if not (np.isfinite(high) and np.isfinite(low)):
        raise StateError(f"{name} is {value}: it must be finite")
    return high, low


def packed(values: Any, names: Sequence[str], label: str) -> Array:
    """Return (2 m,) high words, then low words, of numbers in order or by name.

    Raises:
        StateError: if a name, their number or a value is invalid.
    """
    if isinstance(values, Mapping):
        check_named(values, names, label)
        values = [values[name] for name in names]
    elif isinstance(values, str) or not hasattr(values, "__len__"):
        values = [values]
    if len(values) != len(names):
        count = len(values)
        raise StateError(f"{label} must have {len(names)} values ({', '.join(names[:6]) or 'none'}), not {count}")
    words = [two_words(value, f"{label}[{k}] ({names[k]})") for k, value in enumerate(values)]
    return np.array(words, dtype=float).reshape(len(names), 2).T.ravel().copy()


def as_mpmath(high: Any, low: Any) -> Any:
    """Return the sums of high and low words as mpmath numbers in an object array, or one number."""
    with mp.workdps(DIGITS):
        return np.frompyfunc(lambda a, b: mp.mpf(float(a)) + mp.mpf(float(b)), 2, 1)(high, low)


@dataclass(slots=True, kw_only=True, eq=False)
class DoubleDoubleTrajectory:
    """States along a run in double-double arithmetic, the initial state first.

    Attributes:
        t, t_low: (n,) times, high and low words.
        q, q_low: (n, m) positions.
        p, p_low: (n, m) momenta.
        iterations: (n,) solver iterations in double since the previous state, 0 for the first.
        h: step size.
        parameters, parameters_low: (k,) in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
    """

    t: Array
    t_low: Array
    q: Array
    q_low: Array
    p: Array
    p_low: Array
    iterations: NDArray[np.int32]
    h: float
    parameters: Array
    parameters_low: Array
    stepper: DoubleDoubleStepper = field(repr=False)

    def __len__(self) -> int:
        return len(self.t)

    def energy(self) -> tuple[Array, Array]:
        """Return (n,) high and (n,) low words of the energies p.v - L."""
        values = self._states("energies", 1)
        return values[:, 0, 0], values[:, 1, 0]

    def momentum_maps(self) -> tuple[Array, Array]:
        """Return (n, k) high and (n, k) low words of the conserved quantities."""
        count = len(self.stepper.momentum_map_names)
        values = self._states("momentum_maps", count) if count else np.empty((len(self), 2, 0))
        return values[:, 0], values[:, 1]

    def energy_error(self) -> float:
        """Return the largest change of the energy relative to the initial energy, or its change if that is 0."""
        high, low = self.energy()
        return float(np.abs((high - high[0]) + (low - low[0])).max() / (abs(high[0]) or 1.0))

    def mp(self, name: str) -> Any:
        """Return a quantity as mpmath numbers of 40 digits in an object array.

        Args:
            name: ``"t"``, ``"q"``, ``"p"``, ``"parameters"``, ``"energy"``, ``"momentum_maps"`` or a coordinate.

        Raises:
            StateError: for an unknown name.
        """
        if name in ("energy", "momentum_maps"):
            return as_mpmath(*getattr(self, name)())
        if name in ("t", "q", "p", "parameters"):
            return as_mpmath(getattr(self, name), getattr(self, f"{name}_low"))
        if name not in self.stepper.coordinates:
            known = ("t", "q", "p", "parameters", "energy", "momentum_maps", *self.stepper.coordinates)
            raise StateError(f"there is no quantity {name!r}: use one of {', '.join(known)}")
        k = self.stepper.coordinates.index(name)
        return as_mpmath(self.q[:, k], self.q_low[:, k])

    def final_texts(self) -> tuple[list[str], list[str]]:
        """Return the last positions and momenta as text of 32 digits."""
        with mp.workdps(DIGITS):
            q, p = ([mp.nstr(value, SHOWN_DIGITS) for value in self.mp(name)[-1]] for name in "qp")
        return q, p

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write times, states, parameters (both words of each), h and iterations to a ``.npz`` file."""
        names = [each.name for each in fields(self) if each.name != "stepper"]
        write_atomically(path, lambda file: np.savez(file, **{name: getattr(self, name) for name in names}))

    def _states(self, function: str, count: int) -> Array:
        """Return (n, 2, count) words of a function of all states."""
        result = np.empty((len(self), 2, count))
        binding = self.stepper.binding
        arrays = [np.concatenate(pair, axis=-1) for pair in ((self.t, self.t_low), (self.q, self.q_low))]
        arrays += [np.concatenate(pair, axis=-1) for pair in ((self.p, self.p_low),)]
        arrays += [np.concatenate([self.parameters, self.parameters_low]), result]
        last = binding.null if function == "momentum_maps" else binding.workspace()
        if status := binding.function(function)(len(self), *map(binding.pointer, arrays), last):
            raise StateError(f"the {function} of the states cannot be computed: {REASONS[status]}")
        return result


class DoubleDoubleStepper:
    """Compiled integrator whose states have two words: ``compile_stepper(..., precision="double-double")``.

    Attributes:
        source, interface: the C source and its interface.
        coordinates, parameters: names in order.
        momentum_map_names: names of the conserved quantities.
    """

    def __init__(self, source: Source, interface: Interface, flags: tuple[str, ...]) -> None:
        self.source, self.interface, self.flags = source, interface, flags
        self.coordinates, self.parameters = interface.coordinates, interface.parameters
        self.momentum_map_names, self.title = interface.map_names, interface.title
        library = building.load(source, flags=flags)
        self.binding = Binding(library, interface.prefix, interface.workspace)

    def __repr__(self) -> str:
        return f"<DoubleDoubleStepper {self.title}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return DoubleDoubleStepper, (self.source, self.interface, self.flags)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("binding", "title", "source", "interface"):
            raise AttributeError(f"'DoubleDoubleStepper' has no attribute '{name}'")
        raise UnavailableInPairsError(
            f"{name} is not available with precision='double-double', which has integrate with fixed steps: "
            "use precision='double'"
        )

    def supports(self, *names: str) -> Support:
        """Return whether operations are available together, as of :meth:`Stepper.supports`."""
        check_features(*names)
        for name in names:
            if name not in ("momentum_maps",):
                return Support(
                    f"{OPERATIONS[name]} is not available with precision='double-double': use precision='double'"
                )
        return Support()

    def integrate(
        self,
        q: Any,
        p: Any = None,
        *,
        velocity: Any = None,
        h: float | None = None,
        steps: int | None = None,
        t_end: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        parameters: Any = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        **unavailable: Any,
    ) -> DoubleDoubleTrajectory:
        """Integrate ``steps`` steps of h, or to t_end, and save every ``save_every``-th state and the initial one.

        Args:
            q, p: (m,) initial positions and momenta, in order or by name; each a float, text such as ``"0.1"`` (which
                is one tenth), a fraction, an mpmath number or a ``numpy.longdouble``.
            velocity: (m,) initial velocities, instead of p.
            h: fixed step size, a double; negative to integrate backward.
            steps: number of steps; or t_end: final time, a multiple of h from t.
            save_every: steps between saved states.
            t: initial time, a double.
            parameters: by name (others have their defaults, as doubles) or all in order, of the same kinds as q.
            options: convergence criterion of the iteration in double.
            progress: called with the number of completed steps.

        Raises:
            MethodError: for other arguments of :meth:`Stepper.integrate`.
            StateError: if a shape, name or number is invalid.
            StepFailedError: if the iteration of a step does not converge; reduce h.
        """
        if unavailable:
            raise MethodError(
                f"{', '.join(unavailable)} is not available with precision='double-double': omit it, or use "
                "precision='double'"
            )
        if h is None:
            raise MethodError("adaptive steps are not available with precision='double-double': give h and steps")
        h, t = checked_step(h), checked_number(t, "the time t")
        if (steps is None) == (t_end is None):
            raise StateError("give either steps or t_end with h")
        if steps is None:
            assert t_end is not None
            steps = steps_to(t, t_end, h)
            if steps is None:
                raise StateError(f"t_end = {t_end:g} is not a multiple of h = {h:g} from t = {t:g}: give steps")
        steps = checked_count(steps, "steps", least=0)
        save_every = checked_count(save_every, "save_every", least=1)
        values = self._values(parameters)
        positions = packed(q, self.coordinates, "q")
        momenta = self._momenta(positions, p, velocity, t, values)
        return self._recorded(positions, momenta, t, h, steps, save_every, values, options, progress)

    def _values(self, parameters: Any) -> Array:
        """Return (2 k,) words of the parameters."""
        names = self.parameters
        if parameters is None or isinstance(parameters, Mapping):
            given = dict(parameters or {})
            check_named(given, names, "parameters", whole=False)
            defaults = dict(zip(names, self.interface.defaults, strict=True))
            parameters = [{**defaults, **given}[name] for name in names]
        return packed(parameters, names, "parameters")

    def _momenta(self, q: Array, p: Any, velocity: Any, t: float, values: Array) -> Array:
        if (p is None) == (velocity is None):
            raise StateError(f"give either p or velocity with q; got {'neither' if p is None else 'both'}")
        if p is not None:
            return packed(p, self.coordinates, "p")
        v, result = packed(velocity, self.coordinates, "velocity"), np.empty_like(q)
        pointers = map(self.binding.pointer, (q, v, values, result))
        if status := self.binding.function("momentum")(t, *pointers, self.binding.workspace()):
            raise StateError(f"the momentum of the velocity cannot be computed: {REASONS[status]}")
        return result

    def _recorded(
        self,
        q: Array,
        p: Array,
        t: float,
        h: float,
        steps: int,
        save_every: int,
        values: Array,
        options: SolverOptions | None,
        progress: Callable[[int], None] | None,
    ) -> DoubleDoubleTrajectory:
        binding, m, rows = self.binding, len(self.coordinates), steps // save_every + 1
        times, states = empty_array((rows,)), [empty_array((rows, 2 * m)) for _ in range(2)]
        iterations = np.zeros(rows, dtype=np.int32)
        times[0], states[0][0], states[1][0] = t, q, p
        run, report, workspace = binding.new("run *"), binding.new("report *"), binding.workspace()
        binding.function("start")(run, t, h, *binding.pointers(q, p))
        pointers = *binding.pointers(times, *states), binding.integers(iterations)
        given, chosen = binding.pointer(values), binding.options(options)

        def advance(count: int) -> int:
            row = run.step // save_every + 1
            places = (pointers[0] + row, *(each + 2 * m * row for each in pointers[1:3]), pointers[3] + row)
            status = binding.function("advance")(run, count, save_every, given, chosen, *places, report, workspace)
            if status:
                raise step_failure(status, report, step=run.step, h=h, failures=binding.failures)
            return count

        drive(advance, steps, ended=lambda: False, progress=progress)
        high, low = times_after(t, h, save_every * np.arange(rows))
        k = len(self.parameters)
        return DoubleDoubleTrajectory(
            t=high,
            t_low=low,
            q=states[0][:, :m],
            q_low=states[0][:, m:],
            p=states[1][:, :m],
            p_low=states[1][:, m:],
            iterations=iterations,
            h=h,
            parameters=values[:k],
            parameters_low=values[k:],
            stepper=self,
        )


class UnavailableInPairsError(MethodError, AttributeError):
    """Error of an attribute that steppers in double-double arithmetic lack; ``hasattr`` is false."""
