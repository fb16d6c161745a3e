"""Systems in model files: ``[system]``, ``[forces]``, and declarations in other sections."""

from __future__ import annotations

import re
from typing import Any

from scvi_codegen.errors import ModelFileError
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.legendre import lagrangian_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.models.model_files.sections import (
    ALTERNATIVES,
    Document,
    Section,
    check_keys,
    check_one,
    formula_of,
    in_section,
    names_of,
    text_of,
)
from scvi_codegen.models.problems import Problem, problem
from scvi_codegen.models.time_span import real

FORMULAS = ("lagrangian", "hamiltonian", "dissipation", "damping", "constraints")
TURNING = ("rotations", "directions", "spins")
"""Keys of [system] that declare coordinates of another kind."""
TORQUES = ("torques", "torques_space")
"""Sections with three formulas by rotation, in the body frame and in the space frame."""
REQUIRED = {"system": ("name", "coordinates", "lagrangian"), "initial": ("q", "q_dot"), "run": ("span",)}
"""Required keys, or their alternatives."""


def has_arrays(document: Document, sizes: str = r"\w") -> bool:
    """Return whether coordinates are arrays, with sizes that contain a pattern."""
    coordinates = document.get("system", {}).get("coordinates", ())
    return isinstance(coordinates, list) and any(
        isinstance(name, str) and re.search(rf"\[.*{sizes}", name) for name in coordinates
    )


def is_number(value: Any) -> bool:
    """Return whether the value of an array is one number for all entries."""
    return not isinstance(value, str | list | dict)


def check_complete(document: Document) -> None:
    """Raise an error that lists all missing keys; arrays whose sizes are names are at rest by default."""
    missing = []
    for name, keys in REQUIRED.items():
        for key in keys:
            choice = next((choice for choice in ALTERNATIVES if key in choice), {key})
            if choice.isdisjoint(document.get(name, {})) and not _is_optional(document, key):
                missing.append(f"{' or '.join(sorted(choice))} in [{name}]")
    if missing:
        at_rest = "p or q_dot in [initial]" in missing
        rest = "; for a start from rest write q_dot = [0.0, ..], or --velocity 0,.." if at_rest else ""
        raise ModelFileError(f"there is no {', no '.join(missing)}{rest}")


def _is_optional(document: Document, key: str) -> bool:
    """Return whether a required key may be missing: velocities of arrays and spins, coordinates beside rotations."""
    section = document.get("system", {})
    if key == "coordinates":
        return not section.keys().isdisjoint(TURNING)
    return key == "q_dot" and (has_arrays(document, "[A-Za-z_]") or "spins" in section)


def check_used(document: Document, parameters: Section) -> None:
    """Raise an error for an added parameter that no formula contains."""
    section = document["system"]
    formulas = [section.get(key, "") for key in (*FORMULAS, "time_transformation")]
    acting = [formula for name in ("forces", *TORQUES) for formula in document.get(name, {}).values()]
    formula = " ".join(map(str, (*formulas, *acting)))
    for name in parameters:
        if name not in re.findall(r"\w+", formula):
            raise ModelFileError(f"the system has no parameter '{name}'")


def read_catalogue(section: Section) -> Problem | None:
    """Return the entry of the catalogue that a section ``[system]`` names, if any."""
    if "catalogue" not in section:
        return None
    check_keys(section, ("catalogue", "time_transformation"), "key", "[system] beside catalogue")
    name = text_of(section, "catalogue", "[system]")
    return in_section("[system]", lambda: problem(name))


def read_system(document: Document, entry: Problem | None) -> MechanicalSystem:
    """Return the system of a file, with the values of its scalar parameters."""
    forces, values = document.get("forces", {}), _scalars(document)
    if entry is not None:
        if forces:
            raise ModelFileError(
                "[forces] are not supported for a system of the catalogue: write the system out in [system]"
            )
        return in_section("[parameters]", lambda: entry.system.with_parameters(**values))
    section = document["system"]
    check_one(section, "system", "lagrangian", "hamiltonian")
    arguments: dict[str, Any] = {
        "name": text_of(section, "name", "[system]"),
        "coordinates": names_of(section, "coordinates") if "coordinates" in section else (),
        **_turning(document),
        "parameters": values,
        "forces": {key: formula_of(forces, key, "[forces]") for key in forces},
        "damping": formula_of(section, "damping", "[system]") if "damping" in section else None,
        "inputs": names_of(section, "inputs") if "inputs" in section else (),
        "tables": list(document.get("tables", {})),
    }
    constraints = names_of(section, "constraints") if "constraints" in section else ()
    if "hamiltonian" in section:
        return _read_hamiltonian(section, arguments, constraints)
    if "momenta" in section:
        raise ModelFileError(
            "[system] has momenta and a lagrangian: momenta are names for a hamiltonian; leave them out"
        )
    arguments["lagrangian"] = text_of(section, "lagrangian", "[system]")
    arguments["dissipation"] = text_of(section, "dissipation", "[system]") if "dissipation" in section else None
    return in_section("[system]", lambda: LagrangianSystem.from_text(**arguments, constraints=constraints))


def _turning(document: Document) -> dict[str, Any]:
    """Return the arguments that declare rotations, directions, spins and torques."""
    arguments = {key: document["system"][key] for key in TURNING if key in document["system"]}
    for key in TORQUES:
        if document.get(key):
            arguments[key] = {name: list(map(str, formulas)) for name, formulas in document[key].items()}
    return arguments


def _scalars(document: Document) -> dict[str, float]:
    """Return the values of scalar parameters and of uniform arrays; 1 for other arrays, which are read separately."""
    parameters = document.get("parameters", {})
    return {
        key: real(value, f"[parameters] {key}") if "[" not in key or is_number(value) else 1.0
        for key, value in parameters.items()
    }


def _read_hamiltonian(section: Section, arguments: dict[str, Any], constraints: Any) -> MechanicalSystem:
    """Return the system of a Hamiltonian; with constraints that of its Lagrangian."""
    if "dissipation" in section:
        raise ModelFileError(
            "[system] has a dissipation, in velocities, and a hamiltonian: write the forces in [forces] instead"
        )
    arguments["hamiltonian"] = text_of(section, "hamiltonian", "[system]")
    arguments["momenta"] = names_of(section, "momenta") if "momenta" in section else None
    hamiltonian = in_section("[system]", lambda: HamiltonianSystem.from_text(**arguments))
    if not constraints:
        return hamiltonian
    return in_section("[system]", lambda: lagrangian_of(hamiltonian, constraints=constraints))
