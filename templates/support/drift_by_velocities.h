/* Drift of splitting methods with velocities v(p, t): dq += h part v. Requires: step.h, the kernel drift_velocity. */
typedef struct {
  int unused;
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  (void)step;
  data->unused = 0;
}

/* Advances the positions by a part of the step with the momenta p0 + dp. */
static inline void drift(const step_data *step, const solver_data *data, real part, const real *dp, real *dq)
{
  real p[M], v[M];
  (void)data;
  for (int i = 0; i < M; i++)
    p[i] = step->p0[i] + (step->carry_p[i] + dp[i]);
  drift_velocity(p, step->t, step->parameters, v);
  for (int i = 0; i < M; i++)
    dq[i] += step->h * part * v[i];
}
