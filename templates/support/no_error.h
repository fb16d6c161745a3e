/* Of methods without a curve that tells its error. */
static void observe_error(run_memory *run, const step_data *step, const solver_data *data, const real *dq,
    const real *dp, real *workspace)
{
  (void)run, (void)step, (void)data, (void)dq, (void)dp, (void)workspace;
}

real NAME(step_error)(const run_memory *run)
{
  (void)run;
  return -1;
}
