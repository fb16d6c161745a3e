"""Rotations, directions and spins in formulas, as functions of homogeneous coordinates.

Rotations and directions: rigid bodies on SO(3) and pendulums on the sphere S^2, in homogeneous coordinates.

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
(:mod:`scvi_codegen.systems.rotations`) is singular in p, but q . q_dot = 0 holds at every stage, and a
collocation method with s Gauss points for degree s needs about half of the operations.

Formulas of systems with rotations: names, grammar, forces and constraints, as functions of coordinates.

Arrays of rotations, directions and spins in formulas in index notation: ``R_33[i]``, ``omega_1[i]``, ``n_3[i]``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, product
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Add, Expr, Matrix, S, Symbol

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.systems.formulas.arrays import ROTATING, parse_coordinate
from scvi_codegen.systems.formulas.expressions import dot, gradient
from scvi_codegen.systems.formulas.grammar import Parser, parsed
from scvi_codegen.systems.formulas.indices import Array, Size
from scvi_codegen.systems.formulas.numpy_values import varies
from scvi_codegen.systems.formulas.symbols import DOT, check_name, name_of_key, symbol

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
        return f"rotation {self.name} {self.rate} momentum" if self.momentum else f"rotation {self.name} {self.rate}"

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
            rates = 2 * rates_matrix(q).T * v / dot(q, q)
        matrix = matrix_of(q) / dot(q, q)
        return dict(zip((*self.entries, *self.rates), (*matrix, *rates), strict=True))

    def scaling(self) -> Expr:
        """Return the rate of the scaling of the quaternion, 2 q . q_dot/|q|^2."""
        q, v = _vectors(self.coordinates)
        return 2 * dot(q, v) / dot(q, q)

    def forces(self, torque: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return the four generalised forces 2 E(q) tau/|q|^2 of a torque in the body frame."""
        q, _ = _vectors(self.coordinates)
        return tuple(2 * rates_matrix(q) * Matrix(torque) / dot(q, q))

    def body_momentum(self, p: Sequence[Symbol]) -> tuple[Expr, ...]:
        """Return the angular momentum in the body frame, E(q)^T p/2."""
        q, _ = _vectors(self.coordinates)
        return tuple(rates_matrix(q).T * Matrix(p) / 2)

    def torque(self, derivatives: Sequence[Expr]) -> Matrix:
        """Return tau_k = sum_ij D_ij (R hat(e_k))_ij of derivatives D by the nine entries, in the body frame.

        Column j of R hat(e_k) is R (e_k x e_j).
        """
        weights: Matrix = Matrix(3, 3, self.entries).T * Matrix(3, 3, list(derivatives))
        pairs: tuple[tuple[int, int], ...] = ((2, 1), (0, 2), (1, 0))
        return Matrix([weights[i, j] - weights[j, i] for i, j in pairs])


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
        return tuple(symbol(entry.name + DOT) for entry in self.entries)

    def values(self) -> dict[Symbol, Expr]:
        """Return the unit vector and its velocity by symbol, as functions of the vector and its velocity."""
        r, v = _vectors(self.coordinates)
        n = r / sympy.sqrt(dot(r, r))
        return dict(zip(self.entries, n, strict=True)) | dict(zip(self.rates, self.forces(v), strict=True))

    def scaling(self) -> Expr:
        """Return the rate of the scaling of the vector, r . r_dot/|r|^2."""
        r, v = _vectors(self.coordinates)
        return dot(r, v) / dot(r, r)

    def forces(self, force: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return the three generalised forces (f - n (n . f))/|r| of a force on the unit vector."""
        r, _ = _vectors(self.coordinates)
        length = sympy.sqrt(dot(r, r))
        n = r / length
        return tuple((Matrix(force) - n * dot(n, force)) / length)


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


Forces = tuple[tuple[str, tuple[Expr, ...]], ...]
"""Components of a force by name: one of a coordinate, three of a rotation (torque in the body frame) or direction."""


@dataclass(frozen=True, slots=True)
class Reduced:
    """Lagrangian and forces of a system with rotations in the names of its formulas: x, R_11, omega_1, n_1, ..

    Attributes:
        lagrangian: l.
        forces: generalised force by ordinary coordinate, and three components by rotation (torque in the body frame)
            or direction.
        constraints: expressions that are 0.
    """

    lagrangian: Expr
    forces: Forces = ()
    constraints: tuple[Expr, ...] = ()


class RotationNames:
    """Names that rotations, directions and spins add to formulas, and the rules that replace them.

    Args:
        members: rotations, directions and spins.

    Raises:
        SystemDefinitionError: if two have a symbol in common.
    """

    def __init__(self, members: Sequence[Homogeneous]) -> None:
        self.members = tuple(members)
        self.values: dict[Symbol, Expr] = {}
        for member in self.members:
            for name, value in member.values().items():
                if name in self.values:
                    raise SystemDefinitionError(f"'{name}' has two meanings among rotations and directions: rename one")
                self.values[name] = value

    @classmethod
    def declared(
        cls,
        rotations: Mapping[str, str] | None,
        directions: Sequence[str] | None = None,
        spins: Sequence[str] | None = None,
        *,
        momentum: bool = False,
    ) -> RotationNames:
        """Return the names of rotations (names of their rates by name), directions and spins; check their names."""
        turning = dict(rotations or {})
        pointing, spinning = directions or (), spins or ()
        for name in (*turning, *turning.values(), *pointing, *spinning):
            check_name(name)
        rotating = [Rotation(name, rate, momentum) for name, rate in turning.items()]
        return cls((*rotating, *map(Direction, pointing), *map(Spin, spinning)))

    @classmethod
    def of_states(cls, declarations: Sequence[str], taken: Collection[str]) -> RotationNames:
        """Return the names in formulas of states, with body momenta of names that are not taken."""
        names = cls(cls.members_of(declarations))
        for rotation in names.rotations:
            pairs = zip(rotation.momenta, rotation.body_momentum(momenta_of(rotation.coordinates)), strict=True)
            names.values |= {name: momentum for name, momentum in pairs if name.name not in taken}
        return names

    @staticmethod
    def members_of(declarations: Sequence[str]) -> list[Homogeneous]:
        """Return members declared as :attr:`Rotation.declaration` is."""
        members: list[Homogeneous] = []
        for kind, name, *rest in map(str.split, declarations):
            if kind == "rotation":
                members.append(Rotation(name, rest[0], momentum=len(rest) > 1))
            else:
                members.append(Direction(name) if kind == "direction" else Spin(name))
        return members

    @property
    def rotations(self) -> tuple[Rotation, ...]:
        """Rotations among the members."""
        return tuple(member for member in self.members if isinstance(member, Rotation))

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the homogeneous coordinates."""
        return tuple(name for member in self.members for name in member.coordinates)

    @property
    def symbols(self) -> dict[str, Symbol]:
        """Symbols of formulas by name."""
        return {value.name: value for value in self.values}

    def read(self, text: str, symbols: Mapping[str, Symbol]) -> Expr:
        """Parse a formula, in which ``rotate_k(R, a, b, c)`` is the k-th component of R (a, b, c)."""
        return parsed(_RotatingParser(text, symbols, {member.name: member for member in self.rotations}))

    def in_coordinates(self, formula: Expr) -> Expr:
        """Return a formula as a function of the homogeneous coordinates and their velocities."""
        return formula.xreplace(self.values)

    def gauge(self, inertia: Callable[[Rotation], Expr] = lambda _: S.One) -> Expr:
        """Return the energy (q . p)^2/(8 I0) of the scalings of quaternions, which is zero for q . p = 0."""
        names = [rotation.coordinates for rotation in self.rotations]
        along = [dot([*map(symbol, q)], momenta_of(q)) for q in names]
        return Add(*(q_p**2 / (8 * inertia(rotation)) for rotation, q_p in zip(self.rotations, along, strict=True)))

    def inertia(self, member: Homogeneous, reduced: Expr, parameters: Sequence[Symbol]) -> Expr:
        """Return I0 of a member: the mean of the diagonal of l's Hessian in its rates if that is constant, else 1."""
        return _mean_inertia(member.rates, reduced, frozenset(parameters))

    def lagrangian(self, reduced: Expr, parameters: Sequence[Symbol]) -> Expr:
        """Return l plus the scaling terms, as a function of the homogeneous coordinates and their velocities."""
        members = [member for member in self.members if not isinstance(member, Spin)]
        terms = [self.inertia(member, reduced, parameters) * member.scaling() ** 2 / 2 for member in members]
        return Add(self.in_coordinates(reduced), *terms)

    def forces_by_name(
        self,
        coordinates: Sequence[str],
        read: Callable[[Any], Expr],
        forces: Mapping[Any, Any] | None,
        torques: Mapping[str, Sequence[Any]] | None,
        torques_space: Mapping[str, Sequence[Any]] | None,
        dissipation: Any,
        others: Iterable[tuple[str, Iterable[Expr]]] = (),
    ) -> Forces:
        """Return the forces by name of a coordinate (one), rotation or direction (three components), and ``others``."""
        if not isinstance(forces or {}, Mapping):
            raise SystemDefinitionError(f"forces must be a mapping from coordinates to formulas, not {forces!r}")
        into_body = {member.name: Matrix(3, 3, member.entries).T for member in self.rotations}
        turning = dict.fromkeys(into_body, len(AXES))
        moved = dict.fromkeys(coordinates, 1)
        moved |= {member.name: len(AXES) for member in self.members if isinstance(member, Direction)}
        in_space = self._stated("torque", "rotation", torques_space or {}, turning, read)
        total: dict[str, tuple[Expr, ...]] = {}
        for name, force in chain(
            self._stated("force", "coordinate", forces or {}, moved, read),
            self._stated("torque", "rotation", torques or {}, turning, read),
            ((name, into_body[name] * Matrix(torque)) for name, torque in in_space),
            others,
            () if dissipation is None else self._friction(read(dissipation), coordinates),
        ):
            total[name] = tuple(map(Add, total[name], force)) if name in total else tuple(force)
        return tuple(total.items())

    def _stated(
        self, kind: str, where: str, by_name: Mapping[Any, Any], targets: Mapping[str, int], read: Callable[[Any], Expr]
    ) -> Iterator[tuple[str, Iterable[Expr]]]:
        """Yield the forces or torques by name of what they act on; ``targets``: numbers of components by name."""
        for key, formulas in by_name.items():
            if (name := name_of_key(key)) not in targets:
                turns = name in {member.name for member in self.rotations}
                hint = f": write torques={{'{name}': [..]}}." if turns else closest(name, [*targets])
                raise SystemDefinitionError(
                    f"there is a {kind} on '{name}', which is not a {where}{hint} "
                    f"{where.capitalize()}s: {', '.join(targets) or 'none'}"
                )
            single = isinstance(formulas, str) or not isinstance(formulas, Sequence)
            force = [*map(read, [formulas] if single else formulas)]
            if len(force) != targets[name]:
                raise SystemDefinitionError(f"the {kind} on '{name}' must have three components, not {formulas!r}")
            yield name, force

    def _friction(self, dissipation: Expr, coordinates: Sequence[str]) -> list[tuple[str, tuple[Expr, ...]]]:
        """Return the forces -dD/dv of Rayleigh's function."""
        rates = {name: (symbol(name + DOT),) for name in coordinates}
        rates |= {member.name: member.rates for member in self.members}
        derivatives = {name: gradient(dissipation, velocities) for name, velocities in rates.items()}
        if not any(derivatives.values()):
            raise SystemDefinitionError(
                f"the dissipation {dissipation} contains no velocity: Rayleigh's function D(q, v) defines "
                "the forces -dD/dv. Add velocities, or remove it"
            )
        return [
            (name, tuple(-entries.get(i, S.Zero) for i in range(len(rates[name]))))
            for name, entries in derivatives.items()
            if entries
        ]

    def fields(
        self,
        function: str,
        formula: Expr,
        forces: Forces,
        constraints: Sequence[Expr],
        variables: Sequence[str],
        parameters: Sequence[Symbol],
    ) -> dict[str, Any]:
        """Return the fields of a system that are formulas, as functions of its coordinates."""
        fields = {
            "forces": self.forces(forces, variables),
            "constraints": tuple(map(self.in_coordinates, constraints)),
            "rotations": self.members,
        }
        if function == "hamiltonian":
            return {function: self.in_coordinates(formula), "gauge": self.gauge(), **fields}
        reduced = Reduced(formula, forces, tuple(constraints)) if self.members else None
        return {function: self.lagrangian(formula, parameters), "reduced": reduced, **fields}

    def forces(self, by_name: Forces, variables: Sequence[str]) -> tuple[Expr, ...]:
        """Return the generalised forces on all coordinates, in order; an empty tuple if there are none."""
        members = {member.name: member for member in self.members if not isinstance(member, Spin)}
        forces: dict[str, Expr] = {}
        for name, components in by_name:
            force = tuple(map(self.in_coordinates, components))
            member = members.get(name)
            forces |= zip(member.coordinates, member.forces(force), strict=True) if member else {name: force[0]}
        ordered = tuple(forces.get(name, S.Zero) for name in variables)
        return ordered if any(force != 0 for force in ordered) else ()


class _RotatingParser(Parser):
    """Parser with ``rotate_k(R, a, b, c)`` and ``unrotate_k(R, a, b, c)``."""

    def __init__(self, text: str, symbols: Mapping[str, Symbol], rotations: Mapping[str, Rotation]) -> None:
        super().__init__(text, symbols)
        self.rotations = rotations

    def name(self, name: str, column: int) -> Expr:
        entries = [entry for entry in (f"{name}_11", f"{name}_1") if entry in self.symbols and name not in self.symbols]
        if entries:
            self.refuse(f"'{name}' is not a scalar: write one of its components, as {entries[0]}", column)
        if name not in ROTATING and name.removeprefix("un").startswith("rotate"):
            self.refuse(f"'{name}' is not a function: known are {', '.join(ROTATING)}", column)
        if name not in ROTATING:
            return super().name(name, column)
        opening = self.accept("(")
        if opening is None:
            self.refuse(f"'{name}' is a function: write {name}(R, a, b, c)", column)
        self.open(opening.column)
        kind, rotation, place = self.tokens[self.position]
        if kind != "name" or rotation not in self.rotations:
            rotations = ", ".join(self.rotations)
            self.refuse(f"{name} needs a rotation first, not '{rotation}'. Rotations: {rotations}", place)
        self.position += 1
        vector: list[Expr] = []
        while self.accept(","):
            vector.append(self.sum())
        self.close()
        if len(vector) != len(AXES):
            self.refuse(f"{name} takes a rotation and three components, not {len(vector)}", column)
        matrix = Matrix(3, 3, self.rotations[rotation].entries)
        turned = (matrix.T if name.startswith("un") else matrix) * Matrix(vector)
        return turned[int(name[-1]) - 1]


@dataclass(frozen=True, slots=True)
class MemberArray:
    """Array of rotations, directions or spins, ``R_33[i]`` and ``omega_1[i]``; a single one without axes."""

    member: Homogeneous
    axes: tuple[Size, ...]

    @property
    def array(self) -> Array:
        """Array of the homogeneous coordinates, with those of one member along the last axis."""
        letters = "".join(name[-1] for name in self.member.coordinates)
        return Array(self.member.name, (*self.axes, Size("", len(letters))), letters)

    @property
    def formulas(self) -> tuple[Array, ...]:
        """Arrays that occur in formulas: matrix or vector, and rates."""
        return tuple(Array(entry.name, self.axes) for entry in _symbols(self.member))

    @property
    def rates(self) -> tuple[Array, ...]:
        """Arrays of the rates."""
        return tuple(Array(rate.name, self.axes) for rate in self.member.rates)

    def torques(self, *, in_space: bool = False) -> tuple[Array, ...]:
        """Return the arrays of the components of torques, or of forces on directions, which occur in no formula."""
        return tuple(Array(name, self.axes) for name in _torque_names(self.member, in_space=in_space))

    def entries(self, sizes: Mapping[str, int]) -> Iterator[tuple[tuple[int, ...], Homogeneous]]:
        """Yield every member with its indices."""
        for index in product(*(range(axis.at(sizes)) for axis in self.axes)):
            suffix = "".join(f"_{k}" for k in index)
            name = self.member.name + suffix
            if isinstance(self.member, Rotation):
                yield index, replace(self.member, name=name, rate=self.member.rate + suffix)
            else:
                yield index, replace(self.member, name=name)

    def names(self, sizes: Mapping[str, int]) -> dict[str, NDArray[np.str_]]:
        """Return the names of the entries of :attr:`formulas` and of both kinds of torques."""
        names: dict[str, dict[tuple[int, ...], str]] = {}
        for index, member in self.entries(sizes):
            for array, name in zip(_all_names(self.member), _all_names(member), strict=True):
                names.setdefault(array, {})[index] = name
        shape = tuple(axis.at(sizes) for axis in self.axes)
        return {array: np.array([*texts.values()], dtype=np.str_).reshape(shape) for array, texts in names.items()}


def member_arrays(
    rotations: Mapping[str, str] | None,
    directions: Sequence[str] | None,
    spins: Sequence[str] | None,
    *,
    momentum: bool,
) -> tuple[MemberArray, ...]:
    """Return the declared rotations (name of the rate by declaration, ``{"R[N]": "omega"}``), directions and spins."""
    declared: list[tuple[type, str, str]] = [(Rotation, text, rate) for text, rate in (rotations or {}).items()]
    declared += [(kind, text, "") for kind, texts in ((Direction, directions), (Spin, spins)) for text in texts or ()]
    members = []
    for kind, text, rate in declared:
        array = parse_coordinate(text)
        for name in filter(None, (array.name, rate)):
            check_name(name)
        member = Rotation(array.name, rate, momentum) if kind is Rotation else kind(array.name)
        members.append(MemberArray(member, array.axes))
    return tuple(members)


def entries_in_formulas(
    arrays: Iterable[Array], members: Iterable[Homogeneous], sizes: Mapping[str, int]
) -> dict[Array, NDArray[np.str_]]:
    """Return the arrays ``R_11`` to ``R_33``, ``omega_1``, .. of those arrays whose entries ``R_0``, .. are members.

    The values are the names of their entries, ``R_0_11``, ...
    """
    by_name = {member.name: member for member in members}
    entries = dict[Array, NDArray[np.str_]]()
    for array in arrays:
        first = "_0" * (len(array.axes) - 1)
        member = by_name.get(array.name + first)
        if first and member is not None:
            if isinstance(member, Rotation):
                member = replace(member, rate=member.rate.removesuffix(first))
            turning = MemberArray(replace(member, name=array.name), array.axes[:-1])
            names = turning.names(sizes)
            entries |= {component: names[component.name] for component in turning.formulas}
    return entries


def torque_components(
    members: Sequence[MemberArray], target: str, formulas: Sequence[str], *, in_space: bool
) -> Iterator[tuple[str, str, tuple[Array, ...]]]:
    """Yield target, formula and arrays of each component of a torque on ``R[i]``, or of a force on ``n[i]``."""
    name, bracket, place = target.partition("[")
    by_name = {member.member.name: member for member in members}
    if name not in by_name or isinstance(formulas, str) or len(formulas) != len(AXES):
        raise SystemDefinitionError(
            f"the torque on '{target}' must have three components and act on a rotation or a direction"
            f"{closest(name, by_name)}"
        )
    if by_name[name].axes and not bracket:
        raise SystemDefinitionError(f"'{name}' is an array: write the torque on each of them as '{name}[i]'")
    arrays = by_name[name].torques(in_space=in_space)
    for array, formula in zip(arrays, formulas, strict=True):
        yield f"{array.name}{bracket}{place}", formula, arrays


def torque_symbols(member: Homogeneous, *, in_space: bool = False) -> tuple[Symbol, ...]:
    """Return the symbols of the components of the torque on a member."""
    return tuple(symbol(name) for name in _torque_names(member, in_space=in_space))


def _torque_names(member: Homogeneous, *, in_space: bool) -> tuple[str, ...]:
    return tuple(f"{member.name}_{'space_torque' if in_space else 'torque'}_{axis}" for axis in AXES)


def _symbols(member: Homogeneous) -> tuple[Symbol, ...]:
    return (*member.entries, *member.rates)


def _all_names(member: Homogeneous) -> tuple[str, ...]:
    torques = (_torque_names(member, in_space=in_space) for in_space in (False, True))
    return (*(entry.name for entry in _symbols(member)), *(name for names in torques for name in names))


@lru_cache(maxsize=4)
def _mean_inertia(rates: tuple[Symbol, ...], reduced: Expr, parameters: frozenset[Symbol]) -> Expr:
    if varies(reduced, rates, parameters):
        return S.One
    entries = [S.Zero] * len(AXES)
    for i, row in gradient(reduced, rates).items():
        entries[i] = gradient(row, rates).get(i, S.Zero)
        if not entries[i].free_symbols <= parameters:
            return S.One
    return Add(*entries) / len(AXES) if any(entries) else S.One
