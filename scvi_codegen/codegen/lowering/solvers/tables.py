"""Common interface and tables of the fixed-point solvers.

A solver is a function from a problem to a :class:`~scvi_codegen.codegen.ir.equations.FixedPointIteration`, or ``None``,
and a line in ``FIXED_POINTS`` (:mod:`scvi_codegen.codegen.lowering.program`). The iteration is plain data, with the
tables and the support headers from which :mod:`scvi_codegen.codegen.rendering.kernels.simd` renders C. Solvers share
only the problem. They may rely on the following:

* the tables of a shape are numbers of the method in 60 digits, also in the iteration; they are rounded when they are
  printed, as double-double numbers if one rounding is not accurate enough;
* the tables of an iteration are padded to its lanes: lanes beyond the last real point repeat it (its row, its abscissa)
  and have weight 0. They are in the domain of the Lagrangian whenever it is, and never delay convergence;
* an iteration that does not converge costs time, not correctness: Newton's method follows it.

A method whose unknowns are velocities has two tables, positions from velocities and momenta from forces,

    q_n = q0 + h sum_b position[n][b] V_b,    P_b = p0 + h sum_n momentum[b][n] F_n,

with q1 and p1 by the rows ``end_position`` and ``end_momentum``. The solvers of separable and of coupled systems are
both derived from them.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Any, TypeAlias

import numpy as np

from scvi_codegen.codegen.ir.equations import FixedPointIteration, PredictorTables, Remainder, ShiftTables
from scvi_codegen.codegen.ir.kernel import Number, NumberTable, lower_matrix, lower_vector
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.stage_system import Shape, Velocities
from scvi_codegen.methods.tables.basis import (
    continuation,
    extrapolation,
    identity_matrix,
    legendre_functional,
    matrix_product,
    transpose,
)
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import equivalent_lagrangian
from scvi_codegen.systems.system import MechanicalSystem


@dataclass(frozen=True, slots=True)
class StepProblem:
    """A system, and the shape of its stage equations."""

    system: MechanicalSystem
    shape: Shape | None

    @property
    def lagrangian(self) -> LagrangianSystem | None:
        """The system itself, or for a Hamiltonian its Lagrangian system with the same step (35f), if one is found."""
        return equivalent_lagrangian(self.system)


Solver: TypeAlias = Callable[[StepProblem], FixedPointIteration | None]


MOST_LANES = 32
VECTOR = 8
"""Lanes of the longest vector of a processor (AVX-512); shorter vectors divide it."""
DEGREE_OF_ONE, DEGREE_OF_TWO = 8, 12
"""Degrees of the polynomials through the last step, or through the last two, that are extrapolated into the next.

Higher degrees are more accurate, but amplify rounding errors, by about 1e6 for these.
"""
REAL = mp.mpf("1e-30")
"""Relative imaginary part below which an eigenvalue is real."""
INTERPOLATED = 5
"""Degree up to which the polynomial of two steps interpolates all points; above, least squares predict better."""


def lane_count(points: int, *, in_groups: bool = True) -> int:
    """Return the number of points with padding: a power of two, at least 2; in groups of more than 16 whole vectors."""
    power = max(2, 1 << (points - 1).bit_length())
    return -(-points // VECTOR) * VECTOR if in_groups and power > 2 * VECTOR else power


def pad_matrix(entries: Matrix, lanes: int) -> NumberTable:
    """Return the padded table: rows beyond the last repeat it, columns beyond are zero."""
    wide = tuple(_longer(line, lanes) for line in entries)
    return lower_matrix((*wide, *(wide[-1],) * (lanes - len(wide))))


def pad_vector(entries: Vector, lanes: int, *, repeat: bool = False) -> tuple[Number, ...]:
    """Return the padded vector; further entries are zero, or repeat the last."""
    return lower_vector(_longer(entries, lanes, repeat=repeat))


REMAINDER_BITS, LARGEST_RATE = 200, 0.9
"""Fixed-point precision of the characteristic polynomial; largest rate at which a remainder is extrapolated."""


def remainder_tables(product: Matrix, end_position: Vector, end_momentum: Vector, lanes: int) -> Remainder:
    """Return b^T R = b^T J (1 - J)^-1, J = -lambda P, in powers of lambda for end weights b; see remainder.h.

    With the adjugate of 1 + lambda P, sum_k lambda^k B_k, B_0 = 1, B_k = d_k - P B_(k-1), d_k = tr(P B_(k-1)) / k
    (Faddeev-LeVerrier), b^T R det(1 + lambda P) = -sum_k lambda^(k+1) b^T P B_k.
    """
    P = np.array([[int(mp.nint(mp.ldexp(x, REMAINDER_BITS))) for x in line] for line in product], dtype=object)
    points, adjugate, determinant = len(P), np.diag([1 << REMAINDER_BITS] * len(P)), []
    rows: tuple[list[Vector], ...] = ([], [])
    for k in range(1, points + 1):
        product_with = P.dot(adjugate) >> REMAINDER_BITS  # P B_(k-1), two fixed-point factors
        for table, weights in zip(rows, (end_position, end_momentum), strict=True):
            columns = (zip(weights, product_with[:, n], strict=True) for n in range(points))
            table.append(
                tuple(-mp.ldexp(mp.fsum(b * int(x) for b, x in column), -REMAINDER_BITS) for column in columns)
            )
        determinant.append(int(np.trace(product_with)) // k)
        adjugate = np.diag([determinant[-1]] * points) - product_with
    fastest = float(np.abs(np.linalg.eigvals(np.array(product, dtype=float))).max())
    padding = (mp.zero,) * (lanes - points)
    at_points = (tuple((*line, *padding) for line in transpose(tuple(table))) for table in rows)
    position, momentum = (lower_matrix((*table, *((mp.zero,) * lanes,) * (lanes - points))) for table in at_points)
    return Remainder(
        position=position,
        momentum=momentum,
        determinant=pad_vector(tuple(mp.ldexp(x, -REMAINDER_BITS) for x in determinant), lanes),
        largest=LARGEST_RATE / fastest if fastest > 0 else 0.0,
    )


NEWTON_STEPS = 3
"""From 15 to more than 60 digits of eigenvalues."""
LARGEST_CONDITION, LEAST_ANGLE = mp.mpf("1e8"), mp.mpf("0.1")
"""Of eigenvectors in the Frobenius norm, and of eigenvalues from the negative real axis, of usable shifts."""


@lru_cache(maxsize=16)
def shift_tables(matrix: NumberTable, lanes: int) -> ShiftTables | None:
    """Return the eigenvectors of the (g, g) matrix P of a step: P = V diag(mu) V^-1, x = V z, z = V^-1 x.

    Of two conjugate eigenvalues the one with positive imaginary part is kept, since for real x

        x_n = sum_k V_nk z_k = sum_real V_nk z_k + sum_kept 2 (Re V_nk Re z_k - Im V_nk Im z_k).

    So ``back`` has the factor 2 and the sign of the imaginary parts, and ``into`` the rows of V^-1 as they are. Each
    vector of kept components is padded to a power of two and stored as its real, then its imaginary parts. Rows of
    ``back`` beyond the g points repeat the last one, up to ``lanes``.

    ``None`` if the matrix is defective, as that of SVI(3, "gauss-lobatto:3").
    """
    points = len(matrix)
    values, vectors = eigenvectors(matrix)
    try:
        inverse = mp.inverse(vectors)
    except ZeroDivisionError:
        return None
    real = [abs(mp.im(value)) < REAL * abs(value) for value in values]
    kept = [k for k, value in enumerate(values) if real[k] or mp.im(value) > 0]
    count = 1 << (len(kept) - 1).bit_length()

    def parts(entries: Sequence[Number], sign: int = 1) -> Vector:
        padding = [mp.zero] * (count - len(kept))
        real_parts = [mp.re(entries[k]) for k in kept]
        return (*real_parts, *padding, *(sign * mp.im(entries[k]) for k in kept), *padding)

    def back(point: int) -> Vector:
        return parts([(1 if real[k] else 2) * vectors[point, k] for k in range(points)], -1)

    return ShiftTables(
        count=count,
        mu=lower_vector(parts(values)),
        into=lower_vector(tuple(chain(*(parts(inverse[:, j]) for j in range(points))))),
        back=lower_matrix(transpose(tuple(back(min(n, points - 1)) for n in range(lanes)))),
        is_accurate=mp.mnorm(vectors, "f") * mp.mnorm(inverse, "f") < LARGEST_CONDITION
        and all(mp.pi - abs(mp.arg(value)) > LEAST_ANGLE for value in values if value != 0),
    )


def eigenvectors(matrix: NumberTable) -> tuple[list[Any], Any]:
    """Return the eigenvalues and the matrix of eigenvectors, by inverse iteration from those in double precision.

    The largest component x_m of an eigenvector is 1. Inverse iteration with the latest shift is Newton's method for
    A x = mu x, x_m = 1 (Peters & Wilkinson 1979): with (A - mu) y = x, mu + 1 / y_m and y / y_m are the next mu and x.
    (``mp.eig`` takes ten times as long.)
    """
    values, vectors = np.linalg.eig(np.array(matrix, dtype=float))
    exact, eigenvalues, columns = mp.matrix(matrix), [], []
    for value, vector in zip(values, vectors.T, strict=True):
        if value.imag < 0:  # the conjugate of another one
            continue
        largest = int(np.argmax(abs(vector)))
        mu, x = mp.mpmathify(value), mp.matrix([mp.mpmathify(entry / vector[largest]) for entry in vector])
        for _ in range(NEWTON_STEPS):
            with contextlib.suppress(ZeroDivisionError):  # mu is an eigenvalue
                y = mp.lu_solve(exact - mu * mp.eye(len(values)), x)
                mu, x = mu + 1 / y[largest], y / y[largest]
        pairs = [(mu, x)] if value.imag == 0 else [(mu, x), (mp.conj(mu), x.apply(mp.conj))]
        eigenvalues += [eigenvalue for eigenvalue, _ in pairs]
        columns += [list(eigenvector) for _, eigenvector in pairs]
    return eigenvalues, mp.matrix(columns).T


def predictor_tables_of(
    abscissae: Vector, lanes: int, *, through: Matrix | None = None, degree: int | None = None
) -> PredictorTables:
    """Return the predictor tables from values at the points in the last one or two steps to those in the next.

    ``through``: a matrix to apply to the prediction; ``degree``: of the leading coefficient that the method resolves,
    by default the highest that the points determine.
    """
    highest = len(abscissae) - 1 if degree is None else degree
    alone = extrapolation(abscissae, 1, min(len(abscissae) - 1, DEGREE_OF_ONE))
    distinct = len({*abscissae, *(x - 1 for x in abscissae)})  # one fewer if both ends of a step are points
    through_most = max(2 * len(abscissae) - 2, INTERPOLATED)
    tables: tuple[Matrix, ...] = (alone, *continuation(abscissae, min(distinct - 1, through_most, DEGREE_OF_TWO)))
    if through is not None:
        tables = tuple(matrix_product(through, table) for table in tables)
    last_alone, last, before = (pad_matrix(table, lanes) for table in tables)
    return PredictorTables(
        abscissae=lower_vector(abscissae),
        degree=highest,
        highest=pad_vector(legendre_functional(abscissae, highest), lanes),
        next=pad_vector(legendre_functional(abscissae, highest - 1), lanes),
        last_alone=last_alone,
        last=last,
        before=before,
    )


def _longer(entries: Vector, lanes: int, *, repeat: bool = False) -> Vector:
    return (*entries, *((entries[-1] if repeat else mp.zero),) * (lanes - len(entries)))


CONSISTENT = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityTables:
    """Tables in 60 digits.

    Attributes:
        abscissae: (g,) of the points; blocks: (s,) abscissae of the velocities.
        position: (g, s); momentum: (s, g); end_position: (s,); end_momentum: (g,).
        velocity, projection: (g, s) from the s velocities to those at the points, (s, g) back; empty if they are the
            same.
        variational: whether ``momentum`` is the adjoint of ``position``: beta_b momentum[b][n] = w_n (beta_b -
            position[n][b]) (summed over the projection, if there is one).
    """

    abscissae: Vector
    blocks: Vector
    position: Matrix
    momentum: Matrix
    end_position: Vector
    end_momentum: Vector
    velocity: Matrix
    projection: Matrix
    variational: bool


def velocity_tables(shape: Shape | None) -> VelocityTables | None:
    """Return the tables of stage equations; ``None`` for other shapes, or if velocities do not determine the curve."""
    if not isinstance(shape, Velocities):
        return None
    if shape.variational:
        return _variational_tables(shape)
    return tableau_tables(shape.abscissae, shape.position, shape.weights)


def resolved_degree(tables: VelocityTables) -> int:
    """Return the highest degree of the momenta along a step that forces reach; higher Legendre coefficients are 0.

    The momenta of a Lobatto IIIA-IIIB pair of s stages have degree s - 2. A coefficient that vanishes for all forces is
    no error estimate.
    """
    for degree in range(len(tables.blocks) - 1, 0, -1):
        (line,) = matrix_product((legendre_functional(tables.blocks, degree),), tables.momentum)
        if max(map(abs, line)) > CONSISTENT:
            return degree
    return 0


def tableau_tables(abscissae: Vector, A: Matrix, b: Vector) -> VelocityTables:
    """Return the tables of a Runge-Kutta method in phase space."""
    return VelocityTables(
        abscissae=abscissae,
        blocks=abscissae,
        position=A,
        momentum=A,
        end_position=b,
        end_momentum=b,
        velocity=(),
        projection=(),
        variational=False,
    )


def _variational_tables(shape: Velocities) -> VelocityTables | None:
    """Return the adjoint pair, ``None`` if a weight beta_b is 0 or the velocities do not determine the curve.

    With velocities at the points: ``momentum[b][n] = w_n (beta_b - position[n][b]) / beta_b``. With other points and
    l = ``velocity``, the matrix K = l^T w l takes the place of the beta_b by which this divides:

        momentum = K^-1 (beta_b - position[n][b])_bn w,    projection = K^-1 l^T w,

    and K^-1 beta = 1 is required: free motion with a constant mass, m K V = beta p, has constant velocities.
    """
    beta, weights = shape.end, shape.weights
    if any(x == 0 for x in beta):
        return None
    rest = tuple(tuple(b - x for x in column) for b, column in zip(beta, transpose(shape.position), strict=True))
    projection: Matrix = ()
    if shape.velocity == identity_matrix(len(shape.velocity)):
        adjoint: Matrix = tuple(tuple(x / b for x in line) for b, line in zip(beta, rest, strict=True))
    else:
        inverse = _inverse_stiffness(shape.velocity, weights)
        if inverse is None or max(abs(mp.fdot(line, beta) - 1) for line in inverse) > CONSISTENT:
            return None
        adjoint = matrix_product(inverse, rest)
        projection = _columns_scaled(matrix_product(inverse, transpose(shape.velocity)), weights)
    return VelocityTables(
        abscissae=shape.abscissae,
        blocks=shape.blocks if projection else shape.abscissae,
        position=shape.position,
        momentum=_columns_scaled(adjoint, weights),
        end_position=beta,
        end_momentum=weights,
        velocity=shape.velocity if projection else (),
        projection=projection,
        variational=True,
    )


def _inverse_stiffness(velocity: Matrix, weights: Vector) -> Matrix | None:
    """Return K^-1, K = l^T w l: it solves beta_b p1 = sum_n w_n (h a_nb L_q + l_nb L_v) for constant mass."""
    stiffness = mp.matrix(matrix_product(_columns_scaled(transpose(velocity), weights), velocity))
    try:
        inverse = mp.inverse(stiffness)
    except ZeroDivisionError:
        return None
    return tuple(tuple(inverse[i, j] for j in range(inverse.cols)) for i in range(inverse.rows))


def _columns_scaled(entries: Matrix, factors: Vector) -> Matrix:
    return tuple(tuple(x * w for x, w in zip(line, factors, strict=True)) for line in entries)
