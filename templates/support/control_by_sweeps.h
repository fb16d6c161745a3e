/* Trials of steps that choose their length, by sweeps. Before it: run.h, a sweep with curve_error.h, rungs.h,
 * ladder_tables.h. */
#define SHORT_STEPS_FAIL 1 /* their changes are held against velocities that are hardly more than rounding */

/* Increments, and what their curve leaves unresolved, if more than `least`; infinity where there are none. Afresh:
 * without a guess. */
static inline double attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess,
    double *dq, double *dp, double decay, double least, const solver_options *options, solver_report *report)
{
  struct guess_tables tables = {NULL, NULL, NULL};
  int status;
  step->tables = &tables;
  *guess = afresh || !choose_tables(run, &tables) ? 0 : run->guess;
  status = sweep(step, data, run->memory, guess, dq, dp, options, report);
  step->tables = NULL;
  if (status != OK)
    return INFINITY;
  return curve_error(step, data, run->memory, dq, EACH, decay, least);
}
