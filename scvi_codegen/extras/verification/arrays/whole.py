"""Checks of array systems at full size: rates against NumPy, reversibility and conserved quantities."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sympy import Expr

from scvi_codegen.api.formulas import DOT
from scvi_codegen.api.methods import Method
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.extras.verification.certificate import Check, Finding, Outcome, checked, information
from scvi_codegen.extras.verification.system_under_test import EPSILON, LONG_RUN, ROUNDINGS, SHORT_RUN
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.stepper import Stepper

Numbers = NDArray[np.float64]

SHORT = 2.0**-60
"""Factor of h for steps whose increment is h times the rate at the start, wholly in the compensation terms."""
PERTURBATION = 2.0**-30
"""Relative change of the state by which the effect of rounding is estimated."""
WORK = 4_000_000
"""Number of coordinates times steps of the run."""
RESOLVED = EPSILON
"""Local error below which round-off dominates the change of the energy."""


@dataclass(frozen=True, slots=True)
class WholeStart:
    """Integrator at full size, and the initial state of runs."""

    system: ArraySystem
    method: Method
    stepper: Stepper
    arrays: Any
    p: Mapping[str, Numbers]
    h: float
    t: float

    def array(self, name: str) -> Numbers:
        """Return an array of positions, momenta, velocities or parameters by name."""
        momenta = {p.name: q.name for q, p in zip(self.system.coordinates, self.system.momenta, strict=False)}
        if name in momenta:
            return self.p[momenta[name]]
        moving = name.removesuffix(DOT)
        if moving != name and moving in self.p:
            return self.p[moving] / _masses(self)[moving]
        values: Numbers = {**self.arrays.state, **self.arrays.fields}[name]
        return values

    def elements(self, loops: Sequence[Any]) -> Any:
        """Return all index values of loops."""
        return self.system.elements(loops, self.arrays.sizes, self.arrays.places)

    def run(self, h: float | None = None) -> Run:
        """Start a run at the initial state, optionally with another step size."""
        return self.begin(self.arrays.state, self.p, self.h if h is None else h, self.t)

    def begin(self, q: Mapping[str, Numbers], p: Mapping[str, Numbers], h: float, t: float) -> Run:
        """Start a run at a state."""
        return self.stepper.start(q, p, h=h, t=t, parameters=self.parameters, tables=self.arrays.places)

    @property
    def parameters(self) -> dict[str, Any]:
        """Numbers and fields by name."""
        names = [parameter.name for parameter in self.system.parameters]
        return {**dict(zip(names, self.arrays.numbers, strict=True)), **self.arrays.fields}


def whole_checks(start: WholeStart) -> Iterator[Check]:
    """Yield all checks of this module; they share one long run."""
    sizes = ", ".join(f"{name} = {size}" for name, size in start.arrays.sizes.items()) or "its size"
    yield from checked("rates", f"at {sizes} the loops give the rates of NumPy", partial(_rates, start))
    yield from checked("energies", f"at {sizes} kinetic and potential energy equal NumPy's", partial(_energies, start))
    if start.method.symmetric:
        statement = f"at {sizes} a step with -h undoes the step with h"
        yield from checked("reversal at full size", statement, partial(_reversal, start))
    yield from _long_run(start, sizes)


def _rates(start: WholeStart) -> Finding:
    """Return the error of (z1 - z0) / h of a very small step, with compensation, in units of rounding."""
    run, worst = start.run(start.h * SHORT), 0.0
    run.advance(1)
    expected, nudged = _numpy_rates(start), _numpy_rates(_perturbed(start))
    named = run.stepper.arrays
    ends = ((start.arrays.state, named(run.q)), (start.p, named(run.p)))
    lows = map(named, run._compensation)
    for (before, after), low, derivatives, others in zip(ends, lows, expected, nudged, strict=True):
        size = _largest(derivatives.values())
        noise = _largest(derivative - others[name] for name, derivative in derivatives.items())
        unit = EPSILON * (size + noise / PERTURBATION) or 1.0
        for name, exact in derivatives.items():
            rate = ((after[name] - before[name]) + low[name]) / run._step_size
            worst = max(worst, _largest([rate - exact]) / unit)
    return Finding(worst, ROUNDINGS, "in units of rounding")


def _largest(arrays: Iterable[Numbers]) -> float:
    """Return the largest absolute value of the entries of arrays, 0 without entries."""
    return max((float(np.abs(array).max(initial=0.0)) for array in arrays), default=0.0)


def _perturbed(start: WholeStart) -> WholeStart:
    def moved(state: Mapping[str, Numbers]) -> dict[str, Numbers]:
        return {
            name: x * (1 + PERTURBATION * np.cos(1.0 + np.arange(x.size)).reshape(x.shape)) for name, x in state.items()
        }

    return replace(start, arrays=replace(start.arrays, state=moved(start.arrays.state)), p=moved(start.p))


def _numpy_rates(start: WholeStart) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
    """Return dq/dt and dp/dt of every coordinate, computed with NumPy."""
    system = start.system
    result = {array.name: np.zeros(array.shape(start.arrays.sizes)) for array in system.state}
    for force in system.all_forces:
        at = start.elements(force.loops)
        for access, formula in force.targets:
            added = np.zeros_like(result[access.array.name])
            _add(added, at.of(access), _values(start, at, formula, force.slots))
            result[access.array.name] += at.transposed(added, access, start.arrays.fields)
    if system.momenta:
        pairs = list(zip(system.coordinates, system.momenta, strict=True))
        return {q.name: -result[p.name] for q, p in pairs}, {q.name: result[q.name] for q, _ in pairs}
    masses = _masses(start)
    return {name: p / masses[name] for name, p in start.p.items()}, result


def _add(total: Numbers, places: tuple[Any, ...], values: Any) -> None:
    """Add values to the entries of an array at places, which may repeat; to a single coordinate all of them."""
    if places:
        np.add.at(total, places, values)
    else:
        total += np.sum(values)


def _masses(start: WholeStart) -> dict[str, Numbers]:
    masses = {array.name: np.zeros(array.shape(start.arrays.sizes)) for array in start.system.coordinates}
    for mass in start.system.masses:
        at = start.elements(mass.loops)
        for access, formula in mass.targets:
            _add(masses[access.array.name], at.of(access), _values(start, at, formula, mass.slots))
    return masses


def _energies(start: WholeStart) -> Finding:
    system, run = start.system, start.run()
    masses = {} if system.momenta else _masses(start)
    kinetic = sum(float(np.sum(start.p[name] ** 2 / mass)) / 2 for name, mass in masses.items())
    terms = (*system.potentials, *system.energy_offsets)
    values = [_values(start, start.elements(term.loops), term.formula, term.slots) for term in terms]
    potential = -sum(float(np.sum(term_values)) for term_values in values)
    size = kinetic + sum(float(np.sum(np.abs(term_values))) for term_values in values)
    wrong = abs(run.energies[0] - kinetic) + abs(run.energies[1] - potential)
    count = sum(np.size(term_values) for term_values in values) + 1
    return Finding(wrong / (size or 1.0), ROUNDINGS * EPSILON * float(np.log2(count) + 1), "relative to its terms")


def _values(start: WholeStart, elements: Any, formula: Expr, slots: Sequence[tuple[Any, Any]]) -> Any:
    arrays = {access.array.name: start.array(access.array.name) for _, access in slots} | {**start.arrays.fields}
    numbers: dict[Expr, float] = dict(zip(start.system.parameters, start.arrays.numbers, strict=True))
    return elements.values(formula, slots, arrays, {**numbers, start.system.time: start.t})


def _reversal(start: WholeStart) -> Finding:
    """Return the defect of a step forward and back, relative to the largest coordinate or increment."""
    run = start.run()
    run.advance(1)
    q1, p1 = run.stepper.arrays(run.q), run.stepper.arrays(run.p)
    back = start.begin(q1, p1, -run._step_size, run.t)
    back.advance(1)
    q2, p2 = back.stepper.arrays(back.q), back.stepper.arrays(back.p)
    masses = dict.fromkeys(start.p, np.ones(())) if start.system.momenta else _masses(start)
    to_length = {name: run._step_size * (1.0 / mass) for name, mass in masses.items()}  # h / m
    lengths = [*start.arrays.state.values(), *q1.values()]
    lengths += [p * to_length[name] for momenta in (start.p, p1) for name, p in momenta.items()]
    differences = [q2[name] - q for name, q in start.arrays.state.items()]
    differences += [to_length[name] * (p2[name] - p) for name, p in start.p.items()]
    error = _largest(differences) / (_largest(lengths) or 1.0)
    return Finding(error, ROUNDINGS * EPSILON, "relative to the largest coordinate")


def _long_run(start: WholeStart, sizes: str) -> Iterator[Check]:
    run = start.run()
    count = sum(values.size for values in start.p.values())
    steps = max(SHORT_RUN // 2, min(LONG_RUN, WORK // count))
    before, maps = np.array(run.energies), run.momentum_maps
    terms = _map_sizes(start)
    try:
        run.advance(steps)
    except StepFailedError as failure:
        statement, remark = f"at {sizes} energy and momentum maps", str(failure)
        yield Check(name="conserved", statement=statement, outcome=Outcome.NOT_MEASURED, remark=remark)
        return
    walk = ROUNDINGS * EPSILON * float(np.sqrt(steps))
    where = f"{steps} steps of {run._step_size:g}"
    change = abs(run.energy - before[2]) / (abs(before[0]) + abs(before[1]) or 1.0)
    if not start.system.changes_energy:
        if start.method.symplectic and run.step_error < RESOLVED:
            statement = f"at {sizes} conserved up to round-off"
            yield from checked("energy", statement, partial(Finding, float(change), walk, f"relative, {where}"))
        else:
            yield information("energy", f"at {sizes} relative change", float(change), where)
    if start.method.symplectic:
        for k, name in enumerate(start.stepper.momentum_map_names):
            off = float(abs(run.momentum_maps[k] - maps[k])) / (terms or 1.0)
            statement = f"at {sizes} conserved to round-off (symmetry)"
            yield from checked(name, statement, partial(Finding, off, walk, f"relative to its terms, {where}"))


def _map_sizes(start: WholeStart) -> float:
    """Return a size of the terms of momentum maps: momenta, and momenta times positions."""
    run = start.run()
    q, p = np.abs(run.q), np.abs(run.p)
    run.advance(1)
    p = p + np.abs(run.p)
    size = float(np.sum(p) + np.sum(p * q))
    return size + float(np.sum(p**2 + q**2)) if start.system.momenta else size
