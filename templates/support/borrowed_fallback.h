/* Where sweeps fail, Newton's iteration of another library, once it was lent: until then the step is not done, and asks
 * for it. Before it: fallback.h. */
static const fallback *borrowed; /* set once, before the calls that need it are made again */

void NAME(borrow_fallback)(const void *lent)
{
  borrowed = lent;
}

/* The error of the step is left in the workspace. */
static SELDOM int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace)
{
  (void)status;
  return borrowed ? borrowed->step(step, dq, dp, options, report, workspace) : STATUS(NEEDED);
}
