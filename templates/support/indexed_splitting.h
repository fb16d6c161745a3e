/* A step of any number of coordinates by kicks of h KICK[n] F, each followed by a drift of h DRIFT[n] v. Before it:
 * increments.h, add_forces, LEAPS, CHUNK, the tables. */

/* The parts of work: where forces are taken, forces at the end of a step, increments of positions and momenta. */
typedef struct {
  double *X, *F, *dq, *dp;
} parts_of_work;

/* Increments by a drift, and where they lead. */
static void drift_by(double by, const double *restrict inverse_mass, const double *restrict p,
    const double *restrict dp, const double *restrict q, double *restrict dq, double *restrict X, long long n)
{
  for (long long i = 0; i < n; i++) {
    dq[i] += by * (inverse_mass[i] * (p[i] + dp[i]));
    X[i] = q[i] + dq[i];
  }
}

static int all_sums_finite(const double *x, const double *y, long long n)
{
  int faults = 0;
  for (long long i = 0; i < n; i++)
    faults |= 0.0 * (x[i] + y[i]) != 0.0;
  return !faults;
}

/* Whether the last kick of a step is at its end: its forces are those of the first of the next. */
static int ends_with_a_kick(void)
{
  return KICK[0] != 0.0 && KICK[LEAPS - 1] != 0.0 && DRIFT[LEAPS - 1] == 0.0;
}

/* Increments begin with what rounding cut off the state. */
static int take_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  double *work = run->work;
  const parts_of_work parts = {work, work + n, work + 2 * n, work + 3 * n};
  (void)options;
  memcpy(parts.dq, run->carry_q, sizeof(double) * (size_t)n);
  memcpy(parts.dp, run->carry_p, sizeof(double) * (size_t)n);
  drift_by(0.0, run->inverse_mass, run->p, parts.dp, run->q, parts.dq, parts.X, n);
  for (int k = 0; k < LEAPS; k++) {
    const double kick = run->h * KICK[k], t = run->t + KICK_ABSCISSA[k] * run->h;
    if (kick != 0.0 && k == 0 && run->guess)
      add_to(parts.dp, parts.F, kick, n);
    else if (kick != 0.0 && k == LEAPS - 1 && ends_with_a_kick()) {
      memset(parts.F, 0, sizeof(double) * (size_t)n);
      add_forces(given, parts.X, t, 1.0, parts.F);
      add_to(parts.dp, parts.F, kick, n);
    } else if (kick != 0.0)
      add_forces(given, parts.X, t, kick, parts.dp);
    if (DRIFT[k] != 0.0)
      drift_by(run->h * DRIFT[k], run->inverse_mass, run->p, parts.dp, run->q, parts.dq, parts.X, n);
  }
  report->iterations++;
  run->error = NAN;
  if (!all_sums_finite(run->q, parts.dq, n) || !all_sums_finite(run->p, parts.dp, n)) {
    run->guess = 0; /* the forces that are kept are those of no state */
    return NOT_FINITE;
  }
  add_all(run->q, parts.dq, run->carry_q, n);
  add_all(run->p, parts.dp, run->carry_p, n);
  run->guess = ends_with_a_kick();
  return OK;
}
