"""C code of flows compiles without warnings, in the project style, for every kind of solver."""

import subprocess

import pytest
from programs import needs
from samples import linkage, pumped_cart_pole, two_rods
from style import check_style

from scvi_codegen import SCVI, SVI, Gauss, SpectralCollocation, StoermerVerlet, problem
from scvi_codegen.codegen.pipeline import Sources
from scvi_codegen.codegen.rendering.program_source import with_casadi_flow, with_flow_of_rows, with_xla_flow
from scvi_codegen.codegen.variants import Derivatives

STRICT = ["-std=c99", "-O0", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Werror"]
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


def compile_with(compiler, flags, source, folder):
    (folder / f"{source.prefix}.h").write_text(source.header)
    (folder / "all.c").write_text(source.code)
    command = [needs(compiler), *STRICT, *flags, "-c", "all.c"]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.covering
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("name", CASES)
def test_flows_compile_without_warnings(name, compiler, tmp_path):
    source = with_casadi_flow(source_of(name), 10, 5).amalgamated()
    check_style(source.code)
    compile_with(compiler, ["-Wno-missing-prototypes"], source, tmp_path)


@pytest.mark.rotated
def test_flows_of_batches_compile_without_warnings(tmp_path):
    first, second = source_of("kepler"), source_of("kepler", order=2)
    for source in (with_flow_of_rows(first), with_flow_of_rows(second, second=True)):
        check_style(source.amalgamated().code)
        compile_with("gcc", ["-Wno-missing-prototypes"], source.amalgamated(), tmp_path)


@pytest.mark.rotated
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_second_derivatives_compile_without_warnings(compiler, tmp_path):
    source = with_casadi_flow(source_of("kepler", order=2), 10, 5, second=True).amalgamated()
    check_style(source.code)
    compile_with(compiler, ["-Wno-missing-prototypes"], source, tmp_path)


def test_headers_of_libraries_remain_includes():
    source = with_xla_flow(source_of("kepler"), "0")
    assert source.amalgamated().code.count('#include "xla/ffi/api/c_api.h"') == 1
    assert [name for name in source.files if "xla/" in name] == []


def test_flows_compile_with_the_interface_of_xla(tmp_path):
    jax = pytest.importorskip("jax", reason="needs the extra 'jax'")
    flags = ["-isystem", jax.ffi.include_dir()]
    source = with_xla_flow(source_of("kepler"), "0").amalgamated()
    check_style(source.code)
    compile_with("gcc", flags, source, tmp_path)
    second = with_xla_flow(source_of("kepler", order=2), "0", second=True).amalgamated()
    check_style(second.code)
    compile_with("gcc", flags, second, tmp_path)
