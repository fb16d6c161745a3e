#if defined(NEWTON_ALONE)
/* Integrals along a step solved by Newton's method. Requires: integrals_along. */
static void integrals(const step_data *step, const solver_data *data, const real *memory, long long guess,
    real *workspace, real *sum)
{
  (void)data, (void)guess, (void)workspace;
  integrals_along(step, memory, sum);
}
#elif defined(NO_FALLBACK)
/* Integrals along a step solved by fixed-point iteration. Requires: integrals_of_iteration. */
static void integrals(const step_data *step, const solver_data *data, const double *memory, long long guess,
    double *workspace, double *sum)
{
  (void)guess, (void)workspace;
  integrals_of_iteration(step, data, memory, sum);
}
#else
/* Integrals along a step solved by fixed-point iteration, or by Newton's method, which leaves guess = 0 and its
 * unknowns in the workspace. Requires: integrals_of_iteration, integrals_along, newton.h. */
static void integrals(const step_data *step, const solver_data *data, const double *memory, long long guess,
    double *workspace, double *sum)
{
  if (guess > 0)
    integrals_of_iteration(step, data, memory, sum);
  else
    integrals_along(step, newton_in(workspace).z, sum);
}
#endif
