"""Unrolling of systems of arrays: for known sizes, the equivalent system of named coordinates.

The unrolled system has every feature, and its integrator is derived independently, so the two can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping

from numpy.typing import ArrayLike

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.mechanics.arrays.elements import unrolled_fields
from scvi_codegen.mechanics.arrays.system import ARRAYS, ArraySystem
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.validation.argument_types import MAPPING, checks_arguments

__all__ = ["unroll_sums"]


@checks_arguments(SystemDefinitionError, system=ARRAYS, sizes=MAPPING, tables=MAPPING, parameters=MAPPING)
def unroll_sums(
    system: ArraySystem | MechanicalSystem,
    sizes: Mapping[str, int],
    *,
    tables: Mapping[str, ArrayLike] | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> MechanicalSystem:
    """Return the system of the coordinates q_0, q_1, .. (r_0_0, r_0_1, ..), the last axis of an array running fastest.

    Args:
        system: the system of arrays to unroll.
        sizes: value of every size; those of tables may be left out.
        tables: index tables of shape (rows, columns) by name.
        parameters: numbers and arrays by name, others keep their defaults; entries of arrays become parameters k_0, ..

    Raises:
        SystemDefinitionError: for unknown names, wrong shapes, and an index outside its array.

    >>> chain = LagrangianSystem.from_text(
    ...     name="chain", coordinates=["q[N]"],
    ...     lagrangian="sum(i in N, q_dot[i]**2/2) - sum(i in 0..N-2, (q[i+1] - q[i])**2/2)")
    >>> unroll_sums(chain, {"N": 2}).formula
    q_0_dot**2/2 + q_1_dot**2/2 - (-q_0 + q_1)**2/2
    """
    assert isinstance(system, ArraySystem)
    kind = HamiltonianSystem if system.momenta else LagrangianSystem
    return kind(**unrolled_fields(system, sizes, tables, parameters))
