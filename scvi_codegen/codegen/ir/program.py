"""The intermediate representation: a program consists of kernels, tables and loops.

A kernel is straight-line arithmetic over ``u[i]`` (its arguments), ``t`` and ``parameters[i]``: temporaries, each used
more than once, then results. Operations are ``+ - * / neg sqrt``, ``inverse_root_k`` (x^(-k/2)) and calls of elementary
functions; there are no branches, loops or integers. Numbers are exact and rounded when they are printed. The code
around the kernels (gather, scatter, Newton's method, fixed-point iterations, the run) consists of loops over tables,
the same for every method and system, and is in the templates.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from scvi_codegen.codegen.ir.equations import (
    NO_CONSTRAINTS,
    NO_RATTLE,
    ConstrainedSteps,
    Constraints,
    FixedPointIteration,
    LoweredStageGroup,
    Rattle,
    ShiftTables,
    Splitting,
)
from scvi_codegen.codegen.ir.kernel import Kernel, Number, NumberTable, RolledKernel, is_divided
from scvi_codegen.codegen.ir.variants import Sums
from scvi_codegen.systems.formulas.indices import Array, ArrayDeclarations, ArrayMap, Convolution

LEAST_REUSED_UNKNOWNS = 32
"""Number of unknowns from which on factors of the Newton matrix are reused in later steps.

New factors cost as much as the additional iterations with old ones at 16 unknowns (Kepler problem, degree 8), twice as
much at 34, ten times at 144.
"""

FEW_UNKNOWNS = 3
"""Largest number of unknowns whose equations may be unrolled instead of loops over tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentumMap:
    """A first integral from a symmetry, by name and formula; ``exact`` if the method is known to conserve it, too."""

    name: str
    formula: str
    exact: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Integrals:
    """Functions f that are integrated along a run, by the method's own quadrature: h sum_n weights[n] f(u_n) a step."""

    kernel: Kernel
    weights: tuple[Number, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCurve:
    """Error estimate from the unknowns of a coordinate: leading coefficient and curvature; tables of (B,) numbers.

    Attributes:
        highest, next: h times this sum is the displacement due to the leading Legendre coefficient of the
            accelerations, and to the next lower one, if any.
        curvatures: h times the absolute values of these sums is the displacement due to the curvature.
        power: exponent of h in the squared leading displacement over that of the curvature and the size, which is a
            displacement by the step, proportional to h; of one or two coefficients it is independent of h.
    """

    highest: tuple[Number, ...]
    next: tuple[Number, ...]
    curvatures: tuple[tuple[Number, ...], tuple[Number, ...]]
    power: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MassGrowth:
    """Growth of masses with time and by damping, for the error estimates of curves of velocities.

    Attributes:
        kernel: rates damping + d log M_ii/dt, m values, at u = (q, v), or (q, p) of a Hamiltonian.
        abscissae: of the velocities that a step stores, in units of the step.
    """

    kernel: Kernel
    abscissae: tuple[Number, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout(ArrayDeclarations):
    """Arrays and parameters of a system; a named coordinate is an array without axes.

    Attributes:
        velocities: on which forces depend, after the coordinates at the points.
        sums: convolutions of the state, coordinates, momenta or velocities.
        parameters, defaults: names and default values of the numbers.
        inputs: index of the first of the five parameters of each tabulated input, by name.
        whole: first and end of the named coordinates of each array of known sizes.
        coupled: the same of those whose neighbouring elements forces couple.
    """

    velocities: tuple[Array, ...] = ()
    sums: tuple[tuple[Convolution, ...], ...] = ()
    parameters: tuple[str, ...] = ()
    defaults: tuple[float, ...] = ()
    inputs: tuple[tuple[str, int], ...] = ()
    whole: tuple[tuple[int, int], ...] = ()
    coupled: tuple[tuple[int, int], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coordinates."""
        return tuple(array.name for array in self.coordinates)


@dataclass(frozen=True, slots=True, kw_only=True)
class StageEquations:
    """Unknowns and equations of a step of named coordinates, which Newton's method solves.

    Attributes:
        sites: the coordinates, then the components of unknowns of other sizes.
        blocks: number of unknowns B at each site.
        stage_groups: stage groups of the equations; none without Newton's method.
        places: (sites,) position of each site in matrices, in a bandwidth-reducing ordering.
        mass_positions: (m,) the same for the coordinates alone.
        bandwidth: largest distance of coupled sites in that ordering.
        momentum_rows: (B,) coefficient of p0 in each row.
        end_position: (B,) weights of q1 = q0 + h sum_b beta_b z_b.
        straight: (B,) 1 if the straight-line guess of a block is v0, else 0.
        momentum_blocks: (B,) 1 if that guess is p0.
        moving_blocks: (B,) 1 if h times the block is a displacement; convergence is tested with these.
        extrapolation: (B, B) predictor of the next step, sum_c table[c][b] z_c; below it the same for multipliers, if
            any.
        acts: whether the equations are those of a discrete Lagrangian, which Newton's method evaluates.
        stage_curve: error estimate from the unknowns, or ``None``.
        numbers: equation numbers of the paper for a few unknowns, and for q1 and p1; ``""`` if it has none.
    """

    sites: int = 0
    blocks: int = 0
    stage_groups: tuple[LoweredStageGroup, ...] = ()
    places: tuple[int, ...] = ()
    mass_positions: tuple[int, ...] = ()
    bandwidth: int = 0
    momentum_rows: tuple[Number, ...] = ()
    end_position: tuple[Number, ...] = ()
    straight: tuple[int, ...] = ()
    momentum_blocks: tuple[int, ...] = ()
    moving_blocks: tuple[int, ...] = ()
    extrapolation: NumberTable = ()
    acts: bool = False
    stage_curve: StageCurve | None = None
    numbers: tuple[str, str, str] = ("", "", "")

    @property
    def unknowns(self) -> int:
        """Number of unknowns: B per site."""
        return self.blocks * self.sites


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantities:
    """Functions of the state of named coordinates that a run evaluates or integrates.

    Attributes:
        legendre: p and dp/dv at (q, v); for a Hamiltonian, v and dv/dp at (q, p); ``None`` if the kernels of the
            fixed-point iteration determine both p and v.
        mass_entries: (i, j) of the derivatives of ``legendre``.
        inverse_legendre: v at (q, p) of a Lagrangian, if it has a formula.
        energy: L at (q, v), which with ``legendre`` gives the energy; without it L at (q, 0), and p v is twice the
            kinetic energy; for a Hamiltonian, H at (q, p).
        hamiltonian: whether the system is Hamiltonian.
        momentum_maps: first integrals from symmetries.
        momentum_kernel: their values at (q, p), then the sums of the squares of their terms; ``None`` if there are
            none.
        integrals: functions integrated along a run, or ``None``; the first one gives the time.
        first_order_rates: H_y at (q, y) of a first-order system, or ``None``: velocities solve theta_y^T q' = H_y,
            where ``legendre`` is theta(q, y).
        work_and_impulses: names of work and impulses of forces: of the energy, and momentum maps; none without forces.
        integrates: whether the method integrates functions along the curve of a step.
    """

    legendre: Kernel | None = None
    mass_entries: tuple[tuple[int, int], ...] = ()
    inverse_legendre: Kernel | None = None
    energy: Kernel | None = None
    hamiltonian: bool = False
    momentum_maps: tuple[MomentumMap, ...] = ()
    momentum_kernel: Kernel | None = None
    integrals: Integrals | None = None
    first_order_rates: Kernel | None = None
    work_and_impulses: tuple[str, ...] = ()
    integrates: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatBath:
    """Heat bath between steps.

    Attributes:
        temperature: kT as text.
        friction: names and formulas of its coefficients, which must not be negative.
        kernel: kT, m momenta at rest, entries of masses, friction and normals, and strengths of noise.
        constant: whether they are functions of parameters alone.
        blocks: coordinates that are coupled.
        sizes: numbers of the terms by their names in C.
        entries: block, row and column of the entries, by names.
    """

    temperature: str
    friction: tuple[tuple[str, str], ...]
    kernel: Kernel
    constant: bool
    blocks: tuple[tuple[int, ...], ...]
    sizes: Mapping[str, int]
    entries: Mapping[str, tuple[tuple[int, int, int], ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class RolledTerms:
    """Terms of a system of arrays, each in its loops.

    Attributes:
        forces, masses: of the equations of motion.
        frictions, heats: of a heat bath, coefficients R of velocities and kT m.
        constants: terms of L, or of -H, without coordinates and momenta, which the energy needs.
        constrained: constrained steps, instead of an iteration or a splitting.
        products, diagonals: the Jacobian of the forces times a direction, and its diagonal, if Newton's method replaces
            the fixed-point iteration.
        reach: largest distance of lattice places that these couple; 0 if none, or if distances are not constant.
        shifts: with Newton's method, the eigenvectors of the method's matrix (:class:`ShiftTables`).
        neighbours: lists of neighbours: name, number of components; a kernel of their periods (0: none), cutoff and
            skin, which writes to the first position.
        velocities, momenta: H_p in (q, p) and L_v in (q, v) of a Lagrangian that is integrated by its Hamiltonian,
            which write to the positions of their coordinates.
        maps: momentum maps.
        continued: whether the predictor extrapolates previous steps instead of reusing the forces at their end.
    """

    forces: tuple[RolledKernel, ...] = ()
    masses: tuple[RolledKernel, ...] = ()
    frictions: tuple[RolledKernel, ...] = ()
    heats: tuple[RolledKernel, ...] = ()
    constants: tuple[RolledKernel, ...] = ()
    constrained: ConstrainedSteps | None = None
    products: tuple[RolledKernel, ...] = ()
    diagonals: tuple[RolledKernel, ...] = ()
    reach: int = 0
    shifts: ShiftTables | None = None
    neighbours: tuple[tuple[str, int, RolledKernel], ...] = ()
    velocities: tuple[RolledKernel, ...] = ()
    momenta: tuple[RolledKernel, ...] = ()
    maps: tuple[ArrayMap, ...] = ()
    continued: bool = False

    @property
    def applied(self) -> tuple[RolledKernel, ...]:
        """Terms that are evaluated at the points of a step."""
        return (*self.forces, *self.products, *self.diagonals)


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """Intermediate representation of an integrator.

    Attributes:
        prefix: C identifier that begins every exported name.
        title: one line, the system and the method.
        notes: lines for the header's comment: order, symmetry, symplecticity.
        order: of the method; the number of its points if none is claimed.
        layout: arrays and parameters.
        fixed_point: the fixed-point iteration tried first, or ``None``.
        splitting: the explicit sequence that replaces iterations, or ``None``.
        newton: whether Newton's method for the stage equations is included.
        polynomial_curves: whether the leading coefficient of a curve is an error estimate.
        equations, quantities: of named coordinates.
        constraints: their kernels.
        rattle: the iteration for the multipliers, which is tried before Newton's method if applicable.
        damping: the rate of a uniform damping, if there is one.
        mass_growth: of masses relative to velocities; ``None`` if they are constant in time and not damped.
        has_unseen_growth: whether masses grow in steps of accelerations, whose error estimate does not see that.
        summed: whether the action is summed also where it is no function of both ends of a step.
        acts_along: whether runs sum the action of their steps.
        bath: heat bath before and after each step of a run, or ``None``.
    """

    prefix: str
    title: str
    notes: tuple[str, ...]
    order: int
    layout: Layout
    fixed_point: FixedPointIteration | None = None
    splitting: Splitting | None = None
    newton: bool = False
    polynomial_curves: bool = True
    equations: StageEquations = StageEquations()
    quantities: Quantities = Quantities()
    constraints: Constraints = NO_CONSTRAINTS
    rattle: Rattle = NO_RATTLE
    damping: Kernel | None = None
    mass_growth: MassGrowth | None = None
    has_unseen_growth: bool = False
    summed: bool = False
    acts_along: bool = False
    bath: HeatBath | None = None

    @property
    def dimension(self) -> int:
        """Degrees of freedom m of named coordinates."""
        return len(self.layout.coordinates)

    @property
    def momentum_maps(self) -> tuple[MomentumMap | ArrayMap, ...]:
        """First integrals from symmetries."""
        return self.quantities.momentum_maps

    @property
    def error_power(self) -> int:
        """Exponent of h in the recorded error estimate of a run; 0 if there is no estimate."""
        if not self.polynomial_curves:
            return 0
        if self.fixed_point:
            return self.fixed_point.error_power
        return self.equations.stage_curve.power if self.equations.stage_curve else 0

    @property
    def has_bath(self) -> bool:
        """Whether steps are those in a heat bath."""
        return bool(self.bath or (isinstance(self, ArrayProgram) and self.loops.heats))

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """All kernels, in the order of emission."""
        stage_groups, quantities = self.equations.stage_groups, self.quantities
        kernels = (
            *(kernel for group in stage_groups for kernel in (group.value, group.derivative)),
            *(
                quantities.legendre,
                quantities.energy,
                *(group.integrand for group in stage_groups if self.sums),
                quantities.momentum_kernel,
            ),
            *(quantities.first_order_rates, quantities.inverse_legendre),
            quantities.integrals and quantities.integrals.kernel,
            *self.constraints.kernels,
            self.damping,
            self.bath and self.bath.kernel,
            *self.rattle.kernels,
        )
        return tuple({kernel.name: kernel for kernel in kernels if kernel}.values())

    @property
    def has_full_masses(self) -> bool:
        """Whether steps are solved by iterations alone, with mass matrices that are not diagonal."""
        fixed_point = self.fixed_point
        return not self.newton and bool(fixed_point and fixed_point.mass_entries and not fixed_point.diagonal)

    @property
    def operations(self) -> int:
        """Number of operations of all kernels, of loops for each of their rows."""
        return sum(sum(kernel.operation_counts().values()) for kernel in self._of_steps)

    @property
    def operations_in_text(self) -> int:
        """Number of operations in the text of all kernels, of loops once."""
        functions = (replace(part, sums=()) for kernel in self._of_steps for part in kernel.functions)
        return sum(sum(part.operation_counts().values()) for part in functions)

    @property
    def _of_steps(self) -> tuple[Kernel, ...]:
        return (*self.kernels, *(self.fixed_point.kernels if self.fixed_point else ()))

    @property
    def masses_of_points(self) -> tuple[int, ...]:
        """Index of each entry of L_vv among those that the kernel of RATTLE computes; empty if its own is shorter."""
        legendre, lower = self.quantities.legendre, self.rattle.lower_masses
        if not (legendre and lower and is_divided([legendre])):
            return ()
        indices = {pair: e for e, (i, j) in enumerate(lower) for pair in ((i, j), (j, i))}
        return tuple(indices[pair] for pair in self.quantities.mass_entries)

    @property
    def constraint_positions(self) -> tuple[int, ...]:
        """Position of each constraint among the constraints, in the order of the sites."""
        extra = self.equations.places[self.dimension :]
        return tuple(sorted(extra).index(place) for place in extra)

    @property
    def constraint_products(self) -> tuple[tuple[int, int, int, int, int], ...]:
        """Products of derivatives e, f of constraints and an entry of M^-1: e, f, row, distance, entry.

        They are terms of the entries of G M^-1 G^T at this distance below the diagonal, in the order of the positions.
        """
        indices = {pair: n for n, (i, j) in enumerate(self.rattle.inverse_masses) for pair in ((i, j), (j, i))}
        places = [(self.constraint_positions[k], i) for k, i in self.constraints.entries]
        return tuple(
            (e, f, row, row - column, indices[i, j])
            for e, (row, i) in enumerate(places)
            for f, (column, j) in enumerate(places)
            if (i, j) in indices and row >= column
        )

    @property
    def constraint_reach(self) -> int:
        """Largest distance of coupled constraints in this order."""
        return max((distance for _, _, _, distance, _ in self.constraint_products), default=0)

    @property
    def mass_reach(self) -> int:
        """Largest distance of coordinates that a mass matrix of points couples, in the order of their positions."""
        order, entries = self.equations.mass_positions, self.rattle.lower_masses
        return max((abs(order[i] - order[j]) for i, j in entries), default=0)

    @property
    def action(self) -> bool:
        """True if there is a discrete Lagrangian."""
        if self.splitting:
            return self.splitting.acts
        return self.newton and self.equations.acts

    @property
    def sums(self) -> int:
        """Number of sums along a curve of Newton's method: work and impulses of forces, then the action."""
        forced = self.quantities.work_and_impulses
        if not (self.newton and (forced or self.action or self.summed)):
            return 0
        return len(forced) + 1 if any(group.integrand for group in self.equations.stage_groups) else 0

    @property
    def between(self) -> bool:
        """True if the step between two positions is solved: its momenta are functions of these."""
        return self.sums > 0 and self.equations.sites == self.dimension and not self.quantities.first_order_rates

    @property
    def memory(self) -> int:
        """Numbers that a run stores of its last steps to predict the next."""
        if self.splitting:
            inputs = 5 * len(self.layout.inputs) * self.splitting.driven
            return self.dimension + 2 * self.acts_along + inputs
        points = self.dimension * self.fixed_point.stored if self.fixed_point else 0
        if self.acts_along and self.fixed_point and self.fixed_point.name == "shooting":
            points += 1
        return max(points, self.equations.unknowns + self.point if self.newton else 0)

    @property
    def reuses_factors(self) -> bool:
        """True if Newton's method starts a step with the factors of the previous one: not if new ones cost little.

        Nor with constraints, whose derivatives rotate with the motion: old factors then reduce the residual only
        tenfold per iteration.
        """
        worth = self.equations.unknowns >= LEAST_REUSED_UNKNOWNS and not self.constraints
        return self.newton and not self.splitting and worth

    @property
    def point(self) -> int:
        """Numbers that describe where the factors were computed: time, q0 with its compensation, unknowns."""
        return 1 + 2 * self.dimension + self.equations.unknowns if self.reuses_factors else 0

    def matrix_size(self, sites: int, blocks: int) -> int:
        """Return the size of a matrix with ``blocks`` unknowns per site: its band with fill-in, or all of it."""
        rows, reach = sites * blocks, (self.equations.bandwidth + 1) * blocks - 1
        return rows * min(rows, 3 * reach + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayProgram(Program):
    """Integrator of a system of arrays of run-time sizes; its fixed-point iteration, of one coordinate, serves all.

    Attributes:
        loops: the terms of the system.
        increments: how those of explicit steps are added.
    """

    loops: RolledTerms
    increments: Sums = "compensated"

    @property
    def momentum_maps(self) -> tuple[MomentumMap | ArrayMap, ...]:
        """First integrals from symmetries."""
        return self.loops.maps

    @property
    def action(self) -> bool:
        """False: there are no discrete Lagrangians of arrays."""
        return False
