"""Tables of the fixed-point solvers with accelerations as unknowns: the nodes of a curve, and points along it."""

from __future__ import annotations

from scvi_codegen.ir.curve_iterations import NodeTables, PointTables
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.simd_padding import pad_matrix, pad_vector
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.basis import cardinal_integrals, cardinal_values
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.tableau import Tableau

__all__ = ["node_tables", "point_tables"]


def node_tables(tableau: Tableau, lanes: int) -> NodeTables:
    """Return the nodes of a curve: the stages of a tableau."""
    size = len(tableau.b)
    return NodeTables(
        count=size,
        abscissae=pad_vector(tableau.c, lanes, repeat=True),
        collocation=pad_matrix(tableau.A, lanes),
        end=pad_vector(tableau.b, lanes, repeat=True),
        mask=pad_vector((mp.one,) * size, lanes),
    )


def point_tables(system: MechanicalSystem, tableau: Tableau, rule: Quadrature, lanes: int) -> PointTables:
    """Return the points of a quadrature along a curve whose velocity is a polynomial through the nodes."""
    forms = forms_of(system)
    return PointTables(
        abscissae=pad_vector(rule.abscissae, lanes, repeat=True),
        position=pad_matrix(cardinal_integrals(tableau.c, rule.abscissae, 0), lanes),
        velocity=pad_matrix(cardinal_values(tableau.c, rule.abscissae), lanes),
        action=system_kernel(
            system,
            "action_lanes",
            (*forms.force, *forms.momentum),
            of=(*system.coordinates, *system.velocities),
            purpose="L_q and L_v at all points, u = (q, v).",
        ),
    )
