/* Duration of a step of a time-transformed system, dt = g dtau: h is the step in tau, and time is the first integral
 * along the curve. Requires: a solver, integrals, the kernel integrands. */

/* Duration of the solved step; NaN if time does not increase. */
static real duration(const step_data *step, const solver_data *data, const real *memory, long long guess,
    real *workspace)
{
  real sum[INTEGRALS];
  integrals(step, data, memory, guess, workspace, sum);
  return sum[0] / step->h > 0 ? sum[0] : (real)NAN;
}

int NAME(rates)(long long count, const real *q, const real *p, const real *parameters, real *rate)
{
  for (long long k = 0; k < count; k++) {
    real u[3 * M] = {0}, value[INTEGRALS]; /* q, velocities (unused), p */
    memcpy(u, q + k * M, sizeof(real) * M);
    memcpy(u + 2 * M, p + k * M, sizeof(real) * M);
    integrands(u, 0, parameters, value);
    if (!all_finite(value, 1) || value[0] <= 0)
      return NOT_FINITE;
    rate[k] = value[0];
  }
  return OK;
}
