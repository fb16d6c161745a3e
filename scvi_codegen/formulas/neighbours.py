"""Lists of neighbours in formulas: the pairs of points that are closer than a cutoff, in a box with or without periods.

A sum over ``i < j in near`` is the sum over all pairs of its summand times a step function of the distance. Generated
code evaluates only the pairs of the list (templates/support/arrays/neighbours.h).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from sympy import Add, Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import unit_step, wrap
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.symbols import check_name
from scvi_codegen.indices import Array

DEFAULT_SKIN = "({cutoff})/8"
MAX_COMPONENTS = 3
"""Largest number of components of a position."""
KEYS = ("of", "cutoff", "box", "skin")


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

    def inside(self, one: Sequence[Expr], other: Sequence[Expr]) -> Expr:
        """Return 1 for two positions closer than the cutoff, else 0."""
        apart = [a - b for a, b in zip(one, other, strict=True)]
        shortest = [wrap(x, period) for x, period in zip(apart, self.box, strict=True)] if self.box else apart
        return unit_step(self.cutoff**2 - Add(*(x**2 for x in shortest)))


def parse_neighbours(
    argument: Mapping[str, Mapping[str, Any]], arrays: Sequence[Array], symbols: Mapping[str, Symbol]
) -> tuple[Neighbours, ...]:
    """Return the lists of neighbours, ``{"near": {"of": "r", "cutoff": "c", "box": "L", "skin": 0.3}}``.

    Args:
        argument: settings by name of the list; lengths are numbers or formulas of parameters; ``box`` is one length,
            or one per component, and absent without a periodic boundary.
        arrays: coordinates.
        symbols: parameters by name.

    Raises:
        SystemDefinitionError: if a key is missing or unknown, or ``of`` is not an array of positions.
    """
    by_name, results = {array.name: array for array in arrays}, []
    for name, entry in argument.items():
        check_name(name)
        keys = set(entry) if isinstance(entry, Mapping) else set()
        if not {"of", "cutoff"} <= keys <= set(KEYS):
            raise SystemDefinitionError(
                f"the neighbours '{name}' must have the keys of and cutoff, and may have box and skin, not {entry!r}"
            )
        array = by_name.get(str(entry["of"]))
        if array is None or not 1 <= len(array.axes) <= 2 or (len(array.axes) == 2 and array.axes[1].name):
            raise SystemDefinitionError(
                f"the neighbours '{name}' are of '{entry['of']}', which is not an array of positions, as r[N, 3]"
            )
        length = partial(_length, symbols=symbols)
        found = Neighbours(
            name=name,
            array=array,
            box=(),
            cutoff=length(entry["cutoff"]),
            skin=length(entry.get("skin", DEFAULT_SKIN.format(**entry))),
        )
        box = entry.get("box", ())
        periods = tuple(map(length, box if isinstance(box, Sequence) and not isinstance(box, str) else [box]))
        if len(periods) == 1:
            periods *= found.components
        if found.components > MAX_COMPONENTS or len(periods) not in (0, found.components):
            raise SystemDefinitionError(
                f"the box of the neighbours '{name}' must be one length, or one per component of {array} (at most 3)"
            )
        results.append(replace(found, box=periods))
    return tuple(results)


def _length(value: Any, symbols: Mapping[str, Symbol]) -> Expr:
    length = parse_expression(str(value), symbols)
    if length.is_number and not length > 0:
        raise SystemDefinitionError(f"the lengths of lists of neighbours must be positive, not {value}")
    return length
