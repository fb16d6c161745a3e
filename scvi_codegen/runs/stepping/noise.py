"""Noise of runs in a heat bath: its stream, its temperature, and what a run reports of it."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, NamedTuple

from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.states.validation import Array, evaluation
from scvi_codegen.systems.system import BATH_ENERGY

NO_BATH = "requires a heat bath: give temperature= or noise= to the system"


class Noise(NamedTuple):
    """Key and stream of the noise of a run, and whether its steps are accepted or rejected."""

    seed: int = 0
    trajectory: int = 0
    metropolis: bool = False

    @classmethod
    def checked(cls, stepper: Any, seed: int | None, metropolis: bool, trajectory: int = 0) -> Noise:
        """Return the stream of these arguments of a run; raise an error for those that the stepper excludes."""
        if seed is None and not metropolis and not trajectory:
            return DEFAULT_NOISE
        interface = stepper.interface
        if interface.temperature is None and (seed is not None or metropolis):
            raise StateError(f"{'metropolis' if seed is None else 'seed'}= {NO_BATH} '{interface.system}'")
        if metropolis and (interface.changes_energy != BATH_ENERGY or "symmetric" not in interface.notes):
            raise MethodError(
                f"metropolis=True is not available for '{interface.title}' ({', '.join(interface.notes)}; "
                f"{interface.changes_energy}): it requires a symmetric method and no forces, inputs and time; omit it"
            )
        return cls(checked_count(0 if seed is None else seed, "seed", least=0), trajectory, metropolis)

    def store(self, memory: Any) -> None:
        """Set the stream of a run that starts, in C."""
        memory.seed, memory.trajectory, memory.metropolis = self


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


def negative_temperature(stepper: Any, t: float, parameters: Array) -> str:
    """Return a sentence on a negative kT at a time, or ""; without the values of inputs it is not checked."""
    interface = stepper.interface
    evaluate, names = evaluation(interface.temperature or "0")
    values = {"t": float(t), **dict(zip(interface.parameters, map(float, parameters), strict=False))}
    with suppress(KeyError):
        if (kT := evaluate([values[name] for name in names])) < 0.0:
            return f"the temperature kT = {interface.temperature} is {kT:g} at t = {t:g}: it must not be negative"
    return ""


def check_temperature(stepper: Any, t: float, parameters: Array) -> None:
    """Raise :class:`StateError` if kT is negative at a time."""
    if message := negative_temperature(stepper, t, parameters):
        raise StateError(message)
