"""Parameters and initial states from measured motions: nonlinear least squares with the exact derivatives of the steps.

The motion goes from measurement to measurement by equal steps no longer than h, so that it is known at each of their
times, and what is minimised is a smooth function of the unknowns whose slopes are those of the computed states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import AccuracyWarning, FitError, StateError, StepFailedError, closest, warn
from scvi_codegen.given.counts import checked_count
from scvi_codegen.given.kinds import MAPPING, NAMES, SWITCH, of, takes
from scvi_codegen.native.arguments import real_array
from scvi_codegen.pictures.residuals import ResidualPlot
from scvi_codegen.runtime.driven import checked_inputs
from scvi_codegen.runtime.inputs import Array, checked_parameters, checked_vector
from scvi_codegen.runtime.measurements import Measurements, distinct, state_names
from scvi_codegen.runtime.segments import LOOSE, TIGHT, Chain, Limits, chained, joined
from scvi_codegen.runtime.stepper import Stepper

__all__ = ["Fit", "fit"]

SAME = 1e-10
"""Beside the largest change that an unknown makes by its own size: what is smaller tells nothing but rounding."""
NEARER = 4
"""Iterations of Gauss and Newton from what was found by steps half as long."""
NOTICED = 1e-6
"""Of its size: by how much steps half as long may move one of which nothing is said."""
SHARE = 0.1
"""Of a direction that changes nothing: an unknown with less of it is not named."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """What measurements say of a motion.

    Attributes:
        names: of the k unknowns: parameters, then coordinates and momenta of the initial state.
        values: (k,) of the unknowns.
        covariance: (k, k) of their errors, to first order, those at bounds taken as known, with not numbers in their
            place; none are numbers where there are no more measurements than unknowns and no noise is given.
        at_bounds: names of the unknowns that a bound holds, not the measurements.
        parameters: of the motion, all of them by name; q, p: (m,) its initial state.
        t: (n,) times of the measurements, the initial state being that at ``start``.
        observed: names of the c quantities measured.
        computed, residuals: (n, c) what the motion has there; what the measurements have beyond it.
        deviations: (c,) standard deviations of the noise, as given, else as the residuals tell.
        evaluations: how often the motion was computed.
        jumps: (segments - 1, 2m) what is left between the end of each segment and the start of the next.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    at_bounds: tuple[str, ...]
    parameters: dict[str, float]
    q: Array
    p: Array
    start: float
    t: Array
    observed: tuple[str, ...]
    computed: Array
    residuals: Array
    deviations: Array
    evaluations: int
    jumps: Array

    @property
    def standard_errors(self) -> dict[str, float]:
        """By the names of the unknowns."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def __str__(self) -> str:
        width = max(map(len, self.names))
        errors = self.standard_errors.values()
        lines = [
            f"{name:{width}} = {value:.8g} " + ("at its bound" if name in self.at_bounds else f"+- {error:.2g}")
            for name, value, error in zip(self.names, self.values, errors, strict=True)
        ]
        return "\n".join(lines)

    @property
    def plot(self) -> ResidualPlot:
        """``fit.plot()``, ``fit.plot("residuals.png")``: the residuals over time, beside the noise; Matplotlib axes."""
        return ResidualPlot(self.t, self.residuals, self.deviations, self.observed)


@takes(
    StateError,
    stepper=of("a compiled stepper", Stepper),
    unknown=NAMES,
    state=SWITCH,
    observed=NAMES,
    inputs=MAPPING,
    bounds=MAPPING,
)
def fit(
    stepper: Stepper,
    t: ArrayLike,
    measured: ArrayLike,
    *,
    q: ArrayLike,
    p: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    h: float,
    parameters: Mapping[str, float] | Sequence[float] | Array | None = None,
    unknown: Sequence[str] | None = None,
    state: bool = True,
    start: float | None = None,
    observed: Sequence[str] | None = None,
    deviations: ArrayLike | None = None,
    inputs: Mapping[str, Any] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    segments: int = 1,
) -> Fit:
    """Find parameters and the initial state of a motion from measurements, by nonlinear least squares.

    Args:
        stepper: system and method.
        t: (n,) times, ascending.
        measured: (n,) or (n, c) values; not a number where nothing was measured.
        q, p, velocity: (m,) the initial state, one of p and velocity: a first guess, or, without ``state``, known.
        h: steps are no longer than this.
        parameters: first guesses of those unknown, values of the others; by default those of the system.
        unknown: names of the parameters to find, by default all but those of inputs; the others are known.
        state: whether the initial state is to be found, too.
        start: time of the initial state, by default that of the first measurement.
        observed: what the columns of ``measured`` are, coordinates and momenta (``"p_x"``, or of a Hamiltonian their
            own names); by default the coordinates in order.
        deviations: number or (c,), standard deviations of the noise; by default the same for all, and told by what is
            left.
        inputs: as of :meth:`Stepper.drive`.
        bounds: (least, greatest) by names of unknowns, infinite where there is none.
        segments: into how many parts a record is cut that is long beside the time in which nearby motions part, or
            whose guess soon runs out of phase (multiple shooting): the state at the start of each is unknown, too, and
            first guessed from the measurements where all coordinates are measured. They come to join in stages.

    Returns:
        A :class:`Fit`. An :class:`~scvi_codegen.AccuracyWarning` says where steps of h, not the measurements, tell an
        unknown: where half as long ones would move it by more than its standard error.

    Raises:
        FitError: where the measurements do not tell an unknown, or no least squares are found.
        MethodError: with constraints, in transformed time, and where a monitor chooses the steps.
        StateError: on wrong shapes, names or numbers.
        StepFailedError: if a step of the first guess fails.
    """
    measurements = Measurements.checked(
        stepper, t, measured, observed, deviations, start, h, checked_inputs(stepper.interface, inputs)
    )
    model = _Model.checked(measurements, q, p, velocity, parameters, unknown, state=state)
    if measurements.used.sum() < len(model.names):
        raise FitError(f"{int(measurements.used.sum())} measurements do not tell {len(model.names)} unknowns")
    chain, x = chained(measurements, model.known, model.places, checked_count(segments, "segments", least=1))
    chain, x, held, evaluations = _solved(model, chain, x, bounds or {})
    fitted = model.fit(chain, x, held, evaluations, known_noise=deviations is not None)
    if told := _told_by_steps(chain, fitted, x, ~held):
        warn(told, AccuracyWarning)
    return fitted


def _solved(
    model: _Model, chain: Chain, x: Array, bounds: Mapping[str, tuple[float, float]]
) -> tuple[Chain, Array, NDArray[np.bool_], int]:
    """The segments as they join, the unknowns, which of them a bound holds, and how many motions that took."""
    from scipy.optimize import least_squares  # here: slow to import

    own, count = model.bounded(bounds), len(x) - len(model.names)
    limits = np.append(own[0], np.full(count, -np.inf)), np.append(own[1], np.full(count, np.inf))
    several = len(chain.parts) > 1
    if several:
        chain = replace(chain, jump=LOOSE, unit=chain.typical(x))
    found = least_squares(chain.residuals, x, jac=chain.slopes, bounds=limits, x_scale="jac")
    if not found.success:
        raise FitError(f"no least squares were found: {found.message} Give a nearer first guess")
    held = found.active_mask != 0
    _check_told(model.names, found.jac, chain.typical_unknowns(found.x), held)
    if not several:
        return chain, found.x, held, found.nfev
    x, held, more = joined(chain, found.x, limits)
    return replace(chain, jump=TIGHT), x, held, found.nfev + more


@dataclass(eq=False)
class _Model:
    """The motion as a function of the unknowns.

    Attributes:
        names, guess: (k,) of the unknowns.
        places: (k,) where they stand among (q, p, parameters).
        known: (2m + parameters,) values of all, those of the unknowns overwritten.
    """

    measurements: Measurements
    names: tuple[str, ...]
    places: NDArray[np.intp]
    known: Array

    @classmethod
    def checked(
        cls,
        measurements: Measurements,
        q: ArrayLike,
        p: ArrayLike | None,
        velocity: ArrayLike | None,
        parameters: Mapping[str, float] | Sequence[float] | Array | None,
        unknown: Sequence[str] | None,
        *,
        state: bool,
    ) -> _Model:
        """From what users give."""
        stepper, m = measurements.stepper, measurements.stepper.dimension
        own = [name for name in stepper.parameters if name not in _of_inputs(stepper)]
        wanted = tuple(own) if unknown is None else distinct(unknown, "unknown")
        for name in wanted:
            if name not in own:
                raise StateError(f"there is no parameter '{name}' to find{closest(name, own)}")
        if p is None and not state:
            raise StateError(
                "momenta follow from velocities by way of the parameters: give p, or let the state be found, too"
            )
        if not wanted and not state:
            raise StateError("there is nothing to find: no parameter is unknown, and the initial state is known")
        if isinstance(parameters, Sequence) and any(isinstance(value, str) for value in parameters):
            raise StateError(
                f"parameters must be values, as {{'{next(iter(parameters))}': 1.0}}, not names: the names of those to "
                f"find go to unknown={list(parameters)}"
            )
        values = checked_parameters(stepper.interface, parameters)
        momenta = stepper.momenta_given(q, p, velocity, measurements.start, values)
        places = [2 * m + stepper.parameters.index(name) for name in wanted]
        names = (*wanted, *state_names(stepper)) if state else tuple(wanted)
        places += range(2 * m) if state else ()
        first = (checked_vector(stepper.interface, given, name) for given, name in ((q, "q"), (momenta, "p")))
        known = np.concatenate([*first, values])
        return cls(measurements, names, np.array(places, dtype=np.intp), known)

    @property
    def guess(self) -> Array:
        """(k,) to begin with."""
        return self.known[self.places]

    def bounded(self, given: Mapping[str, tuple[float, float]]) -> Limits:
        """(k,) and (k,) the least and the greatest of all unknowns, infinite where nothing is given."""
        low, high = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for name, ends in given.items():
            if name not in self.names:
                raise StateError(f"'{name}' is not among the unknowns, so has no bounds{closest(name, self.names)}")
            pair, k = real_array(ends, f"the bounds of {name}"), self.names.index(name)
            if pair.shape != (2,) or np.isnan(pair).any():
                raise StateError(
                    f"the bounds of {name} are (least, greatest), infinite where there is none, not {ends}"
                )
            if not pair[0] < self.guess[k] < pair[1]:
                raise StateError(f"the first guess of {name}, {self.guess[k]:g}, is not between its bounds {ends}")
            low[k], high[k] = pair
        return low, high

    def fit(self, chain: Chain, x: Array, held: NDArray[np.bool_], evaluations: int, *, known_noise: bool) -> Fit:
        """What was found; ``held``: (unknowns,) by a bound."""
        measurements, values, count = self.measurements, chain.values(x), len(self.names)
        m = measurements.stepper.dimension
        scaled, slopes = chain.scaled(x), chain.slopes(x)
        free = len(scaled) - int((~held[:count]).sum())
        noise = 1.0 if known_noise else float(np.sqrt(scaled @ scaled / free)) if free else np.nan
        inverse = np.linalg.pinv(slopes[:, ~held])
        covariance = np.full((len(x), len(x)), np.nan)
        covariance[np.ix_(~held, ~held)] = noise**2 * inverse @ inverse.T
        return Fit(
            names=self.names,
            values=np.array(x[:count]),
            covariance=covariance[:count, :count],
            at_bounds=tuple(name for name, at in zip(self.names, held[:count], strict=True) if at),
            parameters=dict(zip(measurements.stepper.parameters, values[2 * m :].tolist(), strict=True)),
            q=values[:m],
            p=values[m : 2 * m],
            start=measurements.start,
            t=measurements.t,
            observed=measurements.observed,
            computed=chain.computed,
            residuals=measurements.measured - chain.computed,
            deviations=noise * measurements.deviations,
            evaluations=evaluations,
            jumps=chain.jumps,
        )


def _told_by_steps(chain: Chain, fitted: Fit, x: Array, free: NDArray[np.bool_]) -> str:
    """What there is to say of the unknown that steps half as long move most, in standard errors, or nothing.

    What moves by less than a millionth of its size is left alone: data without noise have no errors.
    """
    finer = replace(chain, parts=tuple(part.halved() for part in chain.parts))
    count, found = len(fitted.names), x.copy()
    errors, told = np.sqrt(np.diag(fitted.covariance)), free[:count]
    noticed = np.maximum(errors, NOTICED * chain.typical_unknowns(x)[:count])
    with suppress(StepFailedError):
        for _ in range(NEARER):
            scaled, slopes = finer.evaluated(found)
            found[free] -= np.linalg.pinv(slopes[:, free]) @ scaled
            moved = np.abs(found - x)[:count][told]
            if not (moved > noticed[told]).any():
                return ""
        ratios = moved / errors[told]
        name = [name for name, at in zip(fitted.names, told, strict=True) if at][int(np.argmax(ratios))]
        return (
            f"h is too long for this fit: with steps half as long {name} is {ratios.max():.1f} standard errors "
            "away. Take a shorter h, or a method of higher order"
        )
    return ""


def _of_inputs(stepper: Stepper) -> set[str]:
    return {f"{name}_{part}" for name in stepper.interface.inputs for part in "0123t"}


def _check_told(names: Sequence[str], slopes: Array, sizes: Array, held: NDArray[np.bool_]) -> None:
    """Raise :class:`FitError` for unknowns that can change and leave all that is measured as it is.

    Each by its own size, so that units do not matter.

    Args:
        names: of the first unknowns; states at later nodes have none.
        slopes: (rows, unknowns).
        sizes: (unknowns,) of each, 0 where it is not known.
        held: (unknowns,) by a bound.
    """
    if held.all():
        return
    own = [*names, *[""] * (len(held) - len(names))]
    free, slopes, sizes = [name for name, at in zip(own, held, strict=True) if not at], slopes[:, ~held], sizes[~held]
    lengths = np.linalg.norm(slopes, axis=0)
    changes = lengths * sizes
    if nothing := np.flatnonzero((lengths == 0.0) | ((sizes > 0.0) & (changes <= SAME * changes.max()))).tolist():
        name = free[nothing[0]]
        raise FitError(f"these measurements do not tell {name}: they do not depend on it. {_as_known([name])}")
    singular, directions = np.linalg.svd(slopes / lengths)[1:]
    if singular[-1] > SAME * singular[0]:
        return
    shares = np.abs(directions[-1])
    told = [free[k] for k in np.flatnonzero(shares > SHARE * shares.max()).tolist() if free[k]]
    if len(told) < 2:
        raise FitError(
            f"these measurements do not tell {' '.join(told) or 'the states of segments'}: changed together with "
            "states of later segments, it leaves all that is measured as it is. {_as_known([*told, ''])}"
        )
    raise FitError(
        f"these measurements do not tell {', '.join(told[:-1])} and {told[-1]} apart: changed together, they leave all "
        f"that is measured as it is. {_as_known(told)}"
    )


def _as_known(names: Sequence[str]) -> str:
    """Return the advice that says how to take an unknown as known."""
    return (
        f"Take {names[0] if len(names) == 1 else 'one of them'} as known: list only the parameters to find in unknown=["
        "...] (by default all are) and give values of the others in parameters={...}; state=False keeps the initial "
        "state (with p) as given"
    )
