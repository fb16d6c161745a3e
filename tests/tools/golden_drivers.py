"""C programs that run a generated integrator and print its results as hexadecimal numbers, without any of the package's
Python: what they print depends on the C source alone. With an argument n a program repeats its run n times and prints
the shortest time in nanoseconds instead."""

from collections.abc import Sequence

HEAD = """#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include "{prefix}.h"
#define CALL(name) {prefix}_##name
static double now(void)
{{
  struct timespec at;
  clock_gettime(CLOCK_MONOTONIC, &at);
  return 1e9 * (double)at.tv_sec + (double)at.tv_nsec;
}}
static uint64_t digest = 1469598103934665603u;
static void add(const void *x, size_t size)
{{
  for (size_t i = 0; i < size; i++)
    digest = (digest ^ ((const unsigned char *)x)[i]) * 1099511628211u;
}}
static void show(const char *name, const double *x, long long n)
{{
  add(x, sizeof *x * (size_t)n);
  printf("%s %016llx", name, (unsigned long long)digest);
  for (long long i = 0; i < n && i < 4; i++)
    printf(" %a", x[i]);
  printf("\\n");
}}
"""


def repeated(body: str) -> str:
    """Return C code that repeats ``body`` and prints the shortest time."""
    return f"""double shortest = INFINITY;
  const int repeats = count > 1 ? atoi(arguments[1]) : 1;
  for (int k = 0; k < repeats; k++) {{
    double from = now();
    {body}
    shortest = fmin(shortest, now() - from);
  }}
  if (count > 1)
    return printf("%.0f\\n", shortest) < 0;"""


def numbers(values: Sequence[float]) -> str:
    """An initialiser."""
    return ", ".join(float(value).hex() for value in values) or "0"


def control_of(tolerance: float, h: float, *, transformed: bool = False) -> str:
    """A pointer to the control of adaptive steps, which begin at h above round-off, or of steps of tau."""
    if transformed:
        return f"&(const CALL(step_control)){{{tolerance!r}}}"
    first = f"(const double[]){{{h!r}}}" if tolerance else "NULL"
    return f"&(const CALL(step_control)){{{tolerance!r}, INFINITY, {first}, NULL}}"


def run_driver(
    prefix: str,
    q: Sequence[float],
    p: Sequence[float],
    parameters: Sequence[float],
    h: float,
    steps: int,
    *,
    t_end: float = 0.0,
    tolerance: float = 0.0,
    transformed: bool = False,
) -> str:
    """One step, then a run of fixed steps; of adaptive steps to t_end where that is given."""
    m = len(q)
    control = control_of(tolerance, h, transformed=transformed)
    run = (
        f"CALL(advance_to)(&run, {t_end!r}, {control}, {steps}, {steps}, parameters, NULL, t, q, p, counts,"
        " &report, work)"
        if t_end
        else f"CALL(advance)(&run, {steps}, {max(1, steps // 3)}, parameters, NULL, t, q, p, counts, &report, work)"
    )
    start = 0.0 if t_end else h
    return (
        HEAD.format(prefix=prefix)
        + f"""
static double work[{prefix.upper()}_WORKSPACE], parameters[] = {{{numbers(parameters)}}};
static double q[{8 * m}], p[{8 * m}], t[8];
int main(int count, char **arguments)
{{
  static CALL(run) run;
  const double q0[] = {{{numbers(q)}}}, p0[] = {{{numbers(p)}}};
  CALL(report) report;
  int counts[8] = {{0}}, status = CALL(step)(0.25, {h!r}, q0, p0, parameters, NULL, q, p, &report, work);
  printf("step %d %lld\\n", status, report.iterations);
  show("q", q, {m}), show("p", p, {m}), show("change", &report.change, 1);
  {repeated(f"CALL(start)(&run, 0.25, {start!r}, q0, p0), status = {run};")}
  printf("run %d %lld %lld %lld\\n", status, report.steps, report.iterations, run.step);
  for (int k = 0; k < 4; k++)
    show("stored q", q + k * {m}, {m}), show("stored p", p + k * {m}, {m}), printf("%d\\n", counts[k]);
  show("q", run.q, {m}), show("p", run.p, {m}), show("carry", run.carry_q, {m}), show("carry", run.carry_p, {m});
  show("t", &run.t, 1), show("t_low", &run.t_low, 1), show("error", &run.error, 1), show("time", &run.error_t, 1);
  return 0;
}}
"""
    )


def ensemble_driver(
    prefix: str, q: Sequence[float], p: Sequence[float], parameters: Sequence[float], h: float, steps: int
) -> str:
    """A block of trajectories from neighbouring states."""
    m, most = len(q), 8
    body = f"""CALL(start)(&block, 0.25, {h!r});
    for (int k = 0; k < WIDTH; k++) {{
      double q0[] = {{{numbers(q)}}}, p0[] = {{{numbers(p)}}};
      for (int i = 0; i < {m}; i++)
        block.q[i][k] = q0[i] * (1 + 0.001 * k), block.p[i][k] = p0[i] * (1 - 0.002 * k);
      for (int i = 0; i < {len(parameters)}; i++)
        block.parameters[i][k] = parameters[i];
      block.active[k] = 1.0;
    }}
    CALL(advance)(&block, WIDTH, {steps}, {max(1, steps // 3)}, NULL, q, p, {4 * m});"""
    return (
        HEAD.format(prefix=prefix)
        + f"""
static double q[{8 * most * m}], p[{8 * most * m}], parameters[] = {{{numbers(parameters)}}};
int main(int count, char **arguments)
{{
  enum {{ WIDTH = {prefix.upper()}_WIDTH }};
  static CALL(block) block __attribute__((aligned(64)));
  {repeated(body)}
  printf("%lld %lld\\n", block.step, block.iterations);
  for (int k = 0; k < WIDTH; k++)
    show("q", q + {4 * m} * k, {4 * m}), show("p", p + {4 * m} * k, {4 * m});
  for (int i = 0; i < {m}; i++)
    show("carry", block.carry_q[i], WIDTH), show("carry", block.carry_p[i], WIDTH);
  return 0;
}}
"""
    )


def tangent_driver(
    prefix: str,
    q: Sequence[float],
    p: Sequence[float],
    parameters: Sequence[float],
    h: float,
    steps: int,
    *,
    second: bool = False,
) -> str:
    """Tangent vectors forward over some steps, then adjoint vectors; second derivatives in addition."""
    m = len(q)
    more = f"""
  for (int k = 0; k < {steps} * COUNT * N; k++)
    changes[k] = 0.01 * (k % 7) - 0.02;
  for (int k = 0; k < {steps + 1} * 2 * COUNT * N; k++)
    vectors[k] = k < {steps} * 2 * COUNT * N ? 0.0 : 0.3 + 0.1 * (k % 5);
  status = CALL(second_order)({steps}, t, h, q, p, parameters, NULL, COUNT, changes, vectors, &report, work);
  printf("second %d %lld\\n", status, report.iterations);
  show("vectors", vectors, {steps + 1} * 2 * COUNT * N);
"""
    return (
        HEAD.format(prefix=prefix)
        + f"""
enum {{ N = {prefix.upper()}_STEP_INPUTS, COUNT = 3 }};
static double work[{prefix.upper()}_LINEARISED_WORKSPACE], parameters[] = {{{numbers(parameters)}}};
static double q[{(steps + 1) * m}] = {{{numbers(q)}}}, p[{(steps + 1) * m}] = {{{numbers(p)}}};
static double t[{steps}], h[{steps}], changes[{steps} * COUNT * N], vectors[{steps + 1} * 2 * COUNT * N];
int main(void)
{{
  CALL(report) report;
  int status;
  for (int k = 0; k < {steps}; k++)
    t[k] = {h!r} * k, h[k] = {h!r};
  for (int back = 0; back < 2; back++) {{
    for (int k = 0; k < {steps + 1} * COUNT * N; k++)
      vectors[k] = (back ? k < {steps} * COUNT * N : k >= COUNT * N) ? 0.0 : 1 + 0.1 * (k % 11);
    status = CALL(linearise)({steps}, t, h, q, p, parameters, NULL, back, COUNT, vectors, q + {m}, p + {m}, &report,
        work);
    printf("%d %d %lld\\n", back, status, report.iterations);
    show("vectors", vectors, {steps + 1} * COUNT * N), show("q", q, {(steps + 1) * m}), show("p", p, {(steps + 1) * m});
  }}{more if second else ""}
  return 0;
}}
"""
    )


def arrays_driver(
    prefix: str,
    sizes: Sequence[int],
    tables: Sequence[Sequence[int]],
    fields: int,
    parameters: Sequence[float],
    h: float,
    steps: int,
    *,
    threads: int = 0,
    t_end: float = 0.0,
    tolerance: float = 0.0,
    constrained: bool = False,
) -> str:
    """A run over arrays, from a wave; several threads share a step where SCVI_THREADS is defined."""
    rows = "".join(f"static const int table_{k}[] = {{{', '.join(map(str, row))}}};\n" for k, row in enumerate(tables))
    listed = ", ".join(f"table_{k}" for k in range(len(tables)))
    run = (
        f"CALL(advance_to)(run, {t_end!r}, {control_of(tolerance, h)}, {steps}, 0, all, NULL, NULL, NULL, NULL, NULL,"
        " &report, NULL)"
        if t_end
        else f"CALL(advance)(run, {steps}, 0, all, NULL, NULL, NULL, NULL, NULL, &report, NULL)"
    )
    held = """
    printf("project %d\\n", CALL(project)(0.25, q, p, all, q, p, (double *)run));
"""
    body = f"""memset(memory, 255, sizeof(double) * (size_t)length); /* no values are required */
    run = CALL(bind)(sizes, tables, memory);
    n = run->p - run->q;
    for (long long i = 0; i < n; i++) {{
      const double at = (double)((i * 37) % 101) / 101.0;
      q[i] = {"at + (double)i / 16.0" if constrained else "at"}, p[i] = 0.5 - at * at;
    }}
    CALL(data_at)(all, memory);
    for (int k = 0; k < {fields}; k++)
      for (long long i = 0; i < n; i++)
        ((double *)run->data.field[k])[i] = 1.0 + 0.125 * (double)(i % 3);{held if constrained else ""}
    CALL(start)(run, 0.25, {0.0 if t_end else h!r}, q, p);
    run->threads = {threads};
    from = now();
    status = {run};"""
    return (
        HEAD.format(prefix=prefix)
        + f"""
{rows}int main(int count, char **arguments)
{{
  const long long sizes[] = {{{", ".join(map(str, sizes)) or "0"}}};
  const int *const tables[] = {{{f"{listed}, " if listed else ""}NULL}};
  const long long length = CALL(memory)(sizes, tables);
  double *memory = aligned_alloc(64, sizeof(double) * (size_t)((length + 7) / 8 * 8)), energies[3];
  double *all = calloc((size_t)({fields + 1} * length + {len(parameters)}), sizeof(double));
  double *q = malloc(sizeof(double) * (size_t)length), *p = malloc(sizeof(double) * (size_t)length);
  const double scalars[] = {{{numbers(parameters)}}};
  CALL(report) report;
  CALL(run) *run = NULL;
  long long n = 0;
  int status;
  memcpy(all, scalars, {len(parameters)} * sizeof(double));
  {repeated(body)}
  printf("run %d %lld %lld %lld\\n", status, report.steps, report.iterations, run->step);
  show("q", run->q, n), show("p", run->p, n), show("carry", run->carry_q, n), show("carry", run->carry_p, n);
  show("t", &run->t, 1), show("t_low", &run->t_low, 1), show("h", &run->h, 1), show("error", &run->error, 1);
  CALL(energy_parts)(1, &run->t, run->q, run->p, all, energies, (double *)run);
  show("energies", energies, 3);
  return 0;
}}
"""
    )


def scene_driver(
    prefix: str,
    q: Sequence[float],
    p: Sequence[float],
    parameters: Sequence[float],
    t_end: float,
    steps: int,
    *,
    outputs: int,
    events: Sequence[int] = (),
    inputs: Sequence[tuple[Sequence[float], Sequence[Sequence[float]]]] = (),
    in_tau: bool = False,
    seed: int | None = None,
) -> str:
    """States at equal intervals of a run by adaptive steps, or by ``steps`` fixed ones, with the changes of events.

    Arguments of the program: a change of the initial state, relative to its size, of signs that alternate; and a factor
    of the number of fixed steps.
    """
    m, adaptive = len(q), in_tau or not steps
    tables = "".join(
        f"static const double t_{k}[] = {{{numbers(times)}}};\n"
        f"static const double c_{k}[] = {{{numbers([value for row in rows for value in row])}}};\n"
        for k, (times, rows) in enumerate(inputs)
    )
    if inputs:
        sets = (f"{{t_{k}, c_{k}, {len(rows)}, 0}}" for k, (_, rows) in enumerate(inputs))
        tables += f"static CALL(input) inputs[] = {{{', '.join(sets)}}};\n"
    control = f"{{{t_end!r} / {steps} / more}}" if in_tau else "{0.0, INFINITY, NULL, NULL}"
    until = "CALL(next_breakpoint)(&run, end, 0, inputs, parameters)" if inputs else "end"
    size = "CALL(next_steps)(&run, end, h, inputs, parameters)" if inputs else "last - run.step"
    if events:
        target, how = (until, "control") if adaptive else ("run.t + 2 * run.h", "NULL")
        call = (
            f"CALL(advance_with_changes)(&run, &watch, {target}, {how}, 1, parameters, NULL,"
            " ROOM, t, q, p, length, iterations, number, ROOM, found, &filled, &report, work)"
        )
    elif adaptive:
        call = (
            f"CALL(advance_to)(&run, {until}, control, 1 << 20, 1 << 20, parameters, NULL, t, q, p, iterations,"
            " &report, work)"
        )
    else:
        call = "CALL(advance)(&run, size, run.step + size + 1, parameters, NULL, t, q, p, iterations, &report, work)"
    directions, acts = ", ".join(map(str, events)), ", ".join("1" for _ in events)
    watch = f"""#include "{prefix}_events.h"
static CALL(crossing) found[ROOM];
static CALL(watch) watch = {{.direction = {{{directions}}}, .acts = {{{acts}}}}};
"""
    return (
        HEAD.format(prefix=prefix)
        + f"""
enum {{ M = {m}, ROOM = 256 }};
static double work[{prefix.upper()}_WORKSPACE], parameters[] = {{{numbers(parameters)}}};
static double t[ROOM], q[ROOM * M], p[ROOM * M];
static int iterations[ROOM];
static CALL(run) run;
{tables}{watch if events else ""}
int main(int count, char **arguments)
{{
  const double change = count > 1 ? atof(arguments[1]) : 0.0;
  const int more = count > 2 ? atoi(arguments[2]) : 1;
  const double h = {t_end / steps if steps and not in_tau else 0.0!r} / more;
  double q0[] = {{{numbers(q)}}}, p0[] = {{{numbers(p)}}};
  {f"const CALL(step_control) own = {control}, *control = &own;" if adaptive else ""}
  CALL(report) report;
  int status = 0;
  for (int i = 0; i < M; i++) {{
    q0[i] += (i % 2 ? -1 : 1) * change * {max(map(abs, q)) or 1.0!r};
    p0[i] += (i % 2 ? 1 : -1) * change * {max(map(abs, p))!r};
  }}
  CALL(start)(&run, 0.0, h, q0, p0);
  {f"run.seed = {seed};" if seed else ""}
  for (int k = 1; k <= {outputs} && !status; k++) {{
    const double end = {t_end!r} * k / {outputs};
    const long long last = {steps // outputs}LL * more * k;
    while (!status && ({"run.t != end || run.t_low != 0" if adaptive else f"({size}) > 0"})) {{
      {"" if adaptive else f"const long long size = {size};"}
      {"static double length[ROOM]; static long long number[ROOM]; long long filled = 0;" if events else ""}
      status = {call};
    }}
    printf("state %a", run.t);
    for (int i = 0; i < M; i++)
      printf(" %a", run.q[i]);
    for (int i = 0; i < M; i++)
      printf(" %a", run.p[i]);
    puts("");
  }}
  printf("run %d %lld %lld %a\\n", status, run.step, run.iterations, (double)report.t);
  show("carry", run.carry_q, M), show("carry", run.carry_p, M);
  return status;
}}
"""
    )
