"""Nested loops around a kernel, as C, and their division among threads.

A slot is read, and a sum is added to its target, in the innermost loop on whose index it depends: in a sum over pairs i
< j the data of i are read before the loop over j, and added once after it. Sizes of arrays and loops are numbers of the
problem.

Threads share a term group in rounds of tasks that add to different elements. Terms of a lattice add to neighbours of
the outermost index: even blocks of it are done first, then odd ones. Pairs i < j are done in tiles, a block of i by a
block of j, in the rounds of a round-robin tournament. All other terms, such as rows of tables, may add to any element:
each thread evaluates all terms and adds to its own elements. The choice depends on the indices alone, and the order of
additions on sizes, never on the number of threads.
"""

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from enum import Enum, auto
from typing import TypeAlias

from scvi_codegen.codegen.ir.kernel import CallsApart, Expression, Operation, RolledKernel, loads
from scvi_codegen.codegen.ir.program import Layout
from scvi_codegen.codegen.rendering.text import wrapped, wrapped_comment
from scvi_codegen.systems.formulas.indices import Access, Array, Loop, Place, Size


def product_text(array: Array) -> str:
    """Return the number of entries of an array, in C."""
    return " * ".join(map(size_text, array.axes)) or "1"


def count_text(loops: Sequence[Loop]) -> str:
    """Return the number of elements of loops, in C."""
    outer = {loop.behind for loop in loops}
    spans = [(loop, size_text(loop.end), size_text(loop.first)) for loop in loops if not loop.behind]
    counts = (f"(({n}) * ({n} - 1) / 2)" if loop.index in outer else f"({n} - {first})" for loop, n, first in spans)
    return " * ".join(counts) or "1"


def size_text(size: Size) -> str:
    """Return a size in C."""
    return f"size_{size.name}{_added(size.number)}" if size.name else str(size.number)


def _added(number: int) -> str:
    """Return a whole number that is added in C, or nothing for 0."""
    return f" {number:+d}".replace("+", "+ ").replace("-", "- ") if number else ""


def sizes_text(layout: Layout, text: str) -> Iterator[str]:
    """Yield declarations of the sizes that occur in a source."""
    for k, name in enumerate(layout.sizes):
        if re.search(rf"\bsize_{name}\b", text):
            yield f"const long long size_{name} = arrays->size[{k}];"


class Sharing(Enum):
    """Kinds of tasks (``window`` of templates/support/arrays/arrays.h)."""

    ALONE = auto()
    IN_TURN = auto()
    IN_TILES = auto()
    BY_PLACES = auto()


def sharing_of(rolled: RolledKernel) -> Sharing:
    """Return the kind of tasks for a term group."""
    loops, targets = rolled.loops, rolled.writes
    if not loops:
        return Sharing.ALONE
    if _common_axes(targets, {loops[0].index}):
        return Sharing.IN_TURN
    if len(loops) > 1 and loops[1].behind == loops[0].index and loops[1].end == loops[0].end and loops[0].is_whole:
        pair = {loops[0].index, loops[1].index}
        if _common_axes(targets, pair) and _width(targets, pair) == 0 and not loops[1].near:
            return Sharing.IN_TILES
    return Sharing.BY_PLACES


def sharing_text(rolled: RolledKernel) -> str:
    """Return the C expression of the rounds."""
    kind, loops = sharing_of(rolled), rolled.loops
    if kind is Sharing.IN_TURN:
        span = f"{size_text(loops[0].first)}, {size_text(loops[0].end)}"
        return f"alternating_blocks({span}, {_width(rolled.writes, {loops[0].index})}, {count_text(loops[1:])})"
    if kind is Sharing.IN_TILES:
        return f"pairs_of_blocks({size_text(loops[0].end)})"
    return "by_elements(run, n)" if kind is Sharing.BY_PLACES else "alternating_blocks(0, 1, 0, 1)"


def _common_axes(targets: Sequence[Access], indices: Collection[str]) -> dict[str, int]:
    """Return the axis of each array on which all its targets depend on one of the indices; empty if one has none."""
    common: dict[str, set[int]] = {}
    for target in targets:
        moved = {k for k, place in enumerate(target.places) if place.index in indices and not place.table}
        common[target.array.name] = common.get(target.array.name, moved) & moved
    return {name: min(axes) for name, axes in common.items()} if all(common.values()) else {}


def _width(targets: Sequence[Access], indices: Collection[str]) -> int:
    """Return the largest distance, on these axes, of elements that one term adds to."""
    offsets: dict[str, list[int]] = {}
    for target in targets:
        place = target.places[_common_axes(targets, indices)[target.array.name]]
        offsets.setdefault(target.array.name, []).append(place.base.number)
    return max((max(distances) - min(distances) for distances in offsets.values()), default=0)


DIRECTION = "V"
"""Name of the array that the slots along a direction are read from."""

Lines: TypeAlias = Callable[[int], list[str]]
"""Function that returns the lines of a slot, by its number."""


def starts_text(layout: Layout, text: str) -> Iterator[str]:
    """Yield declarations of the offsets in the state of the arrays that occur in a source.

    The state consists of coordinates, then momenta of a Hamiltonian, or velocities.
    """
    sizes: list[str] = []
    for array in (*layout.coordinates, *layout.momenta, *layout.velocities):
        if re.search(rf"\bstart_{array.name}\b", text):
            yield f"const long long start_{array.name} = {' + '.join(sizes) or '0'};"
        sizes.append(product_text(array))


def function_of_sizes(layout: Layout, head: str, lines: Sequence[str]) -> str:
    """Return a function of a problem, with declarations of the sizes and offsets that occur in its statements."""
    text = "\n".join(lines)
    starts = list(starts_text(layout, text))
    sizes = sizes_text(layout, "\n".join([text, *starts]))
    body = "\n".join(f"  {line}" for line in (*sizes, *starts, *lines))
    return f"{head}\n{{\n{body}\n}}"


def describing_function(layout: Layout, name: str, kind: str, initialisers: Sequence[str]) -> str:
    """Return a function that stores structures of this kind, such as descriptions of arrays."""
    listed = (f"    {initialiser}," for initialiser in initialisers)
    lines = [f"const {kind} described[] = {{", *listed, "};", "memcpy(all, described, sizeof described);"]
    return function_of_sizes(layout, f"static void describe_{name}(const problem *arrays, {kind} *all)", lines)


def _signed(results: Sequence[Expression]) -> tuple[list[int], list[tuple[str, int]]]:
    """Return the results that are stored, and sign and number there of each: forces of a term are opposite in pairs."""
    terms = [(r.operands[0], True) if isinstance(r, Operation) and r.operator == "neg" else (r, False) for r in results]
    stored = {terms[k][0]: k for k in sorted(range(len(terms)), key=lambda k: not terms[k][1])}  # without sign, if any
    signs = ["-" if negative != terms[stored[term]][1] else "+" for term, negative in terms]
    return [*stored.values()], [(sign, [*stored].index(term)) for sign, (term, _) in zip(signs, terms, strict=True)]


class Nest:
    """Loops of a kernel, with arguments and parameters assigned in the outermost loop in which they are known.

    A kernel without loops becomes straight code. The innermost loop is divided into parts if necessary. On each part
    the neighbours across a periodic boundary have constant distances from the index, so that no element needs a test.

    Args:
        layout: the arrays.
        rolled: the kernel.
        scalar: type of the arguments.
        source: array that they are read from; empty if there are none.
        chunked: whether all values of a part are computed before any is added, in loops without conflicts, which a
            compiler vectorises.
        fused: whether coordinates are continued where the last values are added (complete_sums).
        sharing: how threads share it; without sharing, one task covers all.
        apart: functions called in loops of their own, over all values of a part, where no other registers are in use.
    """

    def __init__(
        self,
        layout: Layout,
        rolled: RolledKernel,
        scalar: str,
        source: str,
        *,
        chunked: bool = False,
        fused: bool = False,
        sharing: Sharing = Sharing.ALONE,
        apart: CallsApart | None = None,
    ) -> None:
        self.layout, self.rolled, self.scalar, self.source = layout, rolled, scalar, source
        self.chunked, self.fused, self.sharing, self.apart = chunked, fused, sharing, apart
        self.levels = {loop.index: depth for depth, loop in enumerate(rolled.loops, 1)}
        self.loops = {loop.index: loop for loop in rolled.loops}
        self.scalars = len(layout.parameters)
        self.stored, self.signed = _signed(rolled.kernel.results)

    def read(self, k: int, slot: Access) -> str:
        """Return the assignment of an argument: an entry of the state, or of a direction."""
        along = k >= len(self.rolled.reads) - self.rolled.along
        state, direction = ("image", "image_along") if slot.sums else (self.source, DIRECTION)
        source = direction if along else state
        return f"u[{k}] = {source}[{self.place_in(slot, self.place_of(slot))}];"

    def constant(self, k: int, access: Access) -> str:
        """Return the assignment of a parameter: an entry of a field."""
        return f"parameters[{self.scalars + k}] = field_{access.array.name}[{self.place(access)}];"

    def table_entry(self, place: Place) -> str:
        """Return an index in a table of the problem."""
        columns = next(table for table in self.layout.tables if table.name == place.table).axes[1].number
        return f"table_{place.table}[index_{place.index} * {columns} + {place.column}]"

    def depth_of(self, access: Access) -> int:
        """Return the depth of the innermost loop on whose index an entry depends."""
        return max((self.levels[index] for index in access.indices), default=0)

    def is_innermost(self, access: Access) -> bool:
        """Return whether an entry depends on the index of the innermost loop."""
        return self.depth_of(access) == len(self.rolled.loops)

    def text(
        self,
        *,
        prepare: Lines = lambda k: [],
        innermost: Sequence[str],
        finish: Lines = lambda k: [],
        behind: Sequence[Sequence[str]] = (),
        depth: int = 0,
    ) -> list[str]:
        """Return the lines of the nested loops.

        Args:
            prepare, finish: lines of targets before and after the loops that do not change them.
            innermost: lines in the innermost loop.
            behind: lines, those of each target in a separate loop over the same part.
            depth: number of loops around these lines.
        """
        lines = list(self.known(depth))
        if depth == len(self.rolled.loops):
            return [*lines, *innermost]
        outer = [k for k, target in enumerate(self.rolled.writes) if self.depth_of(target) == depth]
        lines += [line for k in outer for line in prepare(k)]
        inner = self.text(prepare=prepare, innermost=innermost, finish=finish, behind=behind, depth=depth + 1)
        loop = self.rolled.loops[depth]
        if loop.near:
            lines.append(f"const section row = row_of(near_{loop.near}, index_{loop.behind}, {self._window()});")
        lines += (
            self._parts(loop, inner, behind) if loop is self.rolled.loops[-1] else _loop(loop, *self._span(loop), inner)
        )
        return lines + [line for k in outer for line in finish(k)]

    def _parts(self, loop: Loop, inner: Sequence[str], behind: Sequence[Sequence[str]]) -> list[str]:
        """Return the innermost loop, divided into parts if necessary."""
        first, end = self._span(loop)
        if not self.chunked and not self._offsets(loop):
            return _loop(loop, first, end, inner)
        lines = self._part_passed_over(loop) if self.chunked else []
        if self.chunked and len(self.stored) > self.adds_at_once:
            lines = [*lines, f"lanes values[{len(self.stored)}][CHUNK];"]
        lines += _loop(loop, "begin", "end", inner)
        if loop.near:
            lines += _loop(loop, "begin", "end", [line for of_target in behind for line in of_target])
        else:
            for targets in self._targets_by_rows(loop)[self.adds_at_once :]:
                together = len(targets) > 1
                lines += (
                    self._sums_of_row(loop, targets) if together else _loop(loop, "begin", "end", behind[targets[0]])
                )
        if self.apart:
            lines = [*self._calls(loop, self.apart), *self._divided("chunk", "past", lines)]
            head = f"for (long long chunk = {first}, past; chunk < {end}; chunk = past) {{"
            lines = [f"past = {end} - chunk > CHUNK ? chunk + CHUNK : {end};", *lines]
            return [head, *(f"  {line}" for line in lines), "}"]
        return self._divided(first, end, lines, chunked=self.chunked)

    def _offsets(self, loop: Loop) -> list[int]:
        """Return the distances of neighbours across a periodic boundary."""
        accesses = (*self.rolled.reads, *self.rolled.writes, *self.rolled.constants)
        places = [place for access in accesses for place in access.places]
        moved = {place.base.number for place in places if place.index == loop.index and not place.table}
        return sorted(moved - {0}) if loop.periodic else []

    def _divided(self, first: str, last: str, lines: Sequence[str], *, chunked: bool = False) -> list[str]:
        """Return a loop over parts, of at most CHUNK elements, with constant distances in these lines."""
        loop, text = self.rolled.loops[-1], "\n".join(lines)
        body = [f"end = {last} - begin > CHUNK ? begin + CHUNK : {last};" if chunked else f"end = {last};"]
        shifts, size = {_shift(loop.index, offset): offset for offset in self._offsets(loop)}, size_text(loop.end)
        named = [shift for shift in shifts if re.search(rf"\b{shift}\b", text)]
        body += [f"const long long {shift} = around(begin, {shifts[shift]}, {size}, &end);" for shift in named]
        head = f"for (long long begin = {first}, end; begin < {last}; begin = end) {{"
        return [head, *(f"  {line}" for line in (*body, *lines)), "}"]

    def _calls(self, loop: Loop, apart: CallsApart) -> list[str]:
        """Return the lines that compute the values of the functions of a part."""
        expressions = (*apart.arguments.temporaries, *apart.arguments.results)
        used = {load.index for x in expressions for load in loads(x) if load.source == "u"}
        lines = [self.read(k, slot) for k, slot in enumerate(self.rolled.reads) if k in used]
        lines += [self.constant(k, each) for k, each in enumerate(self.rolled.constants) if self.is_innermost(each)]
        lines.append(f"{apart.arguments.name}(u, t, parameters, value);")
        calls = [f"{name}(value[{k}]);" for k, name in enumerate(apart.functions)]
        lines += [f"called[{k}][{counter(loop)} - chunk] = {call}" for k, call in enumerate(calls)]
        lines = self._divided("chunk", "past", _loop(loop, "begin", "end", lines))
        return [f"lanes called[{len(apart.functions)}][CHUNK];", *lines]

    @property
    def adds_at_once(self) -> bool:
        """Whether the first value is added where it is computed: only its target is in that row, at the same index."""
        loop, target, numbers = self.rolled.loops[-1], self.rolled.writes[0], [number for _, number in self.signed]
        rows = [] if loop.near or self.sharing is not Sharing.IN_TURN else self._targets_by_rows(loop)
        alone = rows != [] and not self.fused and len(rows[0]) == 1 and numbers.count(numbers[0]) == 1
        return alone and not target.sums and target.places[-1:] == (Place(index=loop.index),)

    def _targets_by_rows(self, loop: Loop) -> list[list[int]]:
        """Return the targets in turn; together those that differ in the innermost index alone, if tasks add to all."""
        if not self.chunked:
            return []
        rows: list[tuple[object, list[int]]] = []
        for k, target in enumerate(self.rolled.writes):
            last = target.places[-1] if target.places else Place()
            along = last.index == loop.index and not (last.table or last.minus or target.sums)
            row = (target.array, target.places[:-1]) if along and self.sharing is Sharing.IN_TURN else None
            if row is not None and rows and rows[-1][0] == row:
                rows[-1][1].append(k)
            else:
                rows.append((row, [k]))
        return [targets for _, targets in rows]

    def _sums_of_row(self, loop: Loop, targets: Sequence[int]) -> list[str]:
        """Return the lines that add the values of a part to the elements of a row, in one loop where all targets reach.

        At both ends they are added target by target, so that the sums of an element have the order of separate loops.
        """
        lines, ends, addends, row, value = [], [], [], "", ""
        for k in targets:
            access = self.rolled.writes[k]
            shift = self.index(access.places[-1]).removeprefix(f"index_{loop.index}")
            lines.append(f"const section part_{k} = {{begin{shift}, end{shift}}};")
            sign, number = self.signed[k]
            value += f" {sign} values[{number}][at - part_{k}.first]"
            moved = f"(common_{targets[0]}.first - part_{k}.first)"
            addends.append(f"{{values[{number}] + {moved}, {sign}1.0}}")
            factor = f"{sign.strip('+')}{'by' if self.fused else '1.0'}"
            ends.append(f"add_ends(row_{targets[0]}, values[{number}], {factor}, part_{k}, common_{targets[0]});")
            row = self.place_of(replace(access, places=(*access.places[:-1], Place())))
        common = f"part_{targets[0]}"
        for k in targets[1:]:
            common = f"overlap({common}, part_{k})"
        lines.append(f"const section common_{targets[0]} = {common};")
        lines.append(f"lanes *restrict row_{targets[0]} = F + {row};")
        lines += ends
        if self.fused:
            lines.append(f"const addend added[] = {{{', '.join(addends)}}};")
            return [*lines, f"complete_sums(of, by, row_{targets[0]}, common_{targets[0]}, added, {len(targets)});"]
        head = f"for (long long at = common_{targets[0]}.first; at < common_{targets[0]}.end; at++)"
        return [*lines, head, f"  row_{targets[0]}[at] = row_{targets[0]}[at]{value};"]

    def _span(self, loop: Loop) -> tuple[str, str]:
        """Return the first index and the end of a loop in a task."""
        if self.sharing in (Sharing.IN_TURN, Sharing.IN_TILES) and loop is self.rolled.loops[0]:
            return "here->of.first", "here->of.end"
        if self.sharing is Sharing.IN_TILES and loop is self.rolled.loops[1]:
            return f"between({_first(loop)}, here->behind.first, here->behind.end)", "here->behind.end"
        if loop.near:
            return "row.first", "row.end"
        return _first(loop), size_text(loop.end)

    def _window(self) -> str:
        """Return the elements that the rows of a list of neighbours add to in a task: here, their offset and width."""
        arrays = {target.array for target in self.rolled.writes}
        if self.sharing is not Sharing.BY_PLACES or len(arrays) != 1:
            return "NULL, 0, 0"
        (array,) = arrays
        return f"here, start_{array.name}, {product_text(replace(array, axes=array.axes[1:]))}"

    def adding(self, k: int, value: str) -> list[str]:
        """Return the lines that add to the element of a target, if the task adds to it."""
        target = self.rolled.writes[k]
        into = "transposed" if target.sums else "F"
        if self.sharing is not Sharing.BY_PLACES:
            return [f"{into}[{self.place_in(target, self.place_of(target))}] += {value};"]
        named = [self._named(k)] if self._in_a_part(k) else []
        place = self.place_in(target, f"place_{k}")
        return [*named, f"if (whole || within(here, place_{k}))", f"  {into}[{place}] += {value};"]

    def _named(self, k: int) -> str:
        return f"const long long place_{k} = {self.place_of(self.rolled.writes[k])};"

    def _in_a_part(self, k: int) -> bool:
        """Return whether an element is only known in the loops over a part."""
        return self.chunked and self.is_innermost(self.rolled.writes[k])

    def _passed_over(self) -> list[str]:
        """Return the lines that skip an element that adds to nothing in a task."""
        tests = [f"within(here,\0place_{k})" for k in range(len(self.rolled.writes))]
        past = [f"if (!(whole || {' || '.join(tests)}))", "  continue;"]
        return past if self.sharing is Sharing.BY_PLACES and not self.chunked else []

    def _part_passed_over(self, loop: Loop) -> list[str]:
        """Return the lines that skip a part of the innermost loop that adds to nothing in a task."""
        if self.sharing is not Sharing.BY_PLACES:
            return []
        places = range(len(self.rolled.writes))
        named = [self._named(k) for k in places if self._in_a_part(k)]
        tests = [f"wanted |= within(here, place_{k});" for k in places]
        look = _loop(loop, "begin", "end && !wanted", [*named, *tests])
        return ["int wanted = whole;", *look, "if (!wanted)", "  continue;"]

    def known(self, depth_of: int) -> Iterator[str]:
        """Yield the lines known at a level: arguments, parameters, elements that not every task adds to."""
        for k, target in enumerate(self.rolled.writes if self.sharing is Sharing.BY_PLACES else ()):
            if self.depth_of(target) == depth_of and not self._in_a_part(k):
                yield self._named(k)
        if depth_of == len(self.rolled.loops):
            yield from self._passed_over()
        for k, slot in enumerate(self.rolled.reads):
            if self.depth_of(slot) == depth_of and self.source:
                yield self.read(k, slot)
        for k, access in enumerate(self.rolled.constants):
            if self.depth_of(access) == depth_of:
                yield self.constant(k, access)

    def place_in(self, access: Access, place: str) -> str:
        """Return the index in the values of all convolutions if an entry is one of a convolution, else in the state."""
        return f"{self.layout.sums.index(access.sums)} * length + {place}" if access.sums else place

    def place_of(self, access: Access) -> str:
        """Return the index of an entry in the state."""
        return f"start_{access.array.name} + {self.place(access)}"

    def place(self, access: Access) -> str:
        """Return the index of an entry in its array, in row-major order."""
        text = ""
        for place, axis in zip(access.places, access.array.axes, strict=True):
            here = self.index(place)
            first = text if re.fullmatch(r"\w+(\([^()]*\))?", text) else f"({text})"
            text = f"{first} * {size_text(axis)} + {here}" if text else here
        return text or "0"

    def index(self, place: Place) -> str:
        """Return an index on an axis."""
        if place.table:
            return self.table_entry(place)
        if not place.index:
            return size_text(place.base)
        if place.minus:
            return f"index_{place.index} - index_{place.minus}"
        name, offset = f"index_{place.index}", place.base.number
        loop = self.loops[place.index]
        if not offset or not loop.periodic:
            return name + _added(offset)
        if loop is self.rolled.loops[-1]:
            return f"{name} + {_shift(place.index, offset)}"
        return f"wrapped_index({name} + {offset}, {size_text(loop.end)})".replace("+ -", "- ")

    def function(self, head: str, arguments: Sequence[str], lines: Sequence[str], *, values: str = "") -> str:
        """Return the loops as a function; without values no kernel is evaluated."""
        declared = [*self._arrays("\n".join(lines))]
        if self.source and self.rolled.reads:
            declared.append(f"{self.scalar} u[{self.rolled.kernel.arguments}];")
        elif self.source:
            declared += [f"const {self.scalar} u[1] = {{0}};", f"(void){self.source};"]
        if values:
            count = max(1, self.scalars + len(self.rolled.constants))
            declared += [f"{values};", f"double parameters[{count}] = {{0}};"]
            declared += [f"parameters[{k}] = arrays->parameters[{k}];" for k in range(self.scalars)]
        body = [*sizes_text(self.layout, "\n".join([*declared, *lines])), *declared, *lines]
        text = "\n".join(wrapped(line.strip(), indent=2 + len(line) - len(line.lstrip())) for line in body)
        whole = (argument.replace(" ", "\0") for argument in arguments)
        signature = wrapped(f"{head}({', '.join(whole)})", indent=0)
        return f"{wrapped_comment(self.rolled.text)}\n{signature}\n{{\n{text}\n}}"

    def _arrays(self, text: str) -> Iterator[str]:
        yield from starts_text(self.layout, text)
        for kind, arrays, number in (("field", self.layout.fields, "double"), ("table", self.layout.tables, "int")):
            for k, array in enumerate(arrays):
                if f"{kind}_{array.name}[" in text:
                    yield f"const {number} *{kind}_{array.name} = arrays->{kind}[{k}];"
        if "image[" in text and self.scalar == "lanes":
            yield "const lanes *image = sums->values;"
            yield "const long long length = sums->length;"
        if "image_along[" in text:
            yield "const lanes *image_along = sums->along;"
        if "transposed[" in text:
            yield "lanes *transposed = sums->transposed;"
        for loop in self.rolled.loops:
            if loop.near:
                yield f"const neighbours *near_{loop.near} = arrays->near_{loop.near};"


def counter(loop: Loop) -> str:
    """Return the variable that counts the elements of a loop: its index, or a position in a list of neighbours."""
    return f"{'at' if loop.near else 'index'}_{loop.index}"


def _first(loop: Loop) -> str:
    return f"index_{loop.behind} + 1" if loop.behind else size_text(loop.first)


def _shift(index: str, offset: int) -> str:
    return f"shift_{index}_{'plus' if offset > 0 else 'minus'}_{abs(offset)}"


def _loop(loop: Loop, first: str, end: str, lines: Sequence[str]) -> list[str]:
    name = counter(loop)
    head = f"for (long long {name} = {first}; {name} < {end}; {name}++)"
    if loop.near:
        lines = [f"const long long index_{loop.index} = near_{loop.near}->others[{name}];", *lines]
    body = [f"  {line}" for line in lines]
    return [head, *body] if len(lines) == 1 else [f"{head} {{", *body, "}"]
