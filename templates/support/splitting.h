/* A step by kicks of h KICK[n] L_q and drifts of h DRIFT[n] M^-1 p between them. Before it: step.h, KICKS, the tables,
 * KICK_ABSCISSA, and the kernels force and mass. */
typedef struct {
  real inverse_mass[M];
} solver_data;

static void prepare(const step_data *step, solver_data *data)
{
  mass(NULL, step->t, step->parameters, data->inverse_mass);
  for (int i = 0; i < M; i++)
    data->inverse_mass[i] = 1 / data->inverse_mass[i];
}

/* The increments of one step; memory keeps the last force, which is the first of the next step. */
static int solve(const step_data *step, const solver_data *data, real *memory, long long *guess, real *dq, real *dp,
    const solver_options *options, solver_report *report, real *workspace)
{
  real F[M], u[M];
  (void)options;
  (void)workspace;
  memset(dq, 0, sizeof(real) * M);
  memset(dp, 0, sizeof(real) * M);
  for (int n = 0;; n++) {
    for (int i = 0; i < M; i++)
      u[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    if (n == 0 && *guess)
      memcpy(F, memory, sizeof F);
    else
      force(u, step->t + KICK_ABSCISSA[n] * step->h, step->parameters, F);
    for (int i = 0; i < M; i++)
      dp[i] += step->h * KICK[n] * F[i];
    if (n == KICKS - 1)
      break;
    for (int i = 0; i < M; i++)
      dq[i] += step->h * DRIFT[n] * data->inverse_mass[i] * (step->p0[i] + (step->carry_p[i] + dp[i]));
  }
  report->iterations++;
  memcpy(memory, F, sizeof F);
  *guess = 1;
  return OK;
}
