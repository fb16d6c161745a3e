"""LaTeX of array formulas."""

from __future__ import annotations

from sympy import latex

from scvi_codegen.formulas.arrays import ArrayTerm
from scvi_codegen.formulas.symbols import DOT
from scvi_codegen.indices import Access, Loop, Place


def latex_sum(term: ArrayTerm) -> str:
    r"""Return a term in LaTeX.

    >>> from scvi_codegen.formulas.arrays import parse_array, parse_sums
    >>> (term,) = parse_sums("sum(i in 0..N-2, (q[i+1] - q[i])**2/2)", [parse_array("q[N]")], {})
    >>> print(latex_sum(term))
    \sum_{i=0}^{N-2} \left(\frac{\left(q_{i+1} - q_{i}\right)^{2}}{2}\right)
    """
    formula = latex(term.formula, symbol_names={slot: latex_entry(access) for slot, access in term.slots})
    sums = latex_sums(term)
    return f"{sums} \\left({formula}\\right)" if sums else str(formula)


def latex_sums(term: ArrayTerm) -> str:
    """Return the summation signs of a term alone."""
    pairs = {loop.behind for loop in term.loops}
    return " ".join(_sum(loop) for loop in term.loops if loop.index not in pairs)


def _sum(loop: Loop) -> str:
    if loop.behind:
        return rf"\sum_{{0 \le {loop.behind} < {loop.index} < {loop.end}}}"
    if loop.periodic:
        return rf"\sum_{{{loop.index} \in \mathbb{{Z}}_{{{loop.end}}}}}"
    return rf"\sum_{{{loop.index}={loop.first}}}^{{{loop.end + -1}}}"


def latex_entry(access: Access) -> str:
    """Return an array entry with subscripts."""
    name = access.array.name
    letter = rf"\dot{{{_letter(name.removesuffix(DOT))}}}" if name.endswith(DOT) else _letter(name)
    return f"{letter}_{{{', '.join(map(_place, access.places))}}}"


def _letter(name: str) -> str:
    return name if len(name) == 1 else rf"\mathrm{{{name}}}".replace("_", r"\_")


def _place(subscript: Place) -> str:
    return (
        rf"{_letter(subscript.table)}_{{{subscript.index} {subscript.column}}}" if subscript.table else str(subscript)
    )
