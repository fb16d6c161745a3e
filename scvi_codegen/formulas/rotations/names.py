"""Formulas of systems with rotations: names, grammar, forces and constraints, as functions of coordinates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sympy import Add, Expr, Matrix, S, Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.arrays import ROTATING
from scvi_codegen.formulas.expressions import gradient, hessian
from scvi_codegen.formulas.grammar import Parser, parsed
from scvi_codegen.formulas.rotations.members import AXES, Direction, Homogeneous, Rotation, Spin, momenta_of
from scvi_codegen.formulas.symbols import DOT, check_name, symbol

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
            for each, value in member.values().items():
                if each in self.values:
                    raise SystemDefinitionError(f"'{each}' has two meanings among rotations and directions: rename one")
                self.values[each] = value

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
        for each in names.rotations:
            momenta = each.body_momentum(momenta_of(each.coordinates))
            names.values |= {name: p for name, p in zip(each.momenta, momenta, strict=True) if name.name not in taken}
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
        return {each.name: each for each in self.values}

    def read(self, text: str, symbols: Mapping[str, Symbol]) -> Expr:
        """Parse a formula, in which ``rotate_k(R, a, b, c)`` is the k-th component of R (a, b, c)."""
        return parsed(_RotatingParser(text, symbols, {member.name: member for member in self.rotations}))

    def in_coordinates(self, formula: Expr) -> Expr:
        """Return a formula as a function of the homogeneous coordinates and their velocities."""
        return formula.xreplace(self.values)

    def gauge(self, inertia: Callable[[Rotation], Expr] = lambda _: S.One) -> Expr:
        """Return the energy (q . p)^2/(8 I0) of the scalings of quaternions, which is zero for q . p = 0."""
        along = [
            Add(*(symbol(q) * p for q, p in zip(member.coordinates, momenta_of(member.coordinates), strict=True)))
            for member in self.rotations
        ]
        return Add(*(each**2 / (8 * inertia(member)) for member, each in zip(self.rotations, along, strict=True)))

    def inertia(self, member: Homogeneous, reduced: Expr, parameters: Sequence[Symbol]) -> Expr:
        """Return I0 of a member: the mean of the diagonal of l's Hessian in its rates if that is constant, else 1."""
        entries = hessian(reduced, member.rates)
        mean = Add(*(entries.get((i, i), S.Zero) for i in range(len(AXES)))) / len(AXES)
        return mean if mean != 0 and mean.free_symbols <= set(parameters) else S.One

    def lagrangian(self, reduced: Expr, parameters: Sequence[Symbol]) -> Expr:
        """Return l plus the scaling terms, as a function of the homogeneous coordinates and their velocities."""
        members = [each for each in self.members if not isinstance(each, Spin)]
        terms = [self.inertia(each, reduced, parameters) * each.scaling() ** 2 / 2 for each in members]
        return Add(self.in_coordinates(reduced), *terms)

    def forces_by_name(
        self,
        coordinates: Sequence[str],
        read: Callable[[Any], Expr],
        forces: Mapping[str, Any] | None,
        torques: Mapping[str, Sequence[Any]] | None,
        torques_space: Mapping[str, Sequence[Any]] | None,
        dissipation: Any,
        others: Iterable[tuple[str, Matrix]] = (),
    ) -> Forces:
        """Return the forces by name of a coordinate (one), rotation or direction (three components), and ``others``."""
        rotating = {member.name: member for member in self.rotations}
        pointing = [member.name for member in self.members if isinstance(member, Direction)]
        total: dict[str, Matrix] = {}

        def add(name: str, force: Matrix) -> None:
            total[name] = total[name] + force if name in total else force

        for what, by_name, known in (
            ("force", forces, [*coordinates, *pointing]),
            ("torque", torques, [*rotating]),
            ("torque", torques_space, [*rotating]),
        ):
            for name, formulas in (by_name or {}).items():
                if name not in known:
                    hint = f": write torques={{'{name}': [..]}}." if name in rotating else closest(name, known)
                    raise SystemDefinitionError(
                        f"there is a {what} on '{name}'{hint} Possible: {', '.join(known) or 'none'}"
                    )
                texts = [formulas] if isinstance(formulas, str | Expr) else list(formulas)
                if len(texts) != (1 if name in coordinates else len(AXES)):
                    raise SystemDefinitionError(f"the {what} on '{name}' must have three components, not {formulas!r}")
                force = Matrix([read(text) for text in texts])
                if by_name is torques_space:
                    force = Matrix(3, 3, rotating[name].entries).T * force
                add(name, force)
        friction = () if dissipation is None else self._friction(read(dissipation), coordinates)
        for name, force in (*others, *friction):
            add(name, force)
        return tuple((name, tuple(force)) for name, force in total.items())

    def _friction(self, dissipation: Expr, coordinates: Sequence[str]) -> Iterator[tuple[str, Matrix]]:
        """Yield the forces of Rayleigh's function."""
        for name, rates in self._rates(coordinates).items():
            if friction := gradient(dissipation, rates):
                yield name, -Matrix([friction.get(i, S.Zero) for i in range(len(rates))])

    def fields(
        self,
        function: str,
        formula: Expr,
        forces: Any,
        constraints: Sequence[Expr],
        variables: Sequence[str],
        parameters: Sequence[Symbol],
    ) -> dict[str, Any]:
        """Return the fields of a system that are formulas, as functions of its coordinates.

        Args:
            function: ``"lagrangian"`` or ``"hamiltonian"``.
            formula, constraints: in the names of formulas.
            forces: on all coordinates; with rotations by name (:meth:`forces_by_name`).
            variables, parameters: names of all coordinates, symbols of the parameters.
        """
        if not self.members:
            return {function: formula, "forces": forces, "constraints": tuple(constraints)}
        fields = {
            "forces": self.forces(forces, variables),
            "constraints": tuple(map(self.in_coordinates, constraints)),
            "rotations": self.members,
        }
        if function == "hamiltonian":
            return {function: self.in_coordinates(formula), "gauge": self.gauge(), **fields}
        reduced = Reduced(formula, forces, tuple(constraints))
        return {function: self.lagrangian(formula, parameters), "reduced": reduced, **fields}

    def _rates(self, coordinates: Sequence[str]) -> dict[str, tuple[Symbol, ...]]:
        ordinary = {name: (symbol(name + DOT),) for name in coordinates}
        return ordinary | {member.name: member.rates for member in self.members}

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
        entries = [each for each in (f"{name}_11", f"{name}_1") if each in self.symbols and name not in self.symbols]
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
            known = ", ".join(self.rotations)
            self.refuse(f"{name} needs a rotation first, not '{rotation}'. Rotations: {known}", place)
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
