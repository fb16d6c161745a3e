"""Explicit methods whose step is a text of statements."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import SWITCH, ArgumentType, check_kind, checked_count, of
from scvi_codegen.methods.method import Exactness, Method, Specification
from scvi_codegen.methods.recurrence import ExplicitStep
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.methods.stage_system import StageSystem
    from scvi_codegen.systems.splittings.kinetic import KineticSplitting


@dataclass(frozen=True, slots=True, kw_only=True)
class ExplicitMethod(Method):
    """Explicit method for L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, or H = T(p) + V(q, t).

    Its equations in 60 digits, its derivatives and its C in each number type, of one trajectory and of many as SIMD
    lanes, are made from the same statements. ``verify`` checks the claims.

    Args:
        name: identifier; in a table of methods also the word for model files.
        title: display title.
        order: of convergence.
        symmetric, symplectic: what is claimed of its steps.
        step: its statements, ``ExplicitStep.of(text, tables)``.
        exactness: momentum maps that it conserves to round-off.

    Raises:
        MethodError: for a claim of another type, an empty name, and an order below 1.
    """

    name: str
    title: str
    order: int
    symmetric: bool
    symplectic: bool
    step: ExplicitStep
    exactness: Exactness = field(default_factory=Exactness)

    implicit = False
    __repr__ = summary("name", "order")

    def __post_init__(self) -> None:
        name = ArgumentType("a name, as 'blanes-moan'", lambda text: isinstance(text, str) and bool(text.strip()))
        step = of("a text of statements, ExplicitStep.of(text, tables)", ExplicitStep)
        exactness = of("Exactness", Exactness)
        kinds = {"name": name, "title": name, "symmetric": SWITCH, "symplectic": SWITCH}
        for argument, kind in (kinds | {"step": step, "exactness": exactness}).items():
            check_kind(kind, getattr(self, argument), argument, MethodError)
        checked_count(self.order, "the order", least=1, error=MethodError)

    def explicit_step(self, split: KineticSplitting) -> ExplicitStep:
        """See :meth:`Method.explicit_step`."""
        return self.step

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": self.name}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the equations of the statements; unknowns are the velocities, determined row after row."""
        from scvi_codegen.methods.explicit_stages import explicit_system

        return explicit_system(system, self)
