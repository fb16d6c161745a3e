"""Tables: splines through points, as functions of formulas (:mod:`scvi_codegen.systems.formulas.tables`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import SystemDefinitionError

Outside: TypeAlias = Literal["refuse", "constant", "linear"]


@dataclass(frozen=True)
class Table:
    """Spline through points, a function of formulas with one or two arguments.

    Args:
        x: strictly monotone abscissae; of two arguments a pair of them.
        y: ordinates; of two arguments a matrix with a row for each of the first abscissae.
        degree: of the polynomials between the breakpoints, 1 to 5; degree k has k - 1 continuous derivatives. The
            spline is that of :func:`scipy.interpolate.make_interp_spline`, whose breakpoints of degrees 2 and 4 lie
            between the points.
        outside: what a value beyond the first or last point is: an error ("refuse"), that at the end ("constant"), or
            that of the tangent at the end ("linear").

    Raises:
        SystemDefinitionError: for points that are not finite, too few or not monotone, and other degrees.
    """

    x: Any
    y: Any
    degree: int = 1
    outside: Outside = "refuse"

    def __post_init__(self) -> None:
        if self.degree not in range(1, 6):
            raise SystemDefinitionError(f"degree of a table must be 1 to 5, not {self.degree!r}")
        if self.outside not in get_args(Outside):
            raise SystemDefinitionError(f"outside of a table must be one of {get_args(Outside)}, not {self.outside!r}")
        pair = isinstance(self.x, tuple | list) and len(self.x) == 2 and np.ndim(self.x[0]) == 1
        axes, values = [_numbers(axis) for axis in (self.x if pair else [self.x])], _numbers(self.y)
        if values.shape != (shape := tuple(map(np.size, axes))) or not np.isfinite(values).all():
            raise SystemDefinitionError(f"y of a table must be finite numbers of the shape {shape} of its abscissae")
        for k, axis in enumerate(axes):
            if axis.ndim != 1 or len(axis) <= self.degree or not np.isfinite(axis).all():
                least = f"at least {self.degree + 1} finite numbers"
                raise SystemDefinitionError(f"x of a table of degree {self.degree} must be {least}")
            if axis[0] > axis[-1]:
                axes[k], values = axis[::-1], np.flip(values, k)
            for j in np.flatnonzero(np.diff(axes[k]) <= 0.0)[:1]:
                raise SystemDefinitionError(
                    f"x of a table must be strictly monotone: it contains {axes[k][j]:g} before {axes[k][j + 1]:g}. "
                    "Sort the points, and keep one of those with equal x"
                )
        x = tuple(tuple(axis.tolist()) for axis in axes)
        object.__setattr__(self, "x", x if pair else x[0])
        object.__setattr__(self, "y", tuple(map(tuple, values.tolist())) if pair else tuple(values.tolist()))

    @property
    def axes(self) -> tuple[tuple[float, ...], ...]:
        """Abscissae of each argument, ascending."""
        return self.x if isinstance(self.x[0], tuple) else (self.x,)


def _numbers(values: Any) -> NDArray[np.float64]:
    """Return an array of numbers, NaN for anything else."""
    try:
        return np.array(values, dtype=float)
    except (TypeError, ValueError):
        return np.array(np.nan)


def tables_of(functions: Mapping[str, Table | Mapping[str, Any]] | None) -> dict[str, dict[str, Any]]:
    """Return functions as tables, as ``[functions.F]`` of model files; SystemDefinitionError for invalid points."""
    plain = {}
    for name, function in (functions or {}).items():
        try:
            plain[name] = asdict(function if isinstance(function, Table) else Table(**function))
        except (SystemDefinitionError, TypeError) as error:
            raise SystemDefinitionError(f"function '{name}': {error}") from error
    return plain


def functions_of(plain: Mapping[str, Mapping[str, Any]] | None) -> tuple[tuple[str, Table], ...]:
    """Return the functions of such tables, by name."""
    return tuple((name, Table(**arguments)) for name, arguments in (plain or {}).items())
