"""The fixed-point solver of stage equations: no Newton matrix, points as lanes of one vector.

It exists where the unknowns are velocities V_n at the points themselves, so that the stage equations read

    L_v(q_n, V_n) = P_n = p0 + h sum_j A_nj L_q(q_j, V_j),      q_n = q0 + h sum_j a_nj V_j,

that is for SVI with as many points as its degree, every Runge-Kutta method in phase space, and Stoermer-Verlet. With
other points an SVI has fewer velocities z_b, V_n = sum_b l_nb z_b, and the equations are projected on them: with
K = l^T w l the residual is p0 + h K^-1 (beta - a)^T w L_q - K^-1 l^T w L_v, and a correction goes to the points by l,
through the mass of each, and back by K^-1 l^T w.

For *separable* systems (constant diagonal mass, forces of position and time) the equations collapse to
q_n = q0 + h c_n v0 + h^2 sum_j Ahat_nj f(q_j), c_n the row sums of a, for spectral collocation and Runge-Kutta methods
in position form as well.

For a variational method the two matrices belong together. With mu_nj = a_nj / beta_j, the scaled weights h beta_j
rounded once and used in stages and updates alike, and A_nj / w_j = 1 - mu_jn, exact since mu is a multiple of 2^-51,
the rounded map still has a generating function: its energy error does not drift.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from scvi_codegen.basis import extrapolation, matrix_product, transpose
from scvi_codegen.derivatives import jacobian
from scvi_codegen.errors import MethodError
from scvi_codegen.lowering import lower_kernel, lower_matrix, lower_vector
from scvi_codegen.mechanics import force, is_separable, momentum
from scvi_codegen.methods.collocation import phase_space_system
from scvi_codegen.methods.galerkin import EXTRAPOLATION_DEGREE
from scvi_codegen.methods.method import Method
from scvi_codegen.precision import Matrix, Vector, mp
from scvi_codegen.program import Kernel, ShootingSweep, Splitting, Sweep
from scvi_codegen.stage_system import PointFamily, StageSystem
from scvi_codegen.system import LagrangianSystem

__all__ = ["check_solver", "pad_matrix", "pad_vector", "sweep_of"]

MOST_POINTS = 32
FRACTION_BITS = 51
CONSISTENT = 1e-12


def sweep_of(system: LagrangianSystem, method: Method) -> Sweep | None:
    """The fixed-point iteration of a method for a system, or ``None`` where there is none."""
    separable = is_separable(system)
    stages = _velocity_stages(system, method, separable=separable)
    if stages is None:
        return None
    family = stages.families[0]
    tables = _variational_tables(family, stages) if _is_variational(stages) else _tableau_tables(family, stages)
    if tables is None or len(family.abscissae) > MOST_POINTS:
        return None
    if separable:
        guess = extrapolation(family.abscissae, 1, min(len(family.abscissae) - 1, EXTRAPOLATION_DEGREE))
    else:
        guess = stages.extrapolation or ()
    return _padded(system, family, tables, guess, separable=separable)


class _Tables:
    """Unpadded tables, in 60 digits."""

    def __init__(
        self,
        *,
        position: Matrix,
        position_weights: Vector,
        momentum: Matrix,
        momentum_weights: Vector,
        end_position: Vector,
        end_momentum: Vector,
        velocity: Matrix = (),
        projection: Matrix = (),
    ) -> None:
        self.position, self.position_weights = position, position_weights
        self.momentum, self.momentum_weights = momentum, momentum_weights
        self.end_position, self.end_momentum = end_position, end_momentum
        self.velocity, self.projection = velocity, projection


def _velocity_stages(system: LagrangianSystem, method: Method, *, separable: bool) -> StageSystem | None:
    """Stage equations with one family whose kernel is (L_q, L_v) and whose unknowns are velocities."""
    if getattr(method, "form", None) == "position":
        return phase_space_system(system, method.tableau) if separable else None  # type: ignore[attr-defined]
    stages = method.stage_system(system)
    family = stages.families[0]
    plain = len(stages.families) == 1 and len(family.gathers) == len(family.scatters) == 2
    return stages if plain else None


def _is_identity(entries: Matrix) -> bool:
    """Of a table whose first column multiplies q0."""
    square = len(entries) == len(entries[0]) - 1
    return square and all(x == int(n + 1 == b) for n, line in enumerate(entries) for b, x in enumerate(line))


def _is_variational(stages: StageSystem) -> bool:
    return stages.action is not None


def _variational_tables(family: PointFamily, stages: StageSystem) -> _Tables | None:
    """Mu and its partner; where the velocities are not those at the points, the equations projected on the curve."""
    beta = stages.end_position.entries[0][1:]
    if any(x == 0 for x in beta):
        return None
    position = tuple(line[1:] for line in family.gathers[0].table.entries)
    velocity = tuple(line[1:] for line in family.gathers[1].table.entries)
    unit = mp.ldexp(1, FRACTION_BITS)
    mu = tuple(tuple(mp.nint(x / b * unit) / unit for x, b in zip(line, beta, strict=True)) for line in position)
    plain = _is_identity(family.gathers[1].table.entries)
    if plain:
        partner = transpose(tuple(tuple(1 - x for x in line) for line in mu))
        projection: Matrix = ()
    else:
        inverse = _inverse_stiffness(velocity, family.weights)
        if inverse is None or max(abs(mp.fdot(line, beta) - 1) for line in inverse) > CONSISTENT:
            return None
        rest = tuple(tuple(b - x for x in column) for b, column in zip(beta, transpose(position), strict=True))
        partner = matrix_product(inverse, rest)
        projection = _weighted(matrix_product(inverse, transpose(velocity)), family.weights)
    return _Tables(
        position=mu,
        position_weights=beta,
        momentum=partner,
        momentum_weights=family.weights,
        end_position=(mp.one,) * len(beta),
        end_momentum=(mp.one,) * len(family.weights),
        velocity=() if plain else velocity,
        projection=projection,
    )


def _inverse_stiffness(velocity: Matrix, weights: Vector) -> Matrix | None:
    """K^-1, K = l^T w l: it solves beta_b p1 = sum_n w_n (h a_nb L_q + l_nb L_v) for constant mass."""
    stiffness = mp.matrix(matrix_product(transpose(velocity), tuple(_scaled(velocity, weights))))
    try:
        inverse = mp.inverse(stiffness)
    except ZeroDivisionError:
        return None
    return tuple(tuple(inverse[i, j] for j in range(inverse.cols)) for i in range(inverse.rows))


def _scaled(entries: Matrix, weights: Vector) -> Iterator[Vector]:
    """Rows times weights."""
    return (tuple(w * x for x in line) for w, line in zip(weights, entries, strict=True))


def _tableau_tables(family: PointFamily, stages: StageSystem) -> _Tables:
    """(A, b) for positions and momenta alike."""
    A = tuple(line[1:] for line in family.gathers[0].table.entries)
    b = stages.end_position.entries[0][1:]
    ones = (mp.one,) * len(b)
    return _Tables(position=A, position_weights=ones, momentum=A, momentum_weights=ones, end_position=b, end_momentum=b)


def _padded(system: LagrangianSystem, family: PointFamily, tables: _Tables, guess: Matrix, *, separable: bool) -> Sweep:
    points, blocks = len(family.abscissae), len(tables.momentum)
    lanes = 2
    while lanes < max(points, blocks):
        lanes *= 2
    weighted = _weighted(tables.position, tables.position_weights)
    product = _weighted(matrix_product(weighted, tables.momentum), tables.momentum_weights)
    kernel, mass, entries = _separable_kernels(system) if separable else _coupled_kernel(system)
    return Sweep(
        separable=separable,
        points=points,
        blocks=blocks,
        lanes=lanes,
        abscissae=pad_vector(family.abscissae, lanes, repeat=True),
        drift=pad_vector(tuple(mp.fsum(line) for line in weighted), lanes, repeat=True),
        position=pad_matrix(tables.position, lanes),
        position_weights=pad_vector(tables.position_weights, lanes),
        momentum=pad_matrix(tables.momentum, lanes),
        momentum_weights=pad_vector(tables.momentum_weights, lanes),
        end_position=pad_vector(tables.end_position, lanes),
        end_momentum=pad_vector(tables.end_momentum, lanes),
        product=pad_matrix(product, lanes),
        velocity=pad_matrix(tables.velocity, lanes) if tables.velocity and not separable else (),
        projection=pad_matrix(tables.projection, lanes) if tables.projection and not separable else (),
        extrapolation=pad_matrix(guess, lanes),
        kernel=kernel,
        force=_force_kernel(system, separable=separable),
        mass=mass,
        mass_entries=entries,
    )


def _weighted(entries: Matrix, weights: Vector) -> Matrix:
    return tuple(tuple(x * w for x, w in zip(line, weights, strict=True)) for line in entries)


def pad_matrix(entries: Matrix, lanes: int) -> tuple[tuple[float, ...], ...]:
    """Rows beyond the last repeat it, columns beyond are zero: a lane too many is the last point again."""
    wide = [(*line, *(mp.zero,) * (lanes - len(line))) for line in entries]
    return lower_matrix((*wide, *(wide[-1],) * (lanes - len(wide))))


def pad_vector(entries: Vector, lanes: int, *, repeat: bool = False) -> tuple[float, ...]:
    """The rest is zero, or the last entry again."""
    return lower_vector((*entries, *((entries[-1] if repeat else mp.zero),) * (lanes - len(entries))))


def _force_kernel(system: LagrangianSystem, *, separable: bool) -> Kernel:
    arguments = system.coordinates if separable else (*system.coordinates, *system.velocities)
    return lower_kernel(
        "force_lanes", arguments=arguments, time=system.time, parameters=system.parameters, values=force(system)
    )


def _separable_kernels(system: LagrangianSystem) -> tuple[Kernel, Kernel, tuple[tuple[int, int], ...]]:
    mass = jacobian(momentum(system), system.velocities)
    kernel = lower_kernel(
        "mass", arguments=(), time=system.time, parameters=system.parameters, values=tuple(mass.values())
    )
    return _force_kernel(system, separable=True), kernel, tuple(mass)


def _coupled_kernel(system: LagrangianSystem) -> tuple[Kernel, None, tuple[tuple[int, int], ...]]:
    momenta = momentum(system)
    mass = {key: entry for key, entry in jacobian(momenta, system.velocities).items() if key[0] >= key[1]}
    kernel = lower_kernel(
        "point_lanes",
        arguments=(*system.coordinates, *system.velocities),
        time=system.time,
        parameters=system.parameters,
        values=(*force(system), *momenta),
        slopes=tuple(mass.values()),
    )
    return kernel, None, tuple(mass)


def check_solver(
    solver: str, method: Method, names: Sequence[str], *, found: Sweep | ShootingSweep | Splitting | None
) -> None:
    """Raise :class:`MethodError` for a solver that does not exist, or was not ``found`` for this method and system."""
    if solver not in names:
        raise MethodError(f"there is no solver {solver!r}; there are {', '.join(names)}")
    if solver == "explicit" and found is None:
        raise MethodError(f"{method.name} is not explicit for this system; use solver='auto'")
    if solver == "fixed-point" and found is None:
        raise MethodError(
            f"{method.name} has no fixed-point iteration for this system; use solver='auto' or 'newton', "
            "or an SVI with as many quadrature points as its degree"
        )
