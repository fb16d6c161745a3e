#include "../core/status_codes.h"
#include "../newton/suspension.h"
#include "one_trajectory.h"

/* Step by fixed-point iteration. If it fails, the step is solved by Newton's method, by that of another library
 * (LIBRARY_FALLBACK) or not at all (NO_FALLBACK). Requires: a fixed-point iteration. */

#ifdef LIBRARY_FALLBACK
#include "../newton/library_fallback.h"
#elif defined(NO_FALLBACK)
/* No fallback: if the fixed-point iteration fails, the step fails. */
#define fall_back(status, step, dq, dp, options, report, workspace, ...) ((void)(workspace), (status))
#else
#include "../newton/newton_from_line.h"

/* Fallback to Newton's method when the fixed-point iteration fails. A trial follows no branch of solutions (hundreds of
 * updates): what is not near the line at its size is at a smaller one. */

static int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace, const error_measure *measure)
{
  newton_data *newtons = newton_in(workspace);
  const long long before = report->iterations;
  int keep;
#ifdef MIXED_VELOCITIES
  if (step->points)
    ((solved_step *)step->points)->by_iteration = 0;
#endif
  status = (measure->share == EACH ? newton_on_line : newton_from_line)(step, newtons, dp, &keep, options, report);
  gather(END_POSITION, 1, step->h, newtons->z, M, dq, 0, 1);
  memset(dq + M, 0, sizeof(double) * M);
  memset(dp + M, 0, sizeof(double) * M);
  if (status == OK && is_spurious(step, newtons->z, dq, report->iterations - before))
    return STATUS(SPURIOUS_SOLUTION);
  return status;
}
#endif

typedef iteration_data solver_data;

/* Returns 1 if 1 / m is finite: without a mass, the equations that Newton's method would solve have no motion. */
static int has_masses(const solver_data *data)
{
#ifdef SUPPORT_SEPARABLE_ITERATION_H
  for (int i = 0; i < M; i++)
    if (!(fabs(data->inverse_mass[i]) < INFINITY))
      return 0;
#endif
  return 1;
}

#define prepare prepare_iteration

/* Computes the increments by fixed-point iteration from the straight line unless it is suspended, else by fall_back. */
static __attribute__((noinline)) int solve_afresh(const step_data *step, const solver_data *data, history memory,
    long long *guess, double *dq, double *dp, const solver_options *options, solver_report *report, double *workspace)
{
  long long steps = 0;
  int status = NOT_CONVERGED;
  if (!is_suspended(*guess))
    status = fixed_point(step, data, memory, &steps, dq, dp, options, report);
  if (status != OK && !has_masses(data))
    return SINGULAR;
  if (status != OK) {
    status = fall_back(status, step, dq, dp, options, report, workspace, &(error_measure){ALL, DECAY});
    if (status == OK && !reaches(step, dq, dp))
      status = NOT_FINITE;
#ifndef NO_FALLBACK
    report->fallback_steps += status == OK;
#endif
    steps = after_fallback(*guess);
  }
  if (status == OK)
    *guess = steps;
  return status;
}

/* Computes the increments by fixed-point iteration from the curve extrapolated from *guess former steps, or from the
 * straight line if there are none or it fails. On success *guess is the number of steps for the next predictor, or
 * negative after Newton's method (suspension.h). On failure the increments are undefined. */
HOT int solve(const step_data *step, const solver_data *data, history memory, long long *guess, double *dq, double *dp,
    const solver_options *options, solver_report *report, double *workspace)
{
  long long steps = *guess;
  if (steps > 0 && fixed_point(step, data, memory, &steps, dq, dp, options, report) == OK) {
    *guess = steps;
    return OK;
  }
  return solve_afresh(step, data, memory, guess, dq, dp, options, report, workspace);
}
