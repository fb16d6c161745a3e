/* The largest error of the steps of a run. Before it: largest_error of a solver, ERROR_POWER. */
static void observe_error(run_memory *run, const step_data *step, const solver_data *data, const real *dq,
    real *workspace)
{
  const real error = largest_error(run, step, data, dq, workspace);
  if (run->error == run->error && !(error <= run->error)) {
    run->error = error;
    run->error_t = step->t;
  }
}

real NAME(step_error)(const run_memory *run)
{
  return MATH(pow)(run->error, ERROR_POWER);
}
