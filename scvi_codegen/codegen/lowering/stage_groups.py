"""Kernels of a system, and stage groups: kernels with their derivatives, and gathers and scatters as loops.

There is one group of sites per coordinate, then one per component of other unknowns. Two coordinates are coupled if a
mixed second derivative of the Lagrangian does not vanish. The Newton matrix has a block for every coupled pair; in a
good ordering the blocks are in a narrow band, outside of which nothing is stored or computed. An open chain has
bandwidth 1, a closed one 2, and if all coordinates are coupled the band is the whole matrix.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import sympy
from sympy import Expr, Symbol

from scvi_codegen.codegen.ir.arithmetic import lower_kernel
from scvi_codegen.codegen.ir.equations import DerivativeBlock, LoweredStageGroup, TableLoop
from scvi_codegen.codegen.ir.kernel import Kernel, RolledKernel, lower_matrix, lower_vector
from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import DIGITS, mp
from scvi_codegen.methods.stage_system import Gather, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.derived_expressions import auxiliary_multipliers, curve_rates, forms_of, multipliers
from scvi_codegen.systems.formulas.array_statements import ArrayForce
from scvi_codegen.systems.formulas.arrays import ArrayTerm
from scvi_codegen.systems.formulas.expressions import Tape, jacobian, tangents
from scvi_codegen.systems.formulas.indices import Access
from scvi_codegen.systems.formulas.intermediates import inner_of, parts, separated, symbols_of
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.symmetry.symmetry import work_rates
from scvi_codegen.systems.system import MechanicalSystem


def integrand_kernel(system: MechanicalSystem, name: str, u: Iterable[Symbol]) -> Kernel | None:
    """Return the kernel of the functions that a run integrates along its curve; ``None`` if there are none."""
    if not system.integrands:
        return None
    return system_kernel(system, name, system.integrands, u=u, purpose="Functions that are integrated along the curve.")


def damping_kernel(system: MechanicalSystem) -> Kernel | None:
    """Return the kernel of the rate of a uniform damping; ``None`` without damping."""
    if system.damping == 0:
        return None
    return system_kernel(system, "damping", (system.damping,), u=(), purpose="The rate gamma of the damping.")


def system_kernel(
    system: MechanicalSystem,
    name: str,
    values: Iterable[Expr],
    *,
    u: Iterable[Symbol],
    partials: Iterable[Expr] = (),
    purpose: str = "",
    paired: bool = False,
    of_rounding: bool = False,
) -> Kernel:
    """Return the kernel ``name`` as a function of the time and parameters of a system.

    Args:
        system, name: the system, and the C identifier.
        values: expressions of the values.
        u: the arguments.
        partials: expressions of derivatives, stored after the values.
        purpose: one sentence on what it computes, for the comment above it.
        paired: whether its sums have short chains of operations instead of few operations.
        of_rounding: whether it computes bounds of the rounding errors of the values instead.
    """
    values, partials = regular_at_roots(system, tuple(values)), regular_at_roots(system, tuple(partials))
    kernel = lower_kernel(
        name,
        arguments=tuple(u),
        time=system.time,
        parameters=system.parameters,
        values=values,
        partials=partials,
        paired=paired,
        of_rounding=of_rounding,
    )
    return replace(kernel, purpose=purpose)


LEAST_BASE = sympy.Rational(1, 2**126)
"""Least number that a regularised base adds: the smallest normal one in single precision."""


def regular_at_roots(system: MechanicalSystem, expressions: tuple[Expr, ...]) -> tuple[Expr, ...]:
    """Return derivatives of forces such that they are evaluated where these are defined, also at zeros of roots.

    Let momenta and forces contain powers u^r of a base u with 0 < r, no integer, but no negative ones, as sqrt(x^2 +
    y^2) x: they are defined at u = 0. Then powers u^(r - k), r < k, come from their derivatives alone. Those of first
    order are u^(r - 1) u_x g, g the other factors of u^r. If u >= 0 is smooth, |u_x| <= C sqrt(u) (Glaeser's
    inequality), so that this is at most C u^(r - 1/2) |g|: where g = 0 or r > 1/2 its limit is 0, but the factors are
    infinity and 0. The base u + 2^-126 in negative powers gives finite factors, whose product is 0 at u_x g = 0, and
    the same bits as u for all u > 2^-72. Where the limit is none (u_x u^(-1/2), the slope of a kink) the result is one
    of the generalised derivatives of Clarke. Powers that forces themselves contain, as of a collision, remain.
    """
    powers = {part for part in parts(*expressions) if _is_root(part) and part.exp < 0}
    regular = _regular_bases(system) if powers else frozenset()
    bases = {part: sympy.Pow(part.base + LEAST_BASE, part.exp) for part in powers if part.base in regular}
    return tuple(expression.xreplace(bases) for expression in expressions) if bases else expressions


def _is_root(part: Expr) -> bool:
    return bool(part.is_Pow and part.exp.is_Rational and not part.exp.is_Integer and part.base.free_symbols)


@lru_cache(maxsize=8)
def _regular_bases(system: MechanicalSystem) -> frozenset[Expr]:
    """Return the bases of roots in momenta and forces that these contain with positive exponents alone."""
    forms = forms_of(system)
    values = (*(forms.legendre if system.auxiliaries else forms.momentum), *forms.force)
    found = [part for part in parts(*values) if part.is_Pow and part.base.free_symbols]
    undefined = {part.base for part in found if not part.exp.is_positive}
    return frozenset(part.base for part in found if _is_root(part)) - undefined


def rolled_kernel(
    system: ArraySystem,
    name: str,
    values: Iterable[Expr],
    term: ArrayTerm | ArrayForce,
    u: Sequence[tuple[Symbol, Access]] = (),
    *,
    along: Sequence[Symbol] = (),
    targets: Sequence[Access] | None = None,
    text: str,
    purpose: str,
) -> RolledKernel:
    """Return the kernel ``name`` in the loops of a term.

    Args:
        system, name, values, purpose: as of :func:`system_kernel`.
        term: the term, whose other entries are the last parameters.
        u: entries that are arguments.
        along: further arguments, the components of a direction by these entries.
        targets: entries that the values are added to; by default ``u``.
        text: formula for the comment.
    """
    symbols, accesses = [slot for slot, _ in u], tuple(access for _, access in u)
    constants = [(slot, access) for slot, access in term.slots if slot not in symbols]
    kernel = lower_kernel(
        name,
        arguments=(*symbols, *along),
        time=system.time,
        parameters=(*system.parameters, *(slot for slot, _ in constants)),
        values=tuple(values),
    )
    return RolledKernel(
        kernel=replace(kernel, purpose=purpose),
        loops=term.loops,
        reads=accesses * (2 if along else 1),
        writes=accesses if targets is None else tuple(targets),
        constants=tuple(access for _, access in constants),
        text=comment_text(text),
        along=len(along),
    )


def comment_text(text: str) -> str:
    """Return one printable line that neither ends nor begins a C comment."""
    line = "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))
    return line.replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ? /")


@dataclass(frozen=True, slots=True)
class UnknownLayout:
    """Groups of blocks of the same size, each at as many sites: first those at the coordinates, of size ``None``.

    Attributes:
        dimension: number of coordinates.
        first: the first site, by size.
        columns: the indices of the B blocks, by size.
        rows: the indices of the B rows, by size.
        count: number of sites.
    """

    dimension: int
    first: dict[int | None, int]
    columns: dict[int | None, tuple[int, ...]]
    rows: dict[int | None, tuple[int, ...]]
    count: int

    def size(self, count: int, table: Table, members: dict[int | None, tuple[int, ...]], first: int = 0) -> int | None:
        """Return the size of the ``members`` in a table of ``count`` components: multipliers may be as many as m."""
        used = any(line[k + first] for line in table.entries for k in members.get(count, ()))
        return count if used or count != self.dimension else None


def layout_of(stages: StageSystem, dimension: int) -> UnknownLayout:
    """Return the sites of stage equations; MethodError unless blocks and rows of every size are equally many."""
    blocks, rows = [block.size for block in stages.blocks], [row.size for row in stages.rows]
    sizes = [None, *sorted({size for size in (*blocks, *rows) if size is not None})]
    numbers = [dimension if size is None else size for size in sizes]
    columns, lines = (
        {size: tuple(k for k, own in enumerate(items) if own == size) for size in sizes} for items in (blocks, rows)
    )
    if len({len(places) for group in (columns, lines) for places in group.values()}) > 1:
        counts = ", ".join(
            f"{len(columns[size])} blocks and {len(lines[size])} rows of {number}"
            for size, number in zip(sizes, numbers, strict=True)
        )
        raise MethodError(
            "stage equations must have as many blocks as rows of every size, and equally many of all "
            f"sizes; got {counts}"
        )
    first = {size: sum(numbers[:k]) for k, size in enumerate(sizes)}
    return UnknownLayout(dimension, first, columns, lines, sum(numbers))


def _block_size(gather: Gather, sites: UnknownLayout) -> int | None:
    return sites.size(len(gather.arguments), gather.table, sites.columns, 1)


def _row_size(scatter: Scatter, sites: UnknownLayout) -> int | None:
    return sites.size(len(scatter.results), scatter.table, sites.rows)


Pairs = Iterable[tuple[int, int]]


def bandwidth(pairs: Pairs, positions: tuple[int, ...]) -> int:
    """Return the largest distance of two coupled coordinates in an ordering.

    >>> bandwidth([(0, 2), (1, 2)], (0, 1, 2))
    2
    """
    return max((abs(positions[i] - positions[j]) for i, j in pairs), default=0)


def bandwidth_ordering(pairs: Pairs, count: int) -> tuple[int, ...]:
    """Return the position of each coordinate: the original order, or reverse Cuthill-McKee if that is narrower.

    >>> bandwidth_ordering([(0, 2), (1, 2)], 3)
    (2, 0, 1)
    """
    coupled = {(max(pair), min(pair)) for pair in pairs if pair[0] != pair[1]}
    original = tuple(range(count))
    if bandwidth(coupled, original) <= 1 or 2 * len(coupled) == count * (count - 1):
        return original
    order = _cuthill_mckee(coupled, count)
    return order if bandwidth(coupled, order) < bandwidth(coupled, original) else original


def _cuthill_mckee(coupled: set[tuple[int, int]], count: int) -> tuple[int, ...]:
    # Imported here because SciPy is slow to import and most systems do not need it.
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    rows, columns = np.array(sorted(coupled | {(j, i) for i, j in coupled})).T
    graph = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    order = reverse_cuthill_mckee(graph, symmetric_mode=True)
    return tuple(int(place) for place in np.argsort(order))


MOST_PAIRS_COMPARED, REDUCTION = 16, mp.mpf(10) ** -20
"""Number of pairs of mixed derivatives that are compared by value; by which twice the digits reduce rounding errors."""


def has_action(system: MechanicalSystem) -> bool:
    """Return whether the discrete Lagrangian exists as a function of both ends of a step.

    It does not if velocities do not determine momenta, with forces, with constraints, or with damping.
    """
    if system.forces or system.constraints or system.damping != 0:
        return False
    return not isinstance(system, HamiltonianSystem) or system.is_regular


def lowered_stage_group(system: MechanicalSystem, group: StageGroup, sites: UnknownLayout) -> LoweredStageGroup:
    """Return a stage group in loops: its kernel with derivatives, and rounded tables."""
    x, entries = _derivatives(group)
    places, blocks = _derivative_blocks(group, sites, entries)
    names = tuple(argument_name(system, gather) for gather in group.gathers)
    u = f"u = ({', '.join(names)})"
    return LoweredStageGroup(
        name=group.name,
        arguments=names,
        abscissae=lower_vector(group.abscissae),
        weights=lower_vector(group.weights),
        gathers=tuple(_gather_loop(group, g, sites) for g in range(len(group.gathers))),
        scatters=tuple(_scatter_loop(group, s, sites) for s in range(len(group.scatters))),
        value=system_kernel(
            system, f"{group.name}_value", group.results, u=group.arguments, purpose=f"{_results(group, names)} at {u}."
        ),
        derivative=_derivative_kernel(
            system,
            group,
            x,
            {place: entries[place] for place in places},
            purpose=f"The same, and the nonzero derivatives with respect to {u}.",
        ),
        blocks=blocks,
        integrand=_integrand(system, group, u) if group.in_action else None,
        integrand_power=group.scalar_power,
        integrand_weights=lower_vector(group.scalar_weights),
    )


def _results(group: StageGroup, names: tuple[str, ...]) -> str:
    if group.computes:
        return group.computes
    if group.name == "node":
        return "Derivatives of lambda . E" if "lambda" in names else "The Euler-Lagrange residual E"
    if group.scalar_power:
        return f"Derivatives of d^{group.scalar_power}L/dt^{group.scalar_power}"
    partials = [f"L_{name}" for name in names]
    if group.forced:
        partials[0] += " + f"
    return " and ".join(partials) if len(group.scatters) == len(names) else "L_v"


def _integrand(system: MechanicalSystem, group: StageGroup, u: str) -> Kernel | None:
    """Return the kernel that is summed along the curve: work and impulses of forces, then the action."""
    assert group.scalar is not None
    if rates_of_forces := work_rates(system):
        rates = [*(work.rate for work in rates_of_forces), group.scalar]
        purpose = f"Power and impulse rates of the forces, and L, at {u}."
        return system_kernel(system, "exchanges", rates, u=group.arguments, purpose=purpose)
    name = "lagrangian" if group.name == "quadrature" else f"{group.name}_action"
    purpose = f"{_integrand_text(system, group.scalar_power)} at {u}."
    return system_kernel(system, name, (group.scalar,), u=group.arguments, purpose=purpose)


def _integrand_text(system: MechanicalSystem, order: int) -> str:
    """Return L, or its time derivative of an order, as in formulas."""
    if order == 0:
        return "p . v - H" if system.auxiliaries else "L"
    return "dL/dt" if order == 1 else f"d^{order}L/dt^{order}"


def argument_name(system: MechanicalSystem, gather: Gather) -> str:
    """Return the name of the arguments of a gather as used in formulas."""
    names = {
        system.coordinates: "q",
        system.velocities: "v",
        **dict(zip(curve_rates(system, 3), ("a", "j", "s"), strict=True)),
        multipliers(system): "lambda",
        system.auxiliaries: "p",
        auxiliary_multipliers(system): "nu",
    }
    name = gather.arguments[0].name.rpartition("_")[0] if gather.arguments else ""
    return names.get(gather.arguments, name)


def _derivative_blocks(
    group: StageGroup, sites: UnknownLayout, entries: Iterable[tuple[int, int]]
) -> tuple[list[tuple[int, int]], tuple[DerivativeBlock, ...]]:
    """Return result and argument of the nonzero derivatives, block by block, and these blocks.

    A block has the results of one scatter and the arguments of one gather, which begin at row ``top`` and column
    ``left`` of the group's matrix. Its entries are sites of the step's matrix, (row, column); ``first`` is the place of
    its derivatives among all.
    """
    places: list[tuple[int, int]] = []
    blocks = []
    for s, scatter in enumerate(group.scatters):
        top = sum(len(other.results) for other in group.scatters[:s])
        for g, gather in enumerate(group.gathers):
            left = sum(len(other.arguments) for other in group.gathers[:g])
            rows, columns = range(top, top + len(scatter.results)), range(left, left + len(gather.arguments))
            nonzero = [(i - top, j - left) for i, j in entries if i in rows and j in columns]
            if nonzero:
                row, column = sites.first[_row_size(scatter, sites)], sites.first[_block_size(gather, sites)]
                pairs = tuple((row + i, column + j) for i, j in nonzero)
                blocks.append(DerivativeBlock(scatter=s, gather=g, first=len(places), entries=pairs))
                places.extend((top + i, left + j) for i, j in nonzero)
    return places, tuple(blocks)


MOST_WRITTEN_OUT = 32
"""Largest number of arguments by which results with intermediate quantities are differentiated entry by entry."""


def _derivatives(group: StageGroup) -> tuple[tuple[Symbol, ...], dict[tuple[int, int], sympy.Expr]]:
    """Return the nonzero derivatives, or directions x of the arguments, and by place the change of a result along x."""
    if len(group.arguments) <= MOST_WRITTEN_OUT or not any(map(inner_of, group.results)):
        return (), _partials(group)
    x = tuple(Symbol(f"x[{j}]", real=True) for j in range(len(group.arguments)))
    changes = [(change, symbols_of(change)) for change in tangents(group.results, group.arguments, x)]
    columns = [*enumerate(x)]
    return x, {(i, j): row for i, (row, found) in enumerate(changes) for j, name in columns if name in found}


def _derivative_kernel(
    system: MechanicalSystem,
    group: StageGroup,
    x: Sequence[Symbol],
    entries: Mapping[tuple[int, int], sympy.Expr],
    *,
    purpose: str,
) -> Kernel:
    """Return the kernel of the results and of their derivatives, which :func:`_derivatives` returns.

    Local derivatives, of each intermediate quantity by those that it depends on, are evaluated once, and their products
    with unit vectors in a loop: as many operations as those of the formulas of all entries, in a third of the code.
    """
    name, kernel = f"{group.name}_derivatives", partial(system_kernel, system, u=group.arguments, purpose=purpose)
    if not x:
        return kernel(name, group.results, partials=entries.values())
    rows = {i: change for (i, _), change in entries.items()}
    changes, local = separated([*rows.values()], frozenset(x))
    along = lower_kernel(f"{name}_along", arguments=x, time=system.time, parameters=[*local.values()], values=changes)
    numbers = {i: k for k, i in enumerate(rows)}
    return replace(
        kernel(name, group.results, partials=[*local]),
        tangents=replace(along, purpose="Changes of these values along u, by their local derivatives."),
        entries=tuple(sorted(((numbers[i], j, e) for e, (i, j) in enumerate(entries)), key=lambda entry: entry[1])),
    )


def _partials(group: StageGroup) -> dict[tuple[int, int], sympy.Expr]:
    """Return the nonzero derivatives of results with respect to arguments; symmetric for a gradient."""
    entries = jacobian(group.results, group.arguments)
    if group.scalar is None or group.forced:
        return entries
    _check_symmetry(group, entries)
    return {(i, j): entries.get((min(i, j), max(i, j)), entry) for (i, j), entry in entries.items()}


def _check_symmetry(group: StageGroup, entries: Mapping[tuple[int, int], sympy.Expr]) -> None:
    """Raise :class:`MethodError` if mixed derivatives differ: Newton's method would not converge with them."""
    unlike = [(i, j) for (i, j), entry in entries.items() if i < j and entry != entries.get((j, i))]
    for i, j in unlike[:MOST_PAIRS_COMPARED]:
        pair = entries[i, j], entries.get((j, i), sympy.S.Zero)
        if _differ(*pair):
            u = group.arguments
            raise MethodError(
                f"the results of the stage group '{group.name}' are not the gradient of its scalar: the "
                "derivative of that "
                f"for {u[i]} by {u[j]} is {pair[0]}, of that for {u[j]} by {u[i]} {pair[1]}. They must be equal: check "
                "the signs and the order of the results in its scatters, or give the stage group no scalar"
            )


def _differ(first: sympy.Expr, second: sympy.Expr) -> bool:
    """Return whether two expressions have different values at a point where both have one.

    The difference of equal ones is a rounding error, whatever cancels inside, and decreases with the unit of round-off.
    """
    symbols = sorted(first.free_symbols | second.free_symbols, key=str)
    differences = []
    try:
        for digits in (DIGITS, 2 * DIGITS):
            with mp.workdps(digits):
                values = Tape([first, second], symbols)([mp.mpf(k + 3) / (k + 5) for k in range(len(symbols))])
                differences.append(abs(values[0] - values[1]))
    except ArithmeticError:
        return False
    return bool(differences[1] > REDUCTION * differences[0] > 0)


def _gather_loop(group: StageGroup, index: int, sites: UnknownLayout) -> TableLoop:
    gather = group.gathers[index]
    size = _block_size(gather, sites)
    return TableLoop(
        name=f"{group.name}_gather_{index}",
        first=sites.first[size],
        sites=len(gather.arguments),
        offset=sum(len(other.arguments) for other in group.gathers[:index]),
        from_state=bool(gather.table.entries[0][0]),
        power=gather.power + 1,
        table=lower_matrix(gather.table.columns([b + 1 for b in sites.columns[size]]).entries),
    )


def _scatter_loop(group: StageGroup, index: int, sites: UnknownLayout) -> TableLoop:
    scatter = group.scatters[index]
    size = _row_size(scatter, sites)
    return TableLoop(
        name=f"{group.name}_scatter_{index}",
        first=sites.first[size],
        sites=len(scatter.results),
        offset=sum(len(other.results) for other in group.scatters[:index]),
        power=scatter.power,
        table=lower_matrix(scatter.table.columns([*sites.rows[size], -1]).entries),
    )
