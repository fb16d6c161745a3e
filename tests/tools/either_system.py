"""Systems of a Lagrangian or a Hamiltonian, by the keyword that is given."""

from typing import Any

import scvi_codegen as sc


def either_system(**given: Any) -> sc.LagrangianSystem | sc.HamiltonianSystem:
    """Return the system of ``lagrangian=`` or ``hamiltonian=``; other arguments as of ``from_text``."""
    return (sc.HamiltonianSystem if "hamiltonian" in given else sc.LagrangianSystem).from_text(**given)
