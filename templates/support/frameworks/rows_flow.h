#ifndef SUPPORT_ROWS_FLOW_H
#define SUPPORT_ROWS_FLOW_H

#include "flow.h"

/* Flow of many rows, for callers with arrays. Requires: flow.h. */

/* part: 0 states, 1 tangent vectors of the states (JVP), 2 gradients with respect to the inputs (VJP); of rows x
 * (rows, STEP_INPUTS), each with `count` tangent vectors, (STEP_INPUTS), or adjoint vectors, (kept states,
 * FLOW_STATE). On failure the results are undefined. */
int NAME(flow_rows)(int part, long long steps, long long every, int count, long long rows, const real *x,
    const real *given, real *found, solver_report *report)
{
  flow_call way = {.steps = steps, .every = every, .count = count};
  return flow_rows((flow_part)part, &way, rows, x, given, found, report);
}

#ifdef SECOND_DERIVATIVES
/* Derivatives of gradients, (rows, count, STEP_INPUTS), for callers with arrays. Requires: flow.h. */

int NAME(hessian_rows)(long long steps, long long every, int count, long long rows, const real *x, const real *partials,
    const real *changes, real *found, solver_report *report)
{
  flow_call way = {.steps = steps, .every = every, .count = count};
  return hessian_rows(&way, rows, x, partials, changes, found, report);
}
#endif

#endif
