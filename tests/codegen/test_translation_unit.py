"""Two generated integrators, of named coordinates and of arrays, in one translation unit."""

import random
import re
import string
from pathlib import Path

import numpy as np
import pytest
from golden_cells import catalogue, ring
from programs import needs
from samples import QUICK_FLAGS
from strict_c import STRICT, run

from scvi_codegen import SVI, LagrangianSystem, compile_stepper, generate_source
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.codegen.pipeline import ArraySources, c_identifier
from scvi_codegen.codegen.rendering.c_text import macros_of, names_of
from scvi_codegen.codegen.rendering.own_names import with_exported_names, with_own_names
from scvi_codegen.codegen.rendering.reachable import readable
from scvi_codegen.codegen.rendering.source import Source

H, STEPS, N = 0.05, 40, 8
RUNS = """
#include "kepler.c"
#include "ring.c"
#include <stdio.h>
#include <stdlib.h>

enum {{ M = 2, N = {n} }}; /* both integrators have such a name of their own */

static void show(const double *x, int n)
{{
  for (int i = 0; i < n; i++)
    printf("%.17g ", x[i]);
}}

int main(void)
{{
  static double work[KEPLER_WORKSPACE], q[M] = {{0.4, 0.1}}, p[M] = {{0.0, 2.0}}, t;
  static kepler_run one;
  static double all[4096] __attribute__((aligned(64))), start[2 * N];
  const long long sizes[] = {{N}};
  const int *const tables[] = {{NULL}};
  ring_run *run = ring_memory(sizes, tables) <= 4096 ? ring_bind(sizes, tables, all) : NULL;
  kepler_report of_one;
  ring_report of_all;
  const double parameters[] = {{1.0}}, beta[] = {{0.25}};
  int count, status;
  kepler_start(&one, 0.0, {h}, q, p);
  status = kepler_advance(&one, {steps}, {steps}, parameters, NULL, &t, q, p, &count, &of_one, work);
  for (int i = 0; i < N; i++)
    start[i] = 0.125 * i, start[N + i] = 0.5 - 0.0625 * i;
  ring_start(run, 0.0, {h}, start, start + N);
  status |= ring_advance(run, {steps}, 1, beta, NULL, NULL, NULL, NULL, NULL, &of_all, NULL);
  show(one.q, M), show(one.p, M), show(run->q, N), show(run->p, N);
  return status;
}}
"""


def written(source: Source, folder: Path) -> None:
    for name, text in source.single_file().files.items():
        (folder / name).write_text(text)


@pytest.mark.rotated
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_two_integrators_in_one_translation_unit_agree_with_python(compiler, tmp_path):
    kepler, arrays = catalogue("kepler")(), ring()
    written(generate_source(kepler, SVI(4), prefix="kepler")[0], tmp_path)
    written(ArraySources(arrays, SVI(4), prefix="ring").integrator()[0], tmp_path)
    (tmp_path / "main.c").write_text(RUNS.format(n=N, h=H, steps=STEPS))
    run([needs(compiler), *STRICT, "-Wno-psabi", "main.c", "-lm", "-o", "main"], tmp_path)
    printed = run(["./main"], tmp_path)
    one = compile_stepper(kepler, SVI(4), flags=QUICK_FLAGS).integrate([0.4, 0.1], [0.0, 2.0], h=H, steps=STEPS)
    q, p = 0.125 * np.arange(N), 0.5 - 0.0625 * np.arange(N)
    many = compile_stepper(arrays, "svi:4", flags=QUICK_FLAGS).start(q, p=p, h=H)
    many.advance(STEPS)
    expected = np.concatenate([one.q[-1], one.p[-1], many.q["q"], many.p["q"]])
    assert np.array(printed.split(), dtype=float) == pytest.approx(expected, rel=1e-13, abs=1e-13)


@pytest.mark.second
def test_no_name_or_macro_of_an_integrator_remains(tmp_path):
    """The same program twice, under two prefixes, is the hardest case: every name occurs in both."""
    for prefix in ("one", "two"):
        written(generate_source(catalogue("double-pendulum")(), "svi:4", prefix=prefix)[0], tmp_path)
    (tmp_path / "both.c").write_text('#include "one.c"\n#include "two.c"\n')
    run([*find_compiler(), *STRICT, "-Wno-psabi", "-fsyntax-only", "both.c"], tmp_path)
    macros = [*find_compiler(), "-std=c99", "-E", "-dM"]
    (tmp_path / "empty.c").write_text(
        "".join(f"#include <{name}.h>\n" for name in ("float", "limits", "math", "string"))
    )
    listed, empty = (run([*macros, name], tmp_path) for name in ("both.c", "empty.c"))
    left = {line.split()[1].split("(")[0] for line in set(listed.splitlines()) - set(empty.splitlines())}
    assert {name for name in left if not name.upper().startswith(("ONE_", "TWO_"))} == set()


def test_single_file_defines_no_macro_that_it_does_not_use():
    code = generate_source(catalogue("double-pendulum")(), "svi:2", prefix="one")[0].single_file().code
    assert "_ZGV##set##N##count##" in code  # part of a name of the vector library, not the N of Newton's iteration
    plain = re.sub(r"/\*.*?\*/", "", code, flags=re.DOTALL)
    assert "#undef" not in plain
    for name in re.findall(r"^#define (\w+)$", plain, re.MULTILINE):
        assert len(re.findall(rf"\b{name}\b", plain)) > 1, name


@pytest.mark.second
def test_names_that_occur_in_the_templates_are_names_of_integrators(tmp_path):
    """An integrator ``finish`` exports ``finish_step``, and constraints have a function of that name."""
    rod = LagrangianSystem.from_text("rod", ["x", "y"], "x_dot**2/2 + y_dot**2/2 - y", constraints=["x**2 + y**2 = 1"])
    source = generate_source(rod, "svi:2", prefix="r_0")[0]
    words = {word for text in source.files.values() for word in re.findall(r"\b[a-z][a-z_]*_[a-z_]+\b", text)}
    exported = re.findall(r"\br_0_(\w+)\(", source.header)
    names = {word.removesuffix(f"_{end}") for word in words for end in exported if word.endswith(f"_{end}")}
    assert {"finish", "find"} < names
    for name in ("finish", "find", *random.Random(20).sample(sorted(names - {"finish", "find"}), 8)):
        written(generate_source(rod, "svi:2", prefix=c_identifier(name))[0], tmp_path)
    run([*find_compiler(), *STRICT, "-Wno-psabi", "-fsyntax-only", *tmp_path.glob("*.c")], tmp_path)


KEPT = "-O0 -w -std=gnu99 -fkeep-static-functions -fkeep-inline-functions -fkeep-static-consts".split()  # noqa: SIM905


@pytest.mark.second
def test_names_are_those_of_the_compiler(tmp_path):
    """Functions and tables by the symbols of the object, macros by the preprocessor's list; fast paths and loops."""
    rod = LagrangianSystem.from_text("rod", ["x", "y"], "x_dot**2/2 + y_dot**2/2 - y", constraints=["x**2 + y**2 = 1"])
    for system, method in ((catalogue("kepler")(), "svi:4"), (rod, "svi:2")):
        source = generate_source(system, method, prefix="r_0")[0].amalgamated()
        (tmp_path / "r_0.h").write_text(source.header)
        (tmp_path / "r_0.c").write_text(source.code)
        (tmp_path / "heads.c").write_text(
            '#include "r_0.h"\n' + "".join(f"#include <{name}.h>\n" for name in ("float", "limits", "math", "string"))
        )
        run([needs("gcc"), *KEPT, "-c", "r_0.c"], tmp_path)
        listing = run([needs("nm"), "r_0.o"], tmp_path)
        lines = [line for line in listing.splitlines() if "." not in line]  # variables of functions have a dot
        symbols = [line.split()[-2:] for line in lines]
        objects = {name for kind, name in symbols if kind in "TtRrDdBb"}
        listed, empty = (run(["gcc", "-std=gnu99", "-E", "-dM", name], tmp_path) for name in ("r_0.c", "heads.c"))
        macros = {line.split()[1].split("(")[0] for line in {*listed.splitlines()} - {*empty.splitlines()}}
        names = {
            name.replace("NAME(", "r_0_").replace("STATUS(", "R_0_").rstrip(")")
            for name in names_of(source.code, macros_of(source.code))
        }
        assert objects <= names
        assert macros <= names
        functions = {name for kind, name in symbols if kind in "Tt"}
        assert functions <= {*source.functions} | {name for name in names if name.startswith("lanes_")}  # by macros


OF_C = "pendulum max status int double run step dbl solver"
"""Legal names that occur in the templates, in C or in its headers."""


def words_of(code: str, name: str) -> list[str]:
    """Return the words of a source without its comments, the integrator's name replaced by one of no meaning."""
    text = re.sub(r"/\*.*?\*/", "", code, flags=re.DOTALL).replace("\\\n", "")
    neutral = re.sub(rf"\b{name}(?=[_.])", "svi", text)
    return re.findall(r"\w+|[^\w\s]", re.sub(rf"\b{name.upper()}(?=_)", "SVI", neutral))


@pytest.mark.second
def test_a_single_file_of_any_name_is_the_same_program(monkeypatch, tmp_path):
    """Names of 2 to 64 characters, which break lines at all places, change nothing but names."""
    with monkeypatch.context() as patched:  # the source for microcontrollers before it is a single file
        patched.setattr(Source, "single_file", lambda source: source)
        source, _ = generate_source(catalogue("kepler")(), "stoermer-verlet", prefix="r_0", embedded="double")
    texts = "\f".join([*readable(source.amalgamated().code).values(), source.header])

    def single_file(name: str) -> str:
        code, header = texts.replace("r_0", name).replace("R_0", name.upper()).rsplit("\f", 1)
        (tmp_path / f"{name}.h").write_text(header)
        files = with_exported_names(dict(enumerate(code.split("\f"))))
        return with_own_names("\n".join(files.values()), name, header)

    choose = random.Random(20)
    letters, further = string.ascii_lowercase, string.ascii_lowercase + string.digits + "_"
    expected = words_of(single_file("r_0"), "r_0")
    for length in (*range(2, 65), *choose.choices(range(2, 65), k=120)):
        name = c_identifier(choose.choice(letters) + "".join(choose.choices(further, k=length - 1)))
        assert words_of(single_file(name), name) == expected, name
    for name in OF_C.split():
        (tmp_path / f"{name}.c").write_text(single_file(name))
    files = [f"{name}.c" for name in OF_C.split()]
    run([*find_compiler(), *STRICT, "-Wno-psabi", "-fsyntax-only", *files], tmp_path)
