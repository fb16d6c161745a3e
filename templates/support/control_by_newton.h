/* Trial of an adaptive step by Newton's method. Requires: run.h, newton_solver.h, stage_error.h. Include before
 * step_size_levels.h. */
#define HOT static
#define SHORT_STEPS_FAIL 0

static inline real smaller(real a, real b)
{
  return a < b ? a : b;
}

/* Computes the increments; returns the error estimate of the curve if it exceeds `least`, or infinity if the step
 * failed. afresh: without the predictor, which requires the step size of the previous step. */
static real attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess, real *dq,
    real *dp, real decay, real least, const solver_options *options, solver_report *report)
{
  *guess = !afresh && run->change == 0 && run->guess > 0;
  if (solve(step, data, run->memory, guess, dq, dp, options, report, step->scratch + SCRATCH) != OK)
    return INFINITY;
  *guess = 1;
  return stage_error(step, run->memory, dq, EACH, decay, least);
}
