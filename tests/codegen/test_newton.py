"""Newton's iteration: the band, its order, row exchanges within it, and factors reused from step to step."""

import random
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import sympy
from notation import lagrange
from samples import lowered, pumped_chain

import scvi_codegen as sc
from scvi_codegen.codegen.ir.program import LEAST_REUSED_UNKNOWNS
from scvi_codegen.codegen.lowering.stage_groups import _differ, layout_of, lowered_stage_group
from scvi_codegen.codegen.rendering.program_source import workspace_size
from scvi_codegen.interfaces.models.systems import fput_chain
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.systems.formulas.intermediates import intermediate

SIZE = 12


@cache
def ring(seed: int | None = None) -> sc.Stepper:
    """Masses on a ring of hardening springs, coordinates in order or shuffled."""
    order = list(range(SIZE)) if seed is None else random.Random(seed).sample(range(SIZE), SIZE)
    kinetic = " + ".join(f"x{i}_dot**2/2" for i in range(SIZE))
    springs = "".join(f" - cosh(x{i} - x{(i + 1) % SIZE}) + x{i}*x{(i + 5) % SIZE}_dot/50" for i in range(SIZE))
    system = lagrange("ring", [f"x{i}" for i in order], kinetic + springs)
    return sc.compile_stepper(system, sc.SVI(3), solver="newton")


def state(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    return np.sin(np.arange(size)), 0.3 * np.cos(2.0 * np.arange(size))


@cache
def chain(method: object, *, pumped: bool = False) -> sc.Stepper:
    return sc.compile_stepper(pumped_chain(SIZE) if pumped else fput_chain(SIZE), method, solver="newton")


@pytest.mark.rotated
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.full)])
def test_the_order_of_the_coordinates_does_not_matter(seed):
    shuffled, ordered = ring(seed), ring()
    order = [int(name[1:]) for name in shuffled.coordinates]
    q, p = state()
    expected = ordered.integrate(q, p, h=0.1, steps=20)
    found = shuffled.integrate(q[order], p[order], h=0.1, steps=20)
    np.testing.assert_allclose(found.q, expected.q[:, order], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.p, expected.p[:, order], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.energy(), expected.energy(), rtol=1e-14)


@pytest.mark.rotated
def test_memory_grows_linearly_with_the_length_of_a_chain():
    sizes = [workspace_size(lowered(fput_chain(n), sc.SVI(8))) for n in (32, 64, 128)]
    assert sizes[2] - sizes[1] == pytest.approx(2 * (sizes[1] - sizes[0]), rel=1e-3)
    assert sizes[2] < 10**5


def test_constant_masses_need_no_matrix():
    source, _ = sc.generate_source(fput_chain(16), sc.SVI(2), solver="fixed-point")
    assert " BAND = " not in source.code


@pytest.mark.parametrize("method", [sc.SVI(3), sc.SCVI(3)], ids=lambda method: method.name)
class TestReusedFactors:
    """Runs of a chain with enough unknowns that factors go from step to step."""

    @pytest.mark.rotated
    def test_runs_reuse_enough_factors(self, method):
        assert chain(method).interface.unknowns >= LEAST_REUSED_UNKNOWNS

    @pytest.mark.rotated
    def test_run_with_time_dependent_springs_split_anywhere_is_bitwise_equal(self, method):
        """Factors are made again where and when they were made: with all that their matrix depends on."""
        q, p = state()
        stepper = chain(method, pumped=True)
        expected = stepper.integrate(q / 2, p, h=0.02, steps=60)
        run = stepper.start(q / 2, p, h=0.02)
        for chunk in (*[1] * 30, 7, 23):
            last = run.record(chunk)
            run = stepper.from_checkpoint(run.checkpoint())
        assert np.array_equal(last.q[-1], expected.q[-1])
        assert np.array_equal(last.p[-1], expected.p[-1])

    @pytest.mark.rotated
    def test_failed_step_does_not_change_the_run(self, method):
        q, p = state()
        run = chain(method).start(q, p, h=0.15)
        run.record(10)
        before = run.checkpoint()
        strict = chain(method).from_checkpoint(before, options=sc.SolverOptions(max_iterations=1))
        with pytest.raises(sc.StepFailedError):
            strict.record(1)
        assert strict.checkpoint() == before


def test_wrong_sign_in_a_scatter_is_reported_before_compilation():
    """Newton's matrix is the Jacobian of a gradient: by one of other results the iteration would never converge."""
    system = sc.LagrangianSystem.from_text(name="mixed", coordinates=["x"], lagrangian="(1 + x**2)*x_dot**2/2 - x**4")
    stages = discretise(system, sc.SVI(2))
    (group,), sites = stages.stage_groups, layout_of(stages, 1)
    lowered_stage_group(system, group, sites)
    first, *others = group.scatters
    wrong = replace(first, results=tuple(-each for each in first.results))
    with pytest.raises(sc.MethodError, match=r"(?s)'quadrature' are not the gradient of its scalar.*check the signs"):
        lowered_stage_group(system, replace(group, scatters=(wrong, *others)), sites)


def test_derivatives_that_cancel_within_intermediate_quantities_are_equal():
    """Their difference is a rounding error of what cancels, and no term is as large; others differ by little."""
    x, y = sympy.symbols("x y", real=True)
    whole = intermediate((x / 3 + y) ** 3 * sympy.sin(sympy.pi + intermediate(sympy.pi * x)))
    parts = intermediate(-(x**3 / 27 + x**2 * y / 3 + x * y**2 + y**3) * sympy.sin(intermediate(sympy.pi * x)))
    nothing = intermediate(whole - parts)
    assert nothing.definition != 0
    assert not _differ(nothing, sympy.S.Zero)
    assert not _differ(nothing + x, x)
    assert _differ(whole, parts + sympy.Rational(1, 10**30))
