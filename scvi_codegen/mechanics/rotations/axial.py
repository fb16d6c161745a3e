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

leaves the Hamiltonian K, since T is constant along its own flow. A step is Phi_h/2, a step of the method for K, Phi_h/2,
and the turn: symplectic, symmetric, of the order of the method, and exact without V. Its fixed-point iteration contracts
with h^2 V'' in place of h |Pi|/(2A).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from sympy import Add, Expr, Quaternion, S, cos, expand, sin, sqrt
from sympy.core.function import AppliedUndef

from scvi_codegen.formulas.expressions import gradient_tuple
from scvi_codegen.formulas.intermediates import intermediate
from scvi_codegen.formulas.rotations.members import Rotation
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.mechanics.arrays.symmetry import sums_to_zero
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.system import MechanicalSystem


SMALLEST = S(10) ** -40
"""Added to the square of an angle, so that sin(x)/x and its derivative have values at 0."""


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
        product = (Quaternion(*x[self.first : self.first + 4]) * Quaternion(*rotation)).args
        return (*(S.Zero,) * self.first, *product, *(S.Zero,) * (len(x) - self.first - 4))

    def momentum(self, q: Sequence[Expr], p: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return Pi = Im(conj(q) p)/2."""
        own = slice(self.first, self.first + 4)
        return tuple(x / 2 for x in (Quaternion(*q[own]).conjugate() * Quaternion(*p[own])).args[1:])

    def rotation(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return exp(a e_k) - 1, a = kappa h Pi_k/2, where u = h p."""
        half = self.kappa * self.momentum(q, u)[self.axis] / 4
        along = (2 * sin(half) * cos(half) if k == self.axis else S.Zero for k in range(3))
        return (-2 * sin(half) ** 2, *along)

    def half_rotation(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return m = h Pi/(4A) of the free rotation exp(m) during h/2, where u = h p."""
        return tuple(self.rate * x / 4 for x in self.momentum(q, u))

    def changes(self, q: Sequence[Expr], u: Sequence[Expr], *, free: bool, turned: bool) -> list[tuple[Expr, ...]]:
        """Return the changes of q and u = h p by the free rotation during h/2, and then by the turn."""
        m = [intermediate(x) for x in self.half_rotation(q, u)]
        sine, less, _ = _functions(_dot(m, m))
        rotations = [(less, *(sine * x for x in m))] * free + [self.rotation(q, u)] * turned
        changes = []
        for x in (q, u):
            moved = tuple(x)
            for g in rotations:
                moved = tuple(map(intermediate, map(Add, moved, self.change(moved, tuple(map(intermediate, g))))))
            changes.append(tuple(a - b for a, b in zip(moved, x, strict=True)))
        return changes

    def is_symmetry(self, system: HamiltonianSystem) -> bool:
        """Return whether H does not change along (q e_k, p e_k), at random states, so that Pi_k is conserved."""
        variables = (*system.coordinates, *system.momenta)
        axis = [S(int(k == self.axis + 1)) for k in range(4)]
        along = (*self.change(system.coordinates, axis), *self.change(system.momenta, axis))
        rates = [system.hamiltonian.diff(x) * y for x, y in zip(variables, along, strict=True)]
        return sums_to_zero(rates, (*variables, *system.parameters, system.time))


@lru_cache(maxsize=64)
def axial_turns(system: MechanicalSystem) -> tuple[MechanicalSystem, tuple[Turn, ...]]:
    """Return the system with H_0 and the turns that complete its steps; the system itself if no body has an axis."""
    if not isinstance(system, HamiltonianSystem) or not (turns := tuple(sorted(_turns(system), key=lambda x: x.first))):
        return system, ()
    spin = (turn.kappa * turn.momentum(system.coordinates, system.momenta)[turn.axis] ** 2 / 2 for turn in turns)
    removed = (-expand(each, power_base=False, multinomial=False) for each in spin)
    return replace(system, hamiltonian=Add(system.hamiltonian, *removed)), turns


class Frame:
    """Free rotation of a quaternion, Q <- C Q + S b, by the momentum u = tau P, and a gradient in the moving frame.

    With v = u/(4A), b = |Q|^2 v - (Q . v) Q and y = |Q|^2 |v|^2 - (Q . v)^2, the functions are C = cos(sqrt(y)),
    S = sin(sqrt(y))/sqrt(y) and D = (C - S)/y, so that dC/dy = -S/2 and dS/dy = D/2.

    Args:
        turn: the body.
        q, u: positions and momenta of the system.
        functions: symbols of S, C - 1 and D, or nothing.
    """

    def __init__(self, turn: Turn, q: Sequence[Expr], u: Sequence[Expr], functions: Sequence[Expr] = ()) -> None:
        self.first, self.scale, self.q = turn.first, turn.rate / 4, q[turn.first : turn.first + 4]
        self.v = [intermediate(self.scale * x) for x in u[turn.first : turn.first + 4]]
        self.norm, self.along, self.square = _dot(self.q, self.q), _dot(self.q, self.v), _dot(self.v, self.v)
        self.y = intermediate(self.norm * self.square - self.along**2)
        self.b = [intermediate(self.norm * y - self.along * x) for x, y in zip(self.q, self.v, strict=True)]
        self.S, self.less, self.D = functions or _functions(self.y)
        self.moved = [intermediate(x + self.less * x + self.S * b) for x, b in zip(self.q, self.b, strict=True)]

    def rates(self, g: Sequence[Expr]) -> tuple[list[Expr], list[Expr]]:
        """Return W_u and -W_Q from the gradient g = V_q at the rotated quaternion."""
        qg, vg = _dot(self.q, g), _dot(self.v, g)
        by_y = intermediate(self.D * (self.norm * vg - self.along * qg) - self.S * qg)
        sqg, sn = intermediate(self.S * qg), intermediate(self.S * self.norm)
        by_g, by_q = intermediate(1 + self.less - self.S * self.along), intermediate(2 * self.S * vg + by_y * self.square)
        by_v, parts = intermediate(sqg + by_y * self.along), list(zip(g, self.q, self.v, self.b, strict=True))
        velocity = [self.scale * (sn * x - sqg * q + by_y * b) for x, q, _, b in parts]
        return velocity, [by_v * v - by_g * x - by_q * q for x, q, v, _ in parts]


def _functions(y: Expr) -> tuple[Expr, ...]:
    """Return S, C - 1 and D at y."""
    angle = intermediate(sqrt(y + SMALLEST))
    sine, less = intermediate(sin(angle) / angle), intermediate(-2 * sin(angle / 2) ** 2)
    return sine, less, intermediate((1 + less - sine) / angle**2)


def _dot(x: Sequence[Expr], y: Sequence[Expr]) -> Expr:
    return intermediate(Add(*(a * b for a, b in zip(x, y, strict=True))))


@lru_cache(maxsize=64)
def moving_frame(system: MechanicalSystem, functions: tuple[Expr, ...] = ()) -> tuple[Expr, ...]:
    """Return W_u and -W_Q, with the symbols of p for u; nothing if H_0 is not T + V(q), of symmetric bodies alone."""
    core, turns = axial_turns(system)
    if not isinstance(core, HamiltonianSystem) or 4 * len(turns) != core.dimension:
        return ()
    q, p = core.coordinates, core.momenta
    potential = core.hamiltonian.xreplace(dict.fromkeys(p, S.Zero))
    frames = [Frame(turn, q, p, functions[3 * k : 3 * k + 3]) for k, turn in enumerate(turns)]
    energies = (-x.y / (2 * x.scale) for x in frames)
    if not sums_to_zero([core.hamiltonian, -potential, *energies], (*q, *p, *core.parameters, core.time)):
        return ()
    moved: dict[Expr, Expr] = {Add(*(x**2 for x in each.q)): each.norm for each in frames}
    for each in frames:
        moved |= zip(each.q, each.moved, strict=True)
    g = [intermediate(x.xreplace(moved)) for x in gradient_tuple(potential, q)]
    rates = [each.rates(g[each.first : each.first + 4]) for each in frames]
    return tuple(x for part in zip(*rates, strict=True) for each in part for x in each)


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
            turn = Turn(first, axis, expand(inverse[axis] - one), one)
            constant = turn.kappa != 0 and turn.kappa.free_symbols <= set(system.parameters)
            if one == other and constant and turn.is_symmetry(system):
                yield turn
