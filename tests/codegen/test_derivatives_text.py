"""The C text of derivatives: without a warning, in style, of loops over tables and of what is written out."""

import pytest
from samples import damped_pendulum, linkage, pumped_cart_pole, pushed_pendulum, two_rods
from strict_c import check_strict

from scvi_codegen import SCVI, SVI, Gauss, hamiltonian_of, problem, reparametrise
from scvi_codegen.codegen.lowering.derivatives import derivatives_of
from scvi_codegen.codegen.pipeline import program_of
from scvi_codegen.codegen.rendering.program_source import render_derivatives
from scvi_codegen.methods.discretise import discretise

CASES = {
    "linkage": (linkage(), SVI(2, "gauss-lobatto:3")),
    "cart": (pumped_cart_pole(), SVI(1)),
    "pendulum": (problem("planar-pendulum").system, SVI(1)),
    "damped": (damped_pendulum(), SVI(2)),
    "rods": (two_rods(), SVI(1, "gauss-lobatto:2")),
    "double": (problem("double-pendulum").system, SCVI(2)),
    "iterated": (problem("kepler").system, SVI(4)),
    "swept, coupled": (problem("double-pendulum").system, SVI(2)),
    "swept, pushed": (pushed_pendulum(), Gauss(3)),
    "clock": (reparametrise(problem("kepler").system, "frequency"), SVI(2)),
    "clock of momenta": (reparametrise(hamiltonian_of(problem("kepler").system), "arclength"), Gauss(2)),
}


@pytest.mark.tiers(1, 2)
@pytest.mark.sampled(4)
@pytest.mark.covering
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_derivatives_compile_without_warnings(name, second, compiler, tmp_path):
    system, method = CASES[name]
    if second and system.clock:
        pytest.skip("there are no second derivatives in transformed time")
    program = program_of(system, method, solver="auto" if name.startswith("iterated") else "newton")
    derivatives = derivatives_of(system, discretise(system, method), program, second=second)
    check_strict(render_derivatives(derivatives), tmp_path, compiler=compiler)
