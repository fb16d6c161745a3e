"""Common interface of the fixed-point solvers: a function from a problem to an iteration, or ``None``.

A solver is a module in this folder with such a function, a line in ``FIXED_POINTS``
(:mod:`scvi_codegen.lowering.solvers.selection`), and a subclass of
:class:`~scvi_codegen.ir.iteration.FixedPointIteration`, plain data,
which declares the tables and the support headers from which :mod:`scvi_codegen.rendering.simd` renders C. Solvers
share only the problem. They may rely on the following:

* the tables of a shape are numbers of the method in 60 digits, also in the iteration; they are rounded when they are
  printed, as double-double numbers if one rounding is not accurate enough;
* the tables of an iteration are padded to its lanes (:mod:`scvi_codegen.lowering.solvers.simd_padding`);
* an iteration that does not converge costs time, not correctness: Newton's method follows it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from scvi_codegen.ir.iteration import FixedPointIteration
from scvi_codegen.mechanics.hamiltonian import equivalent_lagrangian
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import Shape

__all__ = ["Solver", "StepProblem"]


@dataclass(frozen=True, slots=True)
class StepProblem:
    """A system, and the shape of its stage equations."""

    system: MechanicalSystem
    shape: Shape | None

    @property
    def lagrangian(self) -> LagrangianSystem | None:
        """The system itself, or for a Hamiltonian that of its Lagrangian, if one is found.

        Both have the same step (35f).
        """
        return equivalent_lagrangian(self.system)


Solver: TypeAlias = Callable[[StepProblem], FixedPointIteration | None]
