"""Fixed-point iterations in vectors as C: support headers and tables, for either meaning of a SIMD lane.

A lane is a point of a step of one trajectory, or one of many trajectories; the source of the iterations is the same for
both (``templates/support``), and so are the kernels except for the variables that differ between lanes.

If the iteration fails, Newton's method is the fallback, in the same or in a second library. Its kernels contain second
derivatives of the Lagrangian: for larger systems they are most of the source, and of the time of derivation and
compilation, and most runs never need them. So a source that is compiled here has only the fixed-point iteration and
uses a second library, compiled when the iteration first fails; an exported source includes Newton's method. The second
library is set once, for all steppers of a source: one generator makes one Newton solver for the same iteration.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, TypeAlias

from scvi_codegen.codegen.ir.equations import (
    AdaptivePredictor,
    Constraints,
    FixedPointIteration,
    LinearPart,
    Rattle,
    Splitting,
    StoredValues,
)
from scvi_codegen.codegen.ir.kernel import (
    Constant,
    Expression,
    Kernel,
    Load,
    Number,
    NumberTable,
    Operation,
    subexpressions,
)
from scvi_codegen.codegen.rendering.kernels.printer import (
    DOUBLE,
    INVERSE_ROOT,
    TIMES,
    Sources,
    Target,
    lane_functions,
    print_number,
    scalar_functions,
)
from scvi_codegen.codegen.rendering.text import table

MOST_ROOTS, MOST_PRODUCTS = 1, 3
"""Largest numbers of roots in a kernel, and of products with them."""


class _Product(NamedTuple):
    """Root of the argument times a factor."""

    root: str
    argument: Expression
    factor: Expression | None


def with_factors_in_roots(kernel: Kernel) -> Kernel:
    """Return the kernel with products of a root as ``inverse_root_k_times(x, factor)``, if they are few."""
    if kernel.sums or not 0 < len(_roots(kernel)) <= MOST_ROOTS:
        return kernel
    rewritten = _Rewriting(kernel).kernel()
    products = Counter(root.operator.endswith(TIMES) for root in _roots(rewritten))
    return rewritten if not products[False] and products[True] <= MOST_PRODUCTS else kernel


def _roots(kernel: Kernel) -> list[Operation]:
    """Return the inverse roots of a kernel, with or without a factor."""
    operations = (x for x in subexpressions(*kernel.temporaries, *kernel.results) if isinstance(x, Operation))
    return [operation for operation in operations if operation.operator.startswith(INVERSE_ROOT)]


class _Rewriting:
    """Kernel whose temporaries that are products with a root are parts of the products that use them."""

    def __init__(self, kernel: Kernel) -> None:
        self.original = kernel
        self.temporaries: list[Expression] = []
        self.loads: dict[int, Expression] = {}
        self.products: dict[int, _Product] = {}

    def kernel(self) -> Kernel:
        for k, expression in enumerate(self.original.temporaries):
            product = self.product(expression)
            if product is None:
                self.loads[k] = self.temporary(self.rewritten(expression))
            else:
                self.products[k] = product
        results = tuple(map(self.rewritten, self.original.results))
        return replace(self.original, temporaries=tuple(self.temporaries), results=results)

    def temporary(self, expression: Expression) -> Expression:
        """Return a load of a new temporary."""
        self.temporaries.append(expression)
        return Load("w", len(self.temporaries) - 1)

    def product(self, expression: Expression) -> _Product | None:
        """Return an expression as a product with exactly one root, ``None`` if it is none."""
        if isinstance(expression, Load):
            return self.products.get(expression.index) if expression.source == "w" else None
        if not isinstance(expression, Operation):
            return None
        if expression.operator.startswith(INVERSE_ROOT):
            argument = self.rewritten(expression.operands[0])
            return _Product(
                expression.operator, argument if isinstance(argument, Load) else self.temporary(argument), None
            )
        if expression.operator not in ("neg", "*"):
            return None
        products = [(operand, self.product(operand)) for operand in expression.operands]
        with_root = [product for _, product in products if product is not None]
        if len(with_root) != 1:
            return None
        product, factor = with_root[0], with_root[0].factor
        if expression.operator == "neg":  # -(r f) = r (-f)
            return product._replace(factor=Operation("neg", (factor or Constant(1),)))
        other = next(self.rewritten(operand) for operand, within in products if within is None)
        # (r f) g = r (f g)
        return product._replace(factor=Operation("*", (factor, other)) if factor else other)

    def rewritten(self, expression: Expression) -> Expression:
        product = self.product(expression)
        if product is not None:
            root, argument, factor = product
            return Operation(f"{root}{TIMES}", (argument, factor)) if factor else Operation(root, (argument,))
        if isinstance(expression, Load):
            return self.loads[expression.index] if expression.source == "w" else expression
        if isinstance(expression, Operation):
            return replace(expression, operands=tuple(map(self.rewritten, expression.operands)))
        return expression


Fallback: TypeAlias = Literal["own", "external", "provided", "none"]
"""Fallback of a source: its own, that of another library (``external``), one for others (``provided``), or none."""


LIBRARY = ("sin", "cos", "exp", "log", "pow")
"""Functions that glibc's libmvec has for every x86-64 vector width since 2.22."""

OF_TWO = ("pow", "atan2", "copysign")


@dataclass(frozen=True, slots=True)
class Lanes:
    """Meaning of a lane.

    Attributes:
        sources: loads of a kernel that differ between lanes.
        meaning: its support header, before the tables.
        memory: further headers, after the tables.
        vector: its type in C.
    """

    sources: Sources
    meaning: str
    memory: tuple[str, ...] = ()
    vector: str = "lanes"

    @property
    def are_points(self) -> bool:
        """True if lanes are points of one trajectory."""
        return "t" in self.sources

    def type_of(self, source: str, scalar: str) -> str:
        """Return the C type of the time or of a parameter; ``scalar``: that of numbers."""
        return self.vector if source in self.sources else scalar


POINTS = Lanes(("u", "t"), "points", ("core/progress", "iteration/one_trajectory"))
TRAJECTORIES = Lanes(("u", "parameters"), "trajectories", ("iteration/many_trajectories",))
DIRECTIONS = Lanes(("u",), "directions", vector="directions")


@dataclass(frozen=True, slots=True, kw_only=True)
class IterationSource:
    """Template data of a fixed-point iteration.

    Attributes:
        lanes: number of points, in one vector or in several, depending on the processor.
        whole: whether in one.
        meaning: of a lane.
        defines: macros and values that the support headers require.
        functions: lines that define functions of vectors.
        tables: C source of each.
        kernels: on lanes.
        mass: the constant masses, if any.
        damping: the rate of a damping that differs between lanes.
        support: headers from the tables on.
        linear_part: of the forces, for which steps are solved implicitly.
        error_defines, highest, next: macros and values, and the tables, of the error estimate.
    """

    lanes: int
    whole: bool
    meaning: Lanes
    defines: Mapping[str, str]
    functions: tuple[str, ...]
    tables: tuple[str, ...]
    kernels: tuple[Kernel, ...]
    mass: Kernel | None
    damping: Kernel | None
    support: tuple[str, ...]
    error_defines: Mapping[str, str] = field(default_factory=dict)
    highest: str = ""
    next: str = ""
    linear_part: LinearPart | None = None

    @property
    def inverse_roots(self) -> bool:
        """True if there are inverse roots."""
        return any("INVERSE_ROOT" in line for line in self.functions)

    @property
    def library(self) -> bool:
        """True if functions of the vector library occur."""
        return any("LIBRARY" in line for line in self.functions)


def iteration_source(
    fixed_point: FixedPointIteration,
    meaning: Lanes,
    *,
    kernels: Sequence[Kernel] | None = None,
    changes: bool = False,
    number: Target = DOUBLE,
) -> IterationSource:
    """Return the template data of a fixed-point iteration.

    ``kernels``: those applied to vectors, if not its own; ``changes``: tangent and adjoint vectors are propagated, too.
    """
    kernels = tuple(fixed_point.kernels if kernels is None else kernels)
    if meaning.are_points:
        kernels = tuple(map(with_factors_in_roots, kernels))
    mass = fixed_point.constant_mass
    damping = None if meaning.are_points else fixed_point.damping
    applied = (*kernels, *((mass,) if mass and not meaning.are_points else ()), *((damping,) if damping else ()))
    functions = {name.removesuffix(TIMES) for kernel in applied for name in lane_functions(kernel, meaning.sources)}
    solver = ("iteration/iteration_solver",) if meaning.are_points else ()
    parts = (f"iteration/{name}" for name in fixed_point.parts)
    return IterationSource(
        lanes=fixed_point.lanes,
        whole=meaning.are_points and not fixed_point.in_groups,
        meaning=meaning,
        defines={
            "FINAL_ITERATIONS": str(fixed_point.final_iterations),
            **({"LARGEST_STIFFNESS": repr(fixed_point.remainder.largest)} if fixed_point.remainder else {}),
            **{name: str(value) for name, value in fixed_point.facts.items()},
        },
        functions=tuple(map(_vector_function, sorted(functions))),
        tables=tuple(_tables(fixed_point, meaning, number, changes=changes)),
        kernels=kernels,
        mass=mass,
        damping=damping,
        support=("iteration/convergence", *meaning.memory, *parts, *solver),
        error_defines=_kept(fixed_point),
        highest=lane_table("HIGHEST", fixed_point.guess.highest),
        next=lane_table("NEXT", fixed_point.guess.next),
        linear_part=fixed_point.linear_part if meaning.are_points else None,
    )


def splitting_source(split: Splitting, observed: Kernel | None = None, number: Target = DOUBLE) -> IterationSource:
    """Return the template data of explicit steps of many trajectories, which are lanes."""
    of_drifts = () if split.by_masses else (split.drift, split.turning)
    kernels = tuple(kernel for kernel in (split.force, *of_drifts, observed) if kernel)
    functions = {name for kernel in (*kernels, split.drift) for name in lane_functions(kernel, TRAJECTORIES.sources)}
    sizes = {rows: str(count) for rows, count in split.sizes.items()}
    sizes |= {"EXPLICIT_STEPS": "1", "SPLITTING": "static inline"}
    return IterationSource(
        lanes=1,
        whole=False,
        meaning=TRAJECTORIES,
        defines=sizes
        | ({"CONSTANT_MASSES": "1"} if split.by_masses else {})
        | ({"ROTATING_BODIES": "1"} if split.bodies else {})
        | ({"DRIVEN_FORCES": "1"} if split.driven else {}),
        functions=tuple(map(_vector_function, sorted(functions))),
        tables=tuple(lane_table(name, numbers, len(numbers), number=number) for name, numbers in split.numbers.items()),
        kernels=kernels,
        mass=split.drift if split.by_masses else None,
        damping=None,
        support=("iteration/splitting",),
    )


def constrained_source(rattle: Rattle, constraints: Constraints) -> IterationSource:
    """Return the template data of constrained steps of many trajectories, which are lanes."""
    kernels = (*rattle.kernels, constraints.kernel, constraints.rounding, constraints.motion)
    functions = {name for kernel in kernels for name in lane_functions(kernel, TRAJECTORIES.sources)}
    names = ("EXPLICIT_STEPS", "TRAJECTORIES_AS_LANES", "EXACT_ROOTS")
    return IterationSource(
        lanes=1,
        whole=False,
        meaning=TRAJECTORIES,
        defines=dict.fromkeys(names, "1"),
        functions=tuple(map(_vector_function, sorted(functions))),
        tables=(),
        kernels=kernels,
        mass=None,
        damping=None,
        support=(f"constraints/{rattle.part}", "constraints/many_constrained"),
    )


def loop_functions(kernels: Iterable[Kernel]) -> list[str]:
    """Return the functions of the vector library that occur in kernels, for loops that the compiler vectorises."""
    return sorted(set(LIBRARY) & set().union(*map(scalar_functions, kernels)))


def _kept(fixed_point: FixedPointIteration) -> dict[str, str]:
    """Return the macros of the error estimate."""
    # coefficient k of velocities is h / (4k - 2) times coefficient k - 1 of accelerations
    velocities, degree = fixed_point.kept is StoredValues.VELOCITIES, fixed_point.guess.degree
    forces = fixed_point.kept is StoredValues.FORCES
    return {
        "KEPT": str(len(fixed_point.guess.abscissae)),
        "KEPT_VELOCITIES": str(int(velocities)),
        "KEPT_UNIT(i)": "(data->square * data->inverse_mass[i])" if forces else "(step->h)",
        "RESOLVED": f"{4 * degree - 2 if velocities else 1}.0",
        "NEXT_RESOLVED": f"{max(4 * degree - 6, 0) if velocities else 1}.0",
    }


def _vector_function(name: str) -> str:
    """Return the definition of a function of vectors, each function by a macro whose first argument is its name."""
    if name.startswith(INVERSE_ROOT):
        k = int(name.removeprefix(INVERSE_ROOT))
        powers, inverses = " * ".join(["square"] * (k // 2) + ["y"]), " * ".join(["inverse"] * ((k + 1) // 2))
        times = f"LANES_INVERSE_ROOT(lanes_{name}_times, {k}, ({powers}), ({inverses}));"
        return f"{times}\nINVERSE_ROOT_ALONE(lanes_{name}, lanes_{name}_times)"
    of_two = "_OF_TWO" * (name in OF_TWO)
    if name in LIBRARY:
        return f"LANES_LIBRARY_FUNCTION{of_two}(lanes_{name}, {name})"
    return f"LANE_BY_LANE{of_two}(lanes_{name}, MATH({name}))"


def _tables(fixed_point: FixedPointIteration, meaning: Lanes, number: Target, *, changes: bool) -> Iterator[str]:
    one_each = fixed_point.in_groups and not meaning.are_points
    points = len(fixed_point.guess.abscissae) if one_each else 0
    for numbers in (*fixed_point.tables, *(fixed_point.derivatives_tables if changes else ())):
        yield lane_table(numbers.name, numbers.numbers, points, groups=fixed_point.in_groups, number=number)
        if numbers.in_two_parts:
            low = tuple(tuple(map(number.rest, x)) if numbers.is_matrix else number.rest(x) for x in numbers.numbers)
            yield lane_table(f"{numbers.name}_LOW", low, points, groups=fixed_point.in_groups, number=number)


def lane_table(
    name: str,
    numbers: tuple[Number, ...] | NumberTable,
    points: int = 0,
    *,
    groups: bool = True,
    number: Target = DOUBLE,
) -> str:
    """Return a table over points: one number for each of ``points``; if 0, vectors, those of a matrix by columns."""
    kind, is_matrix = number.scalar if points else "lanes", isinstance(numbers[0], tuple)
    if not is_matrix:
        of_lanes = "[GROUPS]" if groups else ""
        size = f"[{points}]" if points else of_lanes
        return table(f"static const {kind} {name}{size}", [number.number(x) for x in numbers[: points or None]])
    rows = [row[:points] for row in numbers[:points]] if points else [*zip(*numbers, strict=True)]
    size = f"[{points}][{points}]" if points else "[POINTS * GROUPS]"
    lines = [[number.number(x) for x in row] for row in rows]
    return table(f"static const {kind} {name}{size}", lines, braces=bool(points))


def predictor_text(predictor: AdaptivePredictor) -> str:
    """Return the header of the tables from stored values to predicted ones.

    They are of a rejected step, the last one, and each of the last two.
    """
    text = (
        "/* Predictor tables from former steps to the next, by changes of the step-size level. Requires: points.h. */\n"
    )
    changes, size = len(predictor.alone), "[POINTS * GROUPS]"
    for name, tables in (("INSIDE", predictor.inside), ("ALONE", predictor.alone)):
        text += table(f"static const lanes PREDICTOR_{name}[{len(tables)}]{size}", list(map(_columns, tables))) + "\n"
    for name, lines in (("LAST", predictor.last), ("BEFORE", predictor.before)):
        rows = [[f"{{{', '.join(_columns(numbers))}}}" for numbers in line] for line in lines]
        text += table(f"static const lanes PREDICTOR_{name}[{changes}][{changes}]{size}", rows) + "\n"
    return text


def _columns(rows: NumberTable) -> list[str]:
    """Return the table by columns: the contributions of point j to all points."""
    return [print_number(number) for column in zip(*rows, strict=True) for number in column]
