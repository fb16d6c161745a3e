"""Nonholonomic constraints, linear in velocities: rolling, blades, prescribed speeds."""

from scvi_codegen.systems.constraints.kind import ConstraintKind

NONHOLONOMIC = ConstraintKind(
    form="A(q, t) v + b(q, t) = 0",
    applies=lambda expression, velocities: bool(expression.free_symbols & velocities),
    velocity=lambda expression: expression,
)
