/* Trial of an adaptive step by fixed-point iteration. Requires: run.h, curve_error.h, step_size_levels.h,
 * predictor_tables.h. */
#define SHORT_STEPS_FAIL 1 /* their changes are relative to velocities that may be little more than rounding */

/* Computes the increments; returns the error estimate of the curve if it exceeds `least`, or infinity if the step
 * failed. afresh: without the predictor. */
static inline double attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess,
    double *dq, double *dp, double decay, double least, const solver_options *options, solver_report *report)
{
  struct predictor_tables_of tables = {NULL, NULL, NULL};
  int status;
  step->tables = &tables;
  *guess = afresh || !choose_tables(run, &tables) ? 0 : run->guess;
  status = fixed_point(step, data, run->memory, guess, dq, dp, options, report);
  step->tables = NULL;
  if (status != OK)
    return INFINITY;
  return curve_error(step, data, run->memory, dq, EACH, decay, least);
}
