"""Systems of tests in one line: coordinates in one text, and parameters as keywords."""

from collections.abc import Sequence
from typing import Any

from scvi_codegen import HamiltonianSystem, LagrangianSystem

OPTIONS = {
    *("rotations", "directions", "spins", "momenta", "parameters", "forces", "torques", "torques_space", "tables"),
    *("point_forces", "dissipation", "damping", "temperature", "constraints", "inputs", "neighbours", "functions"),
}
"""Keywords of ``from_text``; all others are parameters."""


def lagrange(name: str, coordinates: str | Sequence[str], formula: str, /, **given: Any) -> Any:
    """Return ``LagrangianSystem.from_text(name, coordinates.split(), formula, parameters={..}, ..)``."""
    return LagrangianSystem.from_text(name, _names(coordinates), formula, **_arguments(given))


def hamilton(name: str, coordinates: str | Sequence[str], formula: str, /, **given: Any) -> Any:
    """Return the same for a Hamiltonian."""
    return HamiltonianSystem.from_text(name, _names(coordinates), formula, **_arguments(given))


def _names(names: str | Sequence[str]) -> Sequence[str]:
    return names.split() if isinstance(names, str) else names


def _arguments(given: dict[str, Any]) -> dict[str, Any]:
    options = {name: value for name, value in given.items() if name in OPTIONS}
    options |= {name: _names(options[name]) for name in ("momenta", "inputs") if name in options}
    parameters = {name: value for name, value in given.items() if name not in OPTIONS}
    return options | ({"parameters": parameters} if parameters else {})
