"""Axially symmetric bodies: the spin about the axis of symmetry, integrated exactly.

A body with moments of inertia A = B about two axes and C about the third, e_k, in a potential that does not change if
it turns about e_k, conserves its angular momentum Pi_k about that axis. With kappa = 1/C - 1/A

    H = H_0 + kappa Pi_k^2/2,    {H_0, Pi_k} = 0,

the flow of H is that of H_0, of a body with three equal moments, followed by that of kappa Pi_k^2/2, the turn

    q <- q exp(kappa h Pi_k e_k/2),    p <- p exp(kappa h Pi_k e_k/2)    (products of quaternions)

in any order, as {H_0, Pi_k^2} = 0 (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. III.5.1). A step
applies the method to H_0, and then the turn. Methods commute with turns about e_k, which are linear and symplectic: the
step is symplectic, symmetric and of the order of the method. Its size is limited by the motion of H_0 alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from sympy import Add, Expr, S, cos, expand, sin
from sympy.core.function import AppliedUndef

from scvi_codegen.formulas.rotations.members import Rotation
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.mechanics.arrays.symmetry import sums_to_zero
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.system import MechanicalSystem


@dataclass(frozen=True, slots=True)
class Turn:
    """Turn about a body axis of the quaternion that begins at coordinate ``first``."""

    first: int
    axis: int
    kappa: Expr

    @property
    def description(self) -> str:
        """Definition in one line."""
        k = self.axis + 1
        turn = f"q, p <- q, p exp(kappa h Pi_{k} e_{k}/2) after a step of H - kappa Pi_{k}^2/2"
        return f"axis of symmetry e_{k}: {turn}, kappa = {self.kappa}"

    def _times_axis(self, x: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return the quaternion x e_k in place of x, and 0 for the other entries."""
        w, i, j, k = x[self.first : self.first + 4]
        product = ((-i, w, k, -j), (-j, -k, w, i), (-k, j, -i, w))[self.axis]
        return (*(S.Zero,) * self.first, *product, *(S.Zero,) * (len(x) - self.first - 4))

    def momentum(self, q: Sequence[Expr], p: Sequence[Expr]) -> Expr:
        """Return Pi_k = (q e_k) . p/2."""
        return Add(*(a * b for a, b in zip(self._times_axis(q), p, strict=True))) / 2

    def angle(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, Expr]:
        """Return cos a - 1 and sin a of a = kappa h Pi_k/2, where u = h p."""
        half = self.kappa * self.momentum(q, u) / 4
        return -2 * sin(half) ** 2, 2 * sin(half) * cos(half)

    def change(self, x: Sequence[Expr], angle: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return x exp(a e_k) - x for the quaternion in x, and 0 for the other entries."""
        own = (x[i] if self.first <= i < self.first + 4 else S.Zero for i in range(len(x)))
        return tuple(angle[0] * a + angle[1] * b for a, b in zip(own, self._times_axis(x), strict=True))

    def is_symmetry(self, system: HamiltonianSystem) -> bool:
        """Return whether H does not change along (q e_k, p e_k), at random states, so that Pi_k is conserved."""
        variables = (*system.coordinates, *system.momenta)
        along = (*self._times_axis(system.coordinates), *self._times_axis(system.momenta))
        rates = [system.hamiltonian.diff(x) * y for x, y in zip(variables, along, strict=True)]
        return sums_to_zero(rates, (*variables, *system.parameters, system.time))


@lru_cache(maxsize=64)
def axial_turns(system: MechanicalSystem) -> tuple[MechanicalSystem, tuple[Turn, ...]]:
    """Return the system with H_0 and the turns that complete its steps; the system itself if no body has an axis."""
    if not isinstance(system, HamiltonianSystem) or not (turns := tuple(_turns(system))):
        return system, ()
    spin = (turn.kappa * turn.momentum(system.coordinates, system.momenta) ** 2 / 2 for turn in turns)
    removed = (-expand(each, power_base=False, multinomial=False) for each in spin)
    return replace(system, hamiltonian=Add(system.hamiltonian, *removed)), turns


def _turns(system: HamiltonianSystem) -> Iterator[Turn]:
    bound = system.damping != 0 or any(system.forces) or system.clock or system.arrays
    if bound or system.hamiltonian.atoms(AppliedUndef):
        return
    for member in (each for each in system.rotations if isinstance(each, Rotation)):
        first = system.coordinates.index(symbol(member.coordinates[0]))
        p = system.momenta[first + 1 : first + 4]
        upright = dict(zip(system.coordinates[first : first + 4], (S.One, *(S.Zero,) * 3), strict=True))
        inverse = [expand(4 * system.hamiltonian.xreplace(upright).diff(x, 2)) for x in p]
        for axis in range(3):
            one, other = (inverse[i] for i in range(3) if i != axis)
            turn = Turn(first, axis, expand(inverse[axis] - one))
            constant = turn.kappa != 0 and turn.kappa.free_symbols <= set(system.parameters)
            if one == other and constant and turn.is_symmetry(system):
                yield turn
