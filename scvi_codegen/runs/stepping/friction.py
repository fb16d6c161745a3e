"""Signs of the friction of a heat bath: noise of its strength exists only if no coefficient is negative."""

from __future__ import annotations

from typing import Any

from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array, evaluation


def check_friction(stepper: Any, t: float, parameters: Array, q: Array | None = None) -> str:
    """Raise :class:`StateError` if a coefficient of the friction is negative at a temperature other than 0.

    Returns a remark on a step that failed, with the first coefficient that is unknown there or depends on positions;
    these are not checked without q.
    """
    interface, remark = stepper.interface, ""
    known = {"t": float(t), **dict(zip(interface.parameters, map(float, parameters), strict=False))}
    at = {} if q is None or interface.layout.coordinates else dict(zip(interface.coordinates, q, strict=True))
    kT = _value(interface.temperature, known)
    for name, formula in (("temperature kT", interface.temperature), *interface.friction) if kT != 0.0 else ():
        value = _value(formula, known | at)
        if value is not None and value < 0.0:
            raise StateError(
                f"the {name} of the heat bath of '{interface.system}', {formula}, is {value:g} at t = {t:g}: it must "
                "not be negative; change its parameters, or use forces= for what supplies energy"
            )
        if not remark and _value(formula, known) is None:
            shown = "depends on inputs or arrays" if value is None else f"is {value:g} there"
            remark = f". kT and friction must not be negative: the {name}, {formula}, {shown}"
    return remark


def _value(formula: str, values: dict[str, float]) -> float | None:
    """Return the value of a formula, ``None`` if it contains other names."""
    evaluate, names = evaluation(formula)
    return evaluate([values[name] for name in names]) if values.keys() >= {*names} else None
