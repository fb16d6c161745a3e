/* The largest error of the curves that sweeps found; not a number once there was another. Before it: curve_error.h. */
static double largest_error(const run_memory *run, const step_data *step, const solver_data *data, const double *dq,
    double *workspace)
{
  (void)workspace;
  return run->guess > 0 ? curve_error(step, data, run->memory, dq, ALL, run->error) : NAN;
}
