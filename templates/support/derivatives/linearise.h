#ifndef SUPPORT_LINEARISE_H
#define SUPPORT_LINEARISE_H

#include "vectors_by_newton.h"

/* Tangent or adjoint vectors over many steps: each by Newton's method, or several at once (VECTORS_BY_ITERATION). */
#ifndef VECTORS_BY_ITERATION
/* Tangent and adjoint vectors over steps that are each solved by Newton's method. Requires: vectors_by_newton.h. */
enum {
  STEPS_AT_ONCE = 1
};

/* Propagates the vectors over step `first`. */
static int propagate_steps(propagation *over, long long first, long long end)
{
  const int status = vectors_by_newton(over, first, 0);
  (void)end;
  over->report->steps += status == OK;
  return status;
}
#endif

/* Tangent or adjoint vectors over a sequence of steps, forward or backward. On failure report->t is the time of the
 * failed step. Requires: propagate_steps, which propagates them over at most STEPS_AT_ONCE steps. */
int NAME(linearise)(long long steps, const real *t, const real *h, const real *q, const real *p,
    const real *parameters, const solver_options *options, int back, int count, real *vectors, real *q1, real *p1,
    solver_report *report, real *workspace)
{
  const solver_options standard = NAME(default_options)();
  propagation over = {t, h, q, p, parameters, options ? options : &standard, back, count, vectors, q1, p1, workspace,
      report, 0, 0};
  int status = OK;
  memset(report, 0, sizeof *report);
  for (long long done = 0; status == OK && done < steps; done += STEPS_AT_ONCE) {
    const long long left = steps - done, own = left < STEPS_AT_ONCE ? left : STEPS_AT_ONCE;
    const long long first = back ? left - own : done;
    status = propagate_steps(&over, first, first + own);
  }
  return status;
}

#endif
