"""Lowering of a heat bath: masses, friction and noise at the positions between steps."""

from __future__ import annotations

from collections.abc import Mapping

import sympy
from sympy import Add, Expr

from scvi_codegen.codegen.ir.program import HeatBath
from scvi_codegen.codegen.lowering.stage_groups import system_kernel
from scvi_codegen.common.errors import MethodError
from scvi_codegen.systems.bath import Bath
from scvi_codegen.systems.derived_expressions import coupled_blocks, forms_of
from scvi_codegen.systems.formulas.expressions import hessian, jacobian
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.system import MechanicalSystem

LARGEST_BLOCK = 128
"""Largest number of coupled coordinates: matrices of a block are on the stack."""
PURPOSE = "kT, L_v at v = 0, entries of M, of R and of normals, strengths of noise at u = q."


def heat_bath_of(system: MechanicalSystem) -> HeatBath | None:
    """Return the heat bath of a Lagrangian, ``None`` without one; its matrices are those of coupled coordinates.

    Momenta do not change along normals: of constraints, and of the lengths of homogeneous coordinates of rotations.
    """
    bath, forms, v = system.bath, forms_of(system), system.velocities
    if bath is None:
        return None
    mass, rayleigh = map(_lower, (forms.legendre_jacobian or forms.mass, hessian(bath.dissipation, v)))
    friction = {place: bath.damping * entry for place, entry in mass.items() if bath.damping != 0}
    friction |= {place: friction.get(place, sympy.S.Zero) + entry for place, entry in rayleigh.items()}
    lengths = [Add(*(symbol(q) ** 2 for q in member.coordinates)) / 2 for member in system.rotations]
    normals = jacobian((*system.constraints, *lengths), system.coordinates)
    first: dict[int, int] = {}
    rows = [(first.setdefault(row, i), i) for row, i in normals]
    blocks = coupled_blocks(dict.fromkeys([*mass, *friction, *rows], sympy.S.One), system.dimension)
    if (largest := max(map(len, blocks))) > LARGEST_BLOCK:
        raise MethodError(
            f"the heat bath of '{system.name}' couples {largest} coordinates, more than {LARGEST_BLOCK}: use other "
            "coordinates, with smaller blocks of the mass matrix"
        )
    at_rest = dict.fromkeys(v, sympy.S.Zero)
    momenta = [p.xreplace(at_rest) for p in forms.regular_legendre]
    terms = (bath.temperature, *momenta, *mass.values(), *friction.values(), *normals.values(), *bath.noise)
    block_of = {i: (b, k) for b, block in enumerate(blocks) for k, i in enumerate(block)}
    entries = {
        name: [(*block_of[i], block_of[j][1]) for i, j in matrix]
        for name, matrix in (("BATH_MASS", mass), ("BATH_FRICTION", friction))
    }
    entries["BATH_NORMAL"] = [(block_of[i][0], row, block_of[i][1]) for row, i in normals]
    return HeatBath(
        temperature=system.text_of(bath.temperature),
        friction=_friction_of(system, bath, rayleigh),
        kernel=system_kernel(system, "bath_terms", terms, u=system.coordinates, purpose=PURPOSE),
        constant=all(value.free_symbols <= {*system.parameters} for value in terms),
        blocks=tuple(map(tuple, blocks)),
        sizes={
            **{f"{name}_ENTRIES": len(places) for name, places in entries.items()},
            "NORMAL_ROWS": len(system.constraints) + len(lengths),
            "STRENGTHS": len(bath.noise),
            "BATH_FACTORS": sum(len(block) ** 2 for block in blocks),
            "BATH_TERMS": len(terms),
        },
        entries={name: tuple(places) or ((0, 0, 0),) for name, places in entries.items()},
    )


def _lower(matrix: Mapping[tuple[int, int], Expr]) -> dict[tuple[int, int], Expr]:
    """Return the entries of the lower triangle."""
    return {(i, j): entry for (i, j), entry in matrix.items() if i >= j}


def _friction_of(
    system: MechanicalSystem, bath: Bath, rayleigh: Mapping[tuple[int, int], Expr]
) -> tuple[tuple[str, str], ...]:
    """Return names and formulas of the damping and of the diagonal of R of Rayleigh's function, each formula once."""
    rates = {entry: f"dissipation of {system.coordinates[i].name}_dot" for (i, j), entry in rayleigh.items() if i == j}
    return tuple((name, system.text_of(entry)) for entry, name in ({bath.damping: "damping"} | rates).items())
