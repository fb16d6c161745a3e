"""Hamiltonian systems and Legendre transforms in both directions.

Hamilton's principle in phase space (paper, section 1.1) makes the action of p . v - H(q, p, t) stationary in q and p.
It needs no Lagrangian: systems with singular d2H/dp2, such as H = q p or point vortices, are integrated as well, by
methods that do not require a regular one (:attr:`~scvi_codegen.methods.method.Method.needs_regular`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import FORMULAS, TEXTS, checks_arguments
from scvi_codegen.systems.formulas.table import tables_of
from scvi_codegen.systems.system import MechanicalSystem, zero

if TYPE_CHECKING:
    from sympy import Expr, Symbol

    from scvi_codegen.systems.formulas.table import Table


@dataclass(frozen=True, slots=True, kw_only=True)
class HamiltonianSystem(MechanicalSystem):
    """Hamiltonian H(q, p, t; parameters) in m coordinates and momenta, validated on construction.

    Build one with ``from_text`` or ``from_sympy``, or from a Lagrangian with :func:`hamiltonian_of`. Every method
    accepts it in place of a Lagrangian; variational methods then discretise Hamilton's principle in phase space, (35).

    Attributes:
        name, coordinates, time, parameters, defaults: see :class:`~scvi_codegen.systems.system.MechanicalSystem`.
        momenta: the m momenta, parallel to ``coordinates``.
        hamiltonian: H, exact: it contains no floating-point numbers.
        gauge: energy of a gauge motion, such as the scaling of quaternions, which is zero on the states considered and
            makes H + gauge regular in p; used by Legendre transforms only.

    Raises:
        SystemDefinitionError: naming the symbol at fault.
    """

    momenta: tuple[Symbol, ...]
    hamiltonian: Expr
    gauge: Expr = field(default_factory=zero)

    __repr__ = summary("name", "coordinates", "momenta")

    def __post_init__(self) -> None:
        if len(self.momenta) != len(self.coordinates):
            raise SystemDefinitionError(
                f"there are {len(self.coordinates)} coordinates, but {len(self.momenta)} momenta: "
                "list one momentum per coordinate"
            )
        if self.constraints:
            raise SystemDefinitionError(
                f"'{self.name}' is a Hamiltonian with constraints, which are supported for "
                "Lagrangians only: use lagrangian_of(system, constraints=[...]), which has the same "
                "momenta"
            )
        from scvi_codegen.systems.checks.definition import check_definition

        check_definition(self, "Hamiltonian", self.momenta, "a momentum")

    @classmethod
    @checks_arguments(SystemDefinitionError, constraints=TEXTS)
    def from_text(
        cls,
        name: str,
        coordinates: Sequence[str] = (),
        hamiltonian: str = "",
        *,
        rotations: Mapping[str, str] | None = None,
        spins: Sequence[str] = (),
        momenta: Sequence[str] | None = None,
        parameters: Mapping[str, float] | None = None,
        forces: Mapping[str, str] | None = None,
        damping: str | float | None = None,
        constraints: Sequence[str] = (),
        inputs: Sequence[str] = (),
        tables: Sequence[str] | Mapping[str, Any] = (),
        neighbours: Mapping[str, Mapping[str, Any]] | None = None,
        functions: Mapping[str, Table | Mapping[str, Any]] | None = None,
    ) -> HamiltonianSystem | Any:
        """Read H from text of the grammar in :mod:`scvi_codegen.systems.formulas.grammar`.

        Arrays are declared and treated as in :meth:`LagrangianSystem.from_text`.

        Args:
            name, coordinates, parameters, damping, inputs, tables, neighbours, functions: as of
                :meth:`LagrangianSystem.from_text`.
            hamiltonian: the formula; it may span several lines.
            rotations: as of :meth:`LagrangianSystem.from_text`, but with the name of the angular momentum in the body
                frame, ``{"R": "Pi"}``.
            spins: names of vectors of constant length with the brackets {s_1, s_2} = s_3 and cyclic.
            momenta: names of the momenta, declared as the coordinates are; by default ``p_`` before the name of the
                coordinate.
            forces: formula by coordinate, in coordinates, momenta and time, added to the rate of its momentum.
            constraints: must be empty; :func:`lagrangian_of` accepts constraints.

        >>> HamiltonianSystem.from_text(
        ...     name="pendulum", coordinates=["q"], momenta=["p"], hamiltonian="p**2/2 - cos(q)"
        ... ).lagrangian
        -p**2/2 + p*q_dot + cos(q)
        """
        arguments = {key: value for key, value in locals().items() if key != "cls"}
        return cls._of_text({**arguments, "functions": tables_of(functions)})

    @classmethod
    @checks_arguments(SystemDefinitionError, inputs=FORMULAS)
    def from_sympy(
        cls,
        *,
        name: str,
        hamiltonian: Expr,
        coordinates: Sequence[Expr] = (),
        momenta: Sequence[Expr] = (),
        rotations: Mapping[str, str] | None = None,
        spins: Sequence[str] = (),
        time: Symbol | None = None,
        parameters: Mapping[Symbol | str, float] | None = None,
        forces: Mapping[Expr | str, Expr] | None = None,
        damping: Expr | float | None = None,
        inputs: Sequence[Any] = (),
    ) -> HamiltonianSystem:
        """Create the system from a SymPy expression in plain symbols or in functions of time.

        Floating-point numbers become the rationals of their shortest decimal form; symbols become canonical as
        described in :mod:`scvi_codegen.systems.formulas.symbols`.

        Args:
            name, time, parameters, damping, inputs: as of :meth:`LagrangianSystem.from_sympy`.
            hamiltonian: H.
            coordinates, momenta: symbols or functions of time, parallel to each other.
            rotations, spins: as of :meth:`from_text`; the names in formulas are symbols, ``Symbol("s_1")``.
            forces: expression by coordinate, in coordinates, momenta and time.
        """
        arguments = {key: value for key, value in locals().items() if key not in ("cls", "hamiltonian")}
        from scvi_codegen.systems.reading import system_from_sympy

        system: HamiltonianSystem = system_from_sympy(cls, "Hamiltonian", hamiltonian, **arguments)
        return system

    @property
    def lagrangian(self) -> Expr:
        """Integrand p . v - H of Hamilton's principle in phase space."""
        from scvi_codegen.systems.formulas.expressions import dot

        return dot(self.momenta, self.velocities) - self.hamiltonian

    @property
    def auxiliaries(self) -> tuple[Symbol, ...]:
        """Momenta."""
        return self.momenta

    @property
    def formula(self) -> Expr:
        """H."""
        return self.hamiltonian

    @property
    def is_regular(self) -> bool:
        """True if d2H/dp2 is invertible at some sampled point, so that velocities determine momenta."""
        return _is_regular(self)

    @classmethod
    def _read(cls, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
        from scvi_codegen.systems.reading import system_from_text

        return system_from_text(cls, arguments)

    def _repr_latex_(self) -> str:
        from sympy import latex

        return rf"$\displaystyle H = {latex(self.hamiltonian)}$"


@lru_cache(maxsize=64)
def _is_regular(system: HamiltonianSystem) -> bool:
    from scvi_codegen.systems.derived_expressions import singular_part

    others = (*system.coordinates, system.time)
    return singular_part(system.hamiltonian, system.momenta, others, system.constants) is None
