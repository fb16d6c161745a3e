"""Properties of the C code: C++ headers, no allocation, no globals, reproducible, no user text."""

import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from notation import hamilton, lagrange
from programs import needs
from samples import QUICK_FLAGS, sample_named
from strict_c import STRICT, run, write

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import TUNED_FLAGS, _mathematics
from scvi_codegen.codegen.rendering.source import Interface, Source
from scvi_codegen.methods.method import Method
from scvi_codegen.systems.system import MechanicalSystem

pytestmark = [pytest.mark.long, pytest.mark.rotated]

CXX = "-std=c++11 -Wall -Wextra -Wpedantic -Werror".split()  # noqa: SIM905  (as one types it)

METHODS = {
    method.name: method
    for method in (
        sc.SVI(1),
        sc.SVI(3, "gauss-lobatto:5"),
        sc.SVI(3, "hermite-2:3"),
        sc.SVI(2, space="trigonometric:0.3"),
        sc.SVI(3, space="splines:2"),
        sc.SCVI(2, abscissae="gauss"),
        sc.SCVI(1, "gauss-legendre:2"),
        sc.SCVI(2),
        sc.SCVI(2, variational=False),
        sc.SpectralCollocation(3, form="position"),
        sc.SpectralCollocation(2, form="phase-space"),
        sc.Gauss(2),
        sc.RadauIIA(2),
        sc.RadauIA(2),
        sc.LobattoIIIA(3),
        sc.ChebyshevLobatto(3, form="position"),
        sc.StoermerVerlet(),
        sc.ExplicitEuler(),
    )
}


TUNED = (sc.SVI(3), sc.Gauss(5), sc.SpectralCollocation(4), sc.SCVI(5, variational=False))


def bare_oscillator() -> sc.LagrangianSystem:
    return lagrange("bare oscillator", "q", "q_dot**2/2 - q**2/2")


def driven_hamiltonian() -> sc.HamiltonianSystem:
    return hamilton("driven Hamiltonian", "x y", "sqrt(1 + p_x**2 + k*p_x*p_y + p_y**2) + x*sin(t) + x**2*p_y", k=0.3)


def hyperbolic() -> sc.HamiltonianSystem:
    return sc.HamiltonianSystem.from_text(name="hyperbolic", coordinates=["q"], momenta=["p"], hamiltonian="q*p")


@cache
def systems() -> Mapping[str, MechanicalSystem]:
    """Separable, coupled, with time, three coordinates, no parameters; by a Hamiltonian, last a singular one."""
    names = ("kepler", "driven-duffing", "double-pendulum", "pumped-cart-pole", "charged-particle")
    own = (bare_oscillator(), driven_hamiltonian(), hyperbolic())
    return {**{name: sample_named(name).system for name in names}, **{system.name: system for system in own}}


@cache
def generated(method: str) -> Mapping[str, tuple[Source, Interface]]:
    """Text of one method for all systems that it takes."""
    found = {}
    for name, system in systems().items():
        with suppress(sc.MethodError):
            found[name] = sc.generate_source(system, METHODS[method])
    assert len(found) >= len(systems()) - 2
    return found


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("method", METHODS)
def test_code_allocates_nothing_writes_nothing_and_has_no_static_state(method):
    for source, _ in generated(method).values():
        text = re.sub(r"/\*.*?\*/", "", source.header + source.amalgamated().code, flags=re.DOTALL)
        assert re.findall(r"\b(?:[mc]alloc|realloc|alloca|free|f?printf|puts|fopen|exit|abort|assert)\b", text) == []
        assert re.findall(r"\bstatic\s+(?!const\b)(?!inline\b)[^(;]*[=;]", text) == []
        assert re.findall(r"\b(?:errno|setjmp|volatile|register|goto)\b", text) == []


def test_headers_compile_as_c_plus_plus(tmp_path):
    pairs = [sc.generate_source(systems()["kepler"], method) for method in METHODS.values()]
    files = write([source for source, _ in pairs], tmp_path)
    uses = "".join(
        f"  total += {s.prefix}_default_options().tolerance + {s.prefix.upper()}_WORKSPACE;\n" for s, _ in pairs
    )
    includes = "".join(f'#include "{source.prefix}.h"\n' for source, _ in pairs)
    text = f"{includes}int main()\n{{\n  double total = 0.0;\n{uses}  return total > 0.0 ? 0 : 1;\n}}\n"
    (tmp_path / "main.cpp").write_text(text)
    run([needs("gcc"), "-std=c99", "-c", *files], tmp_path)
    objects = [f"{Path(file).stem}.o" for file in files]
    run([needs("g++"), *CXX, "main.cpp", *objects, "-lm", "-o", "main"], tmp_path)
    run([str(tmp_path / "main")], tmp_path)


@pytest.mark.sampled(1)
@pytest.mark.covering
@pytest.mark.parametrize("name", ["double-pendulum", "driven-duffing", "driven Hamiltonian"])
@pytest.mark.parametrize("method", TUNED, ids=lambda method: method.name)
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_tuned_builds_compile_without_warnings(compiler, method, name, tmp_path):
    """Flags are the vector instructions of this processor, and glibc's vector functions where available."""
    files = write([sc.generate_source(systems()[name], method)[0]], tmp_path)
    for define, _ in _mathematics(TUNED_FLAGS):
        run([needs(compiler), *STRICT, *TUNED_FLAGS, *define, "-c", *files], tmp_path)


# Equal bytes.

FINGERPRINT = """
import hashlib
from test_c_text import METHODS, generated
names = "svi-1-gauss-legendre-1", "scvi-2-chebyshev-lobatto-gauss-legendre-2", "gauss-2"
for method in names:
    for name, (source, interface) in generated(method).items():
        text = "".join(source.files.values()) + source.declarations + repr(interface.to_record())
        print(method, name, hashlib.sha256(text.encode()).hexdigest())
"""


def test_source_is_equal_in_every_process(tmp_path):
    """Whatever the seed of Python's hashes, on which the order of sets and of SymPy's arguments depends."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", FINGERPRINT],
            cwd=Path(__file__).parent,
            env={**os.environ, "PYTHONHASHSEED": str(seed), "PYTHONPATH": os.pathsep.join(sys.path)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for seed in (0, 4242)
    ]
    first, *others = [process.communicate()[0] for process in processes]
    assert first.count("\n") == 3 * len(systems()) - 1  # one of the methods does not take the singular Hamiltonian
    assert others == [first] * len(others)


def test_source_is_ascii_with_unix_line_ends_and_no_trailing_blanks():
    for method in METHODS:
        for source, _ in generated(method).values():
            for text in source.files.values():
                assert text.isascii()
                assert "\r" not in text
                assert "\t" not in text
                assert re.findall(r"[ \t]+$", text, re.MULTILINE) == []
                assert text.endswith("\n")


# Names and titles that would break C.

C_NAMES = """
    INFINITY fabs M N B newton step double_ errno I NULL NAN memset memcpy sizeof_ main u w0 w1 h z value slope rows row
    parameters gather scatter evaluate factorise solve report options status workspace EOF FLT_EPSILON linux unix y0 y1
    j1 gamma HUGE_VAL M_PI size_t int8_t bool_ true false assert stdin Q P q p t0 _ i k n legendre lagrangian velocity
""".split()  # noqa: SIM905  (a paragraph of words reads better)
TESTED = [sc.SVI(2), sc.SCVI(2), sc.StoermerVerlet()]


def accepted(names: Sequence[str]) -> list[str]:
    """The names that systems may use."""
    saved = []
    for name in names:
        try:
            named_system([name])
        except ValueError:
            continue
        saved.append(name)
    return saved


def named_system(names: Sequence[str], name: str = "oscillators") -> sc.LagrangianSystem:
    """Coupled oscillators whose coordinates are every third of the names, whose parameters are the others."""
    coordinates = names[::3]
    parameters = [name for name in names if name not in coordinates]
    kinetic = "".join(f" + {c}_dot**2/2 - sin({c})**2/3" for c in coordinates)
    coupling = "".join(f" - {a}*{b}" for a, b in pairwise(coordinates))
    terms = "".join(f" - {c}*{coordinates[k % len(coordinates)]}**2/2" for k, c in enumerate(parameters))
    values = {c: 1.0 / (k + 2) for k, c in enumerate(parameters)}
    lagrangian = f"{kinetic}{coupling}{terms}".removeprefix(" + ")
    return sc.LagrangianSystem.from_text(name=name, coordinates=coordinates, lagrangian=lagrangian, parameters=values)


@pytest.mark.parametrize("method", TESTED, ids=lambda method: method.name)
def test_reserved_names_of_c_are_valid_coordinates(method, tmp_path):
    hostile = accepted(C_NAMES)
    plain = [f"name{k}" for k in range(len(hostile))]
    assert len(hostile) > 50
    steppers = [
        sc.compile_stepper(named_system(names), method, prefix="named", flags=QUICK_FLAGS) for names in (hostile, plain)
    ]
    m = steppers[0].dimension
    results = [stepper.step(np.linspace(-0.5, 0.5, m), np.linspace(0.3, -0.2, m), 0.1) for stepper in steppers]
    np.testing.assert_allclose(results[0], results[1], rtol=1e-12, atol=1e-13)
    (file,) = write([steppers[0].source], tmp_path)
    run([needs("gcc"), *STRICT, "-c", file], tmp_path)


TITLES = [
    "*/ #error comment",
    "/*/ nested",
    "back\\slash\\",
    "two\nlines\x00",
    "??/ trigraph ??/",
    "%s %n {{ 7 * 7 }} $(HOME)",
    "Ünïcode ½\u2028",
]


@pytest.mark.tiers(0, 2)
@pytest.mark.sampled(2)
@pytest.mark.parametrize("title", TITLES)
def test_title_cannot_end_its_comment(title, tmp_path):
    system = named_system(["a", "b", "c"], name=title)
    source, interface = sc.generate_source(system, sc.SVI(1))
    assert interface.title.isprintable()
    (file,) = write([source], tmp_path)
    run([needs("gcc"), *STRICT, "-c", file], tmp_path)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize("prefix", ["fabs", "errno", "NULL", "main", "newton", "step", "int", "m", "b"])
def test_reserved_prefixes_of_c_are_valid(prefix, tmp_path):
    source, _ = sc.generate_source(bare_oscillator(), sc.SVI(2), prefix=prefix)
    files = write([source], tmp_path)
    run([needs("gcc"), *STRICT, "-c", *files], tmp_path)


def test_every_method_has_a_unique_name():
    assert all(isinstance(method, Method) for method in METHODS.values())
    prefixes = [interface.prefix for method in METHODS for _, interface in generated(method).values()]
    assert len(set(prefixes)) == len(prefixes)
