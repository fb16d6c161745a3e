"""What every solver without a matrix is: a function from a problem to its sweep, or ``None`` where it does not serve.

A solver is a file in this folder with such a function, a line in ``FIXED_POINTS``
(:mod:`scvi_codegen.lowering.solvers.choice`), and a subclass of :class:`~scvi_codegen.ir.sweep.Sweep`, data alone, that
declares the tables and the support headers of which :mod:`scvi_codegen.rendering.lanes` makes C. Solvers share
nothing but the problem. What they may rely on:

* the tables of a shape are numbers of the method in 60 digits, and stay so in the sweep; they are rounded when they are
  printed, in two parts where what rounding does to the map is to be less;
* the numbers of a sweep are padded to its lanes (:mod:`scvi_codegen.lowering.solvers.padding`);
* a sweep that does not converge costs time, not correctness: Newton's iteration follows it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from scvi_codegen.ir.sweep import Sweep
from scvi_codegen.mechanics.hamiltonian import lagrangian_twin
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
        """The system itself, or where a Hamiltonian is given that of its Lagrangian, if one is found.

        The step of both is the same (35f).
        """
        return lagrangian_twin(self.system)


Solver: TypeAlias = Callable[[StepProblem], Sweep | None]
