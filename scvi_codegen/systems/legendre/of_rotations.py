"""Hamiltonian of a system with rotations whose mass matrix is constant.

In the notation of :mod:`scvi_codegen.systems.formulas.rotations`, with the velocities u = (x_dot, omega), their
momenta mu = (p_x, E(q)^T p_q/2) and l = u^T M u/2 + b . u - V,

    H = (mu - b)^T M^-1 (mu - b)/2 + V(x, R2(q)/|q|^2, t).

H has no term in q . p and is singular in p. Its velocities satisfy q . q_dot = 0 at every stage of a step, so that
|q|^2, a quadratic invariant, is kept to round-off by Gauss collocation, and H is invariant under p -> p + c q, a linear
symmetry with the same reduced space T*SO(3).
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import chain

import sympy
from sympy import Add, Expr, Matrix, S, Symbol

from scvi_codegen.systems.derived_expressions import coupled_blocks, inverse_by_minors
from scvi_codegen.systems.formulas.expressions import gradient, gradient_tuple, hessian
from scvi_codegen.systems.formulas.numpy_values import varies
from scvi_codegen.systems.formulas.rotations import RotationNames
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem

LARGEST_BLOCK = 4
"""Largest block of coupled velocities whose constant mass matrix is inverted symbolically."""


@lru_cache(maxsize=64)
def hamiltonian_of_rotations(system: LagrangianSystem) -> HamiltonianSystem | None:
    """Return H of a system with rotations; ``None`` if its mass matrix varies or constraints or directions exist."""
    names, reduced = RotationNames(system.rotations), system.reduced
    if reduced is None or system.constraints or len(names.rotations) < len(names.members):
        return None
    ordinary = [q for q in system.coordinates if q.name not in names.coordinates]
    u = (*(symbol(f"{q.name}_dot") for q in ordinary), *chain(*(rotation.rates for rotation in names.rotations)))
    inverse = _inverse_of_constant(reduced.lagrangian, u, set(system.parameters))
    if inverse is None:
        return None
    momenta = {q: symbol(f"p_{q.name}") for q in system.coordinates}
    at_rest = dict.fromkeys(u, S.Zero)
    linear = gradient_tuple(reduced.lagrangian, u)
    mu = [*map(momenta.__getitem__, ordinary)]
    for rotation in names.rotations:
        mu += rotation.body_momentum(tuple(momenta[symbol(name)] for name in rotation.coordinates))
    rest = Matrix([m - rate.xreplace(at_rest) for m, rate in zip(mu, linear, strict=True)])
    velocity = dict(zip(u, inverse * rest, strict=True))
    products = [rest[i] * rest[j] * inverse[i, j] / 2 for i in range(len(u)) for j in range(len(u))]
    energy = Add(*products) - reduced.lagrangian.xreplace(at_rest)

    def in_phase_space(formula: Expr) -> Expr:
        return names.in_coordinates(formula.xreplace(velocity))

    applied = tuple((name, tuple(map(in_phase_space, components))) for name, components in reduced.forces)
    return HamiltonianSystem(
        **system._common_fields,
        momenta=tuple(momenta.values()),
        hamiltonian=in_phase_space(energy),
        gauge=names.gauge(lambda rotation: names.inertia(rotation, reduced.lagrangian, system.parameters)),
        forces=names.forces(applied, [q.name for q in system.coordinates]),
    )


def _inverse_of_constant(energy: Expr, u: Sequence[Symbol], parameters: set[Symbol]) -> Matrix | None:
    """Return the inverse of a block-diagonal Hessian of parameters; ``None`` if it varies or a block is too large."""
    if varies(energy, u, parameters):
        return None
    rows = (gradient(row, u) for row in gradient(energy, u).values())  # until one varies: O(n), the Hessian O(n^2)
    if any(not entry.free_symbols <= parameters for row in rows for entry in row.values()):
        return None
    entries, size = hessian(energy, u), len(u)
    inverse = sympy.zeros(size, size)
    for block in coupled_blocks(entries, size):
        if len(block) > LARGEST_BLOCK:
            return None
        part = inverse_by_minors(
            Matrix(len(block), len(block), lambda i, j, block=block: entries.get((block[i], block[j]), S.Zero))
        )
        for i, row in enumerate(block):
            for j, column in enumerate(block):
                inverse[row, column] = part[i, j]
    return inverse
