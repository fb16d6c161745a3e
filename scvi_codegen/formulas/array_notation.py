"""Array formulas in LaTeX, and conversion of SymPy's ``Sum`` and ``Indexed`` to text of their grammar.

SymPy's own derivatives of such sums are not used, as they are sometimes wrong (repeated bound symbols, functions of
indices); a sum is read term by term.

    Sum(f, (i, 0, N - 1))                           sum(i in 0..N-1, f)
    Sum(f, (i, 0, N - 1)) with q[Mod(i + 1, N)]     sum(i in N periodic, f)
    Sum(f, (j, i + 1, N - 1), (i, 0, N - 2))        sum(i < j in N, f)
"""

from collections.abc import Mapping, Sequence

from sympy import Expr, Idx, Indexed, Mod, Sum, Symbol, Tuple, latex
from sympy.printing.str import StrPrinter

from scvi_codegen.errors import SystemDefinitionError
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
        listed = rf",\ \mathrm{{{loop.near}}}" if loop.near else ""
        return rf"\sum_{{0 \le {loop.behind} < {loop.index} < {loop.end}{listed}}}"
    if loop.periodic:
        return rf"\sum_{{{loop.index} \in \mathbb{{Z}}_{{{loop.end}}}}}"
    return rf"\sum_{{{loop.index}={loop.first}}}^{{{loop.end + -1}}}"


def latex_entry(access: Access) -> str:
    """Return an array entry with subscripts, with the summation signs of its convolutions."""
    name, places, before = access.array.name, [*map(_place, access.places)], ""
    for each in reversed(access.sums):
        before += rf"\sum_{{{each.index}}} {_letter(each.coefficients.name)}_{{{each.index}-{places[each.axis]}}} "
        places[each.axis] = each.index
    letter = rf"\dot{{{_letter(name.removesuffix(DOT))}}}" if name.endswith(DOT) else _letter(name)
    entry = f"{letter}_{{{', '.join(places)}}}"
    return rf"\left({before}{entry}\right)" if before else entry


def _letter(name: str) -> str:
    return name if len(name) == 1 else rf"\mathrm{{{name}}}".replace("_", r"\_")


def _place(subscript: Place) -> str:
    return (
        rf"{_letter(subscript.table)}_{{{subscript.index} {subscript.column}}}" if subscript.table else str(subscript)
    )


def array_text(expression: Expr) -> str:
    """Return the text of a sum of sums.

    Raises:
        SystemDefinitionError: for other limits than those above.

    >>> from sympy import IndexedBase, symbols
    >>> q, (i, N) = IndexedBase("q"), symbols("i N", integer=True)
    >>> array_text(-Sum((q[Mod(i + 1, N)] - q[i]) ** 2 / 2, (i, 0, N - 1)))
    '-sum(i in N periodic, (q[i + 1] - q[i])**2/2)'
    """
    return str(_Printer({"full_prec": False}).doprint(expression))


class _Printer(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    def _as_ordered_terms(self, expression: Expr, order: object = None) -> list[Expr]:
        """Return the terms in the order of their texts: results depend on it, and SymPy's order on its version."""
        texts = {term: self._print(term) for term in expression.args}
        return sorted(texts, key=lambda term: (bool(term.is_Number), texts[term].lstrip("-"), texts[term]))

    def _print_Sum(self, expression: Sum) -> str:
        wrapped = dict(map(_wrapped, expression.function.atoms(Mod)))
        for index in (each for entry in expression.function.atoms(Indexed) for each in entry.indices):
            if index.is_Add and index.free_symbols & set(wrapped):
                raise SystemDefinitionError(
                    f"{index} leaves a periodic axis: write Mod({index}, ..), as in its other indices"
                )
        loops = ", ".join(_loops(expression.limits, wrapped))
        return f"sum({loops}, {self._print(expression.function)})"

    def _print_Indexed(self, expression: Indexed) -> str:
        return f"{expression.base.label}[{', '.join(map(self._print, expression.indices))}]"

    def _print_Idx(self, expression: Idx) -> str:
        return str(expression.label)

    def _print_Mod(self, expression: Mod) -> str:
        _wrapped(expression)
        return str(self._print(expression.args[0]))


def _wrapped(expression: Mod) -> tuple[Symbol, Expr]:
    """Return the index in a periodic expression Mod(i + k, N), and the period."""
    index, length = expression.args
    indices = [each for each in index.free_symbols if each not in length.free_symbols]
    if len(indices) != 1 or not (index - indices[0]).is_Integer:
        raise SystemDefinitionError(f"{expression} is not an index of a periodic axis: write Mod(i + 1, N)")
    return indices[0], length


def _loops(limits: Sequence[Tuple], wrapped: Mapping[Symbol, Expr]) -> list[str]:
    """Return the loops of a sum, outermost first; an index that begins at another plus 1 is the second of a pair."""
    if any(len(limit) != 3 for limit in limits):
        raise SystemDefinitionError(f"a sum must have an index and two bounds, as (i, 0, N - 1), not {limits}")
    spans = {index: (first, last) for index, first, last in reversed(limits)}
    pairs = {outer: inner for inner, (first, _) in spans.items() for outer in spans if first - outer == 1}
    loops = []
    for index, (first, last) in spans.items():
        if index in pairs:
            length = spans[pairs[index]][1] + 1
            if first != 0 or last - length not in (-1, -2):
                raise SystemDefinitionError(f"pairs must run over a whole axis, ({index}, 0, N - 2), not {limits}")
            loops.append(f"{index} < {pairs[index]} in {length}")
        elif index in wrapped:
            if first != 0 or wrapped[index] != last + 1:
                message = (
                    f"Mod(.., {wrapped[index]}) requires a sum over the whole periodic axis, "
                    f"({index}, 0, {wrapped[index] - 1}), not {limits}"
                )
                raise SystemDefinitionError(message)
            loops.append(f"{index} in {last + 1} periodic")
        elif index not in pairs.values():
            loops.append(f"{index} in {first}..{last}")
    return loops
