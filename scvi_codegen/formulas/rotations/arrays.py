"""Arrays of rotations, directions and spins in formulas in index notation: ``R_33[i]``, ``omega_1[i]``, ``n_3[i]``."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from sympy import Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.arrays import parse_coordinate
from scvi_codegen.formulas.rotations.members import AXES, Direction, Homogeneous, Rotation, Spin
from scvi_codegen.formulas.symbols import check_name, symbol
from scvi_codegen.indices import Array, Size


@dataclass(frozen=True, slots=True)
class MemberArray:
    """Array of rotations, directions or spins; a single one without axes.

    Attributes:
        member: its name and that of its rate, ``R`` and ``omega`` of ``R_33[i]`` and ``omega_1[i]``.
        axes: sizes.
    """

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
        return tuple(Array(each.name, self.axes) for each in _symbols(self.member))

    @property
    def rates(self) -> tuple[Array, ...]:
        """Arrays of the rates."""
        return tuple(Array(each.name, self.axes) for each in self.member.rates)

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
        for index, each in self.entries(sizes):
            for of, name in zip(_all_names(self.member), _all_names(each), strict=True):
                names.setdefault(of, {})[index] = name
        shape = tuple(axis.at(sizes) for axis in self.axes)
        return {of: np.array(list(each.values()), dtype=np.str_).reshape(shape) for of, each in names.items()}


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
    by_name, found = {member.name: member for member in members}, dict[Array, NDArray[np.str_]]()
    for array in arrays:
        first = "_0" * (len(array.axes) - 1)
        member = by_name.get(array.name + first)
        if first and member is not None:
            if isinstance(member, Rotation):
                member = replace(member, rate=member.rate.removesuffix(first))
            turning = MemberArray(replace(member, name=array.name), array.axes[:-1])
            names = turning.names(sizes)
            found |= {each: names[each.name] for each in turning.formulas}
    return found


def torque_components(
    members: Sequence[MemberArray], target: str, formulas: Sequence[str], *, in_space: bool
) -> Iterator[tuple[str, str, tuple[Array, ...]]]:
    """Yield target, formula and arrays of each component of a torque on ``R[i]``, or of a force on ``n[i]``."""
    name, bracket, place = target.partition("[")
    known = {each.member.name: each for each in members}
    if name not in known or isinstance(formulas, str) or len(formulas) != len(AXES):
        raise SystemDefinitionError(
            f"the torque on '{target}' must have three components and act on a rotation or a direction"
            f"{closest(name, known)}"
        )
    if known[name].axes and not bracket:
        raise SystemDefinitionError(f"'{name}' is an array: write the torque on each of them as '{name}[i]'")
    arrays = known[name].torques(in_space=in_space)
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
    return (*(each.name for each in _symbols(member)), *(name for names in torques for name in names))
