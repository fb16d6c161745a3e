"""Constrained steps of indexed systems: RATTLE, and its symmetric compositions.

A step of h is, with G0 and G1 the derivatives of the constraints at its ends,

    p = p0 + h/2 (F0 + G0^T lambda),  q1 = q0 + h M^-1 p  with  g(q1) = 0,
    p1 = p + h/2 (F1 + G1^T mu)                           with  G1 M^-1 p1 + g_t = 0,

symmetric and symplectic on the constrained phase space; compositions of such steps satisfy the constraints after each
of them and attain their order. Both systems of multipliers are solved iteratively with G M^-1 G^T at the start or end
of the step, a sparse matrix whose pattern is computed once per run.

Sources: J.-P. Ryckaert, G. Ciccotti, H. J. C. Berendsen, J. Comput. Phys. 23 (1977); H. C. Andersen, ibid. 52 (1983);
S. Reich, SIAM J. Numer. Anal. 33 (1996), on compositions; E. Barth, K. Kuczera, B. Leimkuhler, R. D. Skeel, J. Comput.
Chem. 16 (1995), on the iteration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from sympy import Symbol

from scvi_codegen.errors import MethodError
from scvi_codegen.ir.indexed import ConstrainedSteps
from scvi_codegen.ir.kernel import LoopedKernel
from scvi_codegen.ir.numbers import lower_vector
from scvi_codegen.lowering.indexed_kernels import constants_of, kernel_of
from scvi_codegen.lowering.program import comment_text
from scvi_codegen.mechanics.indexed.constraints import (
    constraint_gradient,
    constraint_second_rate,
    constraint_text,
    coordinate_accesses,
)
from scvi_codegen.mechanics.indexed.system import IndexedSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_structure import Velocities
from scvi_codegen.methods.stage_system import StageSystem
from scvi_codegen.tables.precision import Vector, mp

__all__ = ["constrained_steps"]


def constrained_steps(system: IndexedSystem, stages: StageSystem, method: Method) -> ConstrainedSteps:
    """Return the kernels and fractions of constrained steps.

    Raises:
        MethodError: for other methods, and for velocity-dependent forces.
    """
    if system.velocities:
        raise MethodError(
            "velocity-dependent forces are not supported for indexed systems with constraints: remove "
            "the forces or the constraints"
        )
    pairs = list(_kernels(system))
    conditions, curvatures = (tuple(kernels) for kernels in zip(*pairs, strict=True))
    return ConstrainedSteps(conditions=conditions, curvatures=curvatures, parts=lower_vector(_parts(stages, method)))


def _parts(stages: StageSystem, method: Method) -> Vector:
    """Return the fractions of h of the RATTLE steps of which a step is composed."""
    shape = stages.shape
    if method.fractions and not getattr(method, "drifts_first", False):
        return method.fractions
    if isinstance(shape, Velocities) and shape.variational and shape.abscissae == (0, 1) and len(shape.blocks) == 1:
        return (mp.one,)
    raise MethodError(
        f"{method.name} does not support constraints of indexed systems: use 'stoermer-verlet', which is "
        "RATTLE, as is SVI(1, 'gauss-lobatto:2'), or 'composition:8' of it"
    )


def _kernels(system: IndexedSystem) -> Iterator[tuple[LoopedKernel, LoopedKernel]]:
    """Yield the condition of each constraint, and its second derivative in time at constant velocity."""
    for number, term in enumerate(system.constraints):
        held = coordinate_accesses(term, system.coordinates)
        u, accesses = [slot for slot, _ in held], tuple(access for _, access in held)
        v = tuple(Symbol(f"{slot.name} along", real=True) for slot in u)
        *partials, rate = constraint_gradient(term, system.coordinates, system.time)
        values = [term.formula, rate, *partials]
        condition = LoopedKernel(
            text=comment_text(constraint_text(term)),
            loops=term.loops,
            slots=accesses,
            targets=accesses,
            given=constants_of(term.slots, u),
            kernel=kernel_of(system, f"condition_{number}", values, term.slots, u, "g, g_t, and the derivatives of g."),
        )
        both = [*term.slots, *zip(v, accesses, strict=True)]
        second = [constraint_second_rate(term, system.coordinates, system.time, v)]
        curvature = kernel_of(system, f"curvature_{number}", second, both, [*u, *v], "d^2 g / dt^2 along v.")
        yield condition, replace(condition, slots=(*accesses, *accesses), along=len(accesses), kernel=curvature)
