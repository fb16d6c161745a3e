"""The intermediate representation: a program is kernels, tables and loops, C without syntax. It prints itself.

A kernel is straight-line arithmetic over ``u[i]`` (its arguments), ``t`` and ``parameters[i]``: temporaries, each used
more than once, then results. Operations are ``+ - * / neg sqrt``, ``inverse_root_k`` (x^(-k/2)) and calls of elementary
functions; there are no branches, loops or integers. Numbers are exact and rounded when they are printed. Everything
around the kernels (gather, scatter, Newton, sweeps, the run) is a loop over tables, the same for every method and
system, and stands in the templates.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.constraints import Constraints, Rattle
from scvi_codegen.ir.families import Family
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number, NumberTable
from scvi_codegen.ir.sweep import Sweep
from scvi_codegen.ir.sweeps import Splitting

__all__ = ["FEW_UNKNOWNS", "Integrals", "MomentumMap", "Program"]

WORTH_REMEMBERING = 32
"""Unknowns from which on factors of the Newton matrix go from step to step. With 16 (Kepler's problem, degree 8) new
ones take as long as the additional iterations with old ones, with 34 twice as long, with 144 ten times."""

FEW_UNKNOWNS = 3
"""Up to so many, equations may be written out in place of loops over tables."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MomentumMap:
    """What a symmetry conserves, by name and formula; ``exact`` if the method is known to conserve it, too."""

    name: str
    formula: str
    exact: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Integrals:
    """Functions f that are integrated along a run, by the method's own quadrature: h sum_n weights[n] f(u_n) a step.

    Attributes:
        kernel: the functions, at the arguments of the points.
        weights: (g,) of the points.
    """

    kernel: Kernel
    weights: tuple[Number, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCurve:
    """Of the unknowns of a coordinate, what its curve bends and what it leaves unresolved; tables of (B,) numbers.

    Attributes:
        highest, next: h times this sum is what the highest Legendre coefficient of the accelerations moves it by, and
            the one below, if there is one.
        bends: h times the absolute sums of these is what the curve bends it by.
        power: of h in the square of the one over the other.
    """

    highest: tuple[Number, ...]
    next: tuple[Number, ...]
    bends: tuple[tuple[Number, ...], tuple[Number, ...]]
    power: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """All of an integrator but its syntax.

    Attributes:
        prefix: C identifier that begins every exported name.
        title: one line, the system and the method.
        notes: lines for the header's comment: order, symmetry, symplecticity.
        coordinate_names, parameter_names, parameter_defaults: for people and for Python.
        sites: the coordinates, then the components of unknowns of other sizes.
        blocks: number of unknowns B at each site.
        families: points and kernels of the equations that Newton's iteration solves; none without it.
        places: (sites,) the place of each site in matrices, chosen so that those that meet are near each other.
        mass_places: (m,) the same of coordinates alone.
        bandwidth: how many places they are apart at most.
        momentum_rows: (B,) coefficient of p0 in each row.
        end_position: (B,) weights of q1 = q0 + h sum_b beta_b z_b.
        straight: (B,) 1 where the straight-line guess of a block is v0, 0 where it is not.
        momentum_blocks: (B,) 1 where that guess is p0.
        moving_blocks: (B,) 1 where h times the block is a length; convergence is judged by these.
        extrapolation: (B, B) guess for the next step, sum_c table[c][b] z_c; below it the same for multipliers, if any.
        legendre: p and dp/dv at (q, v); where a Hamiltonian is given, v and dv/dp at (q, p).
        mass_entries: (i, j) of the slopes of ``legendre``.
        energy: L at (q, v), from which and ``legendre`` follows the energy; where a Hamiltonian is given, H at (q, p).
        hamiltonian: whether a Hamiltonian is given.
        momentum_maps: what is conserved.
        momentum_kernel: their values at (q, p), then the sums of the squares of their terms; ``None`` without any.
        sweep: the fixed-point iteration tried first, or ``None`` for Newton's alone.
        splitting: the explicit sequence that replaces both, or ``None``.
        newton: whether Newton's iteration is there at all.
        acts: whether the equations are those of a discrete Lagrangian, which Newton's iteration gives.
        order: of the method; where none is claimed, the number of its points.
        polynomial_curves: whether the highest coefficient of a curve tells what it leaves unresolved.
        stage_curve: what tells how well the curve of the stages is resolved, or ``None``.
        numbers: the paper's, of equations for a few unknowns, and of those for q1 and p1; ``""`` where
            it has none.
        integrals: what is integrated along a run, or ``None``; the first is the time that passes.
        exchanges: names of what forces give: energy, and momentum maps; none without forces.
        constraints: what keeps the motion on them, or ``None``.
        damping: the rate of a uniform damping, if there is one.
        rattle: what is tried before Newton's iteration, where a step is one of RATTLE.
        inputs: the place of the first of the five parameters of each function of time that is data, by name.
    """

    prefix: str
    title: str
    notes: tuple[str, ...]
    coordinate_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    parameter_defaults: tuple[float, ...]
    sites: int
    blocks: int
    families: tuple[Family, ...]
    places: tuple[int, ...]
    mass_places: tuple[int, ...]
    bandwidth: int
    momentum_rows: tuple[Number, ...]
    end_position: tuple[Number, ...]
    straight: tuple[int, ...]
    momentum_blocks: tuple[int, ...]
    moving_blocks: tuple[int, ...]
    extrapolation: NumberTable
    legendre: Kernel
    mass_entries: tuple[tuple[int, int], ...]
    energy: Kernel
    hamiltonian: bool
    momentum_maps: tuple[MomentumMap, ...]
    momentum_kernel: Kernel | None
    sweep: Sweep | None
    splitting: Splitting | None
    newton: bool
    acts: bool
    order: int
    polynomial_curves: bool
    stage_curve: StageCurve | None
    numbers: tuple[str, str, str]
    integrals: Integrals | None = None
    exchanges: tuple[str, ...] = ()
    constraints: Constraints | None = None
    inputs: tuple[tuple[str, int], ...] = ()
    damping: Kernel | None = None
    rattle: Rattle | None = None

    @property
    def dimension(self) -> int:
        """Degrees of freedom m."""
        return len(self.coordinate_names)

    @property
    def unknowns(self) -> int:
        """B numbers a site."""
        return self.blocks * self.sites

    @property
    def error_power(self) -> int:
        """Of h in what a run keeps of the error of its curves; 0 where there is none."""
        if not self.polynomial_curves:
            return 0
        if self.sweep:
            return self.sweep.error_power
        return self.stage_curve.power if self.stage_curve else 0

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Every kernel, in the order of emission."""
        pairs = [kernel for family in self.families for kernel in (family.value, family.slope)] if self.newton else []
        along = [family.integrand for family in self.families if self.newton and family.integrand]
        sums = {kernel.name: kernel for kernel in along}
        maps = (self.momentum_kernel,) if self.momentum_kernel else ()
        integrands = (self.integrals.kernel,) if self.integrals else ()
        bound: tuple[Kernel, ...] = (self.constraints.kernel, self.constraints.motion) if self.constraints else ()
        bound += (self.damping,) if self.damping else ()
        bound += (self.rattle.force, self.rattle.mass) if self.rattle else ()
        return (*pairs, self.legendre, *({self.energy.name: self.energy} | sums).values(), *maps, *integrands, *bound)

    @property
    def held_places(self) -> tuple[int, ...]:
        """The place of each constraint among them, in the order of the sites."""
        own = self.places[self.dimension :]
        return tuple(sorted(own).index(place) for place in own)

    @property
    def held_reach(self) -> int:
        """How far constraints that meet are apart at most, each in its place."""
        places = self.held_places
        return max(abs(places[k] - places[j]) for k, j in self.rattle.entries) if self.rattle else 0

    @property
    def action(self) -> bool:
        """Whether there is a discrete Lagrangian."""
        if self.splitting:
            return self.splitting.acts
        return self.newton and self.acts

    @property
    def sums(self) -> int:
        """How many numbers are summed along a curve that Newton's iteration gives: the action, or the exchanges."""
        if not self.newton:
            return 0
        return len(self.exchanges) if self.exchanges else int(self.action)

    @property
    def memory(self) -> int:
        """Numbers a run remembers of its last step to guess the next."""
        if self.splitting:
            return self.dimension
        points = self.sweep.memory(self.dimension) if self.sweep else 0
        return max(points, self.unknowns + self.point if self.newton else 0)

    @property
    def remembers_factors(self) -> bool:
        """Whether Newton's iteration begins a step with the factors of the one before: not if new ones cost little.

        Nor with constraints, whose slopes turn with the motion: old factors then contract tenfold an iteration.
        """
        worth = self.unknowns >= WORTH_REMEMBERING and not self.constraints
        return self.newton and not self.splitting and worth

    @property
    def point(self) -> int:
        """Numbers that say where the factors were made: time, q0 with what rounding cut off, unknowns."""
        return 1 + 2 * self.dimension + self.unknowns if self.remembers_factors else 0

    def matrix_size(self, sites: int, blocks: int) -> int:
        """Numbers of a matrix with ``blocks`` unknowns a site: its band with room for fill-in, or all of it."""
        rows, reach = sites * blocks, (self.bandwidth + 1) * blocks - 1
        return rows * min(rows, 3 * reach + 1)

    def __str__(self) -> str:
        """Readable text of the whole program."""
        head = [
            f"program {self.prefix}: {self.title}",
            f"  {self.blocks} blocks of {self.sites} unknowns, bandwidth {self.bandwidth}",
        ]
        for family in self.families:
            head.append(f"  family {family.name}: {family.points} points")
            head += [
                f"    gather  {loop.name}: {'q0 + ' * loop.from_state}h^{loop.power} sum_b {loop.name}[n][b] z[b]"
                for loop in family.gathers
            ]
            head += [f"    scatter {loop.name}: w[n] h^{loop.power} {loop.name}[n][r]" for loop in family.scatters]
        return "\n".join([*head, *(str(kernel) for kernel in self.kernels)])
