/* Comparison of a step of an indexed system with two steps of half its size, as in halves.h. The half steps are solved
 * in place, so that F of the step is lost; forces of former steps are preserved. Requires: comparison.h,
 * HALVES_VECTORS, solve and go_on of a solver. */

/* Last parts of work: the state at the start of a step; increments of positions by the step, and by its first half. */
typedef struct {
  double *q, *p, *carry_q, *carry_p, *whole, *first;
} state_at_start;

static state_at_start state_in(const run_memory *run, long long n)
{
  double *work = run->work + (STATUS(WORK) - HALVES_VECTORS) * n;
  const state_at_start kept = {work, work + n, work + 2 * n, work + 3 * n, work + 4 * n, work + 5 * n};
  return kept;
}

/* Copies the coordinates of this thread. */
static void copy_state(const state_at_start *from, const state_at_start *to, section own)
{
  const size_t size = sizeof(double) * (size_t)(own.end - own.first);
  memcpy(to->q + own.first, from->q + own.first, size);
  memcpy(to->p + own.first, from->p + own.first, size);
  memcpy(to->carry_q + own.first, from->carry_q + own.first, size);
  memcpy(to->carry_p + own.first, from->carry_p + own.first, size);
}

static inline double increment_of(const run_memory *run, const state_at_start *kept, long long i)
{
  return (run->q[i] - kept->q[i]) + (run->carry_q[i] - kept->carry_q[i]);
}

static void note_increments(const run_memory *run, const state_at_start *kept, double *increments, section own)
{
  for (long long i = own.first; i < own.end; i++)
    increments[i] = increment_of(run, kept, i);
}

/* Performs a step without a predictor. */
static int make_part(run_memory *run, const problem *given, long long n, const solver_options *options)
{
  const struct guess_tables tables = {NULL, NULL, NULL};
  solver_report report = {0};
  long long guess = 0;
  double error;
  const int status = solve(run, given, n, &tables, &guess, 0.0, &error, options, &report);
  if (status != OK)
    return status;
  go_on(run, n);
  add_compensated(&run->t, &run->t_low, run->h, 0.0);
  return OK;
}

/* Performs two steps of h/2; stores the increments of the first. */
static int make_halves(run_memory *run, const problem *given, long long n, double h, const state_at_start *kept,
    const solver_options *options)
{
  int status;
  run->h = h / 2;
  status = make_part(run, given, n, options);
  if (status != OK)
    return status;
  note_increments(run, kept, kept->first, mine(run, n));
  return make_part(run, given, n, options);
}

/* Largest difference of the increments relative to the state after the half steps; 0 if it may be rounding. */
static double difference(const run_memory *run, const state_at_start *kept, long long n)
{
  double largest, most;
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double of_block = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++)
      of_block = larger(of_block, fabs(kept->q[i]) + fabs(increment_of(run, kept, i)));
    add_block(&all, of_block, 0.0);
  }
  wait_for_others(run);
  largest = largest_of(&all, 0) + DBL_MIN;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double of_block = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const double increment = increment_of(run, kept, i), size = fabs(kept->q[i]) + fabs(increment) + largest;
      const double apart = fabs(kept->whole[i] - increment) / size;
      if (!(apart <= of_block))
        of_block = apart < INFINITY ? apart : INFINITY;
    }
    add_block(&all, of_block, 0.0);
  }
  wait_for_others(run);
  most = largest_of(&all, 0);
  return most > ROUNDING_OF_HALVES ? most : 0.0;
}

/* Computes the error of the solved step as in halves.h; state and time are restored. */
static SELDOM int compare_with_halves(run_memory *run, const problem *given, long long n,
    const solver_options *options, double *error)
{
  const state_at_start kept = state_in(run, n), now = {run->q, run->p, run->carry_q, run->carry_p, NULL, NULL};
  const section own = mine(run, n);
  const double whole = run->h, t = run->t, t_low = run->t_low;
  double before = -1.0, h = whole;
  int status = OK, go = 1;
  copy_state(&now, &kept, own);
  go_on(run, n);
  note_increments(run, &kept, kept.whole, own);
  *error = 0.0;
  for (int k = 0; go && k < MOST_HALVINGS; k++) {
    double apart = INFINITY;
    copy_state(&kept, &now, own);
    if (make_halves(run, given, n, h, &kept, options) == OK)
      apart = difference(run, &kept, n);
    *error = larger(*error, apart);
    if (!(apart <= GROSS_DIFFERENCE))
      status = STATUS(STRAYED);
    go = status == OK && apart > RESOLVED_STEP && apart > before;
    before = apart;
    memcpy(kept.whole + own.first, kept.first + own.first, sizeof(double) * (size_t)(own.end - own.first));
    h /= 2;
    run->t = t, run->t_low = t_low;
  }
  copy_state(&kept, &now, own);
  run->h = whole;
  return status;
}
