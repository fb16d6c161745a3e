/* Changes of slopes, (rows, count, GIVEN), as anything calls them that has arrays. Before it: flow_second.h. */

int NAME(bend_rows)(long long steps, long long every, int count, long long rows, const real *x, const real *slopes,
    const real *changes, real *found, solver_report *report)
{
  flow_way way = {.steps = steps, .every = every, .count = count};
  return bend_rows(&way, rows, x, slopes, changes, found, report);
}
