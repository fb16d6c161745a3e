/* Derivatives of gradients, (rows, count, STEP_INPUTS), for callers with arrays. Requires: flow_second.h. */

int NAME(hessian_rows)(long long steps, long long every, int count, long long rows, const real *x, const real *partials,
    const real *changes, real *found, solver_report *report)
{
  flow_call way = {.steps = steps, .every = every, .count = count};
  return hessian_rows(&way, rows, x, partials, changes, found, report);
}
