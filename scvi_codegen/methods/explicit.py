"""Explicit methods whose step is a text of statements."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Vector
from scvi_codegen.methods.method import Exactness, Method, Specification
from scvi_codegen.methods.statements import read
from scvi_codegen.methods.tables.nodes import to_number
from scvi_codegen.systems.splittings.kinetic import KineticSplitting
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.methods.stage_system import StageSystem

RowTables: TypeAlias = tuple[tuple[str, tuple[tuple[str, Vector], ...]], ...]


@dataclass(frozen=True, slots=True)
class ExplicitStep:
    """An explicit step as statements (:mod:`scvi_codegen.methods.statements`).

    With the state q0, p0 at the start, in one or two words, statements compute the increments q and p, which are 0 at
    first, from forces ``F[i] = force(u, t + c * h)`` and velocities ``v[i] = velocity(P, t)``, or ``inverse_mass[i]``
    where the feature ``masses`` holds. F is kept from step to step: ``known`` if it is that of the last one.

    Attributes:
        statements: their text.
        tables: numbers by their name, those of the same rows by the name of the rows.
    """

    statements: str
    tables: RowTables

    @classmethod
    def of(cls, statements: str, tables: Mapping[str, Mapping[str, Sequence[Any]]]) -> ExplicitStep:
        """Return the step with tables of numbers, or of text with all of their digits.

        Raises:
            MethodError: for a line that is not a statement, names that are not those of tables, and tables of different
                lengths with the same rows.
        """
        read(statements)
        for rows, named in tables.items():
            for name in (rows, *named):
                if not re.fullmatch(r"[A-Z][A-Z_]{2,}", name):
                    raise MethodError(f"'{name}' is not the name of a table: write three capital letters or more")
            if len({len(numbers) for numbers in named.values()}) != 1 or not all(named.values()):
                lengths = ", ".join(f"{len(numbers)} of {name}" for name, numbers in named.items()) or "none"
                raise MethodError(f"tables of the rows {rows} need the same number of numbers, not {lengths}")
        return cls(
            statements,
            tuple(
                (rows, tuple((name, tuple(map(to_number, numbers))) for name, numbers in named.items()))
                for rows, named in tables.items()
            ),
        )

    @property
    def numbers(self) -> dict[str, Vector]:
        """The tables by their names."""
        return {name: numbers for _, named in self.tables for name, numbers in named}

    @property
    def sizes(self) -> dict[str, int]:
        """Number of rows by their name."""
        return {rows: len(named[0][1]) for rows, named in self.tables}


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
    """

    name: str
    title: str
    order: int
    symmetric: bool
    symplectic: bool
    step: ExplicitStep
    exactness: Exactness = field(default_factory=Exactness)

    implicit = False

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

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the same equations."""
        return self.stage_system(system)
