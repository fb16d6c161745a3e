/* Vectors over steps that sweeps solve, STEPS_AT_ONCE at a time: first these, each continued from the one before, then
 * the vectors, in either direction. Before it: carry_by_newton.h, which takes all of them where sweeps fail on one; a
 * sweep, and how its steps change: keep_step, slopes_of_step, push_swept, pull_swept. */

static double *kept_of(const carriage *over, long long k)
{
  return over->workspace + LINEARISED + k * KEPT_OF_STEP;
}

/* The increments by sweeps continued from the steps before, or afresh. */
static int solve_by_sweeps(carriage *over, const step_data *step, const sweep_data *data, double *dq, double *dp)
{
  for (int tries = over->guess > 0 ? 2 : 1; tries > 0; tries--) {
    if (sweep(step, data, over->workspace + SCRATCH, &over->guess, dq, dp, over->options, over->report) == OK)
      return 1;
    over->guess = 0;
  }
  return 0;
}

/* Solves these steps; 0 if sweeps do not solve one of them. */
static int solve_steps(carriage *over, long long first, long long end)
{
  const double nothing[M] = {0.0};
  for (long long k = first; k < end; k++) {
    const step_data step = step_of(over, k, nothing);
    double dq[2 * M] = {0.0}, dp[2 * M] = {0.0}; /* increments, then their low parts */
    sweep_data data;
    prepare_sweep(&step, &data);
    over->report->t = step.t;
    if (!solve_by_sweeps(over, &step, &data, dq, dp))
      return 0;
    for (int i = 0; over->q1 && i < M; i++) {
      over->q1[k * M + i] = step.q0[i] + (dq[i] + dq[M + i]);
      over->p1[k * M + i] = step.p0[i] + (dp[i] + dp[M + i]);
    }
    keep_step(&step, &data, over->workspace + SCRATCH, dq, dp, kept_of(over, k - first));
  }
  return 1;
}

/* Over a solved step, vector by vector; how many were carried until sweeps came to no end. */
static int carry_by_sweeps(carriage *over, long long k, const double *kept)
{
  const double nothing[M] = {0.0}, *from = vectors_from(over, k);
  const step_data step = step_of(over, k, nothing);
  double *to = vectors_to(over, k);
  sweep_data data;
  swept_step at;
  prepare_sweep(&step, &data);
  slopes_of_step(&step, &data, kept, &at);
  for (int j = 0; j < over->count; j++) {
    double v[GIVEN];
    memcpy(v, from + j * GIVEN, sizeof v);
    if ((over->back ? pull_swept : push_swept)(&at, v, &over->look) != OK)
      return j;
    for (int i = 0; i < GIVEN; i++)
      to[j * GIVEN + i] += v[i];
  }
  return over->count;
}

/* Over the steps from the first until before `end`. */
static int carry_steps(carriage *over, long long first, long long end)
{
  int swept, status = OK;
  over->guess = over->back ? 0 : over->guess;
  swept = solve_steps(over, first, end);
  for (long long done = 0; status == OK && done < end - first; done++) {
    const long long k = over->back ? end - 1 - done : first + done;
    const int carried = swept ? carry_by_sweeps(over, k, kept_of(over, k - first)) : 0;
    if (carried < over->count)
      status = carry_by_newton(over, k, carried);
    else if (!all_finite(vectors_to(over, k), over->count * GIVEN))
      status = NOT_FINITE;
    over->report->steps += status == OK;
  }
  return status;
}
