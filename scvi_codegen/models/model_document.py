"""Conversion of models to the sections of a model file."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from scvi_codegen.methods.method import Method
from scvi_codegen.models.model import Model

if TYPE_CHECKING:
    from scvi_codegen.models.input_tables import InputTable

__all__ = ["document_of", "method_section", "motion_of"]

SHORT_VECTOR = 4
TEXT_WIDTH = 100


def document_of(model: Model) -> dict[str, Any]:
    """Return all sections, in the order of a file."""
    clock = model.system.clock
    system = clock.plain if clock and clock.plain else model.system
    names = [coordinate.name for coordinate in system.coordinates]
    kind = "hamiltonian" if system.auxiliaries else "lagrangian"
    momenta = {"momenta": [p.name for p in system.auxiliaries]} if system.auxiliaries else {}
    document: dict[str, Any] = {
        "system": {"name": system.name, "coordinates": names, **momenta, kind: _wrapped(system.to_text())}
    }
    forces = zip(names, system.forces, strict=False)
    if applied := {name: _wrapped(system.text_of(force)) for name, force in forces if force != 0}:
        document["forces"] = applied
    if system.damping != 0:
        document["system"]["damping"] = system.text_of(system.damping)
    if system.constraints:
        document["system"]["constraints"] = [system.text_of(g) for g in system.constraints]
    if g := clock.time_transformation if clock else model.time_transformation:
        document["system"]["time_transformation"] = g
    if system.inputs:
        document["system"]["inputs"] = list(system.inputs)
    if model.inputs:
        document["inputs"] = {name: _as_lists(table) for name, table in model.inputs.items()}
    if model.parameters:
        document["parameters"] = model.parameters
    return {**document, **motion_of(model, names)}


def _as_lists(table: InputTable) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in table._asdict().items()}


def motion_of(model: Model, names: Sequence[str]) -> dict[str, Any]:
    """Return the sections other than the system."""
    vectors = (("q", model.q), ("p", model.p), ("q_dot", model.velocity))
    initial = {key: _named(names, vector) for key, vector in vectors if vector is not None}
    length = {"steps": model.steps} if model.span is None else {"span": model.span}
    fields = {"step": model.h, "tolerance": model.tolerance, "error": model.error}
    step = {key: value for key, value in fields.items() if value is not None}
    controller = {"controller": "reversible"} if model.time_transformation else {}
    run = {**step, **controller, **length, "save_every": model.save_every}
    return {"initial": {"t": model.t, **initial}, "method": method_section(model.method), "run": run}


def method_section(method: Method) -> dict[str, Any]:
    """Return the section ``[method]``."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in method.specification().items()}


def _wrapped(formula: str) -> str:
    """Return a formula, wrapped to several lines if it is long."""
    lines = textwrap.wrap(formula, TEXT_WIDTH, break_long_words=False, break_on_hyphens=False)
    return lines[0] if len(lines) == 1 else "\n".join(["", *lines, ""])


def _named(names: Sequence[str], vector: Sequence[float]) -> list[float] | dict[str, float]:
    """Return a short vector as a list, a long one by name."""
    return list(vector) if len(vector) <= SHORT_VECTOR else dict(zip(names, vector, strict=True))
