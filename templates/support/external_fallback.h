/* Fallback to the Newton solver of another library, which is loaded on demand. Until it is set, a step whose
 * fixed-point iteration fails returns FALLBACK_REQUIRED, is not performed, and has to be repeated. Requires:
 * fallback.h. */
static const fallback *library_fallback; /* set once, before the calls that need it are repeated */

void NAME(set_fallback)(const void *shared_fallback)
{
  library_fallback = shared_fallback;
}

/* Solves the step by the fallback library, which leaves its error estimate in the workspace. */
static SELDOM int fall_back(int status, const step_data *step, double *dq, double *dp, const solver_options *options,
    solver_report *report, double *workspace)
{
  (void)status;
  if (!library_fallback)
    return STATUS(FALLBACK_REQUIRED);
  return library_fallback->step(step, dq, dp, options, report, workspace);
}
