"""Parts of the C text called alone, where the end of a step would hide what they do wrong: what is chosen, and read."""

import os
import re
import subprocess
from functools import cache
from pathlib import Path

import pytest
from programs import needs

from scvi_codegen import SVI, LagrangianSystem, SolverOptions, StepFailedError, compile_stepper, problem
from scvi_codegen.codegen.lowering.control import REACH
from scvi_codegen.codegen.rendering.source import Source

SUPPORT = Path(__file__).parents[2] / "templates/support"
SANITIZED = ("gcc", "-std=c99", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@cache
def is_sanitized() -> bool:
    """Return whether a compiler with sanitizers is available."""
    words = [*SANITIZED, "-x", "c", "-", "-o", os.devnull]
    empty = "int main(void) { return 0; }"
    return subprocess.run(words, input=empty, text=True, capture_output=True, check=False).returncode == 0


def output_of(program: str, folder: Path, *flags: str) -> str:
    """Return the output of a program compiled in a folder with sanitizers."""
    needs(SANITIZED[0])
    if not is_sanitized():
        pytest.skip("no gcc with sanitizers here")
    (folder / "main.c").write_text(program)
    for command in ([*SANITIZED, *flags, "main.c", "-lm", "-o", "main"], [str(folder / "main")]):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    return done.stdout


def written(source: Source, folder: Path) -> str:
    """Return the source as one file with its header, and its prefix."""
    alone = source.single_file()
    (folder / f"{alone.prefix}.h").write_text(alone.header)
    (folder / f"{alone.prefix}.c").write_text(alone.code)
    return alone.prefix


LEVELS = """
#include <stdio.h>
typedef double real;
typedef struct { int guess; long long change, change_before; } run_memory;
struct predictor_tables_of { const real *alone, *last, *before; };
static const real PREDICTOR_INSIDE[2][1][1] = {{{0}}};
static const real PREDICTOR_ALONE[5][1] = {{0}}, PREDICTOR_LAST[5][5][1] = {{{0}}}, PREDICTOR_BEFORE[5][5][1] = {{{0}}};
PREDICTOR
int main(void)
{
  for (int guess = 1; guess <= 2; guess++)
    for (int before = -6; before <= 6; before++)
      for (int change = -6; change <= 6; change++) {
        const run_memory run = {guess, change, before};
        struct predictor_tables_of found = {NULL, NULL, NULL};
        printf("%d %d %d %d", guess, before, change, choose_tables(&run, &found));
        printf(" %td", found.alone ? found.alone - PREDICTOR_ALONE[0] : -1);
        printf(" %td", found.last ? found.last - PREDICTOR_LAST[0][0] : -1);
        printf(" %td\\n", found.before ? found.before - PREDICTOR_BEFORE[0][0] : -1);
      }
  return 0;
}
"""


def test_predictor_is_limited_to_the_available_tables(tmp_path):
    """One step predicts across every tabulated change of size, two across every pair; others are not predicted."""
    assert REACH == 2
    header = re.sub(r'#include ".*"', "", (SUPPORT / "step_size/predictor_tables.h").read_text())
    printed = output_of(LEVELS.replace("PREDICTOR\n", header), tmp_path)
    lines = [list(map(int, line.split())) for line in printed.splitlines()]
    assert len(lines) == 2 * 13 * 13
    for guess, before, change, *found in lines:
        reached = abs(change) <= REACH and (guess == 1 or abs(before) <= REACH)
        pair = 5 * (before + REACH) + change + REACH if guess == 2 else -1
        assert found == ([1, change + REACH, pair, pair] if reached else [0, -1, -1, -1])


DOUBT = """
int main(void)
{{
  const double line[EVENT_DEGREE + 1] = {{0, 1}}, cubic[EVENT_DEGREE + 1] = {{0, -0.25, 0, 1}};
  const double bowl[EVENT_DEGREE + 1] = {{0.26, -1, 1}}, hollow[EVENT_DEGREE + 1] = {{0.017, -0.12, 0, 1}};
  double high[EVENT_DEGREE + 1] = {{-0.5}};
  const double *all[] = {{line, cubic, bowl, hollow, high}};
  const double doubts[][2] = {{{{0.12, 0.13}}, {{0.03, 0.04}}, {{0.009, 0.011}}, {{0.0005, 0.002}}, {{0.1, 0.6}}}};
  high[EVENT_DEGREE] = 1;
  for (int i = 0; i < 5; i++)
    for (int k = 0; k < 2; k++) {{
      double extrema[EVENT_DEGREE], zeros[EVENT_DEGREE];
      int count, zero_count;
      printf("%.6f ", {prefix}_uncertain_abscissa(all[i], doubts[i][k], extrema, &count, zeros, &zero_count));
    }}
  return 0;
}}
"""


@pytest.mark.rotated
def test_intervals_are_split_only_where_a_root_is_uncertain(tmp_path):
    """x: slope 1, x^3 - x/4: slope -1/4 in the middle and 1/2 outside, both against eight doubts; hollows
    0.01 and 0.001 above zero, of one extremum and of two; the highest power alone."""
    stepper = compile_stepper(problem("harmonic-oscillator").system, SVI(1), events=["q"])
    extra = stepper.source.beside
    assert extra is not None
    written(stepper.source, tmp_path)
    prefix = written(extra, tmp_path)
    degree = f"#define EVENT_DEGREE {prefix.upper()}_EVENT_DEGREE"  # names at file scope have the prefix
    program = f'#include <stdio.h>\n#include "{prefix}.c"\n{degree}\n{DOUBT.format(prefix=prefix)}'
    flags = ("-Wno-unused-function", f"{stepper.source.prefix}.c")
    found = [float(place) for place in output_of(program, tmp_path, *flags).split()]
    assert found == pytest.approx([2.0, 0.0, 2.0, 0.0, 2.0, 0.5, 2.0, 0.2, 2.0, 0.0], abs=1e-6)


def test_unknown_momentum_is_part_of_newtons_convergence_criterion():
    """A body that falls from q0 = q1: its velocity is guessed at once, its momentum off by g h / 2."""
    falling = LagrangianSystem.from_text(name="falling", coordinates=["x"], lagrangian="x_dot**2/2 - 10*x")
    stepper = compile_stepper(falling, SVI(1), solver="newton")
    once = SolverOptions(tolerance=1e-9, max_iterations=1, absolute=True)
    with pytest.raises(StepFailedError, match=r"\b5(\.0+)?(e\+00)?\b"):
        stepper.discrete_legendre_minus([0.0], [0.0], 1.0, options=once)


DERIVATIVES = """
int main(void)
{{
  enum {{ m = COORDINATES, given = STEP_INPUTS, count = 3, steps = 2 }};
  double *workspace = malloc(sizeof(double) * LINEARISED_WORKSPACE), t[steps] = {{0.0, 0.1}}, h[steps] = {{0.1, 0.1}};
  double q[steps * m], p[steps * m], *vectors = calloc((steps + 1) * count * given, sizeof(double));
  const double parameters[] = {{{defaults}}};
  int status = 0;
  report found;
  for (int i = 0; i < steps * m; i++)
    q[i] = 0.7 - 0.1 * i, p[i] = 0.3 + 0.2 * i;
  for (int i = 0; i < (steps + 1) * count * given; i++)
    vectors[i] = 0.1 * i;
  for (int back = 0; back < 2; back++)
    status |= linearise(steps, t, h, q, p, parameters, NULL, back, count, vectors, NULL, NULL, &found, workspace);
  free(workspace), free(vectors);
  return status;
}}
"""


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("solver", ["fixed-point", "newton"])
@pytest.mark.parametrize(
    "system", [problem("harmonic-oscillator").system, problem("kepler").system], ids=lambda system: system.name
)
def test_derivatives_stay_within_their_workspace(system, solver, tmp_path):
    """Forward and back, in a workspace of exactly the length that they ask for."""
    stepper = compile_stepper(system, SVI(2), solver=solver)
    assert stepper.derivatives is not None
    prefix = written(stepper.derivatives, tmp_path)
    names = re.sub(r"\b([A-Z_]{5,})\b", rf"{prefix.upper()}_\1", DERIVATIVES.format(defaults="1.0, 1.0"))
    names = names.replace(f"{prefix.upper()}_NULL", "NULL")
    names = re.sub(r"\b(linearise\(|report found)", rf"{prefix}_\1", names)
    output_of(f'#include <stdlib.h>\n#include "{prefix}.h"\n{names}', tmp_path, f"{prefix}.c")


PRODUCTS = """
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
NUMBERS
static uint64_t state = 88172645463325252u;
static uint64_t bits(void)
{
  state ^= state << 13;
  state ^= state >> 7;
  return state ^= state << 17;
}
int main(void)
{
  const int spread[] = {2, 60, 500, 1074};
  const double special[] = {0, 1, 3, DBL_MIN, DBL_MAX, INFINITY, NAN, 0x1p-1074, 0x1p990,
                            0x1p-484, 0x1.fffffffffffffp511};
  enum { SPECIAL = sizeof special / sizeof *special };
  long split = 0;
  for (long n = 0; n < 400000; n++) {
    double x[2];
    for (int k = 0; k < 2; k++) {
      const int e = spread[n % 4], few = n % 3 == 0;
      const uint64_t whole = (bits() >> 11 | 1ull << 52) & (few ? ~0ull << bits() % 52 : ~0ull);
      x[k] = ldexp((double)whole, (int)(bits() % (unsigned)(2 * e)) - e - 52);
      if (n < 4 * SPECIAL * SPECIAL)
        x[k] = special[n / 4 / (k ? SPECIAL : 1) % SPECIAL];
      if (bits() & 1)
        x[k] = -x[k];
    }
    const double product = x[0] * x[1], want = fma(x[0], x[1], -product), got = rest_of_product(x[0], x[1], product);
    const double size = fabs(product), largest = fmax(fabs(x[0]), fabs(x[1]));
    const int plain = want == want && largest < 0x1p990 &&
                      ((size > 0x1p-968 && size < 0x1p1020) || x[0] == 0 || x[1] == 0);
    const int near = largest < 0x1p990 && size < 1 ? fabs(want - got) <= 0x1p-1072 : got - got == 0;
    if (plain ? memcmp(&want, &got, sizeof want) != 0 : !near)
      return printf("%a %a: %a, not %a\\n", x[0], x[1], got, want), 0;
    split += plain;
  }
  printf("%d", split > 200000);
  return 0;
}
"""


@pytest.mark.parametrize(("old", "new"), [("", ""), ("is_finite(rest) ? rest : 0", "rest"), ("134217729", "536870913")])
def test_the_rest_of_a_split_product_has_the_bits_of_a_fused_one(tmp_path: Path, old: str, new: str) -> None:
    """WebAssembly has no fused product; without the guard or with another splitter the bits differ."""
    numbers = (SUPPORT / "core" / "numbers.h").read_text().replace(old, new)
    output = output_of(PRODUCTS.replace("NUMBERS", numbers), tmp_path, "-O1", "-ffp-contract=off", "-DSPLIT_PRODUCTS")
    assert (output == "1") is not bool(old)
