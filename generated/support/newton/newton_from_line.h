#ifndef SUPPORT_NEWTON_FROM_LINE_H
#define SUPPORT_NEWTON_FROM_LINE_H

#include "newton.h"

/* Newton's method without previous steps. Requires: newton.h. */

/* Initial guess: q moves on a straight line with its initial velocity. */
static int line_from(const step_data *step, newton_data *data)
{
  real v[M];
  const int status = find_velocity(step->t, step->q0, step->p0, step->parameters, v, step->scratch);
  if (status == OK)
    start_on_line(v, step->p0, data->z);
  return status;
}

/* Newton's method from that guess. */
static int newton_from_line(const step_data *step, newton_data *data, real *dp, int *keep,
    const solver_options *options, solver_report *report)
{
  const int status = line_from(step, data);
  if (status != OK)
    return status;
  *keep = 0;
  return newton(step, data, NULL, NULL, dp, keep, options, report);
}

#ifdef SPURIOUS_TESTED
/* Detection of spurious solutions of Newton's method. Requires: stage_error.h if the stages have an error estimate. */

#define MOST_ERROR 1.0 /* of a step, relative to the state: beyond it the solution may be a spurious one */
#define NEARLY_LINEAR 8 /* iterations: equations solved by so few have one solution nearby, however stiff */

/* Returns 1 if converged stages, after so many iterations, have an inadmissible error estimate. */
static SELDOM int is_spurious(const step_data *step, const real *z, const real *dq, long long iterations)
{
#ifdef STAGE_POWER
  return iterations > NEARLY_LINEAR && !(MATH(pow)(stage_error(step, z, dq, ALL, DECAY, 0), STAGE_POWER) <= MOST_ERROR);
#else
  (void)step, (void)z, (void)dq, (void)iterations;
  return 0;
#endif
}
#endif

#endif
