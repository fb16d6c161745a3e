"""Warnings of coefficients that jump within an element, where the error of elements no longer falls exponentially.

A coefficient with unit_step(x - a) is smooth on each element if a is an end of elements: its argument is evaluated
slightly inside of each of them, so that both have their own value at the end.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import sympy
from sympy import Expr

from scvi_codegen.api.formulas import symbol
from scvi_codegen.common.errors import SystemDefinitionWarning, warn
from scvi_codegen.extras.fields.axes import Axis
from scvi_codegen.extras.fields.density import Density

SAMPLES, HALVINGS = 65, 40
"""Number of samples of a function within an element, and of bisections that locate its jump."""
MOST_SAMPLED = 10**6
"""Largest number of samples of functions of several axes."""


def warn_of_jumps(system: Density, axes: Mapping[str, Axis]) -> None:
    """Issue a :class:`SystemDefinitionWarning` for coefficients that jump within elements, or have one value at ends.

    Parameters have their default values.
    """
    values = dict(zip(system.parameters, system.defaults, strict=True))
    for jump in sorted(system.jumps_in(system.density + system.dissipation), key=str):
        names = [axis for axis in axes if symbol(axis) in jump.free_symbols]
        if any(axes[axis].one_sided is None for axis in names):
            continue
        function = sympy.lambdify([symbol(axis) for axis in names], jump.xreplace(values), "numpy")
        if len(names) == 1:
            for place, ends in _jumps(function, axes[names[0]]):
                warn(
                    f"the density of '{system.name}' has {jump}, which jumps at {names[0]} = {place:.10g}, within the "
                    f"element from {ends[0]:g} to {ends[1]:g}: its error does not fall exponentially with the degree. "
                    f"Put an end of the elements there: elements=[.., {place:.10g}, ..]",
                    SystemDefinitionWarning,
                )
        elif _jumps_within(function, [axes[axis] for axis in names]):
            warn(
                f"the density of '{system.name}' has {jump}, which jumps within elements of {' and '.join(names)}: its "
                "error does not fall exponentially with the degree. Only jumps along ends of elements do not disturb",
                SystemDefinitionWarning,
            )
        if any(_jumps_at_edges(system, jump, axis) for axis in names):
            warn(
                f"the density of '{system.name}' has second derivatives, and {jump} in other terms with derivatives "
                "than a factor times the square of one of them: its value at ends of elements is that of one side, so "
                "that the error falls slowly with the degree",
                SystemDefinitionWarning,
            )


def _jumps(function: Callable[..., Any], axis: Axis) -> Iterator[tuple[float, tuple[float, float]]]:
    """Yield the places within elements at which a function of one axis changes, and the ends of the elements."""
    assert axis.one_sided is not None
    for cell, ends in zip(axis.one_sided.cells, axis.cell_points, strict=True):
        places = np.linspace(cell[0], cell[-1], SAMPLES)
        values = np.broadcast_to(function(places), places.shape)
        for k in np.flatnonzero(np.diff(values)).tolist():
            low, high = float(places[k]), float(places[k + 1])
            for _ in range(HALVINGS):
                middle = (low + high) / 2.0
                low, high = (middle, high) if function(middle) == values[k] else (low, middle)
            yield high, (float(ends[0]), float(ends[-1]))


def _jumps_within(function: Callable[..., Any], axes: list[Axis]) -> bool:
    """Return whether a function of several axes changes within an element."""
    cells = [axis.one_sided.cells for axis in axes if axis.one_sided is not None]
    if int(np.prod([cell.size for cell in cells])) > MOST_SAMPLED:
        return False
    for element in itertools.product(*cells):
        grid = np.meshgrid(*element, indexing="ij")
        if np.ptp(np.broadcast_to(function(*grid), grid[0].shape)):
            return True
    return False


def _jumps_at_edges(system: Density, jump: Expr, axis: str) -> bool:
    """Return whether a function is in terms that are evaluated at edges, but for the squares of second derivatives."""
    derivatives = {symbol(name): orders for name, (_, orders) in system.derivatives.items()}
    used = [name for name in derivatives if name in system.potential.free_symbols]
    if not any(derivatives[name].get(axis) == 2 for name in used):
        return False
    rest = system.potential
    for name in system.second_derivatives(rest, axis):
        rest -= rest.diff(name, 2) * name**2 / 2
    terms = sympy.Add.make_args(sympy.expand(rest))
    return any(jump in term.atoms(type(jump)) and term.free_symbols & set(used) for term in terms)
