/* Momentum at the end of a curve by the Legendre transform of the velocity there; the initial velocity is known.
 * Requires: curve.h. */
typedef struct {
  int unused;
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  (void)step;
  data->unused = 0;
}

static inline double correct_start(const step_data *step, const iteration_data *data, const lanes *mass,
    const double *inverse_size, curve_data *curve)
{
  (void)step, (void)data, (void)mass, (void)inverse_size, (void)curve;
  return 0.0;
}

/* p1 - p0, with p1 the momentum at the end of a curve with the increment dq; NaN if it is undefined. */
static void momentum_increment(const step_data *step, const iteration_data *data, const curve_data *curve,
    const double *dq,
    double *dp)
{
  double u[2 * M];
  (void)data;
  for (int i = 0; i < M; i++) {
    u[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    u[M + i] = end_velocity(curve, i);
  }
  if (NAME(momentum)(step->t + step->h, u, u + M, step->parameters, dp, step->scratch) != OK)
    for (int i = 0; i < M; i++)
      dp[i] = NAN;
  for (int i = 0; i < M; i++)
    dp[i] = (dp[i] - step->p0[i]) - step->carry_p[i];
}
