"""Symbolic to program: expressions become straight-line arithmetic, tables and loops are listed.

A kernel's expressions are read into one graph in which equal nodes are the same node. Three rules make sharing cheap
and complete enough that no separate search for common subexpressions is needed:

* the factors of a product are multiplied left to right in a fixed order (numbers, parameters, composites, coordinates),
  so 3 mu r^-5 x and 3 mu r^-5 y share all but the last factor;
* a sum is normalised to content 1 and a positive first term, so a - b, b - a and 2 a - 2 b are one node;
* every negative power of x is built from 1/x and every half-integer power from sqrt(x); x^(-k/2) for k = 1, 3, 5, 7,
  frequent in mechanics, are functions of their own, for which vectors have something faster; odd quarters are these
  times x^(1/4) or x^(-1/4), a root of a root.

Nothing here changes a value but by rounding; ``tests/test_lowering.py`` reads kernels back and compares.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy

from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.ir.constraints import Rattle
from scvi_codegen.ir.families import Family
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import lower_matrix, lower_vector
from scvi_codegen.ir.program import FEW_UNKNOWNS, Integrals, MomentumMap, Program, StageCurve
from scvi_codegen.ir.sweep import Sweep
from scvi_codegen.ir.sweeps import Splitting
from scvi_codegen.lowering.constraints import lowered_constraints
from scvi_codegen.lowering.families import has_action, lowered_family
from scvi_codegen.lowering.kernels import damping_kernel, integrand_kernel, system_kernel
from scvi_codegen.lowering.ordering import bandwidth, places
from scvi_codegen.lowering.sites import sites_of
from scvi_codegen.lowering.solvers.velocity_tables import resolved_degree, velocity_tables
from scvi_codegen.mechanics.exchanges import exchanges
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.symmetry.symmetry import Symmetry
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.constraints import END_VELOCITY
from scvi_codegen.methods.method import Method, is_conformally_symplectic, is_symplectic
from scvi_codegen.methods.shapes import Accelerations, PrintedCurve, ShotCurve, Velocities
from scvi_codegen.methods.stage_system import StageSystem
from scvi_codegen.tables.basis import cardinal_values, legendre_functional
from scvi_codegen.tables.precision import Matrix, Vector, mp

__all__ = ["lower"]


def lower(
    system: MechanicalSystem,
    method: Method,
    stages: StageSystem,
    *,
    prefix: str,
    sweep: Sweep | None = None,
    splitting: Splitting | None = None,
    newton: bool = True,
    rattle: Rattle | None = None,
    symmetries: Sequence[Symmetry] = (),
) -> Program:
    """The program of one step of ``method`` for ``system``; exported C names begin with ``prefix``.

    Args:
        system, method: what is lowered.
        stages: its equations (:func:`scvi_codegen.methods.discretise.discretise`).
        prefix: a C identifier.
        sweep: the fixed-point iteration to try first (:func:`scvi_codegen.lowering.solvers.choice.sweep_of`).
        splitting: the explicit solver that replaces both
        (:func:`scvi_codegen.lowering.solvers.splitting.splitting_of`).
        newton: whether Newton's iteration is emitted; with it the discrete Legendre transforms.
        rattle: what is tried before Newton's iteration, if a step is one of RATTLE.
        symmetries: whose momentum maps are emitted.
    """
    m, sites = system.dimension, sites_of(stages, system.dimension)
    blocks, rows = [stages.blocks[b] for b in sites.columns[m]], [stages.rows[r] for r in sites.rows[m]]
    mass = forms_of(system).legendre_slopes
    families = tuple(lowered_family(system, family, sites) for family in stages.families) if newton else ()
    constraints = lowered_constraints(system)
    met = [*mass, *_meetings(families)]
    order = places(met, sites.count)
    polynomial = method.exactness.curve != 0
    return Program(
        prefix=prefix,
        title=comment_text(f"{system.name}: {method.title}"),
        notes=notes_of(method, system),
        coordinate_names=tuple(q.name for q in system.coordinates),
        parameter_names=tuple(parameter.name for parameter in system.parameters),
        parameter_defaults=system.defaults,
        sites=sites.count,
        blocks=len(blocks),
        families=families,
        places=order,
        mass_places=tuple(sorted(range(m), key=order.__getitem__).index(i) for i in range(m)),
        bandwidth=bandwidth(met, order),
        momentum_rows=lower_vector(tuple(row.momentum for row in rows)),
        end_position=lower_vector(stages.end_position.columns([b + 1 for b in sites.columns[m]]).entries[0]),
        straight=tuple(int(block.straight[1]) for block in blocks),
        momentum_blocks=tuple(block.momentum for block in blocks),
        moving_blocks=tuple(int(block.moves) for block in blocks),
        extrapolation=lower_matrix(
            tuple(line for columns in sites.columns.values() for line in _required_extrapolation(stages, columns))
        ),
        legendre=_legendre_kernel(system),
        mass_entries=tuple(mass),
        energy=_energy_kernel(system),
        hamiltonian=bool(system.auxiliaries),
        momentum_maps=tuple(_momentum_map(each, method) for each in symmetries),
        momentum_kernel=_momentum_kernel(system, symmetries),
        sweep=sweep,
        splitting=splitting,
        newton=newton,
        acts=sites.count == m and has_action(system) and any(family.in_action for family in stages.families),
        order=method.order or len(stages.blocks),
        polynomial_curves=polynomial,
        stage_curve=_stage_curve(stages) if newton and polynomial and splitting is None else None,
        integrals=_integrals(system, method, stages),
        exchanges=_exchanges(system, stages),
        constraints=constraints,
        damping=damping_kernel(system),
        rattle=rattle,
        inputs=tuple((name, system.parameters.index(symbol(f"{name}_0"))) for name in system.inputs),
        numbers=_numbers(system, method, len(rows)) if len(blocks) * sites.count <= FEW_UNKNOWNS else ("", "", ""),
    )


def _momentum_map(symmetry: Symmetry, method: Method) -> MomentumMap:
    name, formula = comment_text(symmetry.name), comment_text(symmetry.formula)
    return MomentumMap(name=name, formula=formula, exact=method.exactness.keeps(symmetry))


def _numbers(system: MechanicalSystem, method: Method, count: int) -> tuple[str, str, str]:
    """The paper's numbers: of the last ``count`` rows, where those before them give what occurs in no other; q1, p1."""
    paper = method.paper_form(system)
    known = dict.fromkeys(row.number for row in paper.rows[-count:] if row.number[:1].isdigit())
    rows = ", ".join(f"({number})" for number in known)
    q1, p1 = (f"({number})" if number[:1].isdigit() else "" for number in paper.end_numbers)
    return rows, q1, p1


def _stage_curve(stages: StageSystem) -> StageCurve | None:
    """Where the unknowns are two or more velocities along the curve, or its first velocity and its accelerations.

    Constraints give the velocity at the end by itself, as good as the step. What that of the curve is off it by is the
    first coefficient that the curve does not have: it tells more than the last that it has, and of one velocity, too.
    """
    shape, count = stages.shape, len([block for block in stages.blocks if block.size is None])
    held = any(block.name == END_VELOCITY for block in stages.blocks)
    if isinstance(shape, Velocities) and _moves(stages, shape):
        tables, last = velocity_tables(shape), len(shape.blocks) - 1 + held
        degree = last if held or tables is None else resolved_degree(tables)
        if degree == 0:
            return None
        first, tops = 0, _highest_of(shape, None if held else degree)
        bends = [(0, last), (0, (last + 1) // 2)]
        rows = [tuple(mp.mpf((b == last) - (b == first)) for b in range(count)) for first, last in bends]
        power = 2 * degree
    elif isinstance(shape, Accelerations | ShotCurve | PrintedCurve) and _distinct(shape.tableau.c):
        c, size = shape.tableau.c, len(shape.tableau.c)
        first, tops = 1, [legendre_functional(c, k) for k in (size - 1, size - 2)]
        rows = [tuple(mp.mpf(b == only) for b in range(count)) for only in (1, size)]
        power = 2 * size
    else:
        return None
    before, behind = (mp.zero,) * first, (mp.zero,) * (count - first - len(tops[0]))
    highest, below = (lower_vector((*before, *top, *behind)) for top in tops)
    return StageCurve(highest=highest, next=below, bends=(lower_vector(rows[0]), lower_vector(rows[1])), power=power)


def _highest_of(shape: Velocities, degree: int | None) -> list[Vector]:
    """The highest coefficient of the accelerations that velocities tell, and the one below; 0 beside a known end."""
    if degree is None:
        line = (*(-x for x in cardinal_values(shape.blocks, (mp.one,))[0]), mp.one)
        return [tuple((4 * len(shape.blocks) - 2) * x for x in line), (mp.zero,) * len(line)]
    lines = {k: legendre_functional(shape.blocks, k) for k in (degree, degree - 1)}
    return [tuple(max(4 * k - 2, 0) * x for x in line) for k, line in lines.items()]


def _moves(stages: StageSystem, shape: Velocities) -> bool:
    """Whether the velocities, the first blocks, are all that moves positions."""
    own = len(shape.blocks)
    return own == len({*shape.blocks}) and all(block.moves == (b < own) for b, block in enumerate(stages.blocks))


def _distinct(points: Vector) -> bool:
    return len(set(points)) == len(points)


def _integrals(system: MechanicalSystem, method: Method, stages: StageSystem) -> Integrals | None:
    kernel = integrand_kernel(system, "integrands", stages.families[0].arguments)
    if kernel is None:
        return None
    if not isinstance(stages.shape, Velocities):
        raise MethodError(
            f"{method.name} keeps no curve at the end of a step whose points give the time of '{system.name}': take "
            "an SVI, or a Runge-Kutta method in phase space"
        )
    return Integrals(kernel=kernel, weights=lower_vector(stages.shape.weights))


def _exchanges(system: MechanicalSystem, stages: StageSystem) -> tuple[str, ...]:
    """What forces give, by names, where a method integrates along a curve."""
    integrates = any(family.in_action for family in stages.families)
    return tuple(each.name for each in exchanges(system)) if integrates else ()


def _legendre_kernel(system: MechanicalSystem) -> Kernel:
    forms = forms_of(system)
    return system_kernel(
        system,
        "legendre",
        forms.legendre,
        of=forms.legendre_arguments,
        slopes=forms.legendre_slopes.values(),
        purpose="H_p and H_pp at u = (q, p)."
        if system.auxiliaries
        else "Momenta L_v and mass matrix L_vv at u = (q, v).",
    )


def _energy_kernel(system: MechanicalSystem) -> Kernel:
    """The function of the system, from which and the Legendre transform follows the energy."""
    name, purpose = ("hamiltonian", "H at u = (q, p).") if system.auxiliaries else ("lagrangian", "L at u = (q, v).")
    arguments = forms_of(system).legendre_arguments
    return system_kernel(system, name, (system.formula,), of=arguments, purpose=purpose)


def _momentum_kernel(system: MechanicalSystem, symmetries: Sequence[Symmetry]) -> Kernel | None:
    """Momentum maps, then the sums of the squares of their terms."""
    if not symmetries:
        return None
    maps = [symmetry.momentum_map for symmetry in symmetries]
    squares = [sympy.Add(*(term**2 for term in sympy.Add.make_args(J))) for J in maps]
    return system_kernel(
        system,
        "momentum_maps",
        (*maps, *squares),
        of=(*symmetries[0].coordinates, *symmetries[0].momenta),
        purpose="What is conserved at u = (q, p), then the sums of the squares of the terms.",
    )


def _meetings(families: Sequence[Family]) -> list[tuple[int, int]]:
    """Pairs of coordinates with a non-zero slope."""
    return [pair for family in families for block in family.blocks for pair in block.entries]


def comment_text(text: str) -> str:
    """One printable line that neither ends nor begins a C comment."""
    line = "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))
    return line.replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ? /")


def notes_of(method: Method, system: MechanicalSystem) -> tuple[str, ...]:
    order = "no order claimed" if method.order is None else f"order {method.order}"
    return (
        order,
        _geometry(method, system),
        "symmetric" if method.symmetric else "not symmetric",
    )


def _geometry(method: Method, system: MechanicalSystem) -> str:
    if is_symplectic(method, system):
        return "symplectic"
    return f"{'conformally' if is_conformally_symplectic(method, system) else 'not'} symplectic"


def _required_extrapolation(stages: StageSystem, columns: Sequence[int]) -> Matrix:
    """That of some blocks by themselves, transposed."""
    if stages.extrapolation is None or any(block.power != 1 for block in stages.blocks):
        raise TypeError("only stage systems with velocities as unknowns can be lowered")
    return tuple(tuple(stages.extrapolation[i][j] for i in columns) for j in columns)
