"""Loops around kernels: the terms of systems of arrays, and the term groups of named coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, combinations, islice, product
from typing import TYPE_CHECKING

from sympy import Add, Expr, S, Symbol, preorder_traversal

from scvi_codegen.codegen.ir.arithmetic import lower_kernel
from scvi_codegen.codegen.ir.equations import ConstrainedSteps
from scvi_codegen.codegen.ir.kernel import Constant, Load, RolledKernel, exact_number
from scvi_codegen.codegen.ir.program import Program, RolledTerms
from scvi_codegen.codegen.lowering.stage_groups import rolled_kernel
from scvi_codegen.systems.arrays.system import ArraySystem, entries_of, force_of, gathered
from scvi_codegen.systems.formulas.array_statements import ArrayForce
from scvi_codegen.systems.formulas.arrays import ArrayTerm, term_of
from scvi_codegen.systems.formulas.expressions import gradient
from scvi_codegen.systems.formulas.indices import Access, Array, Place
from scvi_codegen.systems.formulas.neighbours import MAX_COMPONENTS, Neighbours
from scvi_codegen.systems.formulas.symbols import DOT
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.term_groups import SplitSystem, TermGroup

if TYPE_CHECKING:
    from scvi_codegen.systems.legendre.of_arrays import SiteHamiltonian

LONG_FORMULA = 1000
"""Nodes of the expressions from which on a comment does not contain a formula."""


def rolled_terms(
    system: ArraySystem, constrained: ConstrainedSteps | None, *, newton: bool, explicit: bool
) -> RolledTerms:
    """Return the kernels of the terms of a system of arrays.

    Args:
        system, constrained: the system; its constrained steps, if any.
        newton: with the Jacobian of the forces.
        explicit: forces at one point at a time, of which those complete at once are preferred.
    """
    potentials = [part for term in system.potentials for part in _parts(system, term)]
    arguments = (*system.state, *system.velocities)
    products, diagonals = _jacobian(system, potentials) if newton else ((), ())
    masses = [
        (f"mass of {access}", mass, number) for number, mass in enumerate(system.masses) for access, _ in mass.targets
    ]
    frictions, heats = (
        tuple(_added(system, f"{name}_{number}", term, (), "", f"{name}.") for number, term in enumerate(terms))
        for name, terms in zip(("friction", "heat"), system.bath_terms, strict=True)
    )
    return RolledTerms(
        frictions=frictions,
        heats=heats,
        forces=(
            *(_potential(system, *part, number, explicit=explicit) for number, part in enumerate(potentials)),
            *(
                _added(system, f"force_{number}", force, arguments, f"forces {_shown(force)}", "Forces.")
                for number, force in enumerate(system.applied_forces, len(potentials))
            ),
        ),
        masses=tuple(_added(system, f"mass_{number}", mass, (), text, "A mass.") for text, mass, number in masses),
        constants=tuple(
            rolled_kernel(system, f"constant_{number}", [term.formula], term, text=_shown(term), purpose="The term.")
            for number, term in enumerate(system.energy_offsets)
        ),
        constrained=constrained,
        products=products,
        diagonals=diagonals,
        reach=reach_of(system.coordinates, diagonals),
        neighbours=tuple(_list(system, near) for near in system.neighbours),
    )


def transforms(sites: SiteHamiltonian) -> dict[str, tuple[RolledKernel, ...]]:
    """Return the kernels of velocities in (q, p), and of momenta in (q, v), as functions of the joined state.

    In both the momenta or velocities follow the positions, so both are read as entries of the momenta.
    """
    system, moving = sites.system, dict[str, tuple[Array, Array]]()
    for array, momentum in zip(sites.system.coordinates, sites.system.momenta, strict=True):
        moving |= {array.name + DOT: (array, momentum), momentum.name: (array, momentum)}

    def rolled_of(name: str, number: int, force: ArrayForce) -> RolledKernel:
        slots = tuple(
            (slot, replace(access, array=moving[access.array.name][1]) if access.array.name in moving else access)
            for slot, access in force.slots
        )
        targets = tuple((replace(access, array=moving[access.array.name][0]), x) for access, x in force.targets)
        rates, purpose = replace(force, slots=slots, targets=targets), f"{name.capitalize()}."
        return _added(system, f"{name}_{number}", rates, system.state, f"{name} {_shown(force)}", purpose)

    return {
        "velocities": tuple(rolled_of("velocities", *pair) for pair in enumerate(sites.velocities)),
        "momenta": tuple(rolled_of("momenta", *pair) for pair in enumerate(sites.momenta)),
    }


def _list(system: ArraySystem, near: Neighbours) -> tuple[str, int, RolledKernel]:
    """Return name, components and lengths of a list of neighbours."""
    lengths = [*near.box, *[S.Zero] * (MAX_COMPONENTS - len(near.box)), near.cutoff, near.skin]
    none = ArrayTerm(loops=(), formula=S.One, slots=())
    first = Access(array=near.array, places=(Place(),) * len(near.array.axes))
    name, purpose = f"list_{near.name}", "Periods, cutoff and skin of a list of neighbours."
    rolled = rolled_kernel(system, name, lengths, none, targets=[first], text=near.name, purpose=purpose)
    return near.name, near.components, rolled


def _added(
    system: ArraySystem, name: str, force: ArrayForce, arguments: Sequence[Array], text: str, purpose: str
) -> RolledKernel:
    """Return the kernel of formulas that are added to entries, as functions of entries of certain arrays."""
    targets, formulas = zip(*force.targets, strict=True)
    u = entries_of(force, arguments)
    return rolled_kernel(system, name, formulas, force, u, targets=targets, text=text, purpose=purpose)


def _potential(system: ArraySystem, term: ArrayTerm, axis: int | None, number: int, *, explicit: bool) -> RolledKernel:
    """Return the derivatives of a term by coordinates and momenta, and the term; ``axis``: of a circulant matrix."""
    force = _signed(system, force_of(term, system.state))
    purpose = "Derivatives with respect to its coordinates."
    forces = dict.fromkeys((force, gathered(force) if explicit else force))
    kernels = {_added(system, f"force_{number}", how, system.state, _shown(term), purpose): how for how in forces}
    rolled = min(kernels, key=_operations)
    u = entries_of(kernels[rolled], system.state)
    scalar = rolled_kernel(system, f"term_{number}", [term.formula], kernels[rolled], u, text="", purpose="The term.")
    return replace(rolled, scalar=scalar.kernel, circulant=axis)


PASS, CALL = 4, 16
"""Operations that take about as long as one more pass over the forces of a row, and as a division or a call."""


def _operations(rolled: RolledKernel) -> int:
    """Return the time of a term in operations of an element, with the passes over the rows that it adds to."""
    inner, counts = {loop.index for loop in rolled.loops[-1:]}, rolled.kernel.operation_counts()
    rows = {(target.array, *(place for place in target.places if place.index not in inner)) for target in rolled.writes}
    calls = sum(count for name, count in counts.items() if name not in ("+", "-", "*", "neg"))
    return sum(counts.values()) + (CALL - 1) * calls + PASS * len(rows)


def _parts(system: ArraySystem, term: ArrayTerm) -> Iterator[tuple[ArrayTerm, int | None]]:
    """Yield the parts f sum_(i<j) c[j-i] (x_i - x_j)^2 / 2 of a term, f constant, with the axis of i; then the rest."""
    whole = {Place(index=loop.index): loop.end for loop in term.loops if loop.is_whole and not loop.near}
    accesses, rest = dict(term.slots), term.formula
    coefficients = [slot for slot, access in term.slots if len(access.places) == 1 and access.places[0].minus]
    for c, (x, y) in product(coefficients, combinations(entries_of(term, system.state), 2)):
        (x_i, at_i), (x_j, at_j) = x, y
        factor = term.formula.diff(c, x_i, x_i)
        axes = [k for k, places in enumerate(zip(at_i.places, at_j.places, strict=False)) if places[0] != places[1]]
        alike = at_i.array == at_j.array and not (at_i.sums or at_j.sums)
        covered = alike and {*at_i.places, *at_j.places} == {*whole} and len(whole) == len(term.loops)
        sizes = tuple(whole.get(place) for place in at_i.places)
        if covered and len(axes) == 1 and sizes == at_i.array.axes and factor and not factor.free_symbols & {*accesses}:
            part = factor * c * (x_i - x_j) ** 2 / 2
            rest -= part
            yield term_of(term.loops, part, accesses), axes[0]
    if rest is term.formula:
        yield term, None
    elif rest := rest.expand():
        yield term_of(term.loops, rest, accesses), None


def _signed(system: ArraySystem, force: ArrayForce) -> ArrayForce:
    """Return the rates of a term of -H, -H_q and H_p; the forces of a Lagrangian are returned as they are."""
    signed = ((access, -value if access.array in system.momenta else value) for access, value in force.targets)
    return replace(force, targets=tuple(signed))


def _shown(term: ArrayTerm | ArrayForce) -> str:
    """Return a term or force as text for a comment; instead of long formulas, the arrays that they contain."""
    formulas = [term.formula] if isinstance(term, ArrayTerm) else [formula for _, formula in term.targets]
    if sum(1 for _ in islice(chain(*map(preorder_traversal, formulas)), LONG_FORMULA)) < LONG_FORMULA:
        return str(term)
    loops = ", ".join(map(str, term.loops))
    return f"a long formula of {', '.join(sorted({access.array.name for _, access in term.slots}))} for {loops}"


def _jacobian(
    system: ArraySystem, potentials: Sequence[tuple[ArrayTerm, int | None]]
) -> tuple[tuple[RolledKernel, ...], tuple[RolledKernel, ...]]:
    """Return the Jacobian of the forces times a direction, by term groups; by term groups also its diagonal."""
    forces = [(force_of(term, system.state), axis) for term, axis in potentials]
    forces += [(force, None) for force in system.applied_forces]
    derived = [_derived(system, *force, number) for number, force in enumerate(forces)]
    pairs = [pair for pair in derived if pair]
    circulant = any(axis is not None or any(access.sums for access, _ in force.targets) for force, axis in forces)
    modes = not system.velocities and (circulant or not system.momenta)
    diagonals = tuple(diagonal for _, diagonal in pairs) if modes else ()
    return tuple(product for product, _ in pairs), diagonals


def _derived(
    system: ArraySystem, force: ArrayForce, axis: int | None, number: int
) -> tuple[RolledKernel, RolledKernel] | None:
    """Return the kernels of a force for :func:`_jacobian`; ``None`` if it does not depend on the state."""
    signed = _signed(system, force)
    force = replace(force, targets=tuple(pair for pair in signed.targets if pair[1] != 0))
    moving = entries_of(force, (*system.state, *system.velocities))
    u, w = [slot for slot, _ in moving], [Symbol(f"{slot.name} along", real=True) for slot, _ in moving]
    rows = [gradient(formula, u) for _, formula in force.targets]
    if not any(rows):
        return None
    along = [Add(*(derivative * w[k] for k, derivative in row.items())) for row in rows]
    targets = [
        Add(*(derivative for k, derivative in row.items() if moving[k][1] == access))
        for row, (access, _) in zip(rows, force.targets, strict=True)
    ]
    rolled = partial(
        rolled_kernel,
        system,
        term=force,
        u=moving,
        targets=[access for access, _ in force.targets],
        text=f"derivatives of {_shown(force)}",
    )
    jacobian = rolled(f"product_{number}", along, along=w, purpose="Jacobian of the forces times a direction.")
    diagonal = rolled(f"diagonal_{number}", targets, purpose="Diagonal of the Jacobian of the forces.")
    return replace(jacobian, circulant=axis), replace(diagonal, circulant=axis)


def with_sums(program: Program, split: SplitSystem) -> Program | None:
    """Return the program of ``of.rest`` with the forces and the energy of the term groups.

    ``None`` if forces enter otherwise than as values of kernels, in Newton's method and shooting, or if steps without
    the forces of ``of.rest`` have no kicks; of groups with velocities also unless these are the unknowns.
    """
    rest, energy, sign = split.rest, program.quantities.energy, -1 if split.rest.auxiliaries else 1
    if any(group.rates for group in split.term_groups):
        return _with_masses(program, split)
    forces, terms = [], []
    for number, group in enumerate(split.term_groups):
        first = ((0,),) * len(group.places)
        forces.append(_over_terms(rest, f"pull_{number}", group, group.partials, ()))
        terms.append(_over_terms(rest, f"term_{number}", group, (sign * group.formula,), first))
    fixed_point, splitting = program.fixed_point and program.fixed_point.with_forces(tuple(forces)), program.splitting
    kicks = splitting is not None and any(splitting.numbers.get("KICK", (1,)))
    if program.newton or energy is None or not (fixed_point or kicks):
        return None
    return replace(
        program,
        quantities=replace(program.quantities, energy=energy.with_sums(tuple(terms))),
        fixed_point=fixed_point,
        splitting=replace(splitting, force=splitting.force.with_sums(tuple(forces))) if splitting else None,
    )


def _with_masses(program: Program, split: SplitSystem) -> Program | None:
    """Return the program with forces, momenta, masses and the energy of term groups; ``None`` without kernels for them.

    Kernels of the rest have all entries of the masses, 0 where only groups have some.
    """
    fixed_point, quantities, m = program.fixed_point, program.quantities, split.rest.dimension
    legendre, energy = quantities.legendre, quantities.energy
    if program.newton or not fixed_point or fixed_point.forces != ("point_lanes", "force_lanes"):
        return None
    if not (legendre and energy):
        return None
    numbers = {place: (k,) for k, place in enumerate(quantities.mass_entries)}
    in_matrix = {(i, j): (i if fixed_point.diagonal else i * m + j,) for i, j in fixed_point.mass_entries}
    in_both = {(i, j): numbers[i, j] + (numbers[j, i] if i != j else ()) for i, j in in_matrix}
    loops = partial(_of_groups, split)
    of_points = {"point_lanes": loops(forces=0, momenta=m, entries=in_matrix), "force_lanes": loops(forces=0)}
    kernels = (kernel.with_sums(of_points.get(kernel.name, ())) for kernel in fixed_point.kernels)
    return replace(
        program,
        quantities=replace(
            quantities,
            legendre=legendre.with_sums(loops(momenta=0, entries=in_both)),
            energy=energy.with_sums(loops(energy=0)),
        ),
        fixed_point=replace(fixed_point, kernels=tuple(kernels)),
    )


def _of_groups(
    split: SplitSystem,
    *,
    forces: int | None = None,
    momenta: int | None = None,
    energy: int | None = None,
    entries: Mapping[tuple[int, int], tuple[int, ...]] | None = None,
) -> tuple[RolledKernel, ...]:
    """Return the loops over terms that add to values of a kernel of positions and velocities.

    Args:
        split: the term groups.
        forces, momenta, energy: index of the first value of each kind, if the kernel has such values.
        entries: indices of derivatives of the kernel by entry (i, j), i >= j, of the masses, if it has these.
    """
    m, loops = split.rest.dimension, []
    for number, group in enumerate(split.term_groups):
        values, targets = list[Expr](), [tuple[int, ...]()] * len(group.places)
        for first, of_slots in ((forces, group.partials), (momenta, group.momenta if group.rates else ())):
            if first is not None and of_slots:
                values += of_slots
                targets = [(*own, *(first + k for k in row)) for own, row in zip(targets, group.places, strict=True)]
        if energy is not None:
            values, targets = [group.formula], [(energy,) for _ in group.places]
        derivatives = tuple[tuple[int, ...], ...]()
        if entries is not None and group.rates:
            derivatives = tuple(sum((entries[pair] for pair in row), ()) for row in group.mass_places)
            counts = [len(entries[pair]) for pair in next(group.mass_places)]
            values += [x for count, x in zip(counts, group.masses.values(), strict=True) for _ in range(count)]
        if values:
            reads = tuple((*row, *(m + k for k in row)) if group.rates else row for row in group.places)
            loops.append(_over_terms(split.rest, f"terms_{number}", group, values, tuple(targets), derivatives, reads))
    return tuple(loops)


def _over_terms(
    system: MechanicalSystem,
    name: str,
    group: TermGroup,
    values: Sequence[Expr],
    targets: tuple[tuple[int, ...], ...],
    derivatives: tuple[tuple[int, ...], ...] = (),
    reads: tuple[tuple[int, ...], ...] = (),
) -> RolledKernel:
    kernel = lower_kernel(
        name,
        arguments=(*group.slots, *group.rates, *group.constants),
        time=system.time,
        parameters=system.parameters,
        values=values,
        constants=len(group.constants),
    )
    index = {parameter: k for k, parameter in enumerate(system.parameters)}
    coefficients = tuple(
        tuple(Load("parameters", index[x]) if x in index else Constant(exact_number(x)) for x in column)
        for column in group.values
    )
    return RolledKernel.over_rows(kernel, reads or group.places, coefficients, targets, derivatives)


def reach_of(arrays: Iterable[Array], term_groups: Iterable[RolledKernel]) -> int:
    """Return the largest distance on an axis of places that forces couple.

    Args:
        arrays: of coordinates; in a lattice the first axes are named sizes, the last ones integers.
        term_groups: term groups of forces, with the coordinates that each depends on.

    Returns:
        0 if no places are coupled, if an array is no lattice, or if a term group couples places by a table, all pairs
        or a convolution.
    """
    convolved = any(access.sums for rolled in term_groups for access in rolled.reads)
    if convolved or not all(array.is_lattice for array in arrays):
        return 0
    pairs = [
        (target, slot)
        for rolled in term_groups
        if rolled.loops
        for target in rolled.writes
        for slot in rolled.reads
        if target != slot
    ]
    axes = [axis for target, slot in pairs for axis in zip(target.places, slot.places, strict=False)]
    if any(a.table or b.table or a.index != b.index for a, b in axes):
        return 0
    distant = any(_distance(*pair) for pair in pairs if pair[0].array == pair[1].array)
    return max(_distance(*pair) for pair in pairs) if distant else 0


def _distance(target: Access, slot: Access) -> int:
    pairs = zip(target.places, slot.places, strict=False)
    return max((abs(a.base.number - b.base.number) for a, b in pairs if a.index), default=0)
