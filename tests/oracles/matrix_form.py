"""Kronecker forms (18) and (21) of spectral collocation, by Lemmas 2.1 and 2.2, independent of the scalar equations."""

import sympy
from sympy import Matrix, eye, kronecker_product

from scvi_codegen.derivation.equations import StepEquations
from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of
from scvi_codegen.tables.basis import differentiation_matrix


def matrix_form(of: StepEquations) -> tuple[Matrix, Matrix]:
    """Return A, the differentiation matrix on the step without its first row and column a0, and the residual.

    Position form (18): (A^2 x I) vec(Q) + a0 x v0 + (A a0) x q0 are the accelerations; the residual is the
    Euler-Lagrange residual with them and V = A Q + a0 q0. Phase space (21): [[A x I, 0], [0, A x I]] (vec Q, vec P) +
    (a0 x q0, a0 x p0) = (vec V, vec L_q), with P = L_v(Q, V) and the unknowns V.
    """
    size, m, forms = of.method.degree, of.system.dimension, forms_of(of.system)
    partials = differentiation_matrix(of.method.node_set.points)
    full = Matrix(size, size + 1, lambda i, j: 2 * sympy.Float(str(partials[i + 1][j]), 50) / of.step)
    A, a0 = full[:, 1:], full[:, :1]
    times = [of.time + sympy.Float(str(c), 50) * of.step for c in of.method.node_set.abscissae[1:]]
    q0, p0 = (Matrix(1, m, part) for part in of.state)
    unknowns = Matrix(size, m, of.unknowns[: size * m])
    position = of.method.form == "position"
    Q = unknowns if position else A.inv() * (unknowns - a0 * q0)
    V = A * Q + a0 * q0 if position else unknowns
    symbols = (*of.system.coordinates, *of.system.velocities, of.system.time)
    nodes = [dict(zip(symbols, (*Q.row(i), *V.row(i), t), strict=True)) for i, t in enumerate(times)]
    if position:
        v0 = Matrix(1, m, of.unknowns[size * m :])
        rates = kronecker_product(A * A, eye(m)) * Matrix(list(Q))
        rates += kronecker_product(a0, v0.T) + kronecker_product(A * a0, q0.T)
        for i, node in enumerate(nodes):
            node |= dict(zip(accelerations(of.system), rates[i * m : (i + 1) * m], strict=True))
        return A, Matrix([e.xreplace(node) for node in nodes for e in forms.euler_lagrange])
    P, G = ([e.xreplace(node) for node in nodes for e in each] for each in (forms.momentum, forms.force))
    single = kronecker_product(A, eye(m))
    known = Matrix.vstack(kronecker_product(a0, q0.T), kronecker_product(a0, p0.T))
    return A, sympy.diag(single, single) * Matrix([*Q, *P]) + known - Matrix([*V, *G])
