#ifndef SUPPORT_LARGEST_ERROR_H
#define SUPPORT_LARGEST_ERROR_H

/* Largest error estimate of the steps of a run: by Newton's method alone (NEWTON_ALONE), or by fixed-point iteration
 * with a fallback in another library (LIBRARY_FALLBACK), with an own one (STAGE_POWER) or without one. */
#if defined(NEWTON_ALONE)
/* Largest error estimate of steps by Newton's method. Requires: stage_error.h. */
static real largest_error(const run_memory *run, const step_data *step, const solver_data *data, const real *dq,
    real *workspace)
{
  (void)data, (void)workspace;
  return stage_error(step, run->memory, dq, ALL, DECAY, run->error);
}
#elif defined(LIBRARY_FALLBACK)
/* Largest error estimate of steps by fixed-point iteration, or by the fallback library where it failed. Requires:
 * curve_error.h, library_fallback.h, whose error is converted to the same power. */
static SELDOM double fallback_error(const run_memory *run, const double *workspace)
{
  return larger(run->error, pow(*workspace, 1 / ERROR_POWER));
}

static double largest_error(const run_memory *run, const step_data *step, const solver_data *data, const double *dq,
    double *workspace)
{
  if (run->guess > 0)
    return curve_error(step, data, run->memory, dq, ALL, now_and_then(run), run->error);
  return fallback_error(run, workspace);
}
#elif defined(STAGE_POWER)
/* Largest error estimate of steps by fixed-point iteration, or by Newton's method where it failed. Requires:
 * curve_error.h, stage_error.h, whose errors are converted to the same power. */
static SELDOM double fallback_error(const run_memory *run, const step_data *step, const double *dq, double *workspace)
{
  const double error = stage_error(step, newton_in(workspace).z, dq, ALL, DECAY, 0.0);
  return larger(run->error, pow(error, STAGE_POWER / ERROR_POWER));
}

static double largest_error(const run_memory *run, const step_data *step, const solver_data *data, const double *dq,
    double *workspace)
{
  if (run->guess > 0)
    return curve_error(step, data, run->memory, dq, ALL, now_and_then(run), run->error);
  return fallback_error(run, step, dq, workspace);
}
#else
/* Largest error estimate of steps by fixed-point iteration; NaN once a step was solved otherwise. Requires:
 * curve_error.h. */
static double largest_error(const run_memory *run, const step_data *step, const solver_data *data, const double *dq,
    double *workspace)
{
  (void)workspace;
  return run->guess > 0 ? curve_error(step, data, STORED(run, step), dq, ALL, now_and_then(run), run->error) : NAN;
}
#endif

#endif
