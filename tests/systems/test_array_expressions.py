"""Sums over indices: what is read, and what is refused with a remedy."""

from itertools import combinations

import numpy as np
import pytest

from scvi_codegen.common.errors import ExpressionError, SystemDefinitionError
from scvi_codegen.systems.formulas.arrays import ArrayTerm, parse_array, parse_sums
from scvi_codegen.systems.formulas.numpy_values import Elements
from scvi_codegen.systems.formulas.symbols import symbol

ARRAYS = [parse_array(text) for text in ("q[N]", "r[N, 3]", "u[NX, NY]", "k[B]")]
TABLES = [parse_array("bonds[B, 2]")]
NAMES = {name: symbol(name) for name in ("c", "t")}


def terms(text: str) -> tuple[ArrayTerm, ...]:
    """Return the parsed terms."""
    return parse_sums(text, ARRAYS, NAMES, TABLES)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("sum(i in N, q[i]**2)", ["sum(i in N, q[i]**2)"]),
        ("-c*sum(i in 0..N-2, q[i]*q[i+1])/2", ["sum(i in 0..N-2, -c*q[i+1]*q[i]/2)"]),
        ("sum(i in N periodic, q[i-2]*q[i])", ["sum(i in N periodic, q[i-2]*q[i])"]),
        ("sum(i < j in N, cos(q[i] - q[j]))", ["sum(i < j in N, cos(q[i] - q[j]))"]),
        ("sum(b in B, k[b]*q[bonds[b, 0]])", ["sum(b in B, k[b]*q[bonds[b, 0]])"]),
        ("sum(i in NX periodic, j in 1..NY-1, u[i+1, j]*u[i, j-1])", None),
        ("sum(i in N, sum(a in 3, r[i, a]**2))", ["sum(i in N, r[i, 0]**2 + r[i, 1]**2 + r[i, 2]**2)"]),
        ("sum(i in N, sum(a < b in 3, r[i, a]*r[i, b]))", None),
        ("sum(i in N, q[i]) + sum(j in N, q[j])", ["sum(i in N, q[i])", "sum(j in N, q[j])"]),
        ("sum(i in N, q[i]) - sum(i in N, t*q[i]**2)", ["sum(i in N, -q[i]**2*t + q[i])"]),
        ("q[0]**2 + q[N-1]", ["q[0]**2 + q[N-1]"]),
        ("sum(a in 0..2, q[a])", ["q[0] + q[1] + q[2]"]),
    ],
)
def test_index_notation_is_parsed(text: str, read: list[str] | None) -> None:
    """Terms over the same loops are one; sums over whole numbers are written out; the text of a term is read again."""
    found = terms(text)
    if read is not None:
        assert [str(term) for term in found] == read
    again = terms(" + ".join(f"({term})" if not term.loops else str(term) for term in found))
    assert again == found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sum(i in N, q[i+1])", "i+1 is N at i = N-1: end at i in 0..N-2, or write 'i in N periodic'"),
        ("sum(i in N, q[i-1])", "i-1 is -1 at i = 0: begin at i in 1..N-1"),
        ("sum(i in 0..N, q[i])", "i is N at i = N: end at i in 0..N-1"),
        ("sum(i in 0..N-2 periodic, q[i])", "is not an index of a periodic axis of size N"),
        ("q[N]", "N is outside an axis of size N"),
        ("q[-1]", "-1 is outside an axis of size N"),
        ("sum(i in N, r[i, 3])", "3 is outside an axis of size 3"),
        ("sum(i in N, q[i, 0])", "has 1 axes, but 2 indices are given"),
        ("sum(i in M, q[i])", "'M' is not the size of an array"),
        ("sum(i in N, x[i])", "'x' is not an array"),
        ("sum(i in N, m[i]*q[i]**2)", "constants as a parameter: parameters={'m[N]': 1.0}, in files"),
        ("sum(i in N, b in B, m[i, (b)]*q[i]**2)", 'in files [parameters] "m[N, B]" = 1.0'),
        ("sum(i in N, q[j])", "'j' is not an index"),
        ("sum(i in N, q)", "'q' is an array, q[N]: write an entry, q[i]"),
        ("sum(i in N, i*q[i])", "'i' is an index, which may occur only in brackets"),
        ("N*sum(i in N, q[i])", "'N' is a size, which may occur only in brackets"),
        ("sum(b in B, bonds[b, 0])", "'bonds' is an index table"),
        ("sum(b in B, q[bonds[b, 2]])", "2 is outside an axis of size 2"),
        ("sum(b in B, q[bonds[b+1, 0]])", "b+1 is B at b = B-1"),
        ("sum(b in 0..B-2, q[bonds[b+1, 0]])", "a table must be accessed by an index and a whole number"),
        ("sum(i in N, sum(i in 3, q[i]))", "the index 'i' is used by an enclosing sum"),
        ("sum(c in N, q[c])", "'c' is the name of something else"),
        ("sum(i in N, q[i])**2", "a sum may be multiplied by numbers and parameters only"),
        ("sum(i in N, q[i])*sum(i in N, q[i])", "a sum may be multiplied by numbers and parameters only"),
        ("sum(i in N, sum(j in N, q[j]))", "a sum within a sum must have whole numbers as bounds"),
        ("sum(i < j in 1..N-1, q[i])", "pairs must run over a whole axis"),
        ("sum(a in 100, q[a])", "1 to 64 terms, not 100"),
        ("sum(a in 100000000, q[0])", "1 to 64 terms, not 100000000"),  # counted before it is written out
        ("sum(a < b in 100000000, q[0])", "1 to 64 terms, not 4999999950000000"),
        ("sum(a in 0..-5, q[0])", "1 to 64 terms, not 0"),
        ("sum(a in 64, sum(b in 64, sum(d in 64, q[0])))", "may have at most 4096 terms, not 262144"),
        ("sum(i in N q[i])", "',' is expected here"),
        ("sum(i in N, q[i)", "']' is expected here"),
        ("sum(i, q[0])", "'in' is expected here"),
        ("q[1.5]", "a whole number of at most 9 digits is expected here"),
    ],
)
def test_invalid_index_notation_is_rejected(text: str, message: str) -> None:
    """Errors name the column and the remedy."""
    with pytest.raises(ExpressionError) as caught:
        terms(text)
    assert message in str(caught.value)


@pytest.mark.parametrize("text", ["q", "q[]", "q[N", "q[N]x", "q[N+1]", "q[0]", "2[N]", "for[N]", "q[N.5]"])
def test_invalid_declarations_are_rejected(text: str) -> None:
    """An array has a name and axes."""
    with pytest.raises(SystemDefinitionError):
        parse_array(text)


def test_values_of_pairs_are_those_of_each_pair_once():
    """Also where the term of an index with itself does not vanish."""
    (term,) = parse_sums("sum(i < j in N, q[i] + 10*q[j])", [parse_array("q[N]")], {})
    q = np.array([1.0, 2.0, 4.0, 8.0])
    found = Elements(term.loops, {"N": 4}, {}).values(term.formula, term.slots, {"q": q}, {})
    assert found.tolist() == [a + 10 * b for a, b in combinations(q.tolist(), 2)]
