"""C code of flows, and of derivatives of each kind of solver, compiles without warnings, in the project style."""

import pytest
from samples import linkage, pumped_cart_pole, two_rods
from strict_c import check_strict

from scvi_codegen import SCVI, SVI, Gauss, SpectralCollocation, StoermerVerlet, problem
from scvi_codegen.codegen.ir.variants import Derivatives
from scvi_codegen.codegen.pipeline import Sources
from scvi_codegen.extras.frameworks.sources import with_casadi_flow, with_flow_of_rows, with_xla_flow

CASES = {
    "linkage": (linkage(), SVI(2, "gauss-lobatto:3")),
    "cart": (pumped_cart_pole(), SVI(2)),
    "kepler": (problem("kepler").system, SVI(4)),
    "shooting": (problem("double-pendulum").system, SCVI(2)),
    "collocation": (problem("planar-pendulum").system, SpectralCollocation(3)),
    "vortices": (problem("point-vortices").system, SVI(2)),
    "gauss": (problem("henon-heiles").system, Gauss(2)),
    "rods": (two_rods(), SVI(1, "gauss-lobatto:2")),
    "leapfrog": (problem("henon-heiles").system, StoermerVerlet()),
}


def source_of(name, order=1):
    return Sources(*CASES[name]).variant(Derivatives(order))


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.covering
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("name", CASES)
def test_flows_compile_without_warnings(name, compiler, tmp_path):
    check_strict(with_casadi_flow(source_of(name), 10, 5), tmp_path, compiler=compiler)


@pytest.mark.rotated
def test_flows_of_batches_compile_without_warnings(tmp_path):
    first, second = source_of("kepler"), source_of("kepler", order=2)
    for source in (with_flow_of_rows(first), with_flow_of_rows(second, second=True)):
        check_strict(source, tmp_path)


@pytest.mark.rotated
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_second_derivatives_compile_without_warnings(compiler, tmp_path):
    check_strict(with_casadi_flow(source_of("kepler", order=2), 10, 5, second=True), tmp_path, compiler=compiler)


def test_headers_of_libraries_remain_includes():
    source = with_xla_flow(source_of("kepler"), "0")
    assert source.amalgamated().code.count('#include "xla/ffi/api/c_api.h"') == 1
    assert [name for name in source.files if "xla/" in name] == []


def test_flows_compile_with_the_interface_of_xla(tmp_path):
    jax = pytest.importorskip("jax", reason="needs the extra 'jax'")
    flags = ["-isystem", jax.ffi.include_dir()]
    for order in (1, 2):
        check_strict(with_xla_flow(source_of("kepler", order), "0", second=order == 2), tmp_path, *flags)
