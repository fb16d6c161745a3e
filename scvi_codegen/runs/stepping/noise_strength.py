"""Strengths of the noise of a heat bath: it exists only if neither kT nor a coefficient of the friction is negative."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array, evaluation


def negative_strength(stepper: Any, t: float, parameters: Array, q: Array | None = None) -> str:
    """Return a sentence on kT or a coefficient of the friction that is negative, or ""; no friction matters at kT = 0.

    Formulas of inputs, of arrays and, without q, of positions are not checked.
    """
    for name, formula, value in _strengths(stepper, t, parameters, q):
        if value is not None and value < 0.0:
            return (
                f"the {name} of the heat bath of '{stepper.interface.system}', {formula}, is {value:g} at t = {t:g}: "
                "it must not be negative; change its parameters, or use forces= for what supplies energy"
            )
    return ""


def check_strengths(stepper: Any, t: float, parameters: Array, q: Array | None = None) -> None:
    """Raise :class:`StateError` if kT or a coefficient of the friction is negative at the start of a run."""
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
    """Return the value of a formula, ``None`` if it contains other names."""
    evaluate, names = evaluation(formula)
    return evaluate([values[name] for name in names]) if values.keys() >= {*names} else None
