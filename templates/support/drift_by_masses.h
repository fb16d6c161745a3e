/* Drift of splitting methods with constant masses: dq += h part M^-1 p. Requires: step.h, the kernel mass. */
typedef struct {
  real inverse_mass[M];
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  mass(NULL, step->t, step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1 / data->inverse_mass[i];
}

/* Advances the positions by a part of the step with the momenta p0 + dp. */
static inline void drift(const step_data *step, const solver_data *data, real part, const real *dp, real *dq)
{
  for (int i = 0; i < M; i++)
    dq[i] += step->h * part * data->inverse_mass[i] * (step->p0[i] + (step->carry_p[i] + dp[i]));
}
