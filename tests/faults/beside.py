"""Faults of what stands beside a Lagrangian, forces, constraints; of Hamiltonians, derivatives and transformed time."""

from dataclasses import replace

import sympy
from faults import constraints_off, function, here, moving_part, without_last_of, without_rates_of
from sabotage import changed_property, changed_result

from scvi_codegen.lowering import constraints as lowered_constraints
from scvi_codegen.lowering import derivatives as lowered_derivatives
from scvi_codegen.lowering import stage_groups
from scvi_codegen.mechanics import derived_expressions as mechanics
from scvi_codegen.methods import constraints as constrained_stages
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.tables.quadrature import gauss_lobatto

FORCES = (
    function(
        "the adjoint of forces with the other sign",
        "pushed/scvi",
        mechanics.Forms,
        "multiplied_forces",
        changed_property(lambda found: (found[0], tuple(-x for x in found[1]), *found[2:])),
    ),
    function(
        "forces left out of the equations of the curve",
        "pushed/scvi",
        mechanics.Forms,
        "multiplied_forces",
        changed_property(lambda found: (*found[:3], tuple(0 * x for x in found[3]))),
    ),
)


HAMILTONIANS = (
    function("H_pt lost", "swing/sc", mechanics, "_along", without_rates_of("t")),
    function(
        "forces on momenta halved",
        "swing/gauss",
        mechanics.Forms,
        "force",
        changed_property(lambda found: tuple(f / 2 for f in found)),
    ),
    function(
        "momenta without the vector potential",
        "field/verlet",
        mechanics.Forms,
        "momentum",
        changed_property(lambda found: tuple(map(moving_part, found))),
    ),
)

CONSTRAINTS = (
    here(
        "a multiplier's force off its gradient",
        "linkage/lobatto-svi",
        constrained_stages,
        "with_constraint_forces",
        changed_result(lambda found: (found[0] * (1 + sympy.Rational(1, 10**6)), *found[1:])),
    ),
    here(
        "hidden constraints without g_t",
        "wire/lobatto-svi",
        constrained_stages,
        "constraint_rates",
        lambda original: (
            lambda system: tuple(
                rate - g.diff(system.time) for rate, g in zip(original(system), system.constraints, strict=True)
            )
        ),
    ),
    here(
        "multipliers without what velocities add",
        "linkage/lobatto-svi",
        lowered_constraints,
        "time_derivatives",
        lambda _: lambda system, functions: (sympy.S.Zero,) * len(functions),
    ),
    here(
        "the end's momentum without the last force",
        "linkage/lobatto-svi",
        constrained_stages,
        "_with_end",
        lambda original: lambda table, rows, points: without_last_of(original(table, rows, points), rows),
    ),
    here("constraints 1e-9 off", "linkage/lobatto-svi", stage_groups, "system_kernel", constraints_off),
    here(
        "reactions off what the blade pushes along",
        "sleigh/lobatto-svi",
        constrained_stages,
        "with_constraint_forces",
        changed_result(lambda found: (found[0] * (1 + sympy.Rational(1, 10**6)), *found[1:])),
    ),
    here(
        "rolling asked for at Lobatto's points",
        "sleigh/lobatto-svi",
        constrained_stages,
        "gauss_legendre",
        lambda _: gauss_lobatto,
    ),
    here(
        "the blade at the end 1e-9 off",
        "sleigh/lobatto-svi",
        constrained_stages,
        "constraint_rates",
        changed_result(lambda found: tuple(rate + sympy.Rational(1, 10**9) for rate in found)),
    ),
    here(
        "multipliers without what turning adds",
        "sleigh/lobatto-svi",
        lowered_constraints,
        "time_derivatives",
        lambda _: lambda system, functions: (sympy.S.Zero,) * len(functions),
    ),
)

TRANSFORMED_TIME = (
    function(
        "transformed time at another energy",
        "slowed/svi-3",
        Integrator,
        "_parameters_at",
        lambda original: lambda self, q, p, parameters=None: original(self, q, 1.01 * p, parameters),
    ),
    here(
        "the energy of the start that falls with the momentum",
        "slowed/svi-3",
        lowered_derivatives,
        "_energy_derivatives",
        changed_result(
            lambda kernel: replace(kernel, results=(*kernel.results[:2], *kernel.results[:1], *kernel.results[3:]))
        ),
    ),
)

PARTS = (
    *FORCES,
    *HAMILTONIANS,
    *CONSTRAINTS,
    *TRANSFORMED_TIME,
    here(
        "a derivative by a parameter off by 1e-6",
        "double/svi",
        lowered_derivatives,
        "jacobian",
        changed_result(lambda found: found | {k: found[k] * sympy.Rational(1000001, 10**6) for k in list(found)[:1]}),
    ),
)
