"""Kernels in loops over index tables: a chain's bonds step as their unrolled terms."""

from dataclasses import replace

import numpy as np
import pytest
import sympy
from samples import QUICK_FLAGS

from scvi_codegen import SVI, LagrangianSystem, Stepper
from scvi_codegen.codegen.ir.arithmetic import lower_kernel
from scvi_codegen.codegen.ir.kernel import Kernel, RolledKernel
from scvi_codegen.codegen.pipeline import describe, program_of
from scvi_codegen.codegen.rendering.program_source import render, render_ensemble
from scvi_codegen.codegen.variants import Lanes
from scvi_codegen.interfaces.models.systems import fput_chain
from scvi_codegen.runs.stepping.compiled_method import Variants

FLAGS = (*(flag for flag in QUICK_FLAGS if "contract" not in flag), "-ffp-contract=off")


def rolled_force(system: LagrangianSystem, name: str, bonds: list[tuple[int, int]]) -> Kernel:
    """The force of a chain: the bonds to the walls in a straight line, those between masses in a loop."""
    q, (alpha, beta) = system.coordinates, system.parameters
    common = {"time": system.time, "parameters": system.parameters}

    def tension(d: sympy.Expr) -> sympy.Expr:
        return d + alpha * d**2 + beta * d**3

    a, b = sympy.symbols("a b", real=True)
    pull = tension(b - a)
    bond = lower_kernel("bond", arguments=(a, b), values=(pull, -pull), **common)
    walls = [sympy.S.Zero] * len(q)
    walls[0] -= tension(q[0])
    walls[-1] += tension(-q[-1])
    kernel = lower_kernel(name, arguments=q, values=walls, **common)
    return replace(kernel, sums=(RolledKernel.over_rows(bond, tuple(bonds)),))


def chain(masses: int) -> tuple[LagrangianSystem, list[tuple[int, int]]]:
    return fput_chain(masses, alpha=0.25), [(i, i + 1) for i in range(masses - 1)]


def states(system: LagrangianSystem, force: Kernel | None) -> tuple[np.ndarray, np.ndarray]:
    """Twenty steps, of one trajectory and of an ensemble, with a force in place of the compiler's own."""
    method = SVI(3)
    program = program_of(system, method, solver="fixed-point", prefix="chain")
    assert program.fixed_point is not None
    if force is not None:
        program = replace(program, fixed_point=replace(program.fixed_point, kernels=(force,)))
    stepper = Stepper(
        render(program),
        describe(program, system, method),
        variants=Variants({Lanes(): render_ensemble(program)}),
        flags=FLAGS,
    )
    q = np.sin(np.arange(1, system.dimension + 1) / 3) / 2
    run = stepper.integrate(q, np.zeros_like(q), h=0.1, steps=20)
    many = stepper.integrate_ensemble(np.array([q, q / 2, -q]), np.zeros((3, len(q))), h=0.1, steps=20)
    return np.hstack([run.q, run.p]), np.array([many.q, many.p])


@pytest.mark.second
def test_loop_over_bonds_equals_its_unrolled_terms() -> None:
    system, bonds = chain(6)
    rolled = rolled_force(system, "force_lanes", bonds)
    found, own = (states(system, force) for force in (rolled, None))
    assert all(np.allclose(*pair, rtol=0, atol=1e-13) for pair in zip(found, own, strict=True))


def test_the_code_of_a_loop_does_not_grow_with_its_table() -> None:
    sizes = []
    for masses in (8, 64):
        system, bonds = chain(masses)
        program = program_of(system, SVI(2), solver="fixed-point", prefix="chain")
        assert program.fixed_point is not None
        force = rolled_force(system, "force_lanes", bonds)
        code = render(replace(program, fixed_point=replace(program.fixed_point, kernels=(force,)))).code
        start = code.index("void bond(")
        sizes.append(code[start : code.index("void mass(", start)].count(";"))
    assert sizes[1] - sizes[0] == 64 - 8  # a value set to 0 for each mass
