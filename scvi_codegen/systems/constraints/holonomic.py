"""Holonomic constraints: joints, rods, closed loops, prescribed motion."""

from scvi_codegen.systems.constraints.kind import ConstraintKind

HOLONOMIC = ConstraintKind(
    form="g(q, t) = 0",
    applies=lambda expression, velocities: not expression.free_symbols & velocities,
    position=lambda expression: expression,
)
