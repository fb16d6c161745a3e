"""Kronecker forms (18) and (21) of spectral collocation, by Lemmas 2.1 and 2.2, independent of the equations."""

from collections.abc import Sequence
from dataclasses import dataclass

import sympy

from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.collocation import SpectralCollocation
from scvi_codegen.tables.basis import differentiation_matrix
from scvi_codegen.tables.precision import Number

Symbols = Sequence[sympy.Symbol]


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixForm:
    """Spectral collocation with Kronecker products: left = right, both column vectors.

    Position form (18): left = (A^2 x I) vec(Q) + a0 x v0 + (A a0) x q0 = vec(accelerations); ``residual`` is the
    Euler-Lagrange residual with these accelerations and V = A Q + a0 q0. Phase space (21): left =
    [[A x I, 0], [0, A x I]] (vec Q, vec P) + (a0 x q0, a0 x p0), right = (vec H_p, vec -H_q).

    Attributes:
        A, a0: the differentiation matrix on [t_k, t_k + h] without its first row, (s, s), and its first column, (s, 1).
        operator: the Kronecker product that acts on the unknowns.
        left: operator times unknowns plus the known state.
        residual: a column vector, 0 for the solution.
    """

    A: sympy.ImmutableMatrix
    a0: sympy.ImmutableMatrix
    operator: sympy.ImmutableMatrix
    left: sympy.ImmutableMatrix
    residual: sympy.ImmutableMatrix


def matrix_form(
    system: MechanicalSystem,
    method: SpectralCollocation,
    unknowns: Symbols,
    state: tuple[Symbols, Symbols],
    time: sympy.Symbol,
    step: sympy.Symbol,
) -> MatrixForm:
    """Return the equations of one step in matrices.

    Args:
        system, method: m coordinates, degree s.
        unknowns: (Q, v0) of the position form, V of phase space; s m of them and m more for v0.
        state: (q0, p0), m symbols each.
        time, step: t_k and h.
    """
    size = method.degree
    partials = differentiation_matrix(method.node_set.points)
    full = sympy.Matrix(size, size + 1, lambda i, j: 2 * _number(partials[i + 1][j]) / step)
    times = [time + _number(c) * step for c in method.node_set.abscissae[1:]]
    form = _position_form if method.form == "position" else _phase_space_form
    return form(system, full[:, 1:], full[:, :1], times, unknowns, state)


def _number(value: Number) -> sympy.Expr:
    return sympy.Float(str(value), 50)


def _position_form(
    system: MechanicalSystem,
    A: sympy.Matrix,
    a0: sympy.Matrix,
    times: Sequence[sympy.Expr],
    unknowns: Symbols,
    state: tuple[Symbols, Symbols],
) -> MatrixForm:
    size, m = A.rows, system.dimension
    q0, Q = sympy.Matrix(1, m, state[0]), sympy.Matrix(size, m, unknowns[: size * m])
    v0 = sympy.Matrix(1, m, unknowns[size * m :])
    operator = sympy.kronecker_product(A * A, sympy.eye(m))
    # vec(Q) of Definition 2.2: the rows of Q stacked on top of each other
    left = operator * sympy.Matrix(list(Q)) + sympy.kronecker_product(a0, v0.T) + sympy.kronecker_product(A * a0, q0.T)
    V, E = A * Q + a0 * q0, forms_of(system).euler_lagrange
    residual = []
    for i, time in enumerate(times):
        replaced = _at_node(system, time, Q.row(i), V.row(i))
        replaced |= dict(zip(accelerations(system), left[i * m : (i + 1) * m], strict=True))
        residual += [e.xreplace(replaced) for e in E]
    return _frozen_form(A, a0, operator, left, sympy.Matrix(residual))


def _phase_space_form(
    system: MechanicalSystem,
    A: sympy.Matrix,
    a0: sympy.Matrix,
    times: Sequence[sympy.Expr],
    unknowns: Symbols,
    state: tuple[Symbols, Symbols],
) -> MatrixForm:
    """Return (21) with H_p = V, -H_q = L_q and P = L_v(Q, V); the positions Q follow from the unknowns V by (15)."""
    size, m = A.rows, system.dimension
    q0, p0 = (sympy.Matrix(1, m, part) for part in state)
    V = sympy.Matrix(size, m, unknowns)
    Q = A.inv() * (V - a0 * q0)
    P, G = [], []
    for i, time in enumerate(times):
        replaced = _at_node(system, time, Q.row(i), V.row(i))
        P += [p.xreplace(replaced) for p in forms_of(system).momentum]
        G += [f.xreplace(replaced) for f in forms_of(system).force]
    single = sympy.kronecker_product(A, sympy.eye(m))
    operator = sympy.diag(single, single)
    known = sympy.Matrix.vstack(sympy.kronecker_product(a0, q0.T), sympy.kronecker_product(a0, p0.T))
    left = operator * sympy.Matrix([*Q, *P]) + known
    return _frozen_form(A, a0, operator, left, left - sympy.Matrix([*V, *G]))


def _frozen_form(
    A: sympy.Matrix, a0: sympy.Matrix, operator: sympy.Matrix, left: sympy.Matrix, residual: sympy.Matrix
) -> MatrixForm:
    return MatrixForm(
        A=A.as_immutable(),
        a0=a0.as_immutable(),
        operator=operator.as_immutable(),
        left=left.as_immutable(),
        residual=residual.as_immutable(),
    )


def _at_node(
    system: MechanicalSystem, time: sympy.Expr, q: sympy.Matrix, v: sympy.Matrix
) -> dict[sympy.Symbol, sympy.Expr]:
    values = dict(zip((*system.coordinates, *system.velocities), (*q, *v), strict=True))
    return values | {system.time: time}
