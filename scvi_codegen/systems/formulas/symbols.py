r"""Names of coordinates, velocities, momenta, parameters and inputs: validation, conversion to canonical symbols.

Every symbol is ``Symbol(name, real=True)`` with a plain identifier as name: coordinate ``q`` has the velocity
``q_dot``, time is ``t``. Names chosen by the user are converted as follows.

* ``\theta_1``, ``\theta_{1}`` and ``θ_1`` become ``theta_1``; spaces become underscores.
* Rejected, with the name: invalid identifiers after this conversion, keywords of C, functions and constants of the
  grammar, ``t`` for anything but time, ``q_dot`` for anything but the velocity of ``q``, two symbols of equal names.

**Inputs** are functions of time passed to runs as data, such as a motor force or a measured ground motion. Between two
breakpoints an input u is a cubic of the time since the first of them,

    u(t) = u_0 + u_1 s + u_2 s^2 + u_3 s^3,        s = t - u_t,

with five parameters of the system. A run updates them at the breakpoints, which are ends of steps: other data need no
recompilation, every method and solver supports them, and no step contains a breakpoint, so orders are preserved.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning, warn
from scvi_codegen.common.validation import ExactNumber

if TYPE_CHECKING:
    from sympy import Basic, Expr, Symbol

C_KEYWORDS = frozenset(
    """
    alignas alignof auto bool break case char const constexpr continue default do double else enum extern false float
    for goto if inline int long nullptr register restrict return short signed sizeof static static_assert struct switch
    thread_local true typedef typeof typeof_unqual union unsigned void volatile while asm fortran
    """.split()  # noqa: SIM905  (a paragraph of words reads better than fifty quoted ones)
)

IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
TIME = "t"
DOT = "_dot"


def symbol(name: str) -> Symbol:
    """Return the real symbol of that name."""
    from sympy import Symbol

    return Symbol(name, real=True)


def number(name: str, value: Any) -> float:
    """Convert a default value to float, also an exact one; text, complex and non-finite numbers are rejected."""
    if isinstance(value, ExactNumber) and math.isfinite(value):
        return value
    if not isinstance(value, str) and hasattr(value, "__len__") and name.isidentifier():
        count = len(value) if getattr(value, "ndim", 1) else 1
        raise SystemDefinitionError(
            f"the parameter '{name}' has {count} values, which requires its size beside the name: "
            f"parameters={{'{name}[{count}]': ..}}, with entries {name}[0] to {name}[{max(count - 1, 0)}] in formulas"
        )
    try:
        converted = math.nan if isinstance(value, (str, bytes, complex)) else float(value)
    except (TypeError, ValueError, OverflowError):
        converted = math.nan
    if not math.isfinite(converted):
        raise SystemDefinitionError(f"the default value of parameter '{name}' is not a finite real number: {value!r}")
    return converted


def identifier(name: str) -> str:
    r"""Convert a name to letters, digits and underscores where possible: ``\theta_{1}`` -> ``theta_1``."""
    spelled = "".join(_letter(character) for character in name.strip())
    return re.sub(r"\s+", "_", spelled.replace("{", "").replace("}", "").replace("\\", ""))


def _letter(character: str) -> str:
    words = unicodedata.name(character, "").split()
    if words[:1] != ["GREEK"] or words[2:3] != ["LETTER"] or len(words) != 4:
        return character
    letter = words[3].replace("LAMDA", "LAMBDA")
    return letter.lower() if words[1] == "SMALL" else letter.capitalize()


def name_of_key(key: object) -> str:
    """Return the name of a parameter that is a symbol, a function of time or text."""
    if isinstance(key, str):
        return key
    from sympy import Symbol
    from sympy.core.function import AppliedUndef

    if isinstance(key, (Symbol, AppliedUndef)):
        return str(key.name)
    raise SystemDefinitionError(f"a parameter must be a symbol or a name, not {key!r} ({type(key).__name__})")


def check_name(name: object) -> None:
    """Raise :class:`SystemDefinitionError` for names that are invalid in C or in formulas."""
    if not isinstance(name, str) or not IDENTIFIER.fullmatch(name):
        arrays = "; arrays are declared among the coordinates, as q[N]" if isinstance(name, str) and "[" in name else ""
        raise SystemDefinitionError(
            f"{name!r} is not a valid name: use letters a-z, A-Z, digits and underscores, beginning "
            f"with a letter{arrays}"
        )
    if name in C_KEYWORDS:
        raise SystemDefinitionError(f"'{name}' is a keyword of C: rename the symbol, for example to '{name}_'")
    from scvi_codegen.systems.formulas.expressions import KINKED, RESERVED

    if name in RESERVED or name == "pi":
        raise SystemDefinitionError(f"'{name}' is reserved in formulas: rename the symbol, for example to '{name}_'")
    if name in KINKED:
        warn(
            f"'{name}' is a name of this system, so the function {name}(..) is not available in its formulas: rename "
            f"the symbol, for example to '{name}_', to use both",
            SystemDefinitionWarning,
        )


def check_names(
    coordinates: Sequence[str], parameters: Sequence[str], momenta: Sequence[str] = (), entries: Iterable[str] = ()
) -> None:
    """Raise :class:`SystemDefinitionError` for invalid names of a system, and for one name in two roles."""
    described = [(name, "an entry of a rotation, direction or spin") for name in entries]
    if not coordinates and not described:
        raise SystemDefinitionError("a system needs at least one coordinate: coordinates is empty")
    roles: dict[str, str] = {TIME: "time"}
    for name in (*coordinates, *momenta, *parameters):
        check_name(name)
    described += [
        *((name, f"coordinate '{name}'") for name in coordinates),
        *((name + DOT, f"the velocity of '{name}'") for name in coordinates),
        *((name, f"momentum '{name}'") for name in momenta),
        *((name, f"parameter '{name}'") for name in parameters),
    ]
    for name, role in described:
        if roles.get(name) == role:
            raise SystemDefinitionError(f"{role} is listed twice: list it once")
        if name in roles:
            shadowed = role.startswith("parameter") and roles[name].startswith("coordinate")
            hint = " (a coordinate is used as a parameter: take it out of the parameters)" if shadowed else ""
            raise SystemDefinitionError(f"'{name}' is the name of both {roles[name]} and {role}: rename one{hint}")
        roles[name] = role


PARTS = ("0", "1", "2", "3", "t")
"""Suffixes of the five parameters of an input: coefficients by power, and the breakpoint."""


def input_parameters(inputs: Sequence[str]) -> dict[str, float]:
    """Return the parameters of all inputs, with default value 0."""
    for name in inputs:
        check_name(name)
    return {f"{name}_{part}": 0.0 for name in inputs for part in PARTS}


def with_inputs(parameters: Mapping[str, float], inputs: Sequence[str]) -> dict[str, float]:
    """Return the default values of parameters and inputs; SystemDefinitionError if two have the same name."""
    parts = input_parameters(inputs)
    for name in parameters:
        if name in parts:
            raise SystemDefinitionError(
                f"'{name}' is the name of both a parameter and a component of the input '{name[:-2]}': rename one"
            )
    return {**parameters, **parts}


def input_formulas(inputs: Sequence[str], time: Symbol) -> Mapping[Symbol, Expr]:
    """Return the cubic polynomial of each input, by its symbol."""
    formulas: dict[Symbol, Expr] = {}
    for name in inputs:
        c0, c1, c2, c3, start = (symbol(f"{name}_{part}") for part in PARTS)
        s = time - start
        formulas[symbol(name)] = c0 + s * (c1 + s * (c2 + s * c3))
    return formulas


def inputs_by_name(formula: Expr, inputs: Sequence[str]) -> Expr:
    """Return a formula with each input's polynomial replaced by its symbol (coefficient 0; others set to 0)."""
    from sympy import Integer

    rules: dict[Basic, Basic] = {symbol(part): Integer(0) for part in input_parameters(inputs)}
    return formula.xreplace(rules | {symbol(f"{name}_0"): symbol(name) for name in inputs})


def default_momenta(coordinates: Sequence[str]) -> tuple[str, ...]:
    """Return the default names of momenta."""
    return tuple(f"p_{name}" for name in coordinates)
