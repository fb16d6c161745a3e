/* Integrals along the step that was solved, by sweeps or by Newton's iteration, which leaves no guess but its unknowns.
 * Before it: integrals_of_sweep, integrals_along, newton.h. */
static void integrals(const step_data *step, const solver_data *data, const double *memory, long long guess,
    double *workspace, double *sum)
{
  if (guess > 0)
    integrals_of_sweep(step, data, memory, sum);
  else
    integrals_along(step, newton_in(workspace).z, sum);
}
