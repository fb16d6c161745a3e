/* Parts of the flow of many rows as anything calls them that has arrays. Before it: flow.h. */

/* part: 0 states, 1 changes of them, 2 slopes by what is given; of rows x (rows, GIVEN), each with count changes,
 * (GIVEN), or slopes, (kept states, FLOW_STATE). */
int NAME(flow_rows)(int part, long long steps, long long every, int count, long long rows, const real *x,
    const real *given, real *found, solver_report *report)
{
  flow_way way = {.steps = steps, .every = every, .count = count};
  return flow_rows((flow_part)part, &way, rows, x, given, found, report);
}
