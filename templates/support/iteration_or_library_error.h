/* Largest error estimate of steps by fixed-point iteration, or by the fallback library where it failed. Requires:
 * curve_error.h, external_fallback.h, whose error is converted to the same power. */
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
