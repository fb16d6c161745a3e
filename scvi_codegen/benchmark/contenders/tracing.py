"""Conversion of accelerations, written for any kind of number, into straight-line Python source for Numba."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scvi_codegen.benchmark.cases.unforced import Rates


class _Lines:
    """Assignments with common subexpressions shared; also replaces the module of functions."""

    def __init__(self) -> None:
        self.names: dict[str, str] = {}

    @property
    def time(self) -> _Traced:
        return _Traced(self, "t")

    def add(self, text: str) -> _Traced:
        return _Traced(self, self.names.setdefault(text, f"w{len(self.names)}"))

    def sin(self, x: _Traced) -> _Traced:
        return self.add(f"sin({x.text})")

    def cos(self, x: _Traced) -> _Traced:
        return self.add(f"cos({x.text})")

    def sqrt(self, x: _Traced) -> _Traced:
        return self.add(f"sqrt({x.text})")


class _Traced:
    """Number that records the operations on it."""

    def __init__(self, lines: _Lines, text: str) -> None:
        self.lines, self.text = lines, text

    def _binary(self, left: object, operator: str, right: object) -> _Traced:
        return self.lines.add(f"{_text(left)} {operator} {_text(right)}")

    def __add__(self, other: object) -> _Traced:
        return self._binary(self, "+", other)

    def __radd__(self, other: object) -> _Traced:
        return self._binary(other, "+", self)

    def __sub__(self, other: object) -> _Traced:
        return self._binary(self, "-", other)

    def __rsub__(self, other: object) -> _Traced:
        return self._binary(other, "-", self)

    def __mul__(self, other: object) -> _Traced:
        return self._binary(self, "*", other)

    def __rmul__(self, other: object) -> _Traced:
        return self._binary(other, "*", self)

    def __truediv__(self, other: object) -> _Traced:
        return self._binary(self, "/", other)

    def __neg__(self) -> _Traced:
        return self.lines.add(f"-{self.text}")

    def __pow__(self, exponent: float) -> _Traced:
        """Return half-integer powers by a square root, which is several times faster than ``pow``."""
        root = self.lines.sqrt(self)
        power = {0.5: root, 1.5: self * root}[abs(exponent)]
        return self.lines.add(f"1.0 / {power.text}") if exponent < 0 else power


def _text(value: object) -> str:
    return value.text if isinstance(value, _Traced) else f"({float(value)!r})"  # type: ignore[arg-type]


def rates_text(rates: Rates, parameters: Mapping[str, float], size: int) -> str:
    """Return the source of ``def rates(out, t, x, unused)``, which fills ``out`` with the derivative of ``x``."""
    lines = _Lines()
    results: list[Any] = rates([_Traced(lines, f"x[{n}]") for n in range(size)], parameters, lines)
    body = [f"{name} = {operation}" for operation, name in lines.names.items()]
    body += [f"out[{n}] = {_text(result)}" for n, result in enumerate(results)]
    return "def rates(out, t, x, unused):\n    " + "\n    ".join(body) + "\n"
