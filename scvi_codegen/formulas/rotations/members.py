"""Rotations and directions: rigid bodies on SO(3) and pendulums on the sphere S^2, in homogeneous coordinates.

A rotation R, which takes vectors from the body frame to the space frame, is written as R(q) of a quaternion q = (w, x,
y, z) of any length, a direction n as r/|r| of a vector r in R^3:

    R(q) = R2(q)/|q|^2,    omega = 2 E(q)^T q_dot/|q|^2    (angular velocity in the body frame)
    n(r) = r/|r|,          n_dot = (r_dot - n (n . r_dot))/|r|

with R2 and E below. The Lagrangian l(x, x_dot, R, omega, n, n_dot, t) of the user becomes

    L(q, q_dot) = l + I0 (2 q . q_dot/|q|^2)^2/2

for each rotation, and likewise for each direction, with a positive constant I0. L is regular and invariant under the
scaling q -> c q, whose momentum map is q . p. Every variational method commutes with this linear point symmetry and
keeps q . p = 0 to round-off; symplectic reduction by the scaling at q . p = 0 is T*SO(3). A step therefore descends to
a symplectic map of T*SO(3), of the order of the method, without a chart and without a constraint |q| = 1 (J. E.
Marsden, A. Weinstein, Rep. Math. Phys. 5 (1974), 121-130). The length of q and the momentum q . p are gauge: R, omega,
the body momentum Pi = dl/domega = E(q)^T p/2 and the angular momentum in space R Pi do not depend on them.

If l is quadratic in the velocities with a constant mass matrix, the Hamiltonian in (q, p) without the scaling term
(:mod:`scvi_codegen.mechanics.rotations.hamiltonian`) is singular in p, but q . q_dot = 0 holds at every stage, and a
collocation method with s Gauss points for degree s needs about half of the operations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Add, Expr, Matrix, Symbol

from scvi_codegen.formulas.symbols import DOT, symbol

AXES = (1, 2, 3)


@dataclass(frozen=True, slots=True)
class Rotation:
    """Rotation from body to space, written as a quaternion of any length.

    Attributes:
        name: name of the rotation matrix in formulas, ``R`` of the entries ``R_11`` to ``R_33``.
        rate: name of the angular velocity in the body frame, ``omega`` of ``omega_1`` to ``omega_3``.
        momentum: in a Hamiltonian ``rate`` names the angular momentum in the body frame.
    """

    name: str
    rate: str
    momentum: bool = False

    @property
    def declaration(self) -> str:
        """Kind and names in one line."""
        return f"rotation {self.name} {self.rate}{' momentum' * self.momentum}"

    @property
    def description(self) -> str:
        """Definition in one line."""
        rate = "E(q)^T p/2" if self.momentum else "2 E(q)^T q_dot/|q|^2"
        names = ", ".join(self.coordinates)
        quaternion = f"quaternion q = ({names}) of any length"
        return f"rotation {self.name} = R(q), {quaternion}, {self.rate} = {rate} in the body frame"

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the four components of the quaternion, scalar part first."""
        return tuple(f"{self.name}_{letter}" for letter in "wxyz")

    @property
    def entries(self) -> tuple[Symbol, ...]:
        """Symbols of the rotation matrix in formulas, row by row."""
        return tuple(symbol(f"{self.name}_{row}{column}") for row in AXES for column in AXES)

    @property
    def rates(self) -> tuple[Symbol, ...]:
        """Symbols of the angular velocity in formulas."""
        return tuple(symbol(f"{self.rate}_{axis}") for axis in AXES)

    @property
    def momenta(self) -> tuple[Symbol, ...]:
        """Symbols of the angular momentum in the body frame, in formulas of states."""
        return self.rates if self.momentum else tuple(symbol(f"p_{self.name}_{axis}") for axis in AXES)

    def values(self) -> dict[Symbol, Expr]:
        """Return matrix and rates by symbol, as functions of the quaternion and its velocity or momentum."""
        q, v = _vectors(self.coordinates)
        if self.momentum:
            rates = Matrix(self.body_momentum(momenta_of(self.coordinates)))
        else:
            rates = 2 * rates_matrix(q).T * v / Add(*(each**2 for each in q))
        matrix = matrix_of(q) / Add(*(each**2 for each in q))
        return dict(zip((*self.entries, *self.rates), (*matrix, *rates), strict=True))

    def scaling(self) -> Expr:
        """Return the rate of the scaling of the quaternion, 2 q . q_dot/|q|^2."""
        q, v = _vectors(self.coordinates)
        return 2 * Add(*(a * b for a, b in zip(q, v, strict=True))) / Add(*(each**2 for each in q))

    def forces(self, torque: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return the four generalised forces 2 E(q) tau/|q|^2 of a torque in the body frame."""
        q, _ = _vectors(self.coordinates)
        return tuple(2 * rates_matrix(q) * Matrix(torque) / Add(*(each**2 for each in q)))

    def body_momentum(self, p: Sequence[Symbol]) -> tuple[Expr, ...]:
        """Return the angular momentum in the body frame, E(q)^T p/2."""
        q, _ = _vectors(self.coordinates)
        return tuple(rates_matrix(q).T * Matrix(p) / 2)


@dataclass(frozen=True, slots=True)
class _Vector:
    """Vector with three components in formulas: ``n_1`` to ``n_3`` for the name ``n``."""

    name: str

    @property
    def declaration(self) -> str:
        """Kind and name in one line."""
        return f"{type(self).__name__.lower()} {self.name}"

    @property
    def entries(self) -> tuple[Symbol, ...]:
        return tuple(symbol(f"{self.name}_{axis}") for axis in AXES)


@dataclass(frozen=True, slots=True)
class Direction(_Vector):
    """Unit vector, written as a vector of any length, with velocities ``n_1_dot`` to ``n_3_dot`` in formulas."""

    @property
    def description(self) -> str:
        """Definition in one line."""
        return f"direction {self.name} = r/|r|, vector r = ({', '.join(self.coordinates)}) of any length"

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the three components of the vector."""
        return tuple(f"{self.name}_{letter}" for letter in "xyz")

    @property
    def rates(self) -> tuple[Symbol, ...]:
        """Symbols of the velocity of the unit vector in formulas."""
        return tuple(symbol(each.name + DOT) for each in self.entries)

    def values(self) -> dict[Symbol, Expr]:
        """Return the unit vector and its velocity by symbol, as functions of the vector and its velocity."""
        r, v = _vectors(self.coordinates)
        n = r / sympy.sqrt(Add(*(each**2 for each in r)))
        return dict(zip(self.entries, n, strict=True)) | dict(zip(self.rates, self.forces(v), strict=True))

    def scaling(self) -> Expr:
        """Return the rate of the scaling of the vector, r . r_dot/|r|^2."""
        r, v = _vectors(self.coordinates)
        return Add(*(a * b for a, b in zip(r, v, strict=True))) / Add(*(each**2 for each in r))

    def forces(self, force: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return the three generalised forces (f - n (n . f))/|r| of a force on the unit vector."""
        r, _ = _vectors(self.coordinates)
        length = sympy.sqrt(Add(*(each**2 for each in r)))
        n = r / length
        along = Add(*(a * b for a, b in zip(n, force, strict=True)))
        return tuple((Matrix(force) - n * along) / length)


@dataclass(frozen=True, slots=True)
class Spin(_Vector):
    """Spin s of constant length with the brackets {s_1, s_2} = s_3 and cyclic, in two pairs of canonical variables.

    With the complex numbers a = q_1 + i p_1 and b = q_2 + i p_2 (Hopf map)

        s_1 + i s_2 = conj(a) b/2,    s_3 = (|a|^2 - |b|^2)/4,    |s| = (|a|^2 + |b|^2)/4,

    whose common phase is gauge. |s| is a quadratic invariant of every Hamiltonian H(s), kept by symplectic methods.
    """

    @property
    def description(self) -> str:
        """Definition in one line."""
        a, b = self.coordinates
        s = self.name
        return (
            f"spin {s}: {s}_1 + i {s}_2 = conj(a) b/2, {s}_3 = (|a|^2 - |b|^2)/4, a = {a} + i p_{a}, b = {b} + i p_{b}"
        )

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the two canonical coordinates."""
        return f"{self.name}_a", f"{self.name}_b"

    rates = ()  # the equations of a spin are of first order

    def values(self) -> dict[Symbol, Expr]:
        """Return the components by symbol, as functions of the canonical variables."""
        (x, y), (p, q) = map(symbol, self.coordinates), momenta_of(self.coordinates)
        components = (x * y + p * q) / 2, (x * q - y * p) / 2, (x**2 + p**2 - y**2 - q**2) / 4
        return dict(zip(self.entries, components, strict=True))


Homogeneous = Rotation | Direction | Spin


def momenta_of(names: Sequence[str]) -> tuple[Symbol, ...]:
    """Return the symbols of the momenta of homogeneous coordinates."""
    return tuple(symbol(f"p_{name}") for name in names)


def matrix_of(q: Sequence[Expr]) -> Matrix:
    """Return R2(q) = |q|^2 R(q), homogeneous of degree 2: R v = q v q^-1."""
    w, x, y, z = q
    return Matrix(
        [
            [w**2 + x**2 - y**2 - z**2, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w**2 - x**2 + y**2 - z**2, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w**2 - x**2 - y**2 + z**2],
        ]
    )


def rates_matrix(q: Sequence[Expr]) -> Matrix:
    """Return the 4 x 3 matrix E(q) with q_dot = E(q) omega/2 for |q_dot . q| = 0; E^T E = |q|^2, E^T q = 0."""
    w, x, y, z = q
    return Matrix([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


def _vectors(names: Sequence[str]) -> tuple[Matrix, Matrix]:
    return Matrix([symbol(name) for name in names]), Matrix([symbol(name + DOT) for name in names])
