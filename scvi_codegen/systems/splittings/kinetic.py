"""Splitting H = T(Pi, p_x) + V(R, x, t) into flows in closed form, also with rotations.

V changes the momenta only. T is the kinetic energy of bodies with the principal moments of inertia 1/a_1, 1/a_2, 1/a_3,

    T = T_x(p_x) + sum (a_1 Pi_1^2 + a_2 Pi_2^2 + a_3 Pi_3^2)/2,      Pi = E(q)^T p/2.

Its exact flow q <- q g, p <- p g with a unit quaternion g conserves |q| and q . p, the gauge, and the angular momentum
in space to round-off. Pi and the vector part of g are written in principal axes, the eigenvectors of an inertia matrix
of numbers if it is not diagonal. If two moments are equal, a_i = a_j, g is the product exp(t a_i Pi/2)
exp(t (a_k - a_i) Pi_k e_k/2) (E. J. Routh, Advanced Rigid Dynamics). Otherwise g contains Jacobi's elliptic functions
and an elliptic integral of the third kind (E. Celledoni, F. Fasso, N. Saefstroem, A. Zanna, SIAM J. Sci. Comput. 30
(2008), 2084-2112), in the form of ``free_rotation.h``. The C code computes them by doubling the argument or by
arithmetic-geometric means; the expressions of this module, from which derivatives of a step are computed, by doubling.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, permutations
from operator import mul
from typing import Any

from sympy import Add, Expr, Matrix, Quaternion, Rational, S, atan2, cos, expand, eye, sin, sqrt, zeros

from scvi_codegen.common.precision import DIGITS, VANISHING, mp
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import jacobian
from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.rotations import Rotation
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.legendre.transform import equivalent_lagrangian
from scvi_codegen.systems.system import MechanicalSystem

DOUBLINGS = 20
"""Doublings of the argument of elliptic functions: series of 4 terms at 2^-20 are correct to 45 digits."""


@dataclass(frozen=True, slots=True)
class KineticSplitting:
    """Splitting of a system into kicks and drifts.

    Attributes:
        system: the form that is split, the equivalent Lagrangian if its masses are constant (``velocity`` is empty).
        bodies: of each rigid body, the index of the first component of its quaternion and the axes i, j, k from 0.
        rates: of each body a_i, a_j - a_i, a_k - a_i.
        axes: of each body the rotation matrix whose columns are its principal axes.
        velocity: m velocities in p of the ordinary coordinates, 0 for quaternions.
        force: m forces in q and t.
    """

    system: MechanicalSystem
    force: tuple[Expr, ...]
    velocity: tuple[Expr, ...] = ()
    bodies: tuple[tuple[int, ...], ...] = ()
    rates: tuple[tuple[Expr, ...], ...] = ()
    axes: tuple[Matrix, ...] = ()

    def flow(self, u: Sequence[Expr]) -> tuple[list[Expr], list[Expr]]:
        """Return the changes of q and u = t p by the flow of T in the time t, in q and u, symbols as many as p.

        g - 1 is computed without cancellation from |g| = 1: short steps add up.
        """
        q, p = self.system.coordinates, self.system.auxiliaries
        moved = [v.xreplace(dict(zip(p, u, strict=True))) for v in self.velocity]
        turned: list[Expr] = [S.Zero] * len(u)
        for (first, _, j, k), (common, outer, inner), axes in zip(self.bodies, self.rates, self.axes, strict=True):
            quaternion = slice(first, first + 4)
            pair = [Quaternion(*q[quaternion]), Quaternion(*u[quaternion])]
            momentum = [intermediate(x / 2) for x in axes.T * Matrix((pair[0].conjugate() * pair[1]).args[1:])]
            if outer == 0:
                around = [inner * x / 2 if n == k else S.Zero for n, x in enumerate(momentum)]
                g = exponential([common * x / 2 for x in momentum]) * exponential(around)
            else:
                offsets = {j: outer, k: inner}
                g = _elliptic_turn(j, [intermediate(common + offsets.get(n, S.Zero)) for n in range(3)], momentum)
            vector = [intermediate(component) for component in axes * Matrix(g.args[1:])]
            real, size = intermediate(g.a), intermediate(sqrt(VANISHING + g.a**2))
            less = intermediate(real - size - Add(*(x**2 for x in vector)) / (1 + size))
            moved[quaternion], turned[quaternion] = (list((x * Quaternion(less, *vector)).args) for x in pair)
        return moved, turned


def exponential(half: Sequence[Expr]) -> Quaternion:
    """Return exp(v) for a vector v, half of a rotation vector."""
    angle = intermediate(sqrt(Add(VANISHING, *(x**2 for x in half))))
    return Quaternion(cos(angle), *(sin(angle) / angle * x for x in half))


def _elliptic_turn(m: int, a: Sequence[Expr], momentum: Sequence[Expr]) -> Quaternion:
    """Return g of a body with the inverse moments a, of which a_m is between the others, for t Pi.

    sigma = sn/sqrt(A) with the modulus k^2 = B/A, so that cn^2 = 1 - A sigma^2, dn^2 = 1 - B sigma^2, sigma' = cn dn.
    """
    left, right = (m + 2) % 3, (m + 1) % 3
    x, y, z = (momentum[axis] for axis in (left, m, right))
    ls, ms, lm = (intermediate(a[i] - a[j]) for i, j in ((left, right), (m, right), (left, m)))
    norm = intermediate(sqrt(Add(VANISHING, x**2, y**2, z**2)))
    U = intermediate(ls * x**2 + ms * y**2)
    A, B, N = (intermediate(invariant) for invariant in (lm * U, ms * (ls * z**2 + lm * y**2), ms * U))
    Q, step = intermediate(N * ls * norm), S.One / 2 ** (DOUBLINGS + 1)
    p, q, r = (intermediate(coefficient) for coefficient in ((A + B) * step**2, A * B * step**4, N * step**2))
    # Taylor series of sigma and sigma' at the argument 2^-(DOUBLINGS + 1), and of the integral of the third kind.
    series = (S.One, -p, p**2 + 12 * q, -(p**3) - 132 * p * q)
    sigma = intermediate(step * Add(*(c / f for c, f in zip(series, (1, 6, 120, 5040), strict=True))))
    rate = intermediate(Add(*(c / f for c, f in zip(series, (1, 2, 24, 720), strict=True))))
    second = 2 * p**2 / 45 + q / 5 + 2 * p * r / 3 + r**2
    phases = [2**DOUBLINGS * Q * step**3 * (S.One / 3 - (p / 3 + r) / 5 + second / 7)]
    # sn 2u = 2 sn cn dn/(1 - k^2 sn^4), and cn 2u, dn 2u likewise (Abramowitz-Stegun 16.18).
    for doubling in reversed(range(DOUBLINGS)):
        square = intermediate(sigma**2)
        product = intermediate(A * B * square**2)
        over = intermediate(1 / (1 - product))
        cn, dn = (intermediate((1 + product - 2 * factor * square) * over) for factor in (A, B))
        sigma, rate = intermediate(2 * sigma * rate * over), intermediate(cn * dn)
        phase = atan2(Q * square * sigma, 1 + N * (sigma**2 - square * rate))
        phases.append(2**doubling * intermediate(phase))
    angle = intermediate(Add(a[right] * norm / 2, *phases))
    C, sine = intermediate(cos(angle)), intermediate(sin(angle) / norm)
    parts: list[Expr] = [S.Zero] * 4
    parts[0] = (C * cn - sine * U * sigma * dn) * (1 - ms * lm * sigma**2 * y**2)
    parts[1 + left] = (sine * rate + C * ls * sigma) * (x * dn - ms * sigma * cn * y * z)
    parts[1 + m] = (sine * dn + C * ms * sigma * cn) * (y * rate + ls * sigma * x * z)
    parts[1 + right] = sine * (1 + N * sigma**2) * (z * cn - lm * sigma * dn * x * y)
    parts = [intermediate(part) for part in parts]
    size = intermediate(sqrt(Add(*(part**2 for part in parts))))
    return Quaternion(*(part / size for part in parts))


@lru_cache(maxsize=64)
def kinetic_splitting(system: MechanicalSystem) -> KineticSplitting | str:
    """Return the splitting of a system, or the reason why there is none."""
    twin = equivalent_lagrangian(system)
    if twin is not None and forms_of(twin).separable:
        return KineticSplitting(twin, forms_of(twin).force)
    forms = forms_of(system)
    members = system.rotations
    q = system.coordinates
    p = system.auxiliaries
    bound = members and (system.constraints or {*map(type, members)} != {Rotation})
    if not p or forms.one_form or system.damping != 0 or bound:
        return "there are constraints, damping, directions or spins, or masses that vary"
    places = [q.index(symbol(member.coordinates[0])) for member in members]
    turning, values = {k + n for k in places for n in range(4)}, list(p)
    for k in places:  # conj(q) p = (q . p, 2 Pi)
        values[k : k + 4] = (Quaternion(*q[k : k + 4]).conjugate() * Quaternion(*p[k : k + 4])).args
    upright: dict[Expr, Expr] = {q[i]: S(int(i in places)) for i in turning}
    velocity = [*(expand(rate.xreplace(upright)) for rate in forms.legendre)] if members else [*forms.legendre]
    if jacobian(velocity, (*q, system.time)):
        return "the kinetic energy has coefficients that depend on coordinates or time"
    bodies = [_body(k, velocity[k : k + 4], p[k + 1 : k + 4], system) for k in places]
    if reasons := [body for body in bodies if isinstance(body, str)]:
        return reasons[0]
    force, applied = forms.force, forms.force
    if members:
        at_rest = dict.fromkeys(p, S.Zero)
        energy = Add(*map(mul, velocity, p)).xreplace(dict(zip(p, values, strict=True))) / 2
        if expand(system.formula - system.formula.xreplace(at_rest) - energy) != 0:
            return "the kinetic energy is not a quadratic form in the momenta with constant coefficients"
        force, applied = tuple(component.xreplace(at_rest) for component in force), system.forces
    if jacobian(applied, (*system.velocities, *p)):
        return "there are forces or torques that depend on velocities"
    for i in turning:
        velocity[i] = S.Zero
    return KineticSplitting(system, force, tuple(velocity), *map(tuple, zip(*bodies, strict=True)))


def _body(first: int, v: Sequence[Expr], p: Sequence[Expr], system: MechanicalSystem) -> tuple[Any, ...] | str:
    """Return (first, i, j, k), the rates and the principal axes of a body, or the reason why there are none."""
    inverse = 4 * Matrix(v[1:]).jacobian(p)
    if (Matrix(v) - zeros(1, 1).col_join(inverse * Matrix(p) / 4)).expand() != zeros(4, 1):
        return "the kinetic energy couples angular velocities with those of other bodies or with other velocities"
    if inverse.is_diagonal():
        return *_axes(first, inverse.diagonal(), system), eye(3)
    if inverse.free_symbols:
        return "products of inertia depend on parameters (write them as numbers, or choose principal axes as body axes)"
    values, axes = mp.eigsy(mp.matrix([[str(x.evalf(DIGITS)) for x in row] for row in inverse.tolist()]))
    axes *= mp.sign(mp.det(axes))
    moments, *rows = ([Rational(str(x)) for x in row] for row in (values, *axes.tolist()))
    return *_axes(first, moments, system), Matrix(rows)


def _axes(first: int, inverse: Sequence[Expr], system: MechanicalSystem) -> tuple[tuple[int, ...], tuple[Expr, ...]]:
    """Return (first, i, j, k) and the rates of a body; inverse moments of i and j are the closest, j is the middle."""
    defaults = [float(moment.xreplace(system.constants)) for moment in inverse]
    gaps = {axes: [abs(defaults[a] - defaults[b]) for a, b in pairwise(axes)] for axes in permutations(range(3))}
    i, j, k = min(gaps, key=gaps.__getitem__)
    return (first, i, j, k), (inverse[i], inverse[j] - inverse[i], inverse[k] - inverse[i])
