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

    z = Phi_tau(Z),    tau = t - t0 - h/2,    K(Z, tau) = V(Phi_tau(Z))

leaves the Hamiltonian K, as T is constant along its own flow. A step is Phi_h/2, a step of the method for K, and Phi_h/2:
symplectic, symmetric and of the order of the method. Its equations contain no rotation but that by V: their fixed-point
iteration contracts with h^2 V'' in place of h |Pi|/(2A), and the error vanishes with V. V depends on positions only, and
these on Q and u = tau P: K = W(Q, u), K_P = tau W_u.
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
    """Turn about a body axis of the quaternion that begins at coordinate ``first``; ``rate`` is 1/A.

    Rotations are given as g - 1, by four components, of a unit quaternion g that multiplies q and p from the right.
    """

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
        """Return x (g - 1) for the quaternion in x, and 0 for the other entries."""
        product = _product(x[self.first : self.first + 4], rotation)
        return (*(S.Zero,) * self.first, *product, *(S.Zero,) * (len(x) - self.first - 4))

    def momenta(self, q: Sequence[Expr], p: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return Pi = Im(conj(q) p)/2."""
        w, *v = q[self.first : self.first + 4]
        return tuple(x / 2 for x in _product((w, *(-x for x in v)), p[self.first : self.first + 4])[1:])

    def rotation(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return exp(kappa h Pi_k e_k/2) - 1, where u = h p."""
        half = self.kappa * self.momenta(q, u)[self.axis] / 4
        parts = [-2 * sin(half) ** 2, *(S.Zero,) * 3]
        parts[1 + self.axis] = 2 * sin(half) * cos(half)
        return tuple(parts)

    def free_rotation(self, q: Sequence[Expr], u: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return exp(h Pi/(2A)) - 1, where u = h p."""
        half = [intermediate(self.rate * each / 4) for each in self.momenta(q, u)]
        angle = intermediate(sqrt(Add(SMALLEST, *(x**2 for x in half))))
        sine = intermediate(sin(angle))
        return -2 * sine**2, *(2 * intermediate(sine * cos(angle) / angle) * x for x in half)

    def is_symmetry(self, system: HamiltonianSystem) -> bool:
        """Return whether H does not change along (q e_k, p e_k), at random states, so that Pi_k is conserved."""
        variables = (*system.coordinates, *system.momenta)
        axis = tuple(S(int(k == 1 + self.axis)) for k in range(4))
        along = (*self.change(system.coordinates, axis), *self.change(system.momenta, axis))
        rates = [system.hamiltonian.diff(x) * y for x, y in zip(variables, along, strict=True)]
        return sums_to_zero(rates, (*variables, *system.parameters, system.time))


def _product(x: Sequence[Expr], y: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return the product of two quaternions."""
    return tuple((Quaternion(*x) * Quaternion(*y)).args)


def joined(one: Sequence[Expr], other: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return f g - 1 from f - 1 and g - 1."""
    one, other = (tuple(map(intermediate, each)) for each in (one, other))
    return tuple(map(Add, one, other, _product(one, other)))


@lru_cache(maxsize=64)
def axial_turns(system: MechanicalSystem) -> tuple[MechanicalSystem, tuple[Turn, ...]]:
    """Return the system with H_0 and the turns that complete its steps; the system itself if no body has an axis."""
    if not isinstance(system, HamiltonianSystem) or not (turns := tuple(_turns(system))):
        return system, ()
    q, p = system.coordinates, system.momenta
    spin = (turn.kappa * turn.momenta(q, p)[turn.axis] ** 2 / 2 for turn in turns)
    removed = (-expand(each, power_base=False, multinomial=False) for each in spin)
    return replace(system, hamiltonian=Add(system.hamiltonian, *removed)), turns


@lru_cache(maxsize=64)
def rates_in_frame(system: MechanicalSystem) -> tuple[tuple[Expr, ...], tuple[Expr, ...]] | None:
    """Return W_u and -W_Q, with the symbols of q and p for Q and u; ``None`` if H_0 is not T + V(q)."""
    core, turns = axial_turns(system)
    if not isinstance(core, HamiltonianSystem) or 4 * len(turns) != core.dimension:
        return None
    q, p = core.coordinates, core.momenta
    potential = core.hamiltonian.xreplace(dict.fromkeys(p, S.Zero))
    energy = (turn.rate * x**2 / 2 for turn in turns for x in turn.momenta(q, p))
    if not sums_to_zero([core.hamiltonian, -potential, *(-x for x in energy)], (*q, *p, *core.parameters, core.time)):
        return None
    frames = [_Frame(turn, q, p) for turn in sorted(turns, key=lambda turn: turn.first)]
    moved = dict(zip(q, (x for each in frames for x in each.moved), strict=True))
    g = [intermediate(x.xreplace(moved)) for x in gradient_tuple(potential, q)]
    rates = [each.rates(g[each.first : each.first + 4]) for each in frames]
    return sum((v for v, _ in rates), ()), sum((f for _, f in rates), ())


class _Frame:
    """Quaternion C Q + S b after the free rotation by the momentum u, and the gradient of a function of it.

    With v = u/(4A), b = |Q|^2 v - (Q . v) Q = Q Im(conj(Q) v), y = |b|^2/|Q|^2, C = cos(sqrt(y)), S = sin(sqrt(y))/sqrt(y)
    and D = 2 dS/dy = (C - S)/y, -S = 2 dC/dy.
    """

    def __init__(self, turn: Turn, q: Sequence[Expr], u: Sequence[Expr]) -> None:
        self.first, self.scale = turn.first, turn.rate / 4
        self.q = q[turn.first : turn.first + 4]
        self.v = [intermediate(self.scale * x) for x in u[turn.first : turn.first + 4]]
        self.norm, self.along, square = _dot(self.q, self.q), _dot(self.q, self.v), _dot(self.v, self.v)
        self.square = square
        y = intermediate(self.norm * square - self.along**2 + SMALLEST)
        inverse = intermediate(1 / sqrt(y))
        angle = intermediate(y * inverse)
        self.C, self.S = intermediate(cos(angle)), intermediate(sin(angle) * inverse)
        self.D = (self.C - self.S) * intermediate(inverse**2)
        self.b = [intermediate(self.norm * x - self.along * y) for x, y in zip(self.v, self.q, strict=True)]
        self.moved = [intermediate(self.C * x + self.S * y) for x, y in zip(self.q, self.b, strict=True)]

    def rates(self, g: Sequence[Expr]) -> tuple[tuple[Expr, ...], tuple[Expr, ...]]:
        """Return W_u and -W_Q from the gradient g = V_q at the moved quaternion."""
        qg, vg = _dot(self.q, g), _dot(self.v, g)
        by_y = intermediate(self.D * (self.norm * vg - self.along * qg) - self.S * qg)
        sqg = intermediate(self.S * qg)
        by_g, by_q = intermediate(self.C - self.S * self.along), intermediate(2 * self.S * vg + by_y * self.square)
        by_v, sn = intermediate(sqg + by_y * self.along), intermediate(self.S * self.norm)
        velocity = (self.scale * (sn * x - sqg * y + by_y * z) for x, y, z in zip(g, self.q, self.b, strict=True))
        force = (by_v * z - by_g * x - by_q * y for x, y, z in zip(g, self.q, self.v, strict=True))
        return tuple(velocity), tuple(force)


def _dot(x: Sequence[Expr], y: Sequence[Expr]) -> Expr:
    return intermediate(Add(*(a * b for a, b in zip(x, y, strict=True))))


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
