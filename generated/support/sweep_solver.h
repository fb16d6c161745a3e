/* A step by sweeps, and what is tried where they fail. Before it: a sweep, and fall_back. */
typedef sweep_data solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  prepare_sweep(step, data);
}

/* The increments by sweeps from the straight line, else as fall_back can. */
static __attribute__((noinline)) int solve_afresh(const step_data *step, const solver_data *data, double *memory,
    long long *guess, double *dq, double *dp, const solver_options *options, solver_report *report, double *workspace)
{
  long long steps = 0;
  int status = sweep(step, data, memory, &steps, dq, dp, options, report);
  if (status != OK) {
    status = fall_back(status, step, dq, dp, options, report, workspace);
    steps = 0;
  }
  if (status == OK)
    *guess = steps;
  return status;
}

/* The increments by sweeps from the curve continued from so many former steps as guess says, or afresh if there are
 * none or it leads nowhere. On success guess says from how many steps the next is continued. */
HOT int solve(const step_data *step, const solver_data *data, double *memory, long long *guess, double *dq, double *dp,
    const solver_options *options, solver_report *report, double *workspace)
{
  long long steps = *guess;
  if (steps > 0 && sweep(step, data, memory, &steps, dq, dp, options, report) == OK) {
    *guess = steps;
    return OK;
  }
  return solve_afresh(step, data, memory, guess, dq, dp, options, report, workspace);
}
