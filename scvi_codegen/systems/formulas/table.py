"""Tables: splines through points, as functions of formulas (:mod:`scvi_codegen.systems.formulas.tables`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import SystemDefinitionError

Outside: TypeAlias = Literal["refuse", "constant", "linear"]
LARGEST_DEGREE = 5


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
        if self.degree not in range(1, LARGEST_DEGREE + 1):
            raise SystemDefinitionError(f"degree of a table must be 1 to {LARGEST_DEGREE}, not {self.degree!r}")
        if self.outside not in get_args(Outside):
            allowed = " or ".join(map(repr, get_args(Outside)))
            raise SystemDefinitionError(f"outside of a table must be {allowed}, not {self.outside!r}")
        two = len(self.x) == 2 and np.ndim(self.x[0]) == 1
        axes = [_monotone(axis, self.degree) for axis in (self.x if two else [self.x])]
        try:
            values = np.array(self.y, dtype=float)
        except (TypeError, ValueError):
            values = np.array(np.nan)
        if values.shape != (shape := tuple(map(len, axes))) or not np.isfinite(values).all():
            raise SystemDefinitionError(f"y of a table must be finite numbers of the shape {shape} of its abscissae")
        for k, axis in enumerate(axes):
            if axis[0] > axis[-1]:
                axes[k], values = axis[::-1], np.flip(values, k)
        x = tuple(tuple(axis.tolist()) for axis in axes)
        object.__setattr__(self, "x", x if two else x[0])
        object.__setattr__(self, "y", tuple(map(tuple, values.tolist())) if two else tuple(values.tolist()))

    @property
    def axes(self) -> tuple[tuple[float, ...], ...]:
        """Abscissae of each argument, ascending."""
        return self.x if isinstance(self.x[0], tuple) else (self.x,)

    @property
    def is_smooth(self) -> bool:
        """Whether its first derivatives are continuous."""
        return self.degree > 1 and self.outside != "constant"


def _monotone(values: Any, degree: int) -> NDArray[np.float64]:
    """Return abscissae as numbers."""
    try:
        x = np.array(values, dtype=float)
    except (TypeError, ValueError):
        x = np.array(np.nan)
    if x.ndim != 1 or len(x) <= degree or not np.isfinite(x).all():
        raise SystemDefinitionError(f"x of a table of degree {degree} must be at least {degree + 1} finite numbers")
    steps = np.diff(x) * (1.0 if x[-1] > x[0] else -1.0)
    for k in np.flatnonzero(steps <= 0.0)[:1]:
        raise SystemDefinitionError(
            f"x of a table must be strictly monotone: {x[k + 1]:g} follows {x[k]:g}. Sort the points, and keep one "
            "of those with equal x"
        )
    return x


def tables_of(functions: Mapping[str, Table | Mapping[str, Any]] | None) -> dict[str, dict[str, Any]]:
    """Return functions as tables of their arguments, as of ``[functions.F]`` in model files.

    Raises:
        SystemDefinitionError: naming the function, if its points are invalid.
    """
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
