"""Parameter estimation: nonlinear least squares with exact derivatives of the steps, single or multiple shooting.

Between measurements the trajectory takes equal steps no longer than h, so that every measurement time is a step end.
The cost is a smooth function of the unknowns, and its gradient is exact for the computed states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.checks import checked_count, checks_arguments
from scvi_codegen.api.states import Array, real_array
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import AccuracyWarning, FitError, StateError, StepFailedError, closest, warn
from scvi_codegen.extras.fits.measurements import Measurements, distinct, state_names
from scvi_codegen.extras.fits.multiple_shooting import LOOSE, TIGHT, Chain, Limits, chained, joined
from scvi_codegen.runs.stepper import Stepper

if TYPE_CHECKING:
    from scvi_codegen.extras.pictures.conserved import ResidualPlot

SAME = 1e-10
"""Sensitivity relative to the largest below which an unknown counts as undetermined."""
REFINEMENT_ITERATIONS = 4
"""Gauss-Newton iterations from the solution with half the step size."""
NEGLIGIBLE_CHANGE = 1e-6
"""Relative change of an unknown with half the step size below which no warning is issued."""
FALSE_ALARM = 1e-3
"""Probability that a model that fits is warned of, by the distribution of chi squared."""
NAMED_FRACTION = 0.1
"""Fraction of the largest entry of a null direction from which on an unknown is named."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Result of a parameter estimation.

    Attributes:
        names: names of the k unknowns: parameters, then coordinates and momenta of the initial state.
        values: (k,) estimates.
        covariance: (k, k) covariance of the estimates, to first order. Unknowns at bounds count as known, with NaN in
            their rows and columns; all NaN without surplus measurements and without ``deviations``.
        at_bounds: names of the unknowns at a bound.
        parameters: all parameters of the system by name.
        q, p: (m,) initial state.
        start: time of the initial state.
        t: (n,) times of the measurements.
        observed: names of the c measured quantities.
        computed, residuals: (n, c) computed values, and measured minus computed values.
        deviations: (c,) standard deviations of the noise, as passed or estimated from the residuals.
        evaluations: number of trajectory evaluations.
        jumps: (segments - 1, 2m) remaining discontinuities between consecutive segments.
        surplus: number n of measurements beyond the estimated unknowns.
        chi_squared: sum of the squared residuals in standard deviations of the noise, about n if the model fits; NaN
            without ``deviations``, which are then estimated so that it is n.
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
    surplus: int
    chi_squared: float

    __repr__ = summary("names", "values", "evaluations")

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by the names of the unknowns."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def __str__(self) -> str:
        width = max(map(len, self.names))
        errors = self.standard_errors.values()
        lines = [
            f"{name:{width}} = {value:.8g} " + ("at its bound" if name in self.at_bounds else f"+- {error:.2g}")
            for name, value, error in zip(self.names, self.values, errors, strict=True)
        ]
        if self.surplus and not math.isnan(self.chi_squared):
            lines.append(f"chi^2/n = {self.chi_squared / self.surplus:.3g} with n = {self.surplus}")
        return "\n".join(lines)

    @property
    def plot(self) -> ResidualPlot:
        """Plot of the residuals over time with the noise level: ``fit.plot()``, ``fit.plot("residuals.png")``."""
        from scvi_codegen.extras.pictures.conserved import ResidualPlot

        return ResidualPlot(self.t, self.residuals, self.deviations, self.observed)


@checks_arguments(StateError, stepper=Stepper.KIND)
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
    fit_initial_state: bool = True,
    start: float | None = None,
    observed: Sequence[str] | None = None,
    deviations: ArrayLike | None = None,
    inputs: Mapping[str, Any] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    segments: int = 1,
) -> Fit:
    """Estimate parameters and the initial state of a trajectory from measurements, by nonlinear least squares.

    Args:
        stepper: the compiled stepper.
        t: (n,) ascending times.
        measured: (n,) or (n, c) values; NaN for missing measurements.
        q, p, velocity: (m,) initial state, with one of p and velocity: initial guess, or known if ``fit_initial_state``
            is false.
        h: largest step size.
        parameters: initial guesses of the unknown parameters, values of the others; defaults of the system otherwise.
        unknown: names of the parameters to estimate, by default all but those of inputs.
        fit_initial_state: whether to estimate the initial state as well.
        start: time of the initial state, by default that of the first measurement.
        observed: names of the columns of ``measured``, coordinates and momenta (``"p_x"``, or the names of the
            Hamiltonian), ``"R_11"``, ``"p_R_1"``, ``"n_1"``, ``"s_1"`` of rotations (body momentum), directions and
            spins; by default the coordinates in order.
        deviations: number or (c,), standard deviations of the noise; by default equal and estimated from the residuals.
        inputs: as of :meth:`Stepper.integrate`.
        bounds: (lower, upper) by names of unknowns; infinite for no bound.
        segments: number of segments for multiple shooting, for records long relative to the Lyapunov time or guesses
            that soon lose phase. The initial state of each segment is unknown and initially guessed from the
            measurements if all coordinates are measured. Continuity is enforced in stages.

    Returns:
        A :class:`Fit`. An :class:`~scvi_codegen.AccuracyWarning` is issued if half the step size would change an
        unknown by more than its standard error, and if the model does not fit measurements of known ``deviations``:
        chi squared is above its quantile at 0.999.

    Raises:
        FitError: if the measurements do not determine an unknown, or least squares do not converge.
        MethodError: if the system has constraints, or time is transformed.
        StateError: if a shape, name or number is invalid.
        StepFailedError: if a step of the initial guess fails.
    """
    stepper = stepper.bind(q, parameters)[0]._known_with_events
    measurements = Measurements.checked(
        stepper, t, measured, observed, deviations, start, h, stepper.products.inputs_of(inputs)
    )
    model = _Model.checked(measurements, q, p, velocity, parameters, unknown, fit_initial_state=fit_initial_state)
    if measurements.used.sum() < len(model.names):
        raise FitError(f"{int(measurements.used.sum())} measurements do not determine {len(model.names)} unknowns")
    chain, x = chained(measurements, model.prior, model.unknown_indices, checked_count(segments, "segments", least=1))
    chain, x, at_bound, evaluations = _solved(model, chain, x, bounds or {})
    fitted = model.fit(chain, x, at_bound, evaluations, known_noise=deviations is not None)
    for message in (_step_size_warning(chain, fitted, x, ~at_bound), _misfit(fitted)):
        if message:
            warn(message, AccuracyWarning)
    return fitted


def _solved(
    model: _Model, chain: Chain, x: Array, bounds: Mapping[str, tuple[float, float]]
) -> tuple[Chain, Array, NDArray[np.bool_], int]:
    """Return the joined segments, the unknowns, a mask of those at bounds, and the number of evaluations."""
    from scipy.optimize import least_squares  # here: slow to import

    ends, count = model.bounded(bounds), len(x) - len(model.names)
    limits = np.append(ends[0], np.full(count, -np.inf)), np.append(ends[1], np.full(count, np.inf))
    several = len(chain.parts) > 1
    if several:
        chain = replace(chain, jump=LOOSE, unit=chain.typical(x))
    solution = least_squares(chain.residuals, x, jac=chain.jacobian, bounds=limits, x_scale="jac")
    if not solution.success:
        raise FitError(f"least squares did not converge: {solution.message} Give a better initial guess")
    at_bound = solution.active_mask != 0
    _check_determined(model.names, solution.jac, chain.typical_unknowns(solution.x), at_bound)
    if not several:
        return chain, solution.x, at_bound, solution.nfev
    x, at_bound, more = joined(chain, solution.x, limits)
    return replace(chain, jump=TIGHT), x, at_bound, solution.nfev + more


@dataclass(eq=False)
class _Model:
    """Trajectory as a function of the unknowns.

    Attributes:
        names, guess: (k,) names and initial guesses of the unknowns.
        unknown_indices: (k,) indices of the unknowns in (q, p, parameters).
        prior: (2m + parameters,) values of the initial guess; those of the unknowns are overwritten.
    """

    measurements: Measurements
    names: tuple[str, ...]
    unknown_indices: NDArray[np.intp]
    prior: Array

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
        fit_initial_state: bool,
    ) -> _Model:
        """Construct from validated arguments of :func:`fit`."""
        stepper, m = measurements.stepper, measurements.stepper.dimension
        fixed = stepper.products.input_columns
        estimable = [name for k, name in enumerate(stepper.parameters) if k not in fixed]
        estimated = tuple(estimable) if unknown is None else distinct(unknown, "unknown")
        for name in estimated:
            if name not in estimable:
                raise StateError(f"there is no parameter '{name}' to estimate{closest(name, estimable)}")
        if p is None and not fit_initial_state:
            raise StateError(
                "velocity does not determine the initial momenta before the parameters are known: give p, or "
                "fit_initial_state=True"
            )
        if not estimated and not fit_initial_state:
            raise StateError(
                "nothing to estimate: unknown is empty and fit_initial_state=False. Name parameters in unknown=[...]"
            )
        if isinstance(parameters, Sequence) and any(isinstance(value, str) for value in parameters):
            raise StateError(
                f"parameters must be values, as {{'{next(iter(parameters))}': 1.0}}, not names: name those to estimate "
                f"in unknown={list(parameters)}"
            )
        state, values = stepper.products.start(q, p, velocity, measurements.start, parameters)
        unknown_indices = [2 * m + stepper.interface.parameters.index(name) for name in estimated]
        names = estimated
        if fit_initial_state:
            names = (*estimated, *state_names(stepper))
            unknown_indices += range(2 * m)
        prior = np.concatenate([state, values])
        return cls(measurements, names, np.array(unknown_indices, dtype=np.intp), prior)

    @property
    def guess(self) -> Array:
        return self.prior[self.unknown_indices]

    def bounded(self, argument: Mapping[str, tuple[float, float]]) -> Limits:
        """Return (k,) lower and (k,) upper bounds of all unknowns; infinite for no bound."""
        low, high = np.full(len(self.names), -np.inf), np.full(len(self.names), np.inf)
        for name, ends in argument.items():
            if name not in self.names:
                raise StateError(f"bounds name '{name}', which is not an unknown{closest(name, self.names)}")
            pair, k = real_array(ends, f"the bounds of {name}"), self.names.index(name)
            if pair.shape != (2,) or np.isnan(pair).any():
                raise StateError(f"the bounds of {name} must be (lower, upper), infinite for no bound, not {ends}")
            if not pair[0] < self.guess[k] < pair[1]:
                raise StateError(f"the initial guess of {name}, {self.guess[k]:g}, is not between its bounds {ends}")
            low[k], high[k] = pair
        return low, high

    def fit(self, chain: Chain, x: Array, at_bound: NDArray[np.bool_], evaluations: int, *, known_noise: bool) -> Fit:
        """Return the result; ``at_bound`` is the (unknowns,) mask of those at bounds."""
        measurements, values, count = self.measurements, chain.values(x), len(self.names)
        m = measurements.stepper.dimension
        scaled, jacobian = chain.scaled(x), chain.jacobian(x)
        free = len(scaled) - int((~at_bound[:count]).sum())
        noise = float(np.sqrt(scaled @ scaled / free)) if free else np.nan
        if known_noise:
            noise = 1.0
        inverse = np.linalg.pinv(jacobian[:, ~at_bound])
        covariance = np.full((len(x), len(x)), np.nan)
        covariance[np.ix_(~at_bound, ~at_bound)] = noise**2 * inverse @ inverse.T
        return Fit(
            names=self.names,
            values=np.array(x[:count]),
            covariance=covariance[:count, :count],
            at_bounds=tuple(name for name, at in zip(self.names, at_bound[:count], strict=True) if at),
            parameters=dict(zip(measurements.stepper.parameters, values[2 * m :].tolist(), strict=False)),
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
            surplus=free,
            chi_squared=float(scaled @ scaled) if known_noise else np.nan,
        )


def _step_size_warning(chain: Chain, fitted: Fit, x: Array, free: NDArray[np.bool_]) -> str:
    """Return a warning if half the step size changes an unknown by more than its standard error, else "".

    Changes below a millionth of the size of an unknown are ignored: noise-free data have no errors.
    """
    finer = replace(chain, parts=tuple(part.halved() for part in chain.parts))
    count, moved_x = len(fitted.names), x.copy()
    errors, determined = np.sqrt(np.diag(fitted.covariance)), free[:count]
    noticed = np.maximum(errors, NEGLIGIBLE_CHANGE * chain.typical_unknowns(x)[:count])
    with suppress(StepFailedError):
        for _ in range(REFINEMENT_ITERATIONS):
            scaled, jacobian = finer.evaluated(moved_x)
            moved_x[free] -= np.linalg.pinv(jacobian[:, free]) @ scaled
            moved = np.abs(moved_x - x)[:count][determined]
            if not (moved > noticed[determined]).any():
                return ""
        ratios = moved / errors[determined]
        name = [name for name, at in zip(fitted.names, determined, strict=True) if at][int(np.argmax(ratios))]
        return (
            f"h is too large for this fit: with half the step size {name} changes by {ratios.max():.1f} standard "
            "errors. Reduce h, or use a method of higher order"
        )
    return ""


def _misfit(fitted: Fit) -> str:
    """Return a warning if chi squared is above the quantile that a model that fits exceeds with FALSE_ALARM, else "".

    Its distribution is that of a sum of n squared normal numbers (W. H. Press et al., Numerical Recipes, 15.1).
    """
    from scipy.special import chdtri  # here: slow to import

    n = fitted.surplus
    if not (n and fitted.chi_squared > chdtri(n, FALSE_ALARM)):
        return ""
    return (
        f"the model does not fit the measurements: chi^2/n = {fitted.chi_squared / n:.3g} with n = {n}, but one that "
        f"fits exceeds {chdtri(n, FALSE_ALARM) / n:.3g} with a probability of {FALSE_ALARM:g}. Standard errors are "
        "those of noise alone: free more parameters (unknown=[...]), add the missing forces, or correct deviations"
    )


def _check_determined(names: Sequence[str], jacobian: Array, sizes: Array, at_bound: NDArray[np.bool_]) -> None:
    """Raise :class:`FitError` for unknowns that can change without changing the computed measurements.

    Columns are scaled by the size of the unknowns, so units do not matter.

    Args:
        names: names of the first unknowns; states of later segments have none.
        jacobian: (rows, unknowns) Jacobian of the residuals.
        sizes: (unknowns,) typical sizes, 0 if unknown.
        at_bound: (unknowns,) mask of those at bounds.
    """
    if at_bound.all():
        return
    labels = [*names, *[""] * (len(at_bound) - len(names))]
    free = [name for name, at in zip(labels, at_bound, strict=True) if not at]
    jacobian = jacobian[:, ~at_bound]
    sizes = sizes[~at_bound]
    lengths = np.linalg.norm(jacobian, axis=0)
    changes = lengths * sizes
    if nothing := np.flatnonzero((lengths == 0.0) | ((sizes > 0.0) & (changes <= SAME * changes.max()))).tolist():
        name = free[nothing[0]]
        raise FitError(f"the measurements do not determine {name}: they do not depend on it. {_as_known([name])}")
    singular, directions = np.linalg.svd(jacobian / lengths)[1:]
    if singular[-1] > SAME * singular[0]:
        return
    shares = np.abs(directions[-1])
    determined = [free[k] for k in np.flatnonzero(shares > NAMED_FRACTION * shares.max()).tolist() if free[k]]
    if len(determined) < 2:
        raise FitError(
            f"the measurements do not determine {' '.join(determined) or 'the states of segments'}: changed together "
            f"with states of later segments, it leaves the computed values unchanged. {_as_known([*determined, ''])}"
        )
    raise FitError(
        f"the measurements do not determine {', '.join(determined[:-1])} and {determined[-1]} separately: changed "
        f"together, they leave the computed values unchanged. {_as_known(determined)}"
    )


def _as_known(names: Sequence[str]) -> str:
    """Return advice on treating an unknown as known."""
    unknown = "one of them" if len(names) > 1 else names[0] or "them"
    return (
        f"Treat {unknown} as known: name only the parameters to "
        "estimate in unknown=[...] (by default all) and give values of the others in parameters={...}; "
        "fit_initial_state=False fixes the initial state (with p)"
    )
