"""C functions that take the arguments of a run as one struct, added to a source when it is compiled for Python.

cffi converts each argument of a call at a cost of .05 microseconds. The struct is filled once per run, and the results
of a short run are read at once.
"""

import re
from dataclasses import replace
from struct import Struct

from scvi_codegen.rendering.source import Source

RESULTS, FIRST_RESULT = Struct("=4d3q"), "error"
"""Format of the last fields of the struct, and the first of them."""
DECLARATIONS = """
typedef struct {
  @_run *run;
  const double *parameters;
  const @_options *options;
  double *t, *q, *p; /* memory for states */
  int *iterations;
  const double *start; /* t, q and p at the start of a run */
  double *sizes; /* of the steps that follow the states, unless NULL */
  @_report *report;
  double *workspace;
  double h, t_end, tolerance; /* h = 0: adaptive steps */
  long long coordinates, measures_growth, has_energies;
  double error, error_t, energies[2];
  long long stored, steps, rejected;
} @_call;
int @_call_advance(const @_call *call, long long steps, long long every);
int @_call_integrate(@_call *call, long long steps, long long every);
"""
# Functions are called by volatile pointers: not inlined, so that the bits of steps do not depend on these callers.
FUNCTIONS = """
static int @_call_store(const @_call *c, long long row, long long steps, long long every) {
  double *t = c->t + row, *q = c->q + row * c->coordinates, *p = c->p + row * c->coordinates;
  __typeof__(@_advance) *volatile fixed = @_advance;%(adaptive)s
  return fixed(c->run, steps, every, c->parameters, c->options, t, q, p, c->iterations + row, c->report, c->workspace);
}

/* Takes steps and stores states. */
int @_call_advance(const @_call *call, long long steps, long long every) {
  return @_call_store(call, 0, steps, every);
}

/* Starts a run, takes steps and stores states, the initial one first. */
int @_call_integrate(@_call *c, long long steps, long long every) {
  c->t[0] = c->start[0];
  c->iterations[0] = 0;
  for (long long i = 0; i < c->coordinates; i++) {
    c->q[i] = c->start[1 + i];
    c->p[i] = c->start[1 + c->coordinates + i];
  }
  @_start(c->run, c->t[0], c->h, c->q, c->p);%(measured)s
  int status = @_call_store(c, 1, steps, every);
  c->steps = c->report->steps;
  c->stored = c->steps / every;%(results)s
  if (c->h == 0.0 && c->sizes)
    for (long long k = 0; k < c->stored; k++)
      c->sizes[k] = c->t[k + 1] - c->t[k];
  if (status || c->h != 0.0 || !c->has_energies)
    return status;
  long long last = c->stored, row = last * c->coordinates;
  if (@_energies(1 + (last == 1), c->t, c->q, c->p, c->parameters, c->energies, c->workspace) ||
      (last != 1 && @_energies(1, c->t + last, c->q + row, c->p + row, c->parameters, c->energies + 1, c->workspace)))
    c->energies[0] = c->energies[1] = 0.0; /* undefined */
  return 0;
}
"""
ADAPTIVE = """
  __typeof__(@_advance_to) *volatile adaptive = @_advance_to;
  if (c->h == 0.0)
    return adaptive(c->run, c->t_end, c->tolerance, steps, every, c->parameters, c->options, t, q, p,
        c->iterations + row, c->report, c->workspace);"""
MEASURED = "\n  c->run->measures_growth = c->measures_growth;"
RESULTS_BY_NAME = {
    "@_step_error": "\n  c->error = @_step_error(c->run);\n  c->error_t = c->run->error_t;",
    "@_advance_to": "\n  c->stored = c->h == 0.0 ? c->report->stored : c->stored;",
    "rejected": "\n  c->rejected = c->run->rejected;",
}
"""Assignments of results that not all sources have, by a name that these declare."""


def with_calls(source: Source) -> Source:
    """Return a source of runs with the functions of calls; others unchanged."""
    prefix = source.prefix
    names = set(re.findall(r"\w+", re.sub(r"/\*.*?\*/", "", source.declarations, flags=re.DOTALL)))
    names = {name.replace(f"{prefix}_", "@_") for name in names}
    if "@_advance" not in names:
        return source
    parts = {
        "adaptive": ADAPTIVE if "@_advance_to" in names else "",
        "measured": MEASURED if "measures_growth" in names else "",
        "results": "".join(text for name, text in RESULTS_BY_NAME.items() if name in names),
    }
    declarations, functions = (text.replace("@_", f"{prefix}_") for text in (DECLARATIONS, FUNCTIONS % parts))
    return replace(source, code=source.code + declarations + functions, declarations=source.declarations + declarations)
