"""Conversion of accelerations, written for any kind of number, into straight-line Python source for Numba."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from scvi_codegen.benchmark.cases.unforced import Rates


class _Traced:
    """Number that records the operations on it; common subexpressions are shared."""

    def __init__(self, names: dict[str, str], text: str) -> None:
        self.names, self.text = names, text

    def record(self, text: str) -> _Traced:
        return _Traced(self.names, self.names.setdefault(text, f"w{len(self.names)}"))

    def __neg__(self) -> _Traced:
        return self.record(f"-{self.text}")

    def __pow__(self, exponent: float) -> _Traced:
        """Return half-integer powers by a square root, which is several times faster than ``pow``."""
        root: Any = self.record(f"sqrt({self.text})")
        power = {0.5: root, 1.5: self * root}[abs(exponent)]
        return self.record(f"1.0 / {power.text}") if exponent < 0 else power


def _binary(form: str) -> Callable[[_Traced, Any], _Traced]:
    return lambda self, other: self.record(form.format(self.text, _text(other)))


for _name, _operator in {"add": "+", "sub": "-", "mul": "*", "truediv": "/"}.items():
    setattr(_Traced, f"__{_name}__", _binary(f"{{0}} {_operator} {{1}}"))
    setattr(_Traced, f"__r{_name}__", _binary(f"{{1}} {_operator} {{0}}"))


class _Functions:
    """Replacement of the module of functions."""

    def __init__(self, time: _Traced) -> None:
        self.time = time

    def __getattr__(self, name: str) -> Callable[[_Traced], _Traced]:
        return lambda x: x.record(f"{name}({x.text})")


def _text(value: Any) -> str:
    return value.text if isinstance(value, _Traced) else f"({float(value)!r})"


def rates_text(rates: Rates, parameters: Mapping[str, float], size: int) -> str:
    """Return the source of ``def rates(out, t, x, unused)``, which fills ``out`` with the derivative of ``x``."""
    names: dict[str, str] = {}
    x = [_Traced(names, f"x[{n}]") for n in range(size)]
    results: list[Any] = rates(x, parameters, _Functions(_Traced(names, "t")))
    body = [f"{name} = {operation}" for operation, name in names.items()]
    body += [f"out[{n}] = {_text(result)}" for n, result in enumerate(results)]
    return "def rates(out, t, x, unused):\n    " + "\n    ".join(body) + "\n"
