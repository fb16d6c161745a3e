"""Axially symmetric bodies: the spin about the axis of symmetry, integrated exactly.

A body with moments of inertia A = B about two axes and C about the third, e_k, in a potential that does not change if
it turns about e_k, conserves its angular momentum Pi_k about that axis. With kappa = 1/C - 1/A

    H = H_0 + kappa Pi_k^2/2,    {H_0, Pi_k} = 0,

the flow of H is that of H_0, of a body with three equal moments, followed by that of kappa Pi_k^2/2, the turn

    q <- q exp(kappa h Pi_k e_k/2),    p <- p exp(kappa h Pi_k e_k/2)    (products of quaternions)

in any order, as {H_0, Pi_k^2} = 0 (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. III.5.1). A step
applies the method to H_0, and then the turn. Methods commute with turns about e_k, which are linear and symplectic: the
step is symplectic, symmetric and of the order of the method. Its size is limited by the motion of H_0 alone.

If H_0 = T + V(q) is the energy of nothing but such bodies, the method is applied in their moving frame (the interaction
picture). With the flow Phi_t of T, q <- q exp(t Pi/(2A)), p <- p exp(t Pi/(2A)), the canonical transformation

    z = Phi_tau(Z),    tau = t - t0 - h/2,    K(Z, tau) = V(Phi_tau(Z)) = W(Q, tau P)

leaves the Hamiltonian K, since T is constant along its flow. A step is Phi_h/2, a step of the method for K, Phi_h/2 and
the turn: symplectic, symmetric, of the order of the method, and exact without V. Its fixed-point iteration contracts
with h^2 V'' in place of h |Pi|/(2A).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

from sympy import Add, Expr, Quaternion, S, cos, expand, sin
from sympy.core.function import AppliedUndef

from scvi_codegen.systems.formulas.expressions import sums_to_zero
from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.rotations import Rotation
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.splittings.kinetic import exponential
from scvi_codegen.systems.system import MechanicalSystem


@dataclass(frozen=True, slots=True)
class Turn:
    """Turn about a body axis of the quaternion that begins at coordinate ``first``; ``rate`` is 1/A."""

    first: int
    axis: int
    kappa: Expr
    rate: Expr

    @property
    def description(self) -> str:
        """Definition in one line."""
        k = self.axis + 1
        turn = f"q, p <- q, p exp(kappa h Pi_{k} e_{k}/2) after a step of H - kappa Pi_{k}^2/2"
        return f"axis of symmetry e_{k}: {turn}, kappa = {self.kappa}"

    def change(self, x: Sequence[Expr], rotation: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return x (g - 1) for the quaternion in x and the four components of g - 1; 0 for the other entries."""
        turned = (Quaternion(*x[self.first : self.first + 4]) * Quaternion(*rotation)).args
        return (*(S.Zero,) * self.first, *turned, *(S.Zero,) * (len(x) - self.first - 4))

    def momentum(self, q: Sequence[Expr], p: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return Pi = Im(conj(q) p)/2."""
        quaternion = slice(self.first, self.first + 4)
        return tuple(x / 2 for x in (Quaternion(*q[quaternion]).conjugate() * Quaternion(*p[quaternion])).args[1:])

    def rotation(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return exp(a e_k) - 1, a = kappa h Pi_k/2, where u = h p."""
        half = self.kappa * self.momentum(q, u)[self.axis] / 4
        along = (2 * sin(half) * cos(half) if k == self.axis else S.Zero for k in range(3))
        return (-2 * sin(half) ** 2, *along)

    def free_rotation(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return exp(h Pi/(4A)) - 1, that of the free rotation during h/2, where u = h p."""
        g = exponential([intermediate(self.rate * x / 4) for x in self.momentum(q, u)])
        return (g.a - 1, g.b, g.c, g.d)

    def action(self, rotation: Callable[..., tuple[Expr, ...]], q: Sequence[Expr], u: Sequence[Expr]) -> Expr:
        """Return h times the action of a rotation, the integral of p . v - T = T: kappa Pi_k^2/2, or |Pi|^2/(2A)."""
        momentum = self.momentum(q, u)
        if rotation is Turn.rotation:
            return self.kappa * momentum[self.axis] ** 2 / 2
        return self.rate * Add(*(x**2 for x in momentum)) / 4

    def is_symmetry(self, system: HamiltonianSystem) -> bool:
        """Return whether H does not change along (q e_k, p e_k), at random states, so that Pi_k is conserved."""
        variables = (*system.coordinates, *system.momenta)
        axis = [S(int(k == self.axis + 1)) for k in range(4)]
        along = (*self.change(system.coordinates, axis), *self.change(system.momenta, axis))
        rates = [system.hamiltonian.diff(x) * y for x, y in zip(variables, along, strict=True)]
        return sums_to_zero(rates)


@lru_cache(maxsize=64)
def axial_turns(system: MechanicalSystem) -> tuple[MechanicalSystem, tuple[Turn, ...]]:
    """Return the system with H_0 and the turns that complete its steps; the system itself if no body has an axis."""
    if not isinstance(system, HamiltonianSystem) or not (turns := tuple(sorted(_turns(system), key=lambda x: x.first))):
        return system, ()
    spin = (turn.kappa * turn.momentum(system.coordinates, system.momenta)[turn.axis] ** 2 / 2 for turn in turns)
    removed = (-expand(energy, power_base=False, multinomial=False) for energy in spin)
    return replace(system, hamiltonian=Add(system.hamiltonian, *removed)), turns


@lru_cache(maxsize=64)
def frame_potential(system: MechanicalSystem) -> Expr | None:
    """Return V if H_0 = T + V(q) of symmetric bodies alone; else ``None``."""
    core, turns = axial_turns(system)
    if not isinstance(core, HamiltonianSystem) or 4 * len(turns) != core.dimension:
        return None
    q, p = core.coordinates, core.momenta
    potential: Expr = core.hamiltonian.xreplace(dict.fromkeys(p, S.Zero))
    energies = (-turn.rate * x**2 / 2 for turn in turns for x in turn.momentum(q, p))
    alone = sums_to_zero([core.hamiltonian, -potential, *energies])
    return potential if alone else None


def rotated(
    turns: Sequence[Turn], q: Sequence[Expr], u: Sequence[Expr], *rotations: Callable[..., tuple[Expr, ...]]
) -> tuple[tuple[Expr, ...], ...]:
    """Return the changes of q and u by rotations in turn, functions of a turn, q and u = h p."""
    changes: tuple[tuple[Expr, ...], ...] = ((S.Zero,) * len(q),) * 2
    for turn, rotation in product(turns, rotations):
        g = tuple(map(intermediate, rotation(turn, q, u)))
        now = [tuple(map(Add, x, change)) for x, change in zip((q, u), changes, strict=True)]
        changes = tuple(tuple(map(Add, d, turn.change(x, g))) for x, d in zip(now, changes, strict=True))
    return changes


def _turns(system: HamiltonianSystem) -> Iterator[Turn]:
    """Yield the turns of bodies with two equal moments of inertia, about the axis of the third."""
    bound = system.damping != 0 or any(system.forces) or system.clock or system.arrays
    if bound or system.hamiltonian.atoms(AppliedUndef):
        return
    for member in system.rotations:
        if not isinstance(member, Rotation):
            continue
        first = system.coordinates.index(symbol(member.coordinates[0]))
        p = system.momenta[first + 1 : first + 4]
        upright = dict(zip(system.coordinates[first : first + 4], (S.One, *(S.Zero,) * 3), strict=True))
        inverse = [expand(4 * system.hamiltonian.xreplace(upright).diff(x, 2)) for x in p]
        for axis in range(3):
            transverse, other = (inverse[i] for i in range(3) if i != axis)
            turn = Turn(first, axis, expand(inverse[axis] - transverse), transverse)
            constant = turn.kappa != 0 and turn.kappa.free_symbols <= set(system.parameters)
            if transverse == other and constant and turn.is_symmetry(system):
                yield turn
