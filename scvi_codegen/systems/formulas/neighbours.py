"""Lists of neighbours in formulas: the pairs of points that are closer than a cutoff, in a box with or without periods.

A sum over ``i < j in near`` is the sum over all pairs of its summand times a step function of the distance. Generated
code evaluates only the pairs of the list (templates/support/arrays/neighbours.h).

Convolutions of arrays within sums, ``sum(j in N, c[j-i]*q[j])``, at each place i.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.indices import Access, Array, Convolution, Loop, Place
from scvi_codegen.systems.formulas.symbols import check_name
from scvi_codegen.systems.formulas.translation import format_expression

MAX_COMPONENTS = 3
"""Largest number of components of a position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbours:
    """List of the pairs of points that are closer than a cutoff, made and updated in C.

    Attributes:
        name: of the list.
        array: positions, ``r[N, 3]``, or ``q[N]`` on a line.
        box: length of a period of each component; empty without periods.
        cutoff: pairs contribute only at distances below it.
        skin: the list contains pairs up to cutoff + skin; it is made again when a point has moved by half of the skin.
    """

    name: str
    array: Array
    box: tuple[Expr, ...]
    cutoff: Expr
    skin: Expr

    @property
    def components(self) -> int:
        """Number of components of a position."""
        return self.array.axes[1].number if len(self.array.axes) > 1 else 1

    @property
    def lengths(self) -> tuple[tuple[str, str, str], ...]:
        """Lengths as texts, ``("near", "cutoff", "5*s/2")``, the cutoff first, for the checks of every run."""
        named = [("cutoff", self.cutoff), ("skin", self.skin), *(("box", period) for period in self.box)]
        return tuple((self.name, kind, format_expression(length)) for kind, length in named)

    def inside(self, first: str, other: str) -> str:
        """Return the formula that is 1 for points of two indices closer than the cutoff, else 0."""
        entry = f"{self.array.name}[{{}}, {{}}]" if len(self.array.axes) > 1 else f"{self.array.name}[{{}}]"
        apart = [f"{entry.format(first, k)} - {entry.format(other, k)}" for k in range(self.components)]
        apart = [f"wrap({x}, {period})" for x, period in zip(apart, self.box, strict=True)] if self.box else apart
        return f"unit_step(({self.cutoff})**2 - ({' + '.join(f'({x})**2' for x in apart)}))"


def parse_neighbours(
    argument: Mapping[str, Mapping[str, Any]], arrays: Sequence[Array], symbols: Mapping[str, Symbol]
) -> tuple[Neighbours, ...]:
    """Return the lists of neighbours, ``{"near": {"of": "r", "cutoff": "c", "box": "L", "skin": 0.3}}``.

    Args:
        argument: settings by name of the list; lengths are numbers or formulas of parameters; ``box`` is one length,
            or one per component, and absent without a periodic boundary.
        arrays: coordinates.
        symbols: parameters by name.
    """
    positions = {array.name: array for array in arrays if len(array.axes) == 1}
    positions |= {array.name: array for array in arrays if [bool(axis.name) for axis in array.axes[1:]] == [False]}
    results = []
    for name, entry in argument.items():
        check_name(name)
        keys = set(entry) if isinstance(entry, Mapping) else set()
        if not {"of", "cutoff"} <= keys <= {"of", "cutoff", "box", "skin"}:
            raise SystemDefinitionError(
                f"the neighbours '{name}' must have the keys of and cutoff, and may have box and skin, not {entry!r}"
            )
        if (array := positions.get(str(entry["of"]))) is None:
            raise SystemDefinitionError(
                f"the neighbours '{name}' are of '{entry['of']}', which is not an array of positions, as r[N, 3]"
            )
        count, box = array.axes[1].number if len(array.axes) > 1 else 1, entry.get("box", ())
        box = list(box) if isinstance(box, Sequence) and not isinstance(box, str) else [box] * count
        if count > MAX_COMPONENTS or len(box) not in (0, count):
            raise SystemDefinitionError(
                f"the box of the neighbours '{name}' must be one length, or one per component of {array} (at most 3)"
            )
        formulas = (*box, entry["cutoff"], entry.get("skin", f"({entry['cutoff']})/8"))
        lengths = [parse_expression(str(value), symbols) for value in formulas]
        if wrong := [str(length) for length in lengths if length.is_number and not length > 0]:
            raise SystemDefinitionError(f"the lengths of the neighbours '{name}' must be positive, not {wrong[0]}")
        *periods, cutoff, skin = lengths
        results.append(Neighbours(name=name, array=array, box=tuple(periods), cutoff=cutoff, skin=skin))
    return tuple(results)


NESTED = (
    "a sum within a sum must have whole numbers as bounds, or be a convolution of coordinates and parameters over the "
    "axis of a sum, sum(i in N, .. sum(j in N, c[j-i]*q[j])); write sum(i in N, j in N, ..) for a double sum"
)
"""Error message of other sums within sums."""


def convolution_of(
    term: Expr, loop: Loop, accesses: Mapping[Symbol, Access], bounds: Mapping[str, object]
) -> tuple[Expr, Access] | None:
    """Return the factor and the access q[j] of a term with c[j-i] q[j] in a sum over j; ``None`` if it is another."""
    entries = {slot: access for slot, access in accesses.items() if loop.index in access.indices}
    slots = sorted(
        (slot for slot in term.free_symbols if slot in entries),
        key=lambda slot: not any(place.minus for place in entries[slot].places),
    )
    if len(slots) != 2 or term.diff(*slots) * slots[0] * slots[1] != term:
        return None
    coefficients, convolved = (entries[slot] for slot in slots)
    at = bounds.get(coefficients.places[0].minus)
    axes = [k for k, place in enumerate(convolved.places) if place.index == loop.index]
    plain = convolved.places[axes[0]] == Place(index=loop.index) and convolved.array.axes[axes[0]] == loop.end
    whole = isinstance(at, Loop) and at.is_whole and at.end == loop.end and loop.is_whole
    if not (plain and whole) or len(axes) != 1 or coefficients.array.axes != (loop.end,):
        return None
    places = [*convolved.places]
    places[axes[0]] = Place(index=coefficients.places[0].minus)
    added = Convolution(axes[0], coefficients.array, loop.index)
    return term.diff(*slots), replace(convolved, places=tuple(places), sums=(*convolved.sums, added))
