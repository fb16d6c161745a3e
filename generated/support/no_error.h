/* Error estimate of methods without a curve: none. */
static int observe_error(run_memory *run, step_data *step, const solver_data *data, const real *dq, const real *dp,
    const solver_options *options, real *workspace)
{
  step->first = 0;
  (void)run, (void)data, (void)dq, (void)dp, (void)options, (void)workspace;
  return OK;
}

real NAME(step_error)(const run_memory *run)
{
  (void)run;
  return -1;
}
