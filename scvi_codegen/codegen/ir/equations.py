"""Stage equations and iterations of a step as data: stage groups in loops, constraints, RATTLE, adaptive step sizes.

A stage group consists of points with the same kernel, and loops that gather its arguments and scatter its results.
Unknowns and rows are located at *sites*: the m coordinates, then the components of blocks of another size
(multipliers). A loop covers ``sites`` sites from the ``first`` on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Literal, TypeAlias

from scvi_codegen.codegen.ir.kernel import NO_KERNEL, Kernel, Number, NumberTable, RolledKernel
from scvi_codegen.methods.recurrence import StepTables


@dataclass(frozen=True, slots=True, kw_only=True)
class TableLoop:
    """Loop around a kernel that gathers its arguments or scatters its results at all points n.

    Arguments are ``u[offset + i] = (q0[i] +) h^power sum_b table[n][b] z[b][first + i]``; results are added to rows,
    ``rows[r][first + i] += weight_n h^power table[n][r] value[offset + i]``, of which p1 is the last.
    """

    name: str
    first: int
    sites: int
    offset: int
    power: int
    table: NumberTable
    from_state: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class DerivativeBlock:
    """Nonzero derivatives of a scatter by a gather: ``derivative[first + e]`` is d value[i_e] / d u[j_e]."""

    scatter: int
    gather: int
    first: int
    entries: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoweredStageGroup:
    """Stage group: points with the same kernel and the loops around it.

    Attributes:
        arguments: names of the gathers, m each.
        value, derivative: the kernel, and the kernel with its derivatives.
        integrand: summed along the curve with h^(1 + integrand_power), or ``None``: the discrete Lagrangian, or with
            forces their work and impulse.
        integrand_weights: (n,) weights of this sum, if they are not ``weights``.
    """

    name: str
    arguments: tuple[str, ...]
    abscissae: tuple[Number, ...]
    weights: tuple[Number, ...]
    gathers: tuple[TableLoop, ...]
    scatters: tuple[TableLoop, ...]
    value: Kernel
    derivative: Kernel
    blocks: tuple[DerivativeBlock, ...]
    integrand: Kernel | None
    integrand_power: int
    integrand_weights: tuple[Number, ...] = ()

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.abscissae)

    @property
    def uses_time(self) -> bool:
        """True if the kernel depends on time explicitly, in its values or derivatives."""
        return self.value.uses_time or self.derivative.uses_time

    @property
    def uses_step(self) -> bool:
        """True if h occurs in the loops around the kernel."""
        powers = [loop.power for loop in self.gathers] + [loop.power for loop in self.scatters]
        return self.uses_time or any(powers)

    @property
    def scratch(self) -> int:
        """Number of arguments, values and derivatives at all points."""
        return self.points * (self.derivative.arguments + self.derivative.values + self.derivative.partials)


@dataclass(frozen=True, slots=True)
class IterationTable:
    """A table by its name in C: one number per point, or rows of them; double-double if necessary."""

    name: str
    numbers: tuple[Number, ...] | NumberTable
    in_two_parts: bool = False

    @property
    def is_matrix(self) -> bool:
        """True if it has rows."""
        return isinstance(self.numbers[0], tuple)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rattle:
    """Constrained steps on s + 1 Lobatto points, by an iteration for the multipliers alone; RATTLE for s = 1.

    ``NO_RATTLE``, s = 0, are other steps, and false.

    Attributes:
        part: its header.
        kernels: of forces and momenta.
        macros: of the header.
        inverse_masses: (i, j) of the lower half of M^-1, the diagonal first; mass_columns: a number of each coordinate,
            different for those that masses couple; lower_masses: (i, j) of M, if it differs between points.
        points: s.
        tables: named and described in the header.
    """

    part: str = ""
    kernels: tuple[Kernel, ...] = ()
    macros: tuple[str, ...] = ()
    inverse_masses: tuple[tuple[int, int], ...] = ()
    mass_columns: tuple[int, ...] = ()
    lower_masses: tuple[tuple[int, int], ...] = ()
    points: int = 0
    tables: tuple[IterationTable, ...] = ()

    def __bool__(self) -> bool:
        return self.points > 0

    @property
    def lanes(self) -> int:
        """Number of SIMD lanes, s rounded up to a power of two."""
        return 1 << (self.points - 1).bit_length()


NO_RATTLE = Rattle()


@dataclass(frozen=True, slots=True, kw_only=True)
class Constraints:
    """Constraints g(q, t) = 0, ``count`` of them; ``NO_CONSTRAINTS`` are none, and false.

    Attributes:
        formulas: as text.
        kernel: g at u = q, then the nonzero derivatives g_q.
        entries: (k, i) of these derivatives.
        rounding: bounds of the rounding errors of g, in units of the round-off.
        motion: at u = (q, v): L_vv a without constraints, m numbers; then g_q v + g_t, and the terms of its time
            derivative without a.
        reactions: 1 - mask of each constraint, then the nonzero entries of D at u = (q, v), whose forces are D^T
            lambda; ``None`` if all constraints are always imposed and ideal.
        directions: (k, i) of the entries of D.
        masked: number of the last constraints, which are imposed in some modes only.
        coefficients: friction, static friction and restitution of each contact at u = (q, v), or ``None``.
        coefficient_rounding: bounds of their rounding errors, in units of the round-off.
        motion_by_steps: L_v and L_q + f without contacts at u = (q, v), then derivatives in ``motion_places``; ``None``
            if the method has no steps of contacts.
        masses_by_steps: the same without the derivatives after the first ``motion_masses``.
        motion_places: of these derivatives in the matrices L_vv (lower half), L_vq and f_v by rows.
        drifts: rates of the constraints at rest, by time.
    """

    formulas: tuple[str, ...] = ()
    kernel: Kernel = NO_KERNEL
    entries: tuple[tuple[int, int], ...] = ()
    rounding: Kernel = NO_KERNEL
    motion: Kernel = NO_KERNEL
    reactions: Kernel | None = None
    directions: tuple[tuple[int, int], ...] = ()
    masked: int = 0
    coefficients: Kernel | None = None
    coefficient_rounding: Kernel | None = None
    motion_by_steps: Kernel | None = None
    masses_by_steps: Kernel | None = None
    motion_places: tuple[int, ...] = ()
    motion_masses: int = 0
    drifts: Kernel | None = None

    def __len__(self) -> int:
        return len(self.formulas)

    @property
    def count(self) -> int:
        """Number of constraints."""
        return len(self.formulas)

    @property
    def kernels(self) -> tuple[Kernel | None, ...]:
        """Those that the constraints have, in the order of emission."""
        reactions = self.reactions, self.coefficients, self.coefficient_rounding
        by_steps = self.motion_by_steps, self.masses_by_steps, self.drifts
        return self.kernel, self.rounding, self.motion, *reactions, *by_steps


NO_CONSTRAINTS = Constraints()


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstrainedSteps:
    """Constrained steps by RATTLE.

    Attributes:
        conditions: g, g_t and the derivatives of g with respect to each slot, at every element.
        curvatures: d^2 g / dt^2 at constant velocities.
        parts: fractions of a step, each of which is a RATTLE step.
    """

    conditions: tuple[RolledKernel, ...]
    curvatures: tuple[RolledKernel, ...]
    parts: tuple[Number, ...]


IterationName: TypeAlias = Literal["separable", "Hamiltonian", "coupled", "collocation", "shooting"]


class StoredValues(Enum):
    """Values at the points of a step that are stored for the predictor and the error estimate of the curve."""

    FORCES = auto()
    VELOCITIES = auto()
    ACCELERATIONS = auto()


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictorTables:
    """(lanes, lanes) predictor tables for values at the points: ``last_alone``, or ``last`` and ``before``.

    Attributes:
        abscissae: of the stored values on a step, without padding.
        degree, highest, next: (lanes,) weights of the leading Legendre coefficient of the curve through them, and of
            the next lower one; zeros if there is none.
    """

    abscissae: tuple[Number, ...]
    degree: int
    highest: tuple[Number, ...]
    next: tuple[Number, ...]
    last_alone: NumberTable
    last: NumberTable
    before: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class ShiftTables:
    """Decomposition A = V diag(mu) V^-1 of the matrix of a step, with one eigenvalue of each complex pair.

    Attributes:
        count: number of eigenvalues, padded to a power of two with zeros.
        mu: (2 count,) real parts, then imaginary parts.
        into: V^-1 by points, each with count real parts, then imaginary parts.
        back: (2 count, lanes) such that x = sum_k Re z_k back_k + Im z_k back_(count + k) for z = V^-1 x.
        is_accurate: whether V is well conditioned and no eigenvalue is negative or nearly so.
    """

    count: int
    mu: tuple[Number, ...]
    into: tuple[Number, ...]
    back: tuple[tuple[Number, ...], ...]
    is_accurate: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Remainder:
    """Tables that extrapolate the remainder of a fixed-point iteration from its last change.

    Attributes:
        position, momentum: (lanes, lanes) coefficients of the powers of the stiffness from 1 on, at each point.
        determinant: (lanes,) those of the denominator, whose constant one is 1.
        largest: largest stiffness with which the iteration converges.
    """

    position: NumberTable
    momentum: NumberTable
    determinant: tuple[Number, ...]
    largest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearPart:
    """Constant derivatives of forces at q = 0, a symmetric band matrix.

    Attributes:
        kernel: its entries as functions of the parameters.
        entries: (i, j), i >= j, their positions in a bandwidth-reducing ordering.
        coordinates: the coordinate at each position.
        bandwidth: largest i - j.
        shifts: eigenvectors of the matrix of a step.
    """

    kernel: Kernel
    entries: tuple[tuple[int, int], ...]
    coordinates: tuple[int, ...]
    bandwidth: int
    shifts: ShiftTables


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedPointIteration:
    """Fixed-point iteration whose kernels are evaluated at points on SIMD lanes: data, from which C is rendered.

    Attributes:
        name: of the equations: separable, Hamiltonian, coupled, collocation or shooting.
        points: real points; lanes beyond repeat the last one and have weight 0.
        lanes: the number of points or more: up to 16, or in one vector, a power of two; otherwise a multiple of 8.
        own_tables: padded to ``lanes``, in the order in which they are printed, without those of the predictor.
        guess: predictor of the stored values.
        kernels: evaluated on SIMD lanes.
        forces: names of the kernels whose first values are the forces L_q, if these enter nowhere else.
        kept: values at the points of a step.
        stored: number of doubles kept from step to step per coordinate.
        parts: support headers of its C, in order, after those of the meaning of a lane.
        macros: names and values of macros that these require.
        mass_entries: (i, j), i >= j, of the derivatives of the kernel that computes the mass, if any.
        constant_mass: kernel of the masses if they are constant and diagonal; of a Hamiltonian, of angles of turns.
        damping: kernel of the rate of a uniform damping, a function of the parameters, if there is one.
        predictor_matrix: table between the stored values and the predicted ones; empty if they are the same.
        matrix: (points, points) table from the forces to the increments at the points, of velocities if the forces
            depend on them; empty if positions and momenta have different ones.
        derivatives_part: support header of tangent and adjoint vectors by fixed-point iteration; ``""`` without one.
        serves_many: whether lanes may be trajectories.
        final_iterations: number of iterations after the one that converges.
        in_groups: whether its C supports several vectors for the points of a step, besides one.
        linear_part: constant linear part of the forces, for which steps are solved implicitly; ``None`` without one.
        remainder: of the iteration; ``None`` if it is not extrapolated.
    """

    name: IterationName
    points: int
    lanes: int
    own_tables: tuple[IterationTable, ...]
    guess: PredictorTables
    kernels: tuple[Kernel, ...]
    forces: tuple[str, ...] = ()
    kept: StoredValues
    stored: int
    parts: tuple[str, ...]
    macros: tuple[tuple[str, int], ...] = ()
    mass_entries: tuple[tuple[int, int], ...] = ()
    constant_mass: Kernel | None = None
    damping: Kernel | None = None
    predictor_matrix: NumberTable = ()
    matrix: NumberTable = ()
    derivatives_part: str = ""
    serves_many: bool = False
    final_iterations: int = 0
    in_groups: bool = True
    linear_part: LinearPart | None = None
    remainder: Remainder | None = None

    @property
    def tables(self) -> Iterator[IterationTable]:
        """All tables, in the order in which they are printed: those of the predictor last."""
        yield from self.own_tables
        for name in ("position", "momentum", "determinant") if self.remainder else ():
            yield IterationTable(f"REMAINDER_{name.upper()}", getattr(self.remainder, name))
        for name in ("last_alone", "last", "before"):
            yield IterationTable(name.upper(), getattr(self.guess, name))

    @property
    def curves(self) -> int:
        """Number of curves whose values at the points are stored."""
        return self.stored // (2 * self.lanes)

    @property
    def derivatives_tables(self) -> tuple[IterationTable, ...]:
        """Tables of tangent and adjoint vectors: positions from forces, or from velocities and momenta from forces."""
        if self.name == "separable":
            return (IterationTable("PRODUCT_BACK", transposed(self.numbers("PRODUCT"), self.points)),)
        changes = {}
        for name in ("POSITION", "MOMENTUM"):
            (weights,) = self.numbers(f"{name}_WEIGHT")
            rows = self.numbers(name)
            changes[name] = tuple(tuple(x * w for x, w in zip(row, weights, strict=True)) for row in rows)
        return (
            *(IterationTable(f"CHANGE_{name}", table) for name, table in changes.items()),
            *(IterationTable(f"CHANGE_{name}_BACK", transposed(table, self.points)) for name, table in changes.items()),
        )

    def numbers(self, name: str) -> NumberTable:
        """Return the numbers of a table, those of a vector as the only row."""
        table = next(table for table in self.own_tables if table.name == name)
        return table.numbers if table.is_matrix else (table.numbers,)

    @property
    def is_explicit(self) -> bool:
        """Whether points do not depend on the values there, so that the stage equations have one solution."""
        tables = [table.numbers for table in self.own_tables if table.name in ("POSITION", "MOMENTUM")]
        return bool(tables) and all(number == 0 for rows in tables for row in rows for number in row)

    def with_forces(self, forces: tuple[RolledKernel, ...]) -> FixedPointIteration | None:
        """Return the iteration with further forces L_q of positions; ``None`` if these also enter otherwise."""
        kernels = (kernel.with_sums(forces) if kernel.name in self.forces else kernel for kernel in self.kernels)
        return replace(self, kernels=tuple(kernels)) if self.forces else None

    @property
    def error_power(self) -> int:
        """Exponent of h in the squared leading displacement over that of the curvature and the size; 0: no curve.

        The size is a displacement by the step, proportional to h; of a curve of one or two points it is constant.
        """
        power = 2 * self.guess.degree + (0 if self.kept is StoredValues.VELOCITIES else 2)
        return power if len(self.guess.abscissae) <= 2 else power - 1

    @property
    def diagonal(self) -> bool:
        """True if the mass matrix is diagonal."""
        return all(i == j for i, j in self.mass_entries)

    @property
    def facts(self) -> Mapping[str, int]:
        """Macros that its support headers require: those of its own, and of a diagonal mass matrix."""
        return dict(self.macros) | ({"DIAGONAL_MASS": 1} if self.mass_entries and self.diagonal else {})


def transposed(table: NumberTable, points: int) -> NumberTable:
    """Return the transpose of a padded table; lanes beyond the points remain 0."""
    padding = (0,) * (len(table) - points)
    columns = tuple(zip(*table[:points], strict=True))[:points]
    return (*((*column, *padding) for column in columns), *((0,) * len(table) for _ in padding))


@dataclass(frozen=True, slots=True, kw_only=True)
class Splitting(StepTables):
    """An explicit step: its statements (:mod:`scvi_codegen.methods.statements`), and their kernels.

    Attributes:
        force: L_q at (q, t).
        drift: the constant diagonal of M (no arguments), v = M^-1 p, or v = H_p at p.
        by_masses: True for M^-1 p.
        bodies: of rigid bodies, whose quaternions turn in closed form, the index of the first component of the
            quaternion and the axes j and k (:mod:`scvi_codegen.systems.splittings.kinetic`).
        turning: a_i, a_j - a_i and a_k - a_i of each body (no arguments), or ``None``.
        principal: of each body the principal axes as columns, row by row; empty if they are the body axes.
        at_rest: L at v = 0 if runs sum the action, else ``None``.
        leaps: whether the statements are kicks and drifts in turn by the tables KICK and DRIFT.
        driven: whether forces depend on inputs, which may jump between steps: no step reuses the force of former ones.
    """

    force: Kernel
    drift: Kernel
    by_masses: bool
    bodies: tuple[tuple[int, ...], ...] = ()
    turning: Kernel | None = None
    principal: NumberTable = ()
    at_rest: Kernel | None = None
    leaps: bool = True
    driven: bool = False

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels of kicks and drifts."""
        return tuple(kernel for kernel in (self.force, self.drift, self.turning, self.at_rest) if kernel)

    @property
    def acts(self) -> bool:
        """True if it has a discrete Lagrangian in closed form: a single drift, whose velocity is (q1 - q0) / h."""
        drifts = self.numbers["DRIFT"] if self.leaps else ()
        return self.by_masses and sum(x != 0 for x in drifts) == 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """Adaptive steps with sizes h = 2^(k / levels), by fixed-point iteration or Newton's method; or steps of tau.

    Attributes:
        code: C of the step-size controller.
        memory: names and comments of its fields in the struct of a run.
        mantissas: 2^(k / levels) for the levels of an octave.
        predictor: predictor of the fixed-point iteration, ``None`` without one.
        stage_growth: factor of the error estimate per level for Newton's method; 0 if there is no estimate.
        density: values of a time transformation at (q, v), or (q, p) of a Hamiltonian; instead of the predictor.
        growth: of errors, measured along runs; ``None`` if it is not.
        arrays: first and end of the named coordinates of each array of known size, rotation or direction, which are to
            be accurate as a whole.
        localised: whether forces may be confined to a short time or a small region.
        friction: whether forces depend on velocities, so that transients may be short.
    """

    code: str
    memory: tuple[tuple[str, str], ...] = ()
    mantissas: tuple[float, ...] = ()
    predictor: AdaptivePredictor | None = None
    stage_growth: float = 0.0
    density: Kernel | None = None
    growth: ErrorGrowth | None = None
    arrays: tuple[tuple[int, int], ...] = ()
    localised: bool = False
    friction: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorGrowth:
    """Propagation of a tangent vector along runs (``codegen/lowering/control.py``).

    Attributes:
        partials: distinct derivatives at the points, on lanes: F_q, or -E_q and -E_v with the terms of the mass matrix.
        product: at u = (x, these) their product with x = dq, or (dq, dq'), on lanes.
        of_velocities: true if accelerations depend on velocities.
        part_of_tolerance: error of an adaptive step in units of its tolerance.
        knots: number of times in a step at which the tangent vector is evaluated.
        tables: from values at the points to those at the knots, from accelerations there to tangent vectors, and to
            Taylor's coefficients at the end of a step, with columns that fill vectors of any length.
    """

    partials: Kernel
    product: Kernel
    of_velocities: bool
    part_of_tolerance: float
    knots: int
    tables: tuple[IterationTable, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptivePredictor:
    """Predictor tables of the fixed-point iteration for varying step sizes, and the growth of the error estimate.

    Attributes:
        reach: largest change of level between successive steps.
        alone: by the change into the next step, -reach .. reach: from the last step to the next.
        last, before: by the changes into the last step and into the next: from these two steps.
        inside: by the number of levels, from 1 on: from a step to a shorter one that begins with it.
        growth: factor of the error estimate per level.
    """

    reach: int
    alone: tuple[NumberTable, ...]
    last: tuple[tuple[NumberTable, ...], ...]
    before: tuple[tuple[NumberTable, ...], ...]
    inside: tuple[NumberTable, ...]
    growth: float
