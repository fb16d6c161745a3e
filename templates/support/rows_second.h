/* Derivatives of gradients, (rows, count, GIVEN), for callers with arrays. Requires: flow_second.h. */

int NAME(bend_rows)(long long steps, long long every, int count, long long rows, const real *x, const real *slopes,
    const real *changes, real *found, solver_report *report)
{
  flow_way way = {.steps = steps, .every = every, .count = count};
  return bend_rows(&way, rows, x, slopes, changes, found, report);
}
