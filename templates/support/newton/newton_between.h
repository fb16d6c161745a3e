#include "newton.h"

/* Newton's method for the step between two positions. */

/* Solves the stage equations with q1 given, from the straight line; p0 and the increment p1 - p0 are results. step->p0
 * must be p0. */
static int newton_between(const step_data *step, newton_data *data, const real *q1, real *p0, real *increment,
    const solver_options *options, solver_report *report)
{
  real v[M];
  int keep = 0;
  for (int i = 0; i < M; i++)
    v[i] = (q1[i] - step->q0[i]) / step->h;
  TRY(find_momentum(step->t, step->q0, v, step->parameters, p0, step->scratch));
  start_on_line(v, p0, data->z);
  return newton(step, data, q1, p0, increment, &keep, options, report);
}
