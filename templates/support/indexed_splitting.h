/* A step of any number of coordinates by kicks of h KICK[n] F, each followed by a drift of h DRIFT[n] v. Before it:
 * forces, LEAPS, the tables. */

/* The parts of work: where forces are taken, forces, increments of positions and momenta. */
static int take_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  double *X = run->work, *F = X + n, *dq = F + n, *dp = dq + n, faults = 0.0;
  (void)options;
  memset(dq, 0, sizeof(double) * 2 * (size_t)n);
  for (int k = 0; k < LEAPS; k++) {
    if (KICK[k] != 0.0) {
      for (long long i = 0; i < n; i++)
        X[i] = run->q[i] + (run->carry_q[i] + dq[i]);
      if (k > 0 || !run->guess)
        forces(given, X, run->t + KICK_ABSCISSA[k] * run->h, F, n);
      for (long long i = 0; i < n; i++)
        dp[i] += run->h * KICK[k] * F[i];
    }
    if (DRIFT[k] != 0.0)
      for (long long i = 0; i < n; i++)
        dq[i] += (run->h * DRIFT[k]) * (run->inverse_mass[i] * (run->p[i] + (run->carry_p[i] + dp[i])));
  }
  report->iterations++;
  for (long long i = 0; i < n; i++)
    faults += 0.0 * (run->q[i] + dq[i]) + 0.0 * (run->p[i] + dp[i]);
  run->error = NAN;
  if (faults != 0.0)
    return NOT_FINITE;
  for (long long i = 0; i < n; i++) {
    add_compensated(&run->q[i], &run->carry_q[i], dq[i], 0.0);
    add_compensated(&run->p[i], &run->carry_p[i], dp[i], 0.0);
  }
  run->guess = KICK[0] != 0.0 && KICK_ABSCISSA[LEAPS - 1] == 1.0 && KICK[LEAPS - 1] != 0.0;
  return OK;
}
