/* A step of any number of coordinates by kicks of h KICK[n] F, each followed by a drift of h DRIFT[n] v. Before it:
 * forces, LEAPS, the tables. */

/* The parts of work: where forces are taken, forces, increments of positions and momenta. */
typedef struct {
  double *X, *F, *dq, *dp;
} parts_of_work;

/* Momenta by a kick. */
static void kick_by(double by, const double *restrict F, double *restrict dp, long long n)
{
  for (long long i = 0; i < n; i++)
    dp[i] += by * F[i];
}

/* Positions by a drift. */
static void drift_by(double by, const double *restrict inverse_mass, const double *restrict p,
    const double *restrict carry_p, const double *restrict dp, double *restrict dq, long long n)
{
  for (long long i = 0; i < n; i++)
    dq[i] += by * (inverse_mass[i] * (p[i] + (carry_p[i] + dp[i])));
}

/* Where increments lead. */
static void move_by(const double *restrict q, const double *restrict carry_q, const double *restrict dq,
    double *restrict X, long long n)
{
  for (long long i = 0; i < n; i++)
    X[i] = q[i] + (carry_q[i] + dq[i]);
}

/* A kick by h KICK F, a drift by h DRIFT v, and where that leads, in portions that stay near the processor. */
static void leap(const run_memory *run, const parts_of_work *parts, double kick, double drift, long long n)
{
  for (long long i = 0; i < n; i += CHUNK) {
    const long long count = n - i < CHUNK ? n - i : CHUNK;
    kick_by(kick, parts->F + i, parts->dp + i, count);
    drift_by(drift, run->inverse_mass + i, run->p + i, run->carry_p + i, parts->dp + i, parts->dq + i, count);
    move_by(run->q + i, run->carry_q + i, parts->dq + i, parts->X + i, count);
  }
}

/* x + carry += increments; whether all are finite is asked before. */
static void add_all(double *restrict x, double *restrict carry, const double *restrict increment, long long n)
{
  for (long long i = 0; i < n; i++)
    add_compensated(&x[i], &carry[i], increment[i], 0.0);
}

static int all_finite_increments(const run_memory *run, const parts_of_work *parts, long long n)
{
  int faults = 0;
  for (long long i = 0; i < n; i++)
    faults |= (0.0 * (run->q[i] + parts->dq[i]) != 0.0) | (0.0 * (run->p[i] + parts->dp[i]) != 0.0);
  return !faults;
}

static int take_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  double *work = run->work;
  const parts_of_work parts = {work, work + n, work + 2 * n, work + 3 * n};
  (void)options;
  memset(parts.dq, 0, sizeof(double) * 2 * (size_t)n);
  for (int k = 0; k < LEAPS; k++) {
    if (KICK[k] != 0.0 && (k > 0 || !run->guess)) {
      if (k == 0)
        for (long long i = 0; i < n; i++)
          parts.X[i] = run->q[i] + run->carry_q[i];
      forces(given, parts.X, run->t + KICK_ABSCISSA[k] * run->h, parts.F, n);
    }
    leap(run, &parts, run->h * KICK[k], run->h * DRIFT[k], n);
  }
  report->iterations++;
  run->error = NAN;
  if (!all_finite_increments(run, &parts, n))
    return NOT_FINITE;
  add_all(run->q, run->carry_q, parts.dq, n);
  add_all(run->p, run->carry_p, parts.dp, n);
  run->guess = KICK[0] != 0.0 && KICK[LEAPS - 1] != 0.0 && DRIFT[LEAPS - 1] == 0.0;
  return OK;
}
