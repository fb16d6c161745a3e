"""Continuation of a periodic orbit: predictor along the tangent of its family, corrector at right angles to it.

An orbit is a point y = (q, p, T), or (q, p, T, lambda) with a parameter of the system. At a point of a family the
closing equations F(y) = 0 leave free

* the fields X_J of the conserved quantities J, along the orbit (J = H) and along symmetries: the same orbit;
* one more direction, the tangent of the family.

An orbit is predicted along the tangent and corrected by Newton's method (H. B. Keller, in Applications of Bifurcation
Theory, 1977; Munoz-Almaraz et al., Physica D 181 (2003) 1), in units of the motion: the ranges of positions and
momenta, the time of one radian, and the change of the parameter that changes the end of the orbit by such a range. The
steps of an orbit are adaptive and frozen while it is corrected, and its discretisation error is measured, as by
`periodic_orbit`.

Bifurcations are zeros of functions of the orbit, by its stability indices s (or multipliers m) but the trivial ones:
fold: the derivative of the parameter, or else of the energy, along the family; branch: prod (s - 1), times that
derivative, as an index passes through 1 at a fold; period doubling: prod (s + 1); Krein collision: the discriminant of
the indices; torus, of steps that are not symplectic: prod (m_j m_k - 1), if it changes the number of |m| > 1. Of
several real indices that pass the same value between two orbits, each is located by its rank.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.formulas import Tape, mp, parse_expression, symbol
from scvi_codegen.api.runs import Products, without_accuracy_warnings
from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import EventError, OrbitError, StepFailedError
from scvi_codegen.extras.orbits.equilibrium import Equilibrium
from scvi_codegen.extras.orbits.solver import (
    CONSERVED,
    EASY,
    ERROR,
    TOLERANCES,
    ClosingEquations,
    OrbitSearch,
    PeriodicOrbit,
    block_diagonal,
)
from scvi_codegen.extras.orbits.step_sequence import StepSequence
from scvi_codegen.extras.paths.size import INCREMENT, ROUNDOFF, SAME_MOTION

MOST_CORRECTIONS, FEW_CORRECTIONS, CONTRACTION = 10, 4, 0.7
"""Newton iterations after which a prediction was too far, those up to which the next one may be farther, and the factor
by which each must be shorter."""
FIRST, GROWTH = 0.25, 1.5
"""First step relative to the largest one, and factor between steps."""
SETTLED = 1e-12
"""Newton step in units of the motion below which an orbit is corrected. One whose square is rounding may cease to
decrease, since Newton's method converges quadratically."""
LARGEST_TURN = math.radians(30)
"""Angle between successive tangents above which the step is halved."""
SMALLEST_STEP = 2.0**-12
"""Step along the family, relative to the largest one, below which the family ends."""
LOCATED = 1e-10
"""Accuracy of the location of a bifurcation between two orbits, relative to their distance."""
BRANCHES = 1e-6
"""Singular values of the closing equations that count as zero, so that another family crosses: between a bifurcation
that is located to 1e-10, where it is the error of the derivatives, 1e-9, and the next orbit, where it is the step."""
FLAT = 1e-6
"""Square of the change of period and parameter along a family below which they are stationary: that of the energy, in
units of the motion, has the error 1e-9 of the orbit."""
BEYOND = {"branch": 1.0, "period doubling": -1.0}
"""Values that real indices pass at bifurcations."""
PHASES = 64
"""Number of states along an orbit among which the nearest to another state is sought."""
BEND = math.tan(LARGEST_TURN / 4.0) / 2.0
"""Largest distance of a family from the chord of a step, relative to the chord: of an arc that turns by 30 degrees."""
NEAR_START = 0.05
"""Time between start and nearest impact, relative to the period, below which the start is moved along the orbit. With
the time of one radian as unit, a step of .3 along the family moves the impact by up to .3/(2 pi) = .05 periods."""


@dataclass(frozen=True, eq=False)
class Formula:
    """A formula of named numbers."""

    expression: Any
    symbols: Mapping[str, Any]
    text: str = ""

    @classmethod
    def of(cls, text: str, names: Sequence[str]) -> Formula:
        """Return the formula that a text states."""
        symbols = {name: symbol(name) for name in names}
        return cls(parse_expression(text, symbols), symbols, text)

    def __call__(self, values: Mapping[str, float]) -> float:
        """Return its value."""
        numbers = [mp.mpf(values[name]) for name in self.symbols]
        return float(Tape([self.expression], [*self.symbols.values()])(numbers)[0])

    def derivative(self, name: str) -> Formula:
        """Return its derivative by one of the names."""
        return replace(self, expression=self.expression.diff(self.symbols[name]))


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Closing equations and fixed entries by the reduced unknowns, in units of the motion."""

    closing: ClosingEquations
    units: Array
    jacobian: Array
    defects: Array
    into: Array


@dataclass(frozen=True, eq=False)
class FamilyPoint:
    """A corrected orbit of a family, with its closing equations linearised.

    Attributes:
        y: (2m + 1,) state and period, or (2m + 2,) with the parameter.
        orbit: the orbit.
        into: (2m + 1, r) or (2m + 2, r) changes of y by those of the reduced unknowns.
        units: (r,) sizes of the reduced unknowns, to which the following vectors refer.
        jacobian: (n, r) of the closing equations and the fixed entries.
        same: (r, k) orthonormal directions to the same orbit, from another start or shifted by a symmetry.
        tangent: (r,) unit tangent of the family.
        conserved: number of conserved quantities.
        energy_gradient: (r,) derivative of the energy.
        by_parameter: whether a parameter varies.
        corrections: number of Newton iterations.
        accuracy: index of the local tolerance in ``TOLERANCES`` that met the bound.
        step: step to the next prediction.
        largest: size of the positions on the largest orbit so far.
        of_both: whether the point belongs to another family, too, from which this one branches off.
    """

    y: Array
    orbit: PeriodicOrbit
    into: Array
    units: Array
    jacobian: Array
    same: Array
    tangent: Array
    conserved: int
    energy_gradient: Array
    by_parameter: bool
    corrections: int
    accuracy: int
    step: float
    largest: float
    of_both: bool = False

    @property
    def along(self) -> Array:
        """(2m + 1,) or (2m + 2,) change of y along the unit tangent."""
        return np.asarray(self.into @ (self.tangent * self.units))

    @property
    def slope(self) -> float:
        """Derivative of the parameter, or else of the energy, along the family."""
        return float(self.tangent[-1] if self.by_parameter else self.energy_gradient @ self.tangent)

    @property
    def symplectic(self) -> bool:
        """Return whether the steps of the orbit are symplectic."""
        return self.orbit.symplectic_error <= ERROR

    @cached_property
    def others(self) -> NDArray[np.complex128]:
        """Stability indices, or multipliers, but those at 1 of motions that are shifted in time or by a symmetry."""
        orbit, autonomous = self.orbit, self.orbit.autonomous
        values = orbit.stability_indices if self.symplectic else orbit.multipliers
        trivial = self.conserved if self.symplectic else max(self.conserved, int(autonomous))
        return values[np.argsort(np.abs(values - 1.0))][trivial:]

    @cached_property
    def tests(self) -> dict[str, float]:
        """Test functions of the bifurcations by kind; see the top of the module."""
        others, symplectic = self.others, self.symplectic
        pairs = np.array(list(combinations(others, 2)), dtype=complex).reshape(-1, 2).T
        collision = np.prod((pairs[0] - pairs[1]) ** 2 if symplectic else pairs[0] * pairs[1] - 1.0)
        return {
            "fold": self.slope,
            "branch": float(np.prod(others - 1.0).real) * (self.slope or 1.0),
            "period doubling": float(np.prod(others + 1.0).real),
            "Krein collision" if symplectic else "torus": float(collision.real),
        }

    def test(self, kind: str, rank: int | None = None) -> float:
        """Return a test function, or by how much the real index of a rank is beyond 1 or -1, -1 for complex ones."""
        if rank is None:
            return self.tests[kind]
        real = np.abs(self.others.imag) <= SAME_MOTION
        return float(np.sort(np.where(real, BEYOND[kind] * self.others.real - 1.0, -1.0))[-1 - rank])

    def crossings(self, after: FamilyPoint) -> Iterator[tuple[str, int | None]]:
        """Yield kind and rank of the test functions that change their sign between this orbit and the next one."""
        changed = {kind for kind, value in self.tests.items() if value * after.tests.get(kind, value) < 0.0}
        values = [point.others[np.abs(point.others.imag) > SAME_MOTION] for point in (self, after)]  # complex ones
        counts = {"Krein collision": {len(part) for part in values}}
        counts["torus"] = {int(np.count_nonzero(np.abs(part) > 1.0)) for part in values}
        changed -= {kind for kind, numbers in counts.items() if len(numbers) == 1}
        yield from ((kind, None) for kind in self.tests if kind in changed)
        if "fold" in changed or len(counts["Krein collision"]) > 1:
            return
        for kind in BEYOND.keys() - changed:
            ranks = range(len(self.others))
            passes = [self.test(kind, rank) * after.test(kind, rank) < 0.0 for rank in ranks]
            yield from ((kind, rank) for rank in ranks if passes[rank])


@dataclass(frozen=True, eq=False)
class Continuation:
    """Predictor and corrector of a family.

    Attributes:
        search: the closing equations.
        parameter: index of the parameter that varies.
        step: largest step in units of the motion.
        bound: bound of the discretisation error.
        period_of: the period as a function of the parameters by name.
        parameter_unit: change of the parameter that changes the end of the first orbit by the size of its motion.
    """

    search: OrbitSearch
    parameter: int | None
    step: float
    bound: float
    period_of: Formula | None
    parameter_unit: float = 1.0

    def begun(
        self, z: Array, start: PeriodicOrbit | Equilibrium, *, backward: bool
    ) -> tuple[Continuation, FamilyPoint]:
        """Return the continuation with the unit of its parameter, and the first point."""
        continuation, y, growth = self, z, None
        if self.parameter is not None:
            continuation, y = self._with_unit(z), np.append(z, start.parameters[self.parameter])
        if isinstance(start, Equilibrium):
            growth = np.concatenate([z[:-1] - np.concatenate([start.q, start.p]), np.zeros(len(y) - len(z) + 1)])
        try:
            point = continuation.corrected(y, growth)
        except OrbitError as error:
            if growth is None:
                raise
            raise OrbitError(f"no orbit has this amplitude= beside the equilibrium; reduce it ({error})") from error
        sizes = np.linalg.svd(point.jacobian, compute_uv=False)
        rank = int(np.count_nonzero(sizes > BRANCHES * sizes[0]))
        freedom = len(point.units) - rank - point.same.shape[1]
        if freedom != 1:
            raise OrbitError(self._freedom_message(freedom, point.orbit))
        if growth is None and (point.slope < 0.0) != backward:
            point = replace(point, tangent=-point.tangent)
        return continuation, point

    def _freedom_message(self, freedom: int, orbit: PeriodicOrbit) -> str:
        if freedom < 1:
            names = self.search.stepper.parameters or ("..",)
            remedy = f"is isolated: vary a parameter of the system, parameter={names[0]!r}, or fix less"
        else:
            remedy = (
                f"is one of a family of {freedom} parameters: fix {freedom - 1} more, by fixed=['x', ..], energy= or "
                "fixed_period=True"
            )
        return f"the orbit of the period {orbit.period:.6g} {remedy}"

    def following(self, point: FamilyPoint) -> FamilyPoint:
        """Return the next point of the family, as far as its tangent turns by at most ``LARGEST_TURN``."""
        step, failure = point.step, ""
        while step >= SMALLEST_STEP * self.step:
            try:
                prediction = self._moved(self.search, point.y, step * point.along)
                following = self.corrected(prediction, prediction - point.y, point)
            except (ArithmeticError, EventError, OrbitError, StepFailedError, np.linalg.LinAlgError) as error:
                step, failure = step / 2.0, str(error)
                continue
            turned = self._onto(point.y) @ following.along / point.units
            if not point.of_both and turned @ point.tangent < math.cos(LARGEST_TURN) * np.linalg.norm(turned):
                step, failure = step / 2.0, "its tangent turns by more than 30 degrees"
                continue
            wider = GROWTH if following.corrections <= FEW_CORRECTIONS else 1.0
            return replace(following, step=min(self.step, wider * step))
        raise OrbitError(f"{self._last_orbit(point)} at {SMALLEST_STEP:.0e} of the step: {failure}")

    def _last_orbit(self, point: FamilyPoint) -> str:
        """Return a description of an orbit that no other follows."""
        orbit, widths = point.orbit, point.orbit.sequence.widths
        times, states = _states_along(orbit, orbit.t, np.append(orbit.q, orbit.p), orbit.period)
        changes = np.linalg.norm(np.diff(states, axis=0) / self.search.sizes_of(states), axis=1)
        slowest = (changes / np.diff(times)).min() * orbit.period / changes.sum()
        shortest = widths.min() / widths.max()
        return (
            f"no orbit follows that of the period {orbit.period:.6g}, whose least speed is {slowest:.1e} of the mean "
            f"(0 at a homoclinic orbit) and whose shortest step {shortest:.1e} of the longest (0 at a collision),"
        )

    def change_along(self, point: FamilyPoint) -> Array:
        """Return the change of the unknowns along the tangent of a point."""
        return self._moved(self.search, point.y, point.along) - point.y

    def end_at(self, first: FamilyPoint, before: FamilyPoint, after: FamilyPoint) -> str:
        """Return why a family ends at an orbit, or ``""``: it shrinks to a point, or passes its first orbit."""
        shrinks = after.units[: self.search.reduction.size] < before.units[: self.search.reduction.size]
        # Terms that are not linear have the relative size of the square of the amplitude, here below the bound.
        if shrinks[0] and after.units[0] < math.sqrt(self.bound) * after.largest:
            end = "the equilibrium" if shrinks[-1] else "a collision"
            return f"it shrinks to {end} near q = {np.array2string(after.orbit.q, precision=6)}"
        length = np.linalg.norm(self._away(before, after.y))
        tail = slice(self.search.reduction.size, None)
        if before is first or (np.abs(self._away(before, first.y)[tail]) > (1.0 + BEND) * length).any():
            return ""
        near = [self._nearest_state(point, first) for point in (before, after)]
        chord = near[1] - near[0]
        part = -(near[0] @ chord) / (chord @ chord)
        if 0.0 <= part < 1.0 and np.linalg.norm(near[0] + part * chord) <= BEND * np.linalg.norm(chord):
            return "it is closed: the next orbit is the first one"
        return ""

    def _away(self, point: FamilyPoint, y: Array) -> Array:
        """Return the change from a point to other unknowns, in units of the motion."""
        return np.asarray(self._onto(point.y) @ self._difference(y, point.y) / point.units)

    def _difference(self, y: Array, other: Array) -> Array:
        """Return y minus other unknowns, with the lengths, signs and phases of rotations of the latter."""
        size = 2 * self.search.stepper.dimension
        return np.append(self.search.reduction.aligned(y[:size], other[:size]), y[size:]) - other

    def _nearest_state(self, point: FamilyPoint, first: FamilyPoint) -> Array:
        """Return the change from an orbit to the nearest start on another one, but along the former."""
        size, orbit = 2 * self.search.stepper.dimension, point.orbit
        t, state, duration = orbit.t, point.y[:size], orbit.period
        if not first.orbit.autonomous:  # time is no matter of choice
            return self._away(first, point.y)
        for _ in range(2):  # among states along the orbit, and among those beside the nearest one
            times, states = _states_along(orbit, t, state, duration)
            changes = [self._away(first, np.append(state, point.y[size:])) for state in states]
            nearest = int(np.argmin(np.linalg.norm(changes, axis=1)))
            t, state = times[max(0, nearest - 1)], states[max(0, nearest - 1)]
            duration = times[min(len(times) - 1, nearest + 1)] - t
        return np.asarray(changes[nearest] - first.same @ (first.same.T @ changes[nearest]))

    def shifted(self, before: FamilyPoint, after: FamilyPoint) -> FamilyPoint:
        """Return a point with its start in the middle between impacts, if one is near the start."""
        stepper, orbit, size = self.search.stepper, after.orbit, 2 * self.search.stepper.dimension
        if not stepper.divides_steps or self.search.fixed_indices or not orbit.autonomous:
            return after
        runs = [point.orbit.run() for point in (before, after)]
        ends = np.concatenate([*(event.t for event in runs[1].events), *(kind.t for kind in runs[1].transitions)])
        times = np.sort((ends - orbit.t) / orbit.period)
        if not len(times) or min(times[0], 1.0 - times[-1]) > NEAR_START:
            return after
        gaps = np.diff(times, append=times[0] + 1.0)
        part = float(times[gaps.argmax()] + gaps.max() / 2.0) % 1.0
        starts = [
            np.concatenate([*run.at(run.t[0] + part * point.orbit.period), point.y[size:]])
            for run, point in zip(runs, (before, after), strict=True)
        ]
        return replace(self.corrected(starts[1], starts[1] - starts[0]), step=after.step, largest=after.largest)

    def bifurcations(self, before: FamilyPoint, after: FamilyPoint) -> Iterator[tuple[str, FamilyPoint]]:
        """Yield kinds and points between two others where test functions vanish, by Brent's method along the chord."""
        from scipy.optimize import brentq  # here: slow to import

        points, chord = {0.0: before, 1.0: after}, self._difference(after.y, before.y)

        def value(part: float, kind: str, rank: int | None) -> float:
            if part not in points:
                points[part] = self.corrected(before.y + part * chord, chord, before)
            return points[part].test(kind, rank)

        for kind, rank in before.crossings(after):
            yield kind, points[float(brentq(value, 0.0, 1.0, (kind, rank), xtol=LOCATED))]

    def branching(self, point: FamilyPoint, periods: int, *, backward: bool) -> tuple[Continuation, FamilyPoint]:
        """Return the point of a bifurcation with the tangent of the other family, whose period is a multiple."""
        size = 2 * self.search.stepper.dimension
        y = point.y.copy()
        y[size] *= periods
        doubled = replace(self, search=replace(self.search, period=float(y[size])))
        if periods > 1 and self.search.sequence is not None:
            equal = StepSequence.equal(periods * len(self.search.sequence))
            doubled = replace(doubled, search=replace(doubled.search, sequence=equal))
        both = doubled.corrected(y, None, point)
        flat = np.count_nonzero(np.linalg.svd(both.jacobian, compute_uv=False) <= BRANCHES)
        if doubled.search.reversor is not None and flat < both.same.shape[1] + 2:  # the branch is not symmetric
            doubled = replace(doubled, search=doubled.search.of_reversor(None))
            both = doubled.corrected(y, None, point)
        kept = _smallest(both.jacobian, both.same.shape[1] + 2)
        others = _without(_without(kept, both.same), both.tangent[:, np.newaxis])
        # Where a period doubles and where a symmetry breaks, period and parameter are stationary along the branch.
        tail, tangent = slice(self.search.reduction.size, None), both.tangent
        branch = others[:, 0]
        if (size_of_tail := tangent[tail] @ tangent[tail]) > FLAT:
            branch = branch - tangent * (branch[tail] @ tangent[tail]) / size_of_tail
        start = (both.into @ (branch * both.units))[:size]
        branch *= (-1.0 if backward else 1.0) * np.sign(start[np.abs(start).argmax()]) / np.linalg.norm(branch)
        return doubled, replace(both, tangent=branch, step=self.step * FIRST, of_both=True)

    def corrected(self, prediction: Array, normal: Array | None, former: FamilyPoint | None = None) -> FamilyPoint:
        """Return the point of the family next to a prediction, with a discretisation error below the bound.

        Args:
            prediction: unknowns.
            normal: change of the unknowns, at right angles to which the prediction is corrected.
            former: the point before it, whose units and whose direction along the family are kept.
        """
        y, corrections, end = prediction, 0, 2 * self.search.stepper.dimension + 1
        for accuracy in range(former.accuracy if former else 0, len(TOLERANCES)):
            search = self._search_at(y, TOLERANCES[accuracy] * self.bound)
            y, further = self._solved(search, prediction, self._in_segments(search, y, former), normal, former)
            linear = self._linearised(search, y)
            corrections = max(corrections, further)
            orbit = self._found(search, y).described(y[:end], linear.closing, corrections, guess=y[:end])
            if orbit.error <= self.bound or self.search.sequence is not None:
                break
        if self.parameter is not None and search.reversor and search.irreversibility(y[:end]) > ERROR:
            raise OrbitError("the reversor= is no symmetry at another value of parameter=: omit it")
        gradient = search.integral_gradients(y[: end - 1], search.t, linear.closing.sizes)[0]
        gradient = gradient @ linear.closing.motion.inward
        same, conserved = self._same_orbit(search, linear, y[: end - 1])
        tangents = _without(_smallest(linear.jacobian, same.shape[1] + 1, BRANCHES), same)
        tangent = tangents[:, 0]
        along = normal if former is None else former.along
        if along is not None:  # the family's, where another one crosses it
            tangent = tangents @ (tangents.T @ (self._onto(y) @ along / linear.units))
            tangent /= np.linalg.norm(tangent)
        return FamilyPoint(
            y=y,
            orbit=orbit,
            into=linear.into,
            units=linear.units,
            jacobian=linear.jacobian,
            same=same,
            tangent=tangent,
            conserved=conserved,
            energy_gradient=np.append(gradient, np.zeros(len(tangent) - len(gradient))) * linear.units,
            by_parameter=self.parameter is not None,
            corrections=corrections,
            accuracy=accuracy,
            step=self.step * FIRST if former is None else former.step,
            largest=max(linear.units[0], 0.0 if former is None else former.largest),
        )

    def _search_at(self, y: Array, tolerance: float) -> OrbitSearch:
        """Return the closing equations next to some unknowns, with the steps of a run there."""
        end = 2 * self.search.stepper.dimension + 1
        search = self._with_parameter(replace(self.search, period=float(y[end - 1])), y)
        return search if search.sequence is not None else search.adapted(y[:end], tolerance)

    def _found(self, search: OrbitSearch, y: Array) -> OrbitSearch:
        """Return the closing equations of an orbit that was found, whose period is prescribed if a formula does so."""
        search = self._with_parameter(search, y)
        return search if self.period_of is None else replace(search, fixed_indices=(*search.fixed_indices, -1))

    def _with_parameter(self, search: OrbitSearch, y: Array) -> OrbitSearch:
        if self.parameter is None:
            return search
        parameters = search.parameters.copy()
        parameters[self.parameter] = y[-1]
        reduction = search.reduction.at(search.t, parameters)
        return replace(search, parameters=parameters, varied=self.parameter, reduction=reduction)

    def _in_segments(self, search: OrbitSearch, y: Array, former: FamilyPoint | None) -> Array:
        """Return unknowns with the starts of more segments where tangent vectors grow along the orbit."""
        end = 2 * search.stepper.dimension + 1
        if former is not None and np.abs(former.orbit.multipliers[0]) <= EASY:
            return y
        nodes = search.nodes(y[:end], smoothed=False)
        return y if nodes is None else np.concatenate([nodes, y[end:]])

    def _solved(
        self, search: OrbitSearch, prediction: Array, y: Array, normal: Array | None, former: FamilyPoint | None
    ) -> tuple[Array, int]:
        """Correct unknowns by Newton's method, by changes of least norm; return start, period and parameter."""
        size, last = 2 * search.stepper.dimension, math.inf
        tail = len(prediction) - size
        for count in range(MOST_CORRECTIONS + 1):
            linear = self._linearised(search, y)
            jacobian, defects = linear.jacobian, linear.defects
            if normal is not None:
                own = np.append(linear.units[: search.reduction.size], linear.units[-tail:])
                onto = self._onto(prediction)
                row = onto @ normal / (own if former is None else former.units) ** 2
                row = row / np.linalg.norm(row * own) @ onto
                away = self._difference(np.append(y[:size], y[-tail:]), prediction)
                columns = row[:size] @ linear.into[:size] + row[size:] @ linear.into[-tail:]
                defects = np.append(defects, row @ away)
                jacobian = np.vstack([jacobian, columns * linear.units])
            change = np.linalg.pinv(jacobian, ERROR) @ defects
            length = float(np.linalg.norm(change))
            if length <= SETTLED or (length <= math.sqrt(ROUNDOFF) and length > last / 2.0):
                return np.append(y[:size], y[-tail:]), count
            if not length < CONTRACTION * last:
                break
            y, last = self._moved(search, y, -linear.into @ (change * linear.units)), length
        raise OrbitError(f"the correction of an orbit of the period {prediction[size]:.6g} does not converge")

    def _onto(self, y: Array) -> Array:
        """Return the matrix from changes of start, period and parameter to those in the reduced tangent space."""
        search, size = self._with_parameter(self.search, y), 2 * self.search.stepper.dimension
        return block_diagonal([search.reduction.outward(*np.split(y[:size], 2)), np.eye(len(y) - size)])

    def _moved(self, search: OrbitSearch, y: Array, change: Array) -> Array:
        """Return unknowns after a change, of the starts of one or more segments."""
        search, end = self._with_parameter(search, y + change), len(y) - (self.parameter is not None)
        return np.append(search.moved(y[:end], change[:end]), (y + change)[end:])

    def _linearised(self, search: OrbitSearch, y: Array) -> _Linearised:
        """Return the closing equations at some unknowns, and their Jacobian by the reduced unknowns, in units."""
        tail, search = 1 + (self.parameter is not None), self._with_parameter(search, y)
        states, period = y[:-tail], y[len(y) - tail]
        closing = search.closing_equations(np.append(states, period))
        rows = search.row_units(closing)
        sizes, count = search.reduced_sizes(closing.sizes), len(closing.segments)
        units = np.append(np.tile(sizes, count), period / (2.0 * math.pi))
        columns, defects, into = closing.partials, closing.defects, closing.into
        if self.parameter is not None:
            units, into = np.append(units, self.parameter_unit), block_diagonal([into, np.eye(1)])
            into[: len(states), -1] = np.concatenate([segment.shift for segment in closing.segments])
            columns = np.column_stack([columns, self._by_parameter(search, closing, states)])
        jacobian = columns * units / rows[:, np.newaxis]
        fixed = search.fixed_changes(into[: len(states) + 1], units)
        jacobian, defects = np.vstack([jacobian, fixed]), np.append(defects / rows, np.zeros(len(fixed)))
        if self.period_of is not None:
            value, slope = self._period(search)
            row = np.zeros(len(units))
            row[-2:] = 1.0, -slope * units[-1] / units[-2]
            jacobian = np.vstack([jacobian, row])
            defects = np.append(defects, (period - value) / units[-2])
        return _Linearised(closing, units, jacobian, defects, into)

    def _period(self, search: OrbitSearch) -> tuple[float, float]:
        """Return the prescribed period and its derivative by the parameter that varies."""
        names = search.stepper.parameters
        values = dict(zip(names, search.parameters, strict=False))
        if self.period_of is None or self.parameter is None:
            return search.period, 0.0
        return self.period_of(values), self.period_of.derivative(names[self.parameter])(values)

    def _by_parameter(self, search: OrbitSearch, closing: ClosingEquations, states: Array) -> Array:
        """Return the derivatives of the closing equations by the parameter."""
        assert self.parameter is not None
        starts = np.roll(states.reshape(len(closing.segments), -1), -1, axis=0)
        column = [search.leaving(*at) @ at[0].by_parameter for at in zip(closing.segments, starts, strict=True)]
        column[-1][np.flatnonzero(search.drifts)] = 0.0
        column[-1] = closing.returning @ column[-1]
        if search.energy is not None:
            at = search, starts[-1], closing.segments[0].shift, self.parameter
            column.append(np.array([self._energy_by_parameter(*at)]))
        return np.concatenate(column)

    def _energy_by_parameter(self, search: OrbitSearch, start: Array, shift: Array, parameter: int) -> float:
        """Return the derivative of the energy of a state, with its shift, by a parameter, by central differences."""
        width = INCREMENT * self.parameter_unit
        changed = np.repeat(search.parameters[np.newaxis], 2, axis=0)
        changed[:, parameter] += -width, width
        q, p = np.split(start + width * np.outer([-1.0, 1.0], shift), 2, axis=1)
        less, more = (float(search.stepper.energy(q[k], p[k], search.t, values)) for k, values in enumerate(changed))
        return (more - less) / (2.0 * width)

    def _with_unit(self, z: Array) -> Continuation:
        """Return the continuation with the unit of its parameter."""
        assert self.parameter is not None
        y = np.append(z, self.search.parameters[self.parameter])
        search = replace(self._search_at(y, TOLERANCES[0] * self.bound), energy=None)
        closing = search.closing_equations(z)
        column = self._by_parameter(search, closing, z[:-1]) / search.row_units(closing)
        effect = float(np.linalg.norm(column))
        if self.period_of is not None:
            effect += abs(self._period(search)[1]) * 2.0 * math.pi / float(z[-1])
        if effect * abs(y[-1]) <= Products.RESOLVED * ROUNDOFF:  # the orbit may stay, but not its multipliers
            unit = self._unit_of_multipliers(search, y, closing, effect)
            effect = effect if effect * unit > Products.RESOLVED * ROUNDOFF else 1.0 / unit
        return replace(self, parameter_unit=1.0 / effect)

    def _unit_of_multipliers(self, search: OrbitSearch, y: Array, closing: ClosingEquations, effect: float) -> float:
        """Return the change of the parameter that changes the monodromy matrix by its size, by that of a small one."""
        reduced = search.reduced_sizes(closing.sizes)
        for change in 2.0 ** np.arange(-320, 320, 16):
            other = self._with_parameter(search, np.append(y[:-1], y[-1] + change)).closing_equations(y[:-1])
            matrices = [part.monodromy / reduced[:, np.newaxis] * reduced for part in (closing, other)]
            if (part := float(np.abs(matrices[1] - matrices[0]).max() / np.abs(matrices[0]).max())) > ERROR:
                return float(change) / part
        if effect > 0.0:
            return math.inf
        raise OrbitError(f"{search.stepper.parameters[self.parameter or 0]} changes neither orbit nor multipliers")

    def _same_orbit(self, search: OrbitSearch, linear: _Linearised, start: Array) -> tuple[Array, int]:
        """Return the orthonormal directions to the same orbit, and the number of conserved quantities.

        They are the flow, the fields Omega grad J of the conserved quantities, whose gradients are the equations that
        are not among the independent ones, and shifts of drifting positions, if they keep fixed entries.
        """
        closing, size, units = linear.closing, search.reduction.size, linear.units
        independent = closing.returning
        if search.reversor is not None:
            at = start[np.newaxis], closing.segments, closing.sizes, closing.relative_error
            independent = search.independent_equations(*at)
        kept, strengths, _ = np.linalg.svd(independent * units[:size] / units[:size, np.newaxis])
        gradients = kept[:, strengths < 0.5]
        fields = np.vstack([gradients[size // 2 :], -gradients[: size // 2]])
        if not closing.motion.by_time.any():
            flow = search.leaving(closing.motion, start) @ closing.motion.by_period / units[:size]
            fields = np.column_stack([flow / np.linalg.norm(flow), fields])
        fields = np.vstack([fields, np.zeros((len(units) - size, fields.shape[1]))])
        fields = _range(np.column_stack([fields, np.eye(len(units))[:, np.flatnonzero(search.drifts)]]))
        rows = linear.jacobian[len(closing.defects) :]
        return _range(fields @ _smallest(rows @ fields, 0, CONSERVED)), gradients.shape[1]


def _states_along(orbit: PeriodicOrbit, t: float, state: Array, duration: float) -> tuple[Array, Array]:
    """Return times and (n, 2m) states of short steps from a state of an orbit."""
    at: dict[str, Any] = {"t": t, "parameters": orbit.parameters, "options": orbit.options}
    with without_accuracy_warnings():
        run = orbit.stepper.integrate(
            *np.split(state, 2), t_end=t + duration, max_step=duration / PHASES, check_growth=False, **at
        )
    return np.asarray(run.t), np.hstack([run.q, run.p])


def _range(vectors: Array) -> Array:
    """Return an orthonormal basis of the span of columns."""
    basis, strengths, _ = np.linalg.svd(vectors, full_matrices=False)
    return basis[:, strengths > CONSERVED * strengths.max(initial=0.0)]


def _smallest(matrix: Array, count: int, least: float = 0.0) -> Array:
    """Return the right singular vectors of ``count`` smallest singular values, and of others up to ``least``."""
    _, strengths, rows = np.linalg.svd(matrix)
    rank = min(matrix.shape[1] - count, int(np.count_nonzero(strengths > least)))
    return rows[rank:].T


def _without(vectors: Array, directions: Array) -> Array:
    """Return an orthonormal basis of the span of columns at right angles to some directions in it."""
    rest = vectors - directions @ (directions.T @ vectors)
    basis, _, _ = np.linalg.svd(rest, full_matrices=False)
    return basis[:, : vectors.shape[1] - directions.shape[1]]
