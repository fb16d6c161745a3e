"""Derivation of a density: equations, semi-discrete system and conservation laws, as text."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import sympy
from sympy import Eq, Expr

from scvi_codegen.fields.density import Density, place_text
from scvi_codegen.fields.laws import ConservationLaw, Variations, names_of
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.formulas.translation import format_expression
from scvi_codegen.representation import summary


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldDerivation:
    """Equations of motion and local conservation laws of a density; of a mesh also its semi-discrete system.

    Attributes:
        field_system: the density.
        equations: Euler-Lagrange equation of each field; of a Hamiltonian density its equations of first order.
        laws: conservation laws of the symmetries of the density.
        semidiscrete: the semi-discrete L or H and its energy in index notation by name; empty without a mesh.
    """

    field_system: Density
    equations: Mapping[str, Eq]
    laws: tuple[ConservationLaw, ...]
    semidiscrete: Mapping[str, str]

    __repr__ = summary("field_system", "laws")

    def to_text(self) -> str:
        """Return plain text: density, equations, semi-discrete system, and conservation laws."""
        return "".join(f"{line}\n" for line in self._lines())

    def _lines(self) -> Iterator[str]:
        letter, title = ("H", "Hamilton") if self.field_system.momenta else ("L", "Euler-Lagrange")
        yield f"{self.field_system.name}: {letter} = {format_expression(self.field_system.density)}"
        for place, formula in self.field_system.point_lagrangians:
            yield f"  at {place_text(place)}: {format_expression(formula)}"
        yield ""
        yield f"{title} equations"
        for each in self.equations.values():
            yield f"  {_written(each.lhs)} = {_written(each.rhs)}"
        for name, text in self.semidiscrete.items():
            yield f"\n{name}"
            yield from (f"  {line}" for line in text.split("\n"))
        divergence = " + ".join(f"d/d{axis} J{axis}" for axis in self.field_system.space)
        found = f", d/d{TIME} J{TIME} + {divergence} = 0" if self.laws else ": none found"
        yield f"\nconservation laws{found}{', the density is damped' * (self.field_system.dissipation != 0)}"
        for law in self.laws:
            yield f"  {law.name}: {law.symmetry}"
            yield f"    J{TIME} = {_written(law.density)}"
            yield from (f"    J{axis} = {_written(part)}" for axis, part in law.flux.items())


def derivation_of(system: Density, assembled: Any = None) -> FieldDerivation:
    """Return the derivation of a density, with its semi-discrete system."""
    variations = Variations(system)
    order = 1 if system.momenta else 2
    equations = {
        each: Eq(variations.functions[each].diff(symbol(TIME), order), formula)
        for each, formula in variations.equations.items()
    }
    for each, rate in zip(system.fields, system.rates, strict=True) if system.dissipation != 0 else ():
        force = variations.along(system.dissipation.diff(rate) / system.density.diff(rate, 2))
        equations[each] = Eq(equations[each].lhs, sympy.expand(equations[each].rhs - force))
    return FieldDerivation(
        field_system=system,
        equations=equations,
        laws=variations.laws() if system.dissipation == 0 else (),
        semidiscrete={} if assembled is None else _semidiscrete(assembled),
    )


def _semidiscrete(assembled: Any) -> dict[str, str]:
    """Return the texts of the semi-discrete Lagrangian and of its energy, or of the semi-discrete Hamiltonian."""
    if assembled.momenta:
        return {"semi-discrete Hamiltonian": assembled.definition["hamiltonian"]}
    text = assembled.definition["lagrangian"]
    terms = text.split("\n+ ")
    kinetic = [each for each in terms if "_dot" in each]
    others = [each for each in terms if each not in kinetic]
    energy = "\n+ ".join(kinetic) + "".join(f"\n- {each}" for each in others)
    return {"semi-discrete Lagrangian": text, "semi-discrete energy": energy}


def _written(formula: Expr) -> str:
    return format_expression(formula.xreplace(names_of(formula)))
