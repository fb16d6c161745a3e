/* Trials of steps that choose their length, by Newton's iteration. Before it: run.h, newton_solver.h, stage_error.h.
 * After it: rungs.h. */
#define HOT static
#define SHORT_STEPS_FAIL 0

static inline real smaller(real a, real b)
{
  return a < b ? a : b;
}

/* Increments, and what their curve leaves unresolved, if more than `least`; infinity where there are none. Afresh:
 * without a guess, which only a step as long as the one before has. */
static real attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess, real *dq,
    real *dp, real decay, real least, const solver_options *options, solver_report *report)
{
  *guess = !afresh && run->change == 0 && run->guess > 0;
  if (solve(step, data, run->memory, guess, dq, dp, options, report, step->scratch + SCRATCH) != OK)
    return INFINITY;
  *guess = 1;
  return stage_error(step, run->memory, dq, EACH, decay, least);
}
