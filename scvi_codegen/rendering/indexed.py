"""Sums over indices as C: nests of loops around kernels.

What a slot is read from, and what is added to it, stands in the innermost loop that moves its place: in a sum over
pairs i < j what belongs to i is read before the loop over j, and added once behind it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

from scvi_codegen.indices import Access, Array, Loop, Place, Size
from scvi_codegen.ir.indexed import IndexedProgram, LoopedKernel
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.rendering.control import ladder_text
from scvi_codegen.rendering.environment import support_text, template_environment
from scvi_codegen.rendering.functions import kernel_text
from scvi_codegen.rendering.lanes import LIBRARY, POINTS, SweepText, sweep_text
from scvi_codegen.rendering.layout import wrapped, wrapped_comment
from scvi_codegen.rendering.printer import INVERSE_ROOT, scalar_functions
from scvi_codegen.rendering.source import Source, included
from scvi_codegen.rendering.stopping import MAX_ITERATIONS
from scvi_codegen.rendering.target import DOUBLE

__all__ = ["render_indexed", "render_indexed_example"]

EXPLICIT_VECTORS, SWEEP_VECTORS = 4, 4
"""Of work: positions, forces, increments; positions at the points, forces in this step and two before."""
NEWTON_VECTORS = 4 + 17
"""Beside these residual, correction, products, and the basis of GMRES (templates/support/gmres.h)."""

DIRECTION = "V"
"""What the slots along a direction are read from."""

Lines: TypeAlias = Callable[[int], list[str]]
"""Of a slot, by its number."""


def render_indexed(program: IndexedProgram) -> Source:
    """Header and source of a program. Equal programs give equal bytes."""
    environment = template_environment()
    terms = [(each, each.scalar) for each in program.forces if each.scalar]
    scalars = [each.kernel for each in program.masses] + [scalar for _, scalar in terms]
    if program.splitting:
        scalars += [each.kernel for each in program.forces]
    context = {
        "program": program,
        "prefix": program.prefix,
        "target": DOUBLE,
        "real": DOUBLE.scalar,
        "max_iterations": MAX_ITERATIONS,
        "forces": [_force_text(program, each) for each in (*program.forces, *program.products, *program.diagonals)],
        "energies": [_energy_text(program, each, scalar) for each, scalar in terms],
        "masses": [_mass_text(program, each) for each in program.masses],
        "force_names": [each.kernel.name for each in program.forces],
        "energy_names": [scalar.name for _, scalar in terms],
        "mass_names": [each.kernel.name for each in program.masses],
        "scalar_kernels": [kernel_text(kernel, DOUBLE) for kernel in scalars],
        "inverse_roots": _inverse_roots(scalars),
        "vector_functions": _vector_functions(program),
        "coordinates": " + ".join(map(_product, program.coordinates)),
        "sweep": _sweep_text(program),
        "work": _work(program),
        "sweep_vectors": SWEEP_VECTORS,
        "hot": "static",
    }
    code = environment.get_template("indexed.c.jinja").render(context)
    control = program.control
    own = {f"support/{program.prefix}_ladder.h": ladder_text(control.ladder)} if control and control.ladder else {}
    return Source(
        prefix=program.prefix,
        header=environment.get_template("indexed.h.jinja").render(context),
        code=code,
        declarations=environment.get_template("parts/indexed_declarations.h.jinja").render(context),
        support=tuple((name, own.get(name) or support_text(name)) for name in included(code)),
    )


def render_indexed_example(prefix: str, **start: Any) -> dict[str, str]:
    """``main.c`` and ``Makefile`` that run the integrator from arrays in files beside them.

    Args:
        prefix: of the C names.
        start: title, momenta (whether a Hamiltonian is given), numbers, sizes, fields and tables with their lengths,
            moving ("p", "velocity" or nothing), run (t, h, steps, every).
    """
    environment, context = template_environment(), {"prefix": prefix, "target": DOUBLE, **start}
    templates = {"main.c": "indexed_main.c.jinja", "Makefile": "Makefile.jinja"}
    return {name: environment.get_template(template).render(context) for name, template in templates.items()}


def _work(program: IndexedProgram) -> int:
    """Numbers of a coordinate: vectors over the points, or of leapfrog, four."""
    if program.sweep is None:
        return EXPLICIT_VECTORS
    own = 2 * SWEEP_VECTORS if program.momenta else SWEEP_VECTORS + bool(program.velocities)
    linear = NEWTON_VECTORS + program.sweep.lanes if program.products else 0
    return (own + linear) * program.sweep.lanes


def _sweep_text(program: IndexedProgram) -> SweepText | None:
    applied = (*program.forces, *program.products, *program.diagonals)
    sweep, kernels = program.sweep, [each.kernel for each in applied]
    return sweep_text(sweep, POINTS, fallback="none", kernels=kernels) if sweep else None


def _vector_functions(program: IndexedProgram) -> list[str]:
    """Those of the vector library that occur in the forces of an explicit method."""
    kernels = [each.kernel for each in program.forces] if program.splitting else []
    return sorted(set(LIBRARY) & set().union(*map(scalar_functions, kernels)))


def _inverse_roots(kernels: Sequence[Kernel]) -> list[int]:
    names = set().union(*map(scalar_functions, kernels))
    return sorted(int(name.removeprefix(INVERSE_ROOT)) for name in names if name.startswith(INVERSE_ROOT))


def _starts(program: IndexedProgram) -> Iterator[tuple[str, str]]:
    """Where each array begins in the state: coordinates, then momenta of a Hamiltonian, or velocities."""
    sizes: list[str] = []
    for array in (*program.coordinates, *program.momenta, *program.velocities):
        yield array.name, " + ".join(sizes) or "0"
        sizes.append(_product(array))


def _product(array: Array) -> str:
    return " * ".join(map(_size_text, array.axes))


def _size_text(size: Size) -> str:
    """A size in C."""
    number = f"{size.number:+d}"
    return f"size_{size.name}{f' {number[0]} {number[1:]}' if size.number else ''}" if size.name else str(size.number)


def _force_text(program: IndexedProgram, looped: LoopedKernel) -> str:
    """A function that adds to the forces; of an explicit method so many times the forces."""
    explicit = program.sweep is None
    nest = _Nest(program, looped, "lanes", "X", chunked=explicit and bool(looped.loops))
    slots = range(len(looped.targets))
    places = [nest.place_of(target) for target in looped.targets]
    inner = [nest.is_innermost(target) for target in looped.targets]
    targets = [f"F[{places[k]}]" if inner[k] else f"sum_{k}" for k in slots]
    call = f"{looped.kernel.name}(u, t, parameters, value);"
    if nest.chunked:
        here = f"[index_{looped.loops[-1].index} - begin]"
        innermost = [call, *(f"values[{k}]{here} = by * value[{k}];" for k in slots)]
        behind = [f"{targets[k]} += values[{k}]{here};" for k in slots]
    else:
        innermost = [call, *(f"{targets[k]} += {'by * ' * explicit}value[{k}];" for k in slots)]
        behind = []
    lines = nest.text(
        prepare=lambda k: [f"lanes sum_{k} = zero;"],
        innermost=innermost,
        behind=behind,
        finish=lambda k: [f"F[{places[k]}] += sum_{k};"],
    )
    zero = [] if all(inner) else ["const lanes zero = {0};"]
    factor = ["double by"] if explicit else []
    direction = [f"const lanes *{DIRECTION}"] if looped.along else []
    arguments = ["const problem *given", "const lanes *restrict X", "times t", *direction, *factor, "lanes *restrict F"]
    values = f"lanes value[{len(looped.targets)}]"
    return nest.function(f"static void add_{looped.kernel.name}", arguments, [*zero, *lines], values=values)


def _energy_text(program: IndexedProgram, looped: LoopedKernel, kernel: Kernel) -> str:
    """A function that gives the sum of the terms."""
    nest = _Nest(program, looped, "double", "q")
    lines = nest.text(
        prepare=lambda k: [],
        innermost=[f"{kernel.name}(u, t, parameters, value);", "add_to_sum(total, value[0]);"],
        finish=lambda k: [],
    )
    arguments = ["const problem *given", "const double *q", "double t", "compensated *total"]
    return nest.function(f"static void sum_{kernel.name}", arguments, lines, values="double value[1]")


def _mass_text(program: IndexedProgram, looped: LoopedKernel) -> str:
    """A function that adds to the masses."""
    nest = _Nest(program, looped, "", "")
    place = nest.place_of(looped.targets[0])
    lines = nest.text(
        prepare=lambda k: [],
        innermost=[
            f"{looped.kernel.name}(NULL, 0.0, parameters, value);",
            f"mass[{place}] += value[0];",
        ],
        finish=lambda k: [],
    )
    arguments = ["const problem *given", "double *mass"]
    return nest.function(f"static void add_{looped.kernel.name}", arguments, lines, values="double value[1]")


class _Nest:
    """The loops of a kernel, with arguments and parameters at the level where they are first known.

    The innermost loop runs over parts of its span. On each part the places of a ring stand at the same distance from
    the index, whether that goes around or not, so that nothing is asked an element.

    Args:
        program: whose arrays they are.
        looped: the kernel.
        scalar: type of the arguments.
        source: what they are read from; nothing where they are not.
        chunked: whether all values of a part are found before any is added, in loops without conflicts, which a
            compiler turns into vectors.
    """

    def __init__(
        self, program: IndexedProgram, looped: LoopedKernel, scalar: str, source: str, *, chunked: bool = False
    ) -> None:
        self.program, self.looped, self.scalar, self.source = program, looped, scalar, source
        self.chunked = chunked
        self.levels = {loop.index: depth for depth, loop in enumerate(looped.loops, 1)}
        self.loops = {loop.index: loop for loop in looped.loops}
        self.scalars = len(program.parameter_names)

    def level(self, access: Access) -> int:
        """The depth of the innermost loop that moves it."""
        return max((self.levels[index] for index in access.indices), default=0)

    def is_innermost(self, access: Access) -> bool:
        """Whether an entry moves with the innermost loop."""
        return self.level(access) == len(self.looped.loops)

    def text(self, *, prepare: Lines, innermost: Sequence[str], finish: Lines, behind: Sequence[str] = ()) -> list[str]:
        """The nest.

        Args:
            prepare, finish: lines of targets before and behind the loops that do not move them.
            innermost: lines in the innermost loop.
            behind: lines, each in a loop of its own over the same part.
        """
        return self._inside(0, prepare, innermost, finish, behind)

    def _inside(
        self, level: int, prepare: Lines, innermost: Sequence[str], finish: Lines, behind: Sequence[str]
    ) -> list[str]:
        lines = list(self._found(level))
        outer = [k for k, target in enumerate(self.looped.targets) if self.level(target) == level]
        if level == len(self.looped.loops):
            return [*lines, *innermost]
        lines += [line for k in outer for line in prepare(k)]
        loop, inner = self.looped.loops[level], self._inside(level + 1, prepare, innermost, finish, behind)
        last = level + 1 == len(self.looped.loops)
        lines += self._parts(loop, inner, behind) if last else _loop(loop, _first(loop), _size_text(loop.end), inner)
        return lines + [line for k in outer for line in finish(k)]

    def _parts(self, loop: Loop, inner: Sequence[str], behind: Sequence[str]) -> list[str]:
        """The innermost loop, in parts where it needs some."""
        first, end = _first(loop), _size_text(loop.end)
        offsets = self._offsets(loop)
        if not offsets and not self.chunked:
            return _loop(loop, first, end, inner)
        lines = [f"end = {end} - begin > CHUNK ? begin + CHUNK : {end};" if self.chunked else f"end = {end};"]
        lines += [
            f"const long long {_shift(loop.index, offset)} = around(begin, {offset}, {end}, &end);"
            for offset in offsets
        ]
        lines += [f"lanes values[{len(self.looped.targets)}][CHUNK];"] if self.chunked else []
        lines += _loop(loop, "begin", "end", inner)
        for line in behind:
            lines += _loop(loop, "begin", "end", [line])
        return [
            f"for (long long begin = {first}, end; begin < {end}; begin = end) {{",
            *(f"  {line}" for line in lines),
            "}",
        ]

    def _offsets(self, loop: Loop) -> list[int]:
        """At which places of a ring stand from an index."""
        accesses = (*self.looped.slots, *self.looped.targets, *self.looped.given)
        places = [place for access in accesses for place in access.places]
        moved = {place.base.number for place in places if place.index == loop.index and not place.table}
        return sorted(moved - {0}) if loop.periodic else []

    def _found(self, level: int) -> Iterator[str]:
        """What is known at a level: arguments, parameters."""
        for k, slot in enumerate(self.looped.slots):
            if self.level(slot) == level and self.source:
                source = self.source if k < len(self.looped.slots) - self.looped.along else DIRECTION
                yield f"u[{k}] = {source}[{self.place_of(slot)}];"
        for k, access in enumerate(self.looped.given, self.scalars):
            if self.level(access) == level:
                yield f"parameters[{k}] = field_{access.array.name}[{self.place(access)}];"

    def place_of(self, access: Access) -> str:
        """Where an entry stands in the state."""
        return f"start_{access.array.name} + {self.place(access)}"

    def place(self, access: Access) -> str:
        """Where an entry stands in its array, the last axis running fastest."""
        text = ""
        for place, axis in zip(access.places, access.array.axes, strict=True):
            here = self.index(place)
            first = text if text.isidentifier() or text.endswith(")") else f"({text})"
            text = f"{first} * {_size_text(axis)} + {here}" if text else here
        return text

    def index(self, place: Place) -> str:
        """A place on an axis."""
        if place.table:
            columns = next(table for table in self.program.tables if table.name == place.table).axes[1].number
            return f"table_{place.table}[index_{place.index} * {columns} + {place.column}]"
        if not place.index:
            return _size_text(place.base)
        name, offset = f"index_{place.index}", place.base.number
        loop = self.loops[place.index]
        if not offset or not loop.periodic:
            return name + (f" {'+' if offset > 0 else '-'} {abs(offset)}" if offset else "")
        if loop is self.looped.loops[-1]:
            return f"{name} + {_shift(place.index, offset)}"
        return f"place_on_ring({name} + {offset}, {_size_text(loop.end)})".replace("+ -", "- ")

    def function(self, head: str, arguments: Sequence[str], lines: Sequence[str], *, values: str) -> str:
        """The nest as a function."""
        count = self.scalars + len(self.looped.given)
        known = [
            *self._arrays("\n".join(lines)),
            *self._unknowns(),
            f"{values};",
            f"double parameters[{max(1, count)}] = {{0}};",
            *(f"parameters[{k}] = given->parameters[{k}];" for k in range(self.scalars)),
        ]
        body = [*self._sizes("\n".join([*known, *lines])), *known, *lines]
        text = "\n".join(wrapped(line.strip(), indent=2 + len(line) - len(line.lstrip())) for line in body)
        signature = wrapped(f"{head}({', '.join(arguments)})", indent=0)
        return f"{wrapped_comment(self.looped.text)}\n{signature}\n{{\n{text}\n}}"

    def _unknowns(self) -> Iterator[str]:
        """The arguments of the kernel, if it has any."""
        if self.source and self.looped.slots:
            yield f"{self.scalar} u[{len(self.looped.slots)}];"
        elif self.source:
            yield f"const {self.scalar} u[1] = {{0}};"
            yield f"(void){self.source};"

    def _sizes(self, text: str) -> Iterator[str]:
        """Those that occur."""
        for k, name in enumerate(self.program.sizes):
            if re.search(rf"\bsize_{name}\b", text):
                yield f"const long long size_{name} = given->size[{k}];"

    def _arrays(self, text: str) -> Iterator[str]:
        """Where those begin that occur."""
        for name, start in _starts(self.program):
            if re.search(rf"\bstart_{name}\b", text):
                yield f"const long long start_{name} = {start};"
        for kind, arrays, number in (("field", self.program.fields, "double"), ("table", self.program.tables, "int")):
            for k, array in enumerate(arrays):
                if f"{kind}_{array.name}[" in text:
                    yield f"const {number} *{kind}_{array.name} = given->{kind}[{k}];"


def _first(loop: Loop) -> str:
    return f"index_{loop.behind} + 1" if loop.behind else _size_text(loop.first)


def _shift(index: str, offset: int) -> str:
    return f"shift_{index}_{'plus' if offset > 0 else 'minus'}_{abs(offset)}"


def _loop(loop: Loop, first: str, end: str, lines: Sequence[str]) -> list[str]:
    """A loop from first to the one before end."""
    name = f"index_{loop.index}"
    head = f"for (long long {name} = {first}; {name} < {end}; {name}++)"
    body = [f"  {line}" for line in lines]
    return [head, *body] if len(lines) == 1 else [f"{head} {{", *body, "}"]
