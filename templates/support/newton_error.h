/* Largest error estimate of steps by Newton's method. Requires: stage_error.h. */
static real largest_error(const run_memory *run, const step_data *step, const solver_data *data, const real *dq,
    real *workspace)
{
  (void)data, (void)workspace;
  return stage_error(step, run->memory, dq, ALL, DECAY, run->error);
}
