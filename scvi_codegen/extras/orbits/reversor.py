"""Reversors: symmetries that map motions to motions that run backward.

A reversor R changes positions by an affine involution, q -> A q + b with A^2 = 1 and A b = -b, velocities as v -> -A v,
and so momenta as p -> -A^T p. A motion that starts in the fixed set of R and returns to it after T/2 has the period T
and is its own mirror image (J. S. W. Lamb, J. A. G. Roberts, Physica D 112 (1998) 1). With the derivative D of half a
period and that of R, R', the monodromy matrix is R' D^-1 R' D.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, islice, product

import numpy as np

from scvi_codegen.api.formulas import Tape, mp, parse_expression, symbol
from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import ScviCodegenError, StateError
from scvi_codegen.extras.paths.size import SAME_MOTION

MOST_CANDIDATES = 256


@dataclass(frozen=True, eq=False)
class Reversor:
    """Reversor q -> A q + b with the (m, m) matrix A and the (m,) shift b."""

    matrix: Array
    shift: Array

    @classmethod
    def of(cls, coordinates: Sequence[str], texts: Sequence[str]) -> Reversor:
        """Return the reversor with these formulas of the positions, such as ``["x", "-y"]``."""
        if len(texts) != len(coordinates):
            raise StateError(f"reversor has {len(texts)} formulas, not one of each coordinate {', '.join(coordinates)}")
        symbols = {name: symbol(name) for name in coordinates}
        try:
            formulas = [parse_expression(text, symbols) for text in texts]
            slopes = [[formula.diff(symbols[name]) for name in coordinates] for formula in formulas]
            m, tape = len(formulas), Tape([*formulas, *chain.from_iterable(slopes)], [*symbols.values()])
            values = np.array(tape([mp.zero] * m), float)
            shift, matrix = values[:m], values[m:].reshape(m, m)
        except (ArithmeticError, ScviCodegenError) as error:
            raise StateError(f"reversor={list(texts)}: {error}") from error
        affine = not any(slope.free_symbols for row in slopes for slope in row)
        twice = np.allclose(matrix @ matrix, np.eye(len(matrix))) and np.allclose(matrix @ shift, -shift)
        if not affine or not twice:
            raise StateError(f"reversor={list(texts)} must be linear formulas that, applied twice, change no position")
        return cls(matrix, shift)

    @classmethod
    def fitting(cls, state: Array) -> Iterator[Reversor]:
        """Yield changes of signs of coordinates that leave a state where it is, those of few coordinates first.

        A candidate too many costs a trial only: steps verify each.
        """
        q, p = (np.abs(part) <= SAME_MOTION * np.abs(part).max() for part in np.split(state, 2))
        signs = [[1.0] * at_rest + [-1.0] * at_zero for at_zero, at_rest in zip(q.tolist(), p.tolist(), strict=True)]
        for choice in sorted(islice(product(*signs), MOST_CANDIDATES), key=sum, reverse=True):
            yield cls(np.diag(choice), np.zeros(len(choice)))

    def __call__(self, states: Array) -> Array:
        """Return the mirror images of (.., 2m) states."""
        q, p = np.split(states, 2, axis=-1)
        return np.concatenate([q @ self.matrix.T + self.shift, -p @ self.matrix], axis=-1)

    @cached_property
    def odd(self) -> Array:
        """(2m, 2m) projection onto the changes that R reverses, (1 - R')/2."""
        return np.asarray((np.eye(2 * len(self.shift)) - self._derivative) / 2.0)

    @cached_property
    def _derivative(self) -> Array:
        rest = np.zeros_like(self.matrix)
        return np.block([[self.matrix, rest], [rest, -self.matrix.T]])

    def monodromy(self, half: Array) -> Array:
        """Return the monodromy matrix of a period by the derivative of half of it."""
        return np.asarray(self._derivative @ np.linalg.solve(half, self._derivative @ half))
