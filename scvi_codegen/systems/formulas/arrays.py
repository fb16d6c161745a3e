"""Parser for array formulas: the grammar of formulas with arrays, and with ``sum(loops, formula)``.

    L     = a sum of  [factor "*"] "sum" "(" loop ("," loop)* "," formula ")"  and of formulas without a sum
    atom  = .. | array "[" index ("," index)* "]" | "rotate_" k "(" rotation ["[" .. "]"] "," a "," b "," c ")"

Loops and indices are those of :mod:`scvi_codegen.systems.formulas.indices`. A sum within a sum has integer bounds, and
is unrolled, ``sum(k in 3, r_dot[i, k]**2)``, or is a convolution, ``sum(j in N, c[j-i]*q[j])``.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from sympy import Add, Expr, S, Symbol

from scvi_codegen.common.errors import ExpressionError, SystemDefinitionError, closest
from scvi_codegen.systems.formulas.grammar import Parser, Token, parsed
from scvi_codegen.systems.formulas.indices import Access, Array, Loop, Place, Size, elements
from scvi_codegen.systems.formulas.neighbours import NESTED, Neighbours, convolution_of
from scvi_codegen.systems.formulas.symbols import check_name, symbol

_TOKEN = re.compile(
    r"(?P<number>(?:\d+(?:\.(?!\.)\d*)?|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<operator>\*\*|\.\.|[<>]=?|[-+*/(),\[\]])",
    re.ASCII,
)
MAX_UNROLLED_TERMS, MAX_NESTED_TERMS = 64, 4096
"""Maximum number of terms of one sum within a sum, and of all such nested sums."""

ROTATING = ("rotate_1", "rotate_2", "rotate_3", "unrotate_1", "unrotate_2", "unrotate_3")
"""Functions of formulas: components of R (a, b, c), from body to space, and of its inverse."""

Bound: TypeAlias = Loop | int


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayTerm:
    """Formula summed over loops; every array access in it is a symbol named as it is written.

    Attributes:
        loops: outermost first; empty for a formula outside of sums.
        formula: in the symbols of ``slots``, parameters and time.
        slots: symbol and access of each array entry that occurs, in alphabetical order.
    """

    loops: tuple[Loop, ...]
    formula: Expr
    slots: tuple[tuple[Symbol, Access], ...]

    def __str__(self) -> str:
        if not self.loops:
            return str(self.formula)
        named = [loop for loop in self.loops if loop.index not in {other.behind for other in self.loops}]
        return f"sum({', '.join(map(str, named))}, {self.formula})"


def parse_array(text: str) -> Array:
    """Parse the declaration of an array, ``"q[N]"``; ExpressionError for other text."""
    return _Declaration(text, {}).read()


def parse_coordinate(text: str) -> Array:
    """Parse the declaration of an array of coordinates, ``"q[N]"``, or the name of one, ``"x"``; or ExpressionError."""
    if "[" in text:
        return parse_array(text)
    check_name(text)
    return Array(text, ())


def parse_sums(
    text: str,
    arrays: Sequence[Array],
    symbols: Mapping[str, Symbol],
    tables: Sequence[Array] = (),
    neighbours: Sequence[Neighbours] = (),
) -> tuple[ArrayTerm, ...]:
    """Parse a sum of sums.

    Args:
        text: the formula.
        arrays: arrays whose entries may occur: coordinates, their velocities, parameters.
        symbols: other symbols that may occur, by name.
        tables: index tables.
        neighbours: lists of neighbours.

    Returns:
        Its terms, with one term per distinct tuple of loops.

    Raises:
        ExpressionError: for anything outside the grammar, and for an index outside its array.

    >>> q = parse_array("q[N]")
    >>> [str(term) for term in parse_sums("-k*sum(i in 0..N-2, (q[i+1] - q[i])**2)", [q], {"k": symbol("k")})]
    ['sum(i in 0..N-2, -k*(q[i+1] - q[i])**2)']
    """
    parser = ArrayParser(text, symbols, arrays, tables, neighbours)
    whole = parsed(parser)
    by_loops: dict[tuple[Loop, ...], list[Expr]] = {}
    for placeholder, (loops, formula, column) in parser.sums.items():
        factor = whole.diff(placeholder)
        if factor.free_symbols & (set(parser.sums) | set(parser.accesses)):
            message = "a sum may be multiplied by numbers and parameters only: move factors that vary into the sum"
            raise ExpressionError(message, text, column)
        by_loops.setdefault(loops, []).append(factor * formula)
    by_loops.setdefault((), []).append(whole.xreplace(dict.fromkeys(parser.sums, S.Zero)))
    terms = [(loops, Add(*formulas)) for loops, formulas in by_loops.items()]
    return tuple(term_of(loops, formula, parser.accesses) for loops, formula in terms if formula != 0)


def term_of(loops: tuple[Loop, ...], formula: Expr, accesses: Mapping[Symbol, Access]) -> ArrayTerm:
    """Return the term of a formula over loops, with the accesses that occur in it."""
    occurring = sorted(formula.free_symbols & set(accesses), key=lambda slot: slot.name)
    return ArrayTerm(loops=loops, formula=formula, slots=tuple((slot, accesses[slot]) for slot in occurring))


class _Indices(Parser):
    """Parser elements shared by declarations and sums: brackets, sizes, whole numbers."""

    pattern = _TOKEN

    def peek(self, ahead: int = 0) -> Token:
        return self.tokens[min(self.position + ahead, len(self.tokens) - 1)]

    def expect(self, *texts: str) -> Token:
        token = self.peek()
        if token.text not in texts:
            actual = f"not '{token.text}'" if token.text else "but the formula ends"
            self.refuse(f"{' or '.join(repr(text) for text in texts)} is expected here, {actual}", token.column)
        self.position += 1
        return token

    def take_name(self, role: str) -> Token:
        token = self.peek()
        if token.kind != "name":
            self.refuse(f"{role} is expected here, not '{token.text}'", token.column)
        self.position += 1
        return token

    def whole_number(self) -> int:
        token = self.peek()
        if not token.text.isdigit() or len(token.text) > 9:
            self.refuse(f"a whole number of at most 9 digits is expected here, not '{token.text}'", token.column)
        self.position += 1
        return int(token.text)

    def offset(self) -> int:
        """Parse ``(+|-) whole number``, repeated, and return the sum."""
        total = 0
        while sign := self.accept("+", "-"):
            total += self.whole_number() * (-1 if sign.text == "-" else 1)
        return total

    def size(self) -> Size:
        """Parse a size: a name, a whole number, or both."""
        if self.peek().kind == "name":
            name = self.take_name("a size").text
            return Size(name, self.offset())
        start = -self.whole_number() if self.accept("-") else self.whole_number()
        return Size("", start + self.offset())


class _Declaration(_Indices):
    def read(self) -> Array:
        name = self.take_name("the name of an array")
        check_name(name.text)
        if self.peek().text != "[":
            self.refuse(f"the sizes of an array are written in brackets, as {name.text}[N]", self.column)
        self.expect("[")
        axes = [self.axis()]
        while self.accept(","):
            axes.append(self.axis())
        self.expect("]")
        if self.peek().kind != "end":
            self.refuse("nothing may follow the brackets of a declaration, as q[N]", self.column)
        return Array(name.text, tuple(axes))

    def axis(self) -> Size:
        column, size = self.column, self.size()
        if size.name and size.number:
            self.refuse("an axis must be a name or a whole number, as q[N] or r[N, 3]", column)
        if not size.name and size.number < 1:
            self.refuse("the size of an axis must be at least 1", column)
        if size.name:
            check_name(size.name)
        return size


def _shown(size: Size) -> str:
    return size.name or str(size.number)


class ArrayParser(_Indices):
    """Parser for formulas with array entries and sums.

    Attributes:
        has_loops: whether a sum over whole axes may become a loop of its own, as in a Lagrangian but not in a force.
    """

    has_loops = True

    def __init__(
        self,
        text: str,
        symbols: Mapping[str, Symbol],
        arrays: Sequence[Array],
        tables: Sequence[Array],
        neighbours: Sequence[Neighbours] = (),
    ) -> None:
        super().__init__(text, symbols)
        self.arrays, self.tables = ({array.name: array for array in group} for group in (arrays, tables))
        self.sizes = {name for array in (*arrays, *tables) for name in array.names}
        self.neighbours = {pairs.name: pairs for pairs in neighbours}
        self.in_scope: dict[str, Bound] = {}
        self.nested = 1
        self.convolved: Loop | None = None
        self.accesses: dict[Symbol, Access] = {}
        self.sums: dict[Symbol, tuple[tuple[Loop, ...], Expr, int]] = {}

    def name(self, name: str, column: int) -> Expr:
        """Parse a sum, an array entry, or a name of the scalar grammar."""
        if name == "sum" and self.peek().text == "(":
            return self.summed(column)
        if name in ROTATING and self.peek().text == "(":
            return self.rotated(name, column)
        if name in self.arrays:
            return self.entry(self.arrays[name], column)
        if name in self.tables:
            self.refuse(f"'{name}' is an index table, whose entries are indices: write q[{name}[.., 0]]", column)
        if self.peek().text == "[":
            declared_arrays = ", ".join(map(str, self.arrays.values())) or "none"
            declared = f"{name}[{', '.join(self.axes_here())}]"
            self.refuse(
                f"'{name}' is not an array{closest(name, self.arrays)} Arrays: {declared_arrays}; declare an array of "
                f"constants as a parameter: parameters={{'{declared}': 1.0}}, in files [parameters] "
                f'"{declared}" = 1.0',
                column,
            )
        if name in self.in_scope or name in self.sizes:
            kind = "an index" if name in self.in_scope else "a size"
            self.refuse(
                f"'{name}' is {kind}, which may occur only in brackets and bounds: declare a parameter for its value",
                column,
            )
        return super().name(name, column)

    def axes_here(self) -> Iterator[str]:
        """Yield the size of each axis that the indices in the brackets here run over, else of the first axis known."""
        first = next((array.axes[0] for array in self.arrays.values()), Size("N", 0))
        position, depth, size = 0, 0, None
        while (text := self.peek(position).text) and not (text == "]" and depth == 1):
            depth += (text in ("(", "[")) - (text in (")", "]"))
            if text == "," and depth == 1:
                yield _shown(size or first)
                size = None
            elif isinstance(bound := self.in_scope.get(text), Loop):
                size = size or bound.end
            position += 1
        yield _shown(size or first)

    def summed(self, column: int) -> Expr:
        """Parse ``sum(loops, formula)`` after ``sum``."""
        self.open(column)
        self.expect("(")
        loops = self.loop()
        while True:
            self.expect(",")
            if self.peek(1).text not in ("in", "<"):
                break
            loops += self.loop()
        inner = any(isinstance(bound, Loop) for bound in self.in_scope.values())
        if inner and len(loops) == 1 and loops[0].end.name:
            return self.convolution(loops[0], column)
        numbers = self.sizes and all(not loop.first.name and not loop.end.name for loop in loops)
        if inner or numbers or not self.has_loops:
            return self.written_out(loops, column)
        self.in_scope |= {loop.index: loop for loop in loops}
        formula = self.sum() * self.inside(loops)
        self.end_of_sum(loops)
        placeholder = symbol(f"sum {len(self.sums)}")
        self.sums[placeholder] = (tuple(loops), formula, column)
        return placeholder

    def inside(self, loops: Sequence[Loop]) -> Expr:
        """Return the factor of a summand that is 1 for pairs closer than the cutoff of their list, else 0."""
        factor: Expr = S.One
        for near, loop in ((self.neighbours[loop.near], loop) for loop in loops if loop.near):
            condition = ArrayParser(near.inside(loop.behind, loop.index), self.symbols, [near.array], ())
            condition.in_scope, condition.accesses = self.in_scope, self.accesses
            factor *= parsed(condition)
        return factor

    def end_of_sum(self, loops: Sequence[Loop]) -> None:
        """Parse the closing bracket of a sum and release its indices."""
        for loop in loops:
            del self.in_scope[loop.index]
        self.close()

    def convolution(self, loop: Loop, column: int) -> Expr:
        """Parse the summand of a convolution ``sum(j in N, c[j-i]*q[j])``, or of a sum of several."""
        self.in_scope[loop.index] = self.convolved = loop
        terms, formula = [], self.sum().expand()
        self.end_of_sum([loop])
        for term in Add.make_args(formula):
            if (product := convolution_of(term, loop, self.accesses, self.in_scope)) is None:
                self.refuse(NESTED, column)
            terms.append(product[0] * self.slot(product[1]))
        return Add(*terms)

    def written_out(self, loops: Sequence[Loop], column: int) -> Expr:
        """Unroll a sum with integer bounds: its formula is parsed once per value of the indices."""
        if any(loop.first.name or loop.end.name for loop in loops):
            self.refuse(NESTED, column)
        count = 1
        for loop in loops:
            length = max(0, loop.end.number - loop.first.number)
            count = count * (length - 1) // 2 if loop.behind else count * length
        if not 0 < count <= MAX_UNROLLED_TERMS:
            self.refuse(f"a sum over whole numbers must have 1 to {MAX_UNROLLED_TERMS} terms, not {count}", column)
        self.nested *= count
        if self.nested > MAX_NESTED_TERMS:
            message = f"nested sums over whole numbers may have at most {MAX_NESTED_TERMS} terms, not {self.nested}"
            self.refuse(f"{message}: use a named size of an array instead of the number", column)
        start, formulas = self.position, []
        for element in elements(loops, {}):
            self.position = start
            self.in_scope |= element
            formulas.append(self.sum() * self.inside(loops))
        self.end_of_sum(loops)
        self.nested //= count
        return Add(*formulas)

    def loop(self) -> list[Loop]:
        """Parse a loop ``i in N``, or a pair of loops ``i < j in N``."""
        first = self.take_name("an index")
        pair = self.take_name("an index") if self.accept("<") else None
        for token in (first, *([pair] if pair else [])):
            self.check_index(token)
        self.expect("in")
        column, size = self.column, self.size()
        near = self.neighbours.get(size.name) if pair else None
        if near is not None:
            size = near.array.axes[0]
        span = (size, self.size() + 1) if self.accept("..") else (Size("", 0), size)
        for end in span:
            if end.name and end.name not in self.sizes:
                sizes = ", ".join(sorted({*self.sizes, *self.neighbours})) or "none"
                self.refuse(
                    f"'{end.name}' is not the size of an array{closest(end.name, self.sizes)} Sizes: {sizes}", column
                )
        periodic = self.peek().text == "periodic"
        self.position += periodic
        if pair is None:
            return [Loop(index=first.text, first=span[0], end=span[1], periodic=periodic)]
        if span[0] != Size("", 0) or periodic:
            self.refuse(f"pairs must run over a whole axis, as {first.text} < {pair.text} in N", column)
        outer = Loop(index=first.text, first=span[0], end=span[1])
        name = near.name if near else ""
        return [outer, Loop(index=pair.text, first=span[0], end=span[1], behind=first.text, near=name)]

    def check_index(self, token: Token) -> None:
        """Raise an error for an index name that is already in use."""
        try:
            check_name(token.text)
        except SystemDefinitionError as error:
            self.refuse(str(error), token.column)
        if token.text in self.in_scope:
            self.refuse(f"the index '{token.text}' is used by an enclosing sum: choose another", token.column)
        if any(token.text in names for names in (self.arrays, self.tables, self.symbols, self.sizes)):
            self.refuse(f"'{token.text}' is the name of something else: choose another index", token.column)

    def entry(self, array: Array, column: int) -> Expr:
        """Parse ``[indices]`` after the name of an array."""
        if array.axes and self.peek().text != "[":
            self.refuse(f"'{array.name}' is an array, {array}: write an entry, {array.entry}", column)
        indices = self.brackets(array, column) if array.axes else ()
        return self.slot(Access(array=array, places=indices))

    def rotated(self, name: str, column: int) -> Expr:
        """Parse ``(R[i], a, b, c)`` after ``rotate_k``: component k of R (a, b, c), or of its inverse."""
        self.open(column)
        self.expect("(")
        token = self.take_name("a rotation")
        matrix = {f"{j}{k}": self.arrays.get(f"{token.text}_{j}{k}") for j in "123" for k in "123"}
        first = matrix["11"]
        if first is None:
            names = [array.removesuffix("_11") for array in self.arrays if array.endswith("_11")]
            rotations = ", ".join(names) or "none"
            self.refuse(f"{name} needs a rotation first, not '{token.text}'. Rotations: {rotations}", token.column)
        places = self.brackets(first, token.column) if first.axes else ()
        terms = []
        for axis in "123":
            self.expect(",")
            array = matrix[axis + name[-1] if name.startswith("un") else name[-1] + axis]
            assert array is not None  # rotations have all nine entries
            terms.append(self.slot(Access(array=array, places=places)) * self.sum())
        self.close()
        return Add(*terms)

    def slot(self, access: Access) -> Symbol:
        """Return the symbol of an array entry."""
        slot = symbol(str(access))
        self.accesses[slot] = access
        return slot

    def brackets(self, array: Array, column: int) -> tuple[Place, ...]:
        """Parse the indices of an entry, and check each against its axis."""
        self.expect("[")
        indices = [self.place()]
        while self.accept(","):
            indices.append(self.place())
        self.expect("]")
        if len(indices) == 1 and self.tables.get(array.name) is array and array.axes[-1] == Size("", 1):
            indices.append(Place())  # pins[p] is pins[p, 0]
        if len(indices) != len(array.axes):
            self.refuse(f"'{array}' has {len(array.axes)} axes, but {len(indices)} indices are given", column)
        for subscript, axis in zip(indices, array.axes, strict=True):
            if problem := self.leaves(subscript, axis):
                self.refuse(f"{Access(array=array, places=tuple(indices))}: {problem}", column)
        return tuple(indices)

    def place(self) -> Place:
        """Parse one index of an array entry."""
        token = self.peek()
        if token.kind != "name":
            return Place(base=self.size())
        if token.text in self.tables:
            return self.entry_of_table()
        if token.text in self.sizes:
            return Place(base=self.size())
        bound = self.in_scope.get(token.text)
        if bound is None:
            indices = ", ".join(self.in_scope) or "none here, outside sums"
            message = (
                f"'{token.text}' is not an index{closest(token.text, self.in_scope)} Indices: {indices}. An "
                "array is accessed by"
            )
            self.refuse(f"{message} a whole number, N-1, i, i+1 or an entry of a table, bonds[b, 0]", token.column)
        self.position += 1
        if self.peek().text == "-" and (other := self.in_scope.get(self.peek(1).text)) is not None:
            self.position += 2
            return self.difference(token, bound, self.tokens[self.position - 1].text, other)
        if isinstance(bound, int):
            return Place(base=Size("", bound + self.offset()))
        return Place(index=token.text, base=Size("", self.offset()))

    def difference(self, token: Token, bound: Bound, subtracted: str, other: Bound) -> Place:
        """Return the difference of two indices: of a pair i < j, or of whole numbers."""
        if isinstance(bound, int) and isinstance(other, int):
            return Place(base=Size("", bound - other))
        if not isinstance(bound, Loop) or (bound.behind != subtracted and bound is not self.convolved):
            self.refuse(
                f"{token.text}-{subtracted} must be the difference of a pair: write c[j-i] in sum(i < j in N, ..), or "
                "of a convolution: c[j-i]*q[j] in sum(i in N, .. sum(j in N, ..))",
                token.column,
            )
        return Place(index=token.text, minus=subtracted)

    def entry_of_table(self) -> Place:
        """Parse the entry of an index table, ``bonds[b, 0]``."""
        token = self.take_name("a table")
        table = self.tables[token.text]
        row, *columns = self.brackets(table, token.column)
        plain = row.index and not row.table and not row.base.number
        if not plain or len(columns) != 1 or columns[0].index or columns[0].base.name:
            self.refuse(
                "a table must be accessed by an index and a whole number, as bonds[b, 0] (pins[p])", token.column
            )
        return Place(index=row.index, table=table.name, column=columns[0].base.number)

    def leaves(self, subscript: Place, axis: Size) -> str:
        """Return why an index is outside an axis; empty if it is inside, or if that depends on other sizes."""
        base = subscript.base
        if subscript.table:
            return ""
        if not subscript.index:
            below = base.number < 0 and not base.name
            above = base.name == axis.name and base.number >= axis.number
            return f"{base} is outside an axis of size {axis}" if below or above else ""
        loop = self.in_scope[subscript.index]
        assert isinstance(loop, Loop)
        if subscript.minus:
            return "" if loop.end == axis else f"{subscript} is at most {loop.end + -1}: the axis must be {loop.end}"
        if loop.periodic:
            whole = loop.is_whole and loop.end == axis
            return "" if whole else f"'{loop}' is not an index of a periodic axis of size {axis}"
        last = loop.end + -1
        remedy = f"or write '{loop.index} in {axis} periodic'"
        if not loop.first.name and (first := loop.first.number + base.number) < 0:
            begin = loop.first + -first
            at = f"{subscript} is {first} at {loop.index} = {loop.first}"
            return f"{at}: begin at {loop.index} in {begin}..{last}, {remedy}"
        if loop.end.name == axis.name and (beyond := loop.end.number + base.number - axis.number) > 0:
            span, leaves = f"{loop.first}..{last + -beyond}", last + base.number
            return f"{subscript} is {leaves} at {loop.index} = {last}: end at {loop.index} in {span}, {remedy}"
        return ""
