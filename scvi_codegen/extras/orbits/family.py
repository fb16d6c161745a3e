"""Families of periodic orbits: orbits in a row, the bifurcations between them, and the families that begin there."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.checks import Kind, checked_count, checks_arguments
from scvi_codegen.api.runs import Products
from scvi_codegen.api.states import Array, checked_number
from scvi_codegen.api.text import counted, summary, write_atomically
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import (
    AccuracyWarning,
    EventError,
    OrbitError,
    StateError,
    StepFailedError,
    closest,
    warn,
)
from scvi_codegen.extras.fits.measurements import state_names
from scvi_codegen.extras.orbits.continuation import Continuation, FamilyPoint, Formula
from scvi_codegen.extras.orbits.equilibrium import Equilibrium
from scvi_codegen.extras.orbits.reversor import Reversor
from scvi_codegen.extras.orbits.solver import (
    ErrorsOfOrbit,
    OrbitSearch,
    PeriodicOrbit,
    bound_of,
    checked_part,
    gains_of,
    indices_of,
)
from scvi_codegen.extras.orbits.step_sequence import StepSequence
from scvi_codegen.extras.paths.size import SAME_MOTION
from scvi_codegen.runs.stepper import Stepper

OTHERS = ("stepper", "sequence", "options", "errors")
OF_ORBITS = tuple(name for name in PeriodicOrbit.__dataclass_fields__ if name not in OTHERS)
"""Fields of orbits that are saved as they are."""
OF_SEARCHES = ("fixed_indices", "energy", "gain", "drifts", "at_rest")
OF_POINTS = ("step", "largest", "of_both", "accuracy")
OF_CONTINUATIONS = ("parameter", "step", "bound", "parameter_unit")


@dataclass(frozen=True, eq=False)
class Bifurcation:
    """Orbit of a family where its stability changes, or where the family turns.

    Attributes:
        kind: ``"fold"`` (the parameter, or else the energy, has an extremum), ``"branch"`` (another family crosses),
            ``"period doubling"``, ``"Krein collision"`` (indices meet and leave the real axis), ``"torus"``.
        after: number of the last orbit of the family before it.
    """

    kind: str
    after: int
    _at: FamilyPoint = field(repr=False)
    _continuation: Continuation = field(repr=False)

    __repr__ = summary("kind", "orbit", "after")

    @property
    def orbit(self) -> PeriodicOrbit:
        """The periodic orbit there."""
        return self._at.orbit

    def switch(
        self,
        *,
        backward: bool = False,
        step: float | None = None,
        count: int = 100,
        until: Until = None,
        progress: Progress = None,
    ) -> Family:
        """Return the family that begins here; arguments of :func:`family`.

        A branch has two sides. The coordinate or momentum of the initial state that changes most increases along the
        family, or decreases with ``backward``.

        Raises:
            OrbitError: if no other family of periodic orbits begins here.
        """
        periods = {"branch": 1, "period doubling": 2}.get(self.kind)
        if periods is None:
            raise OrbitError(f"no other family of periodic orbits begins at a {self.kind}: the family itself passes it")
        continuation = (
            self._continuation
            if step is None
            else replace(self._continuation, step=checked_part("step", step, "relative to the size of the motion"))
        )
        continuation, start = continuation.branching(self._at, periods, backward=backward)
        begun = Family((start.orbit,), (), "", start, start, continuation)
        return begun._grown(checked_count(count, "count", least=2), until, progress)


@dataclass(frozen=True, eq=False)
class Family:
    """One-parameter family of periodic orbits.

    Attributes:
        orbits: in their order along the family.
        bifurcations: between them.
        ended: why the family has no further orbit here.
    """

    orbits: tuple[PeriodicOrbit, ...]
    bifurcations: tuple[Bifurcation, ...]
    ended: str
    _first: FamilyPoint = field(repr=False)
    _last: FamilyPoint = field(repr=False)
    _continuation: Continuation = field(repr=False)

    __repr__ = summary("orbits", "bifurcations", "parameter", "ended")

    def __len__(self) -> int:
        return len(self.orbits)

    def __iter__(self) -> Iterator[PeriodicOrbit]:
        return iter(self.orbits)

    def __getitem__(self, k: int) -> PeriodicOrbit:
        return self.orbits[k]

    @property
    def parameter(self) -> str | None:
        """Name of the parameter of the system that varies; ``None`` if none does."""
        index = self._continuation.parameter
        return None if index is None else self[0].stepper.parameters[index]

    @property
    def periods(self) -> Array:
        """(n,) periods."""
        return np.array([orbit.period for orbit in self.orbits])

    @property
    def energies(self) -> Array:
        """(n,) energies of the initial states."""
        return np.array([orbit.energy for orbit in self.orbits])

    @property
    def values(self) -> Array:
        """(n,) values of the parameter that varies, or else the energies."""
        return np.array([self.value_of(orbit) for orbit in self.orbits])

    def value_of(self, orbit: PeriodicOrbit) -> float:
        """Return the value of the parameter that varies, or else the energy, of an orbit."""
        if self.parameter is None:
            return orbit.energy
        return float(orbit.parameters[orbit.stepper.parameters.index(self.parameter)])

    @property
    def stability_indices(self) -> NDArray[np.complex128]:
        """(n, m) stability indices; see :attr:`PeriodicOrbit.stability_indices`."""
        return np.array([orbit.stability_indices for orbit in self.orbits])

    def more(self, count: int = 100, *, until: Until = None, progress: Progress = None) -> Family:
        """Return the family with up to ``count`` further orbits."""
        return self._grown(len(self) + checked_count(count, "count", least=1), until, progress)

    def _grown(self, count: int, until: Until, progress: Progress) -> Family:
        """Return the family with up to ``count`` orbits."""
        continuation, last, ended = self._continuation, self._last, ""
        orbits, bifurcations = self.orbits, self.bifurcations
        reason = _reason(until, continuation.search.stepper)
        try:
            while len(orbits) < count and not ended:
                following = continuation.following(last)
                try:
                    between = [] if last.of_both else list(continuation.bifurcations(last, following))
                except OrbitError:  # the orbits between them are none of the chord: go on in smaller steps
                    last = replace(last, step=last.step / 4.0)
                    continue
                before, last, after = last, continuation.shifted(last, following), len(orbits) - 1
                orbits = (*orbits, last.orbit)
                bifurcations += tuple(Bifurcation(kind, after, at, continuation) for kind, at in between)
                if progress is not None:
                    progress(len(orbits))
                ended = reason(last.orbit) or continuation.end_at(self._first, before, last)
        except (EventError, OrbitError, StepFailedError) as error:
            ended = str(error)
        except KeyboardInterrupt:
            ended = "it was interrupted"
        _warn_of_errors(orbits[len(self) - 1 :], continuation.bound)
        ended = ended or "it has as many orbits as were asked for"
        return replace(self, orbits=orbits, bifurcations=bifurcations, ended=ended, _last=last)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the orbits to a .npz file: q, p, period, energy, parameters, error, multipliers, stable, bifurcations.

        ``bifurcations`` are the numbers of the orbits before them, ``kinds`` their kinds. Further arrays are those that
        :meth:`load` needs.
        """
        columns = {name: name for name in (*OF_ORBITS, "energy", "multipliers", "stable")}
        columns |= {f"{name}_errors": f"errors.{name}" for name in ("signed", "bounds", "reason")}
        arrays: dict[str, Any] = {key: np.array([*map(attrgetter(x), self.orbits)]) for key, x in columns.items()}
        continuation = self._continuation
        arrays["ends"] = np.concatenate([orbit.sequence.ends for orbit in self.orbits])
        arrays["tolerance"] = np.array([orbit.sequence.tolerance for orbit in self.orbits], dtype=float)
        arrays["bifurcations"] = np.array([*map(attrgetter("after"), self.bifurcations)], dtype=np.intp)
        arrays["kinds"] = np.array([*map(attrgetter("kind"), self.bifurcations)], dtype=np.str_)
        points = [self._first, self._last, *(bifurcation._at for bifurcation in self.bifurcations)]
        arrays["points"] = np.array([[point.y, continuation.change_along(point)] for point in points])
        options, period, reversor = continuation.search.options, continuation.period_of, continuation.search.reversor
        settings = {name: getattr(continuation, name) for name in OF_CONTINUATIONS}
        settings |= {name: np.asarray(getattr(continuation.search, name)).tolist() for name in OF_SEARCHES}
        settings["reversor"] = reversor and [reversor.matrix.tolist(), reversor.shift.tolist()]
        settings |= {"system": self[0].stepper.title, "ended": self.ended}
        settings |= {"last": {name: getattr(self._last, name) for name in OF_POINTS}, "period": period and period.text}
        settings["options"] = options and asdict(options)
        arrays["settings"] = np.array(json.dumps(settings))
        write_atomically(path, lambda file: np.savez(file, **arrays))

    @classmethod
    def load(cls, stepper: Stepper, path: str | os.PathLike[str]) -> Family:
        """Return the family of a file that :meth:`save` wrote, which :meth:`more` continues.

        The first and the last orbit and the bifurcations are computed again.

        Raises:
            StateError: if the file contains no family of this system and method.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            settings = json.loads(str(arrays["settings"]))
        except (KeyError, OSError, ValueError) as error:
            raise StateError(f"'{os.fspath(path)}' has no family of Family.save: {error}") from error
        if settings["system"] != stepper.title:
            raise StateError(f"'{os.fspath(path)}' is a family of '{settings['system']}', not of '{stepper.title}'")
        options = settings["options"] and SolverOptions(**settings["options"])
        orbits = list(_orbits_of(arrays, stepper, options))
        own: dict[str, Any] = {name: np.array(settings[name]) for name in ("gain", "drifts", "at_rest")}
        own |= {"fixed_indices": tuple(settings["fixed_indices"]), "energy": settings["energy"]}
        search = _search_at(orbits[-1], orbits[-1].period, **own)
        search = search.of_reversor(settings["reversor"] and Reversor(*map(np.array, settings["reversor"])))
        continuation = Continuation(
            search=search,
            period_of=settings["period"] and Formula.of(settings["period"], stepper.parameters),
            **{name: settings[name] for name in OF_CONTINUATIONS},
        )
        points = arrays["points"]
        try:
            whole = search.of_reversor(None)
            steps = [orbits[0].sequence, orbits[-1].sequence, *[whole.sequence] * (len(points) - 2)]
            searches = [replace(whole, sequence=own).of_reversor(search.reversor) for own in steps]
            first, last, *others = (
                replace(continuation, search=own).corrected(*point) for own, point in zip(searches, points, strict=True)
            )
            same = np.abs(first.y - points[0, 0]).max() <= SAME_MOTION * np.abs(first.y).max()
        except OrbitError:
            same = False
        if not same:
            raise StateError(
                f"the orbits of '{os.fspath(path)}' are none of this '{stepper.title}', but of another one"
            )
        saved = zip(arrays["kinds"], arrays["bifurcations"], others, strict=True)
        last = replace(last, **settings["last"])
        first = first if len(orbits) > 1 else last  # from which no family returns to it
        return cls(
            orbits=tuple(orbits),
            bifurcations=tuple(Bifurcation(str(kind), int(k), at, continuation) for kind, k, at in saved),
            ended=settings["ended"],
            _first=first,
            _last=last,
            _continuation=continuation,
        )

    def plot(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw the orbits, their stability, and energy (or parameter) against period with the bifurcations.

        Returns:
            The figure of matplotlib; a .png, .svg or .pdf is written if a path is passed.
        """
        from scvi_codegen.extras.orbits.picture import plot_family

        return plot_family(self, path)


Until = str | Callable[[PeriodicOrbit], bool] | None
Progress = Callable[[int], None] | None


START = Kind.of("a periodic orbit or an equilibrium", PeriodicOrbit, Equilibrium)
UNTIL = Kind("a condition as text, or a function", lambda value: isinstance(value, str) or callable(value))


@checks_arguments(StateError, stepper=Stepper.KIND, start=START, mode=Kind.WHOLE)
def family(
    stepper: Stepper,
    start: PeriodicOrbit | Equilibrium,
    *,
    parameter: str | None = None,
    step: float = 0.1,
    count: int = 100,
    until: str | Callable[[PeriodicOrbit], bool] | None = None,
    backward: bool = False,
    fixed: Sequence[str] = (),
    fixed_period: bool = False,
    period: str | None = None,
    energy: float | None = None,
    mode: int = 0,
    amplitude: float | None = None,
    gain: ArrayLike | Sequence[float | None] | None = None,
    reversor: str | Sequence[str] | None = None,
    error: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> Family:
    """Continue a family of periodic orbits, and locate its bifurcations.

    Args:
        stepper: the compiled stepper.
        start: an orbit of the family, or an equilibrium where it begins, with ``amplitude``.
        parameter: name of a parameter of the system that varies along the family. Without it orbits of a conservative
            system form a family by energy.
        step: largest change between successive orbits, relative to the size of the motion; it is halved where the
            family turns by more than 30 degrees.
        count: largest number of orbits.
        until: condition after which the family ends, a formula such as ``"energy > -1.57"`` of the energy, the
            ``period``, parameters and the initial state (``"x"``, ``"p_x"``), or a function of the orbit.
        backward: continue towards smaller values of the parameter, or else of the energy.
        fixed: coordinates and momenta that keep their initial values, such as those of a section.
        fixed_period: keep the period, of systems that depend on time.
        period: formula of the period of a system that depends on time, such as ``"2*pi/omega"``.
        energy: prescribed energy, of a family along a parameter.
        mode: number of the oscillation of the equilibrium, in descending order of frequencies.
        amplitude: largest deviation of a coordinate from the equilibrium on the first orbit.
        gain, reversor, error: as of :func:`periodic_orbit`; branches that break the symmetry have whole orbits.
        progress: called with the number of orbits.

    Returns:
        A :class:`Family`; after Ctrl-C of the orbits so far, which :meth:`Family.more` continues.

    Raises:
        OrbitError: if the start is isolated (vary a parameter), one of a family of several parameters (fix some), or no
            orbit is found next to it.
        StateError: if a name or number is invalid.
    """
    stepper.products.require("periodic_orbit")
    if start.stepper.interface != stepper.interface:
        raise StateError(f"the start is one of '{start.stepper.title}', not of '{stepper.title}'")
    if parameter is not None and parameter not in stepper.parameters:
        raise StateError(f"'{parameter}' is no parameter of '{stepper.title}'{closest(parameter, stepper.parameters)}")
    if isinstance(start, Equilibrium) and backward:
        raise StateError("backward= is for a start at an orbit: a family that begins at an equilibrium leaves it")
    if period is not None and parameter is None:
        raise StateError("period= is a formula of parameter=, which is missing: name it, or give fixed_period=True")
    prescribed = None if energy is None else checked_number(energy, "the energy")
    indices = indices_of(stepper, fixed, fixed_period=fixed_period)
    first = _state_at(start, mode, amplitude)
    search = _search_at(start, float(first[-1]), fixed_indices=indices, energy=prescribed, **gains_of(stepper, gain))
    if reversor is not None:
        state = np.concatenate([start.q, start.p])
        search, first = search.symmetric(reversor, state, lambda own: _state_at(start, mode, amplitude, own))
    first = search.moved(first, 0.0 * first)
    continuation = Continuation(
        search=search,
        parameter=None if parameter is None else stepper.parameters.index(parameter),
        step=checked_part("step", step, "relative to the size of the motion"),
        bound=bound_of(search.sequence, error),
        period_of=None if period is None else Formula.of(period, stepper.parameters),
    )
    continuation, point = continuation.begun(first, start, backward=backward)
    begun = Family((point.orbit,), (), "", point, point, continuation)
    return begun._grown(checked_count(count, "count", least=1), until, progress)


def _search_at(start: PeriodicOrbit | Equilibrium, period: float, **rest: Any) -> OrbitSearch:
    """Return the closing equations next to a start."""
    return OrbitSearch.at(
        start.stepper,
        start.q,
        period=period,
        sequence=_equal_steps_of(start),
        t=start.t,
        parameters=np.array(start.parameters),
        options=start.options if isinstance(start, PeriodicOrbit) else None,
        **rest,
    )


def _orbits_of(arrays: Mapping[str, Any], stepper: Stepper, options: SolverOptions | None) -> Iterator[PeriodicOrbit]:
    """Yield the orbits of a file."""
    parts = np.split(arrays["ends"], np.cumsum(arrays["steps"] + 1)[:-1])
    for k, (ends, tolerance) in enumerate(zip(parts, arrays["tolerance"], strict=True)):
        sequence = StepSequence(ends, None if math.isnan(tolerance) else float(tolerance))
        values = {name: arrays[name][k] for name in OF_ORBITS}
        numbers = {name: value if value.ndim else value.item() for name, value in values.items()}
        errors = ErrorsOfOrbit(
            signed=arrays["signed_errors"][k], bounds=arrays["bounds_errors"][k], reason=str(arrays["reason_errors"][k])
        )
        yield PeriodicOrbit(stepper=stepper, sequence=sequence, options=options, errors=errors, **numbers)


def _equal_steps_of(start: PeriodicOrbit | Equilibrium) -> StepSequence | None:
    """Return the steps that the user of an orbit chose; ``None`` for adaptive ones."""
    if isinstance(start, Equilibrium) or start.sequence.tolerance is not None:
        return None
    return start.sequence


def _state_at(
    start: PeriodicOrbit | Equilibrium, mode: int, amplitude: float | None, reversor: Reversor | None = None
) -> Array:
    """Return (q, p, period) of the first orbit, or of its guess next to an equilibrium, nearest to a fixed set."""
    if isinstance(start, PeriodicOrbit):
        if amplitude is not None:
            raise StateError("amplitude= is for a start at an equilibrium: omit it")
        return np.concatenate([start.q, start.p, [start.period]])
    frequencies, count = start.frequencies, len(start.q)
    if not 0 <= mode < len(frequencies):
        raise StateError(f"the equilibrium has {counted(len(frequencies), 'oscillation')}, none with the number {mode}")
    if amplitude is None or not (amplitude := checked_number(amplitude, "amplitude")) > 0.0:
        raise StateError("a family that begins at an equilibrium needs the amplitude= of its first orbit, positive")
    vector = start.modes[:, mode]
    vector = vector / vector[np.abs(vector[:count]).argmax()]  # that coordinate is at its largest deviation
    if reversor is not None:  # the phase of the least change across the fixed set
        odd = reversor.odd @ vector
        cosine, sine = np.linalg.svd(np.column_stack([odd.real, -odd.imag]))[2][-1]
        vector = vector * (cosine + 1j * sine)
    state = np.concatenate([start.q, start.p]) + amplitude * vector.real
    return np.append(state, 2.0 * math.pi / frequencies[mode])


def _reason(until: Until, stepper: Stepper) -> Callable[[PeriodicOrbit], str]:
    """Return why an orbit is the last one by a condition, ``""`` for others."""
    if until is not None:
        Kind.check(UNTIL, until, "until", StateError)
    if not isinstance(until, str):
        return lambda orbit: "the condition of until holds" if until is not None and until(orbit) else ""
    states = state_names(stepper)
    holds = Formula.of(f"where({until}, 1, 0)", (*states, *stepper.parameters, "energy", "period"))

    def reason(orbit: PeriodicOrbit) -> str:
        parameters = orbit.parameters[: len(stepper.parameters)]  # without modes
        numbers = (*orbit.q, *orbit.p, *parameters, orbit.energy, orbit.period)
        try:
            return f"{until} holds" if holds(dict(zip(holds.symbols, numbers, strict=True))) == 1.0 else ""
        except (ArithmeticError, ValueError) as error:
            return f"until={until!r} is undefined at the last orbit: {error}"

    return reason


def _warn_of_errors(orbits: Sequence[PeriodicOrbit], bound: float) -> None:
    worst = max(orbits, key=lambda orbit: orbit.error)
    if worst.error > bound and Products.warnings_wanted():
        warn(
            f"orbits of the family have discretisation errors up to {worst.error:.1e} (period {worst.period:.6g}), "
            f"above the bound {bound:.1e}: use a method of higher degree or a larger error=",
            AccuracyWarning,
        )
