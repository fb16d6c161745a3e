"""Noise of runs in a heat bath: its stream, its temperature, and what a run reports of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.option_table import OPTION, in_words
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.runs.states.times import steps_within, times_after
from scvi_codegen.runs.states.validation import Array, evaluation
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED
from scvi_codegen.systems.system import BATH_ENERGY

NO_BATH = "requires a heat bath: give temperature or noise to the system"


LARGEST_TEMPERATURE = float(np.sqrt(np.finfo(float).max))
"""kT is the energy of thermal motions; squares of energies are those of its fluctuations."""
COLOURED_INPUT = 2
"""Purpose of the numbers of coloured noise, as in ``templates/support/run/normals.h``."""
WORD = 2**32 - 1


@dataclass(frozen=True, slots=True)
class ColouredNoise:
    """Input of runs with fixed steps: stationary noise u with <u(t) u(s)> = sigma^2 exp(-abs(t - s)/tau).

    It is the process of Ornstein and Uhlenbeck, exact at the steps (D. T. Gillespie, Phys. Rev. E 54 (1996) 2084),

        u_0 = sigma xi_0,   u_(n+1) = E u_n + sigma (1 - E^2)^(1/2) xi_(n+1),   E = exp(-abs(h)/tau),

    and constant in step n + 1. The normal xi_n is a function of the seed, the trajectory, n and the input.

    Args:
        sigma: standard deviation, in the unit of the input.
        tau: correlation time.

    Raises:
        StateError: if sigma is negative, tau is not positive, or one is not finite.
    """

    sigma: float
    tau: float

    def __post_init__(self) -> None:
        numbers = all(isinstance(value, Real) for value in (self.sigma, self.tau))
        if not (numbers and 0 <= self.sigma < np.inf and 0 < self.tau < np.inf):
            raise StateError(f"{self} requires finite numbers sigma >= 0 and tau > 0")

    def values(self, h: float, normals: Array) -> Array:
        """Return (n, ..) values u at the beginnings of n steps of h, from normals."""
        kept, values = np.exp(-abs(h) / self.tau), np.array(normals)
        values[1:] *= np.sqrt(-np.expm1(-2 * abs(h) / self.tau))
        for n in range(1, len(values)):
            values[n] += kept * values[n - 1]
        return self.sigma * values


def normal_numbers(seed: int, trajectory: Any, step: Any, purpose: int, index: int) -> NDArray[np.complex128]:
    """Return pairs of normal numbers, real and imaginary parts, of trajectories and steps that are broadcast.

    They are those of ``templates/support/run/normals.h``, but for rounding: Philox4x32-10, then Box and Muller.
    """
    step, trajectory = np.broadcast_arrays(np.asarray(step, np.uint64), np.asarray(trajectory, np.uint64))
    a, b, c, d = step & WORD, step >> 32, trajectory & WORD, np.full_like(step, purpose << 30 | index)
    for n in range(10):
        low, high = (seed + n * 0x9E3779B9) & WORD, ((seed >> 32) + n * 0xBB67AE85) & WORD
        of_a, of_c = a * 0xD2511F53, c * 0xCD9E8D57
        a, b, c, d = (of_c >> 32) ^ b ^ low, of_c & WORD, (of_a >> 32) ^ d ^ high, of_a & WORD
    chance, turn = ((first << 21 | second >> 11).astype(float) for first, second in ((a, b), (c, d)))
    length: NDArray[np.complex128] = np.sqrt(-2 * np.log((chance + 1) * 2.0**-53)) * np.exp(
        2j * np.pi * turn * 2.0**-53
    )
    return length


def with_sequences(
    names: Sequence[str],
    inputs: Mapping[str, Any],
    seed: int,
    trajectory: Any = 0,
    *,
    t: Any,
    h: Any,
    end: Callable[[], float],
) -> dict[str, Any]:
    """Return inputs, of coloured noise as values that are held in the steps of h from t to the time ``end()``.

    ``trajectory``: number of the stream, or (k, 1) numbers.
    """
    replaced = dict(inputs)
    for name, noise in inputs.items():
        if isinstance(noise, ColouredNoise) and name in names:
            if h is None:
                remedy = in_words("give {h}, and {steps} or {t_end}")
                raise StateError(f"the input '{name}' is {noise}, which requires fixed steps: {remedy}")
            steps = np.arange(1 + int(steps_within(abs(float(end()) - float(t)) or abs(h), h)))
            normals = normal_numbers(
                OPTION["seed"].checked(seed), trajectory, steps, COLOURED_INPUT, names.index(name)
            ).real
            times, values = times_after(float(t), h, steps)[0], noise.values(h, normals.T).T
            if h < 0:  # the value of each step at the earlier end
                times, values = times[::-1], np.roll(values[..., ::-1], -1, axis=-1)
            replaced[name] = times, values, "constant"
    return replaced


class Noise(NamedTuple):
    """Key and stream of the noise of a run, and whether its steps are accepted or rejected."""

    seed: int = 0
    trajectory: int = 0
    metropolis: bool = False

    def checked(self, stepper: Any, inputs: Mapping[str, Any] | None = None) -> Noise:
        """Return the stream of a run; raise an error for what the stepper excludes."""
        (seed, _, metropolis), interface = self, stepper.interface
        coloured = any(isinstance(value, ColouredNoise) for value in (inputs or {}).values())
        if interface.temperature is None and ((seed != 0 and not coloured) or metropolis):
            raise StateError(f"{OPTION['metropolis' if metropolis else 'seed']} {NO_BATH} '{interface.system}'")
        if metropolis and interface.layout.sizes:
            raise MethodError(
                f"{OPTION['metropolis']} is not available with arrays of run-time sizes: {SIZES_REQUIRED}"
            )
        if metropolis and (interface.changes_energy != BATH_ENERGY or "symmetric" not in interface.notes):
            raise MethodError(
                f"{OPTION['metropolis']} is not available for '{interface.title}' ({', '.join(interface.notes)}; "
                f"{interface.changes_energy}): it requires a symmetric method and no forces, inputs and time; omit it"
            )
        return self._replace(seed=OPTION["seed"].checked(seed))

    def store(self, memory: Any) -> None:
        """Set the stream of a run that starts, in C, which has none without a bath."""
        if hasattr(memory, "seed"):
            memory.seed, memory.trajectory, memory.metropolis = self


def negative_strength(stepper: Any, t: float, parameters: Array, q: Array | None = None) -> str:
    """Return a sentence on kT or a friction that is negative, or on kT too large, or ""; no friction matters at kT = 0.

    Formulas of inputs, of arrays and, without q, of positions are not checked.
    """
    for name, formula, value in _strengths(stepper, t, parameters, q):
        if value is not None and value < 0.0:
            return (
                f"the {name} of the heat bath of '{stepper.interface.system}', {formula}, is {value:g} at t = {t:g}: "
                "it must not be negative; change its parameters, or use forces= for what supplies energy"
            )
        if value is not None and formula == stepper.interface.temperature and not value < LARGEST_TEMPERATURE:
            return (
                f"the {name} of the heat bath of '{stepper.interface.system}', {formula}, is {value:g} at t = {t:g}: "
                f"it must be below {LARGEST_TEMPERATURE:.2g}, or squares of energies exceed the range of numbers; "
                "choose units in which it is near 1"
            )
    return ""


def check_strengths(stepper: Any, t: float, h: float | None, parameters: Array, q: Array | None = None) -> None:
    """Raise :class:`StateError` if a run would go backward in time, or starts with a negative kT or friction."""
    if h is not None and h < 0.0:
        raise StateError(f"the heat bath of '{stepper.interface.system}' acts forward in time: h = {h:g}; give h > 0")
    if message := negative_strength(stepper, t, parameters, q):
        raise StateError(message)


def remark_on_strengths(stepper: Any, t: float, parameters: Array, q: Array) -> str:
    """Return a remark on a failed step with the first strength that depends on more than time and parameters, or ""."""
    at = {name: value for name, _, value in _strengths(stepper, t, parameters, q)}
    for name, formula, value in _strengths(stepper, t, parameters):
        if value is None:
            shown = "depends on inputs or arrays" if at[name] is None else f"is {at[name]:g} there"
            return f". kT and friction must not be negative: the {name}, {formula}, {shown}"
    return ""


def _strengths(stepper: Any, t: float, parameters: Array, q: Array | None = None) -> Iterator[tuple[str, str, Any]]:
    """Yield name, formula and value, ``None`` if it is not a function of what is passed."""
    interface = stepper.interface
    values = {"t": float(t), **dict(zip(interface.parameters, map(float, parameters), strict=False))}
    if q is not None and not interface.layout.coordinates:
        values |= dict(zip(interface.coordinates, q, strict=True))
    kT = _value(interface.temperature, values)
    yield "temperature kT", interface.temperature, kT
    if kT != 0.0:
        yield from ((name, formula, _value(formula, values)) for name, formula in interface.friction)


def _value(formula: str, values: dict[str, float]) -> float | None:
    """Return the value of a formula, ``None`` if it contains other names or entries of arrays."""
    if "[" in formula:
        return None
    evaluate, names = evaluation(formula)
    return evaluate([values[name] for name in names]) if values.keys() >= {*names} else None


DEFAULT_NOISE = Noise()


class BathReport(NamedTuple):
    """Seed of a run, sum of the changes of the kinetic energy by the bath, and part of the steps that were accepted."""

    seed: int
    heat: float
    acceptance: float


def report_of(memory: Any) -> BathReport | None:
    """Return the report of the memory of a run, ``None`` without a bath."""
    if not hasattr(memory, "seed"):
        return None
    accepted = memory.accepted / memory.step if memory.metropolis and memory.step else 1.0
    return BathReport(int(memory.seed), float(memory.heat), accepted)
