#ifndef SUPPORT_ARRAY_STEP_H
#define SUPPORT_ARRAY_STEP_H

/* Comparison of a step of arrays with two steps of half its size, as in observed_error.h. The half steps are solved in
 * place, so that F of the step is lost; forces of former steps are preserved. Requires: sizes.h, HALVES_VECTORS, solve
 * and continue_steps of a solver. */

/* Last parts of work: the state at the start of a step; increments of positions by the step, and by its first half;
 * increments of momenta by the step. */
typedef struct {
  double *q, *p, *carry_q, *carry_p, *whole, *first, *whole_p;
} state_at_start;

static state_at_start state_in(const run_memory *run, long long n)
{
  double *work = run->work + (STATUS(WORK) - HALVES_VECTORS) * n;
  const state_at_start kept = {work, work + n, work + 2 * n, work + 3 * n, work + 4 * n, work + 5 * n,
      work + 6 * n};
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

/* Positions, or momenta, now and at the start of a step, and their increments by the step. */
typedef struct {
  const double *now, *carry, *start, *start_carry;
  double *whole;
} numbers;

static numbers vectors_of_state(const run_memory *run, const state_at_start *kept)
{
  const numbers of = {run->q, run->carry_q, kept->q, kept->carry_q, kept->whole};
  return of;
}

static numbers momenta_of(const run_memory *run, const state_at_start *kept)
{
  const numbers of = {run->p, run->carry_p, kept->p, kept->carry_p, kept->whole_p};
  return of;
}

static inline double increment_of(const numbers *x, long long i)
{
  return (x->now[i] - x->start[i]) + (x->carry[i] - x->start_carry[i]);
}

static void note_increments(const numbers *x, double *increments, section own)
{
  for (long long i = own.first; i < own.end; i++)
    increments[i] = increment_of(x, i);
}

/* Performs a step without a predictor. */
static int make_part(run_memory *run, const problem *given, long long n, const solver_options *options)
{
  const struct predictor_tables_of tables = {NULL, NULL, NULL};
  solver_report report = {0};
  long long guess = 0;
  double error;
  const int status = solve(run, given, n, &tables, &guess, 0.0, &error, options, &report);
  if (status != OK)
    return status;
  continue_steps(run, n);
  add_compensated(&run->t, &run->t_low, run->h, 0.0);
  return OK;
}

/* Performs two steps of h/2; stores the increments of the first. */
static int make_halves(run_memory *run, const problem *given, long long n, double h, const state_at_start *kept,
    const solver_options *options)
{
  numbers positions;
  int status;
  run->h = h / 2;
  status = make_part(run, given, n, options);
  if (status != OK)
    return status;
  positions = vectors_of_state(run, kept);
  note_increments(&positions, kept->first, mine(run, n));
  return make_part(run, given, n, options);
}

/* Largest difference of the increments relative to the state after the half steps; 0 if it may be rounding. */
static double difference(const run_memory *run, const numbers *x, long long n)
{
  double largest, most;
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double of_block = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++)
      of_block = larger(of_block, fabs(x->start[i]) + fabs(increment_of(x, i)));
    add_block(&all, of_block, 0.0);
  }
  wait_at_barrier(run);
  largest = largest_of(&all, 0) + DBL_MIN;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double of_block = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const double increment = increment_of(x, i), size = fabs(x->start[i]) + fabs(increment) + largest;
      const double apart = fabs(x->whole[i] - increment) / size;
      if (!(apart <= of_block))
        of_block = apart < INFINITY ? apart : INFINITY;
    }
    add_block(&all, of_block, 0.0);
  }
  wait_at_barrier(run);
  most = largest_of(&all, 0);
  return most > ROUNDING_OF_HALVES ? most : 0.0;
}

/* Computes the error of the solved step as in observed_error.h, of momenta too if requested; state and time are
 * restored. */
static SELDOM int compare_with_halves(run_memory *run, const problem *given, long long n, int momenta,
    const solver_options *options, double *error)
{
  const state_at_start kept = state_in(run, n), now = {run->q, run->p, run->carry_q, run->carry_p, NULL, NULL, NULL};
  const numbers q = vectors_of_state(run, &kept), p = momenta_of(run, &kept);
  const section own = mine(run, n);
  const double whole = run->h, t = run->t, t_low = run->t_low;
  const long long uneven = run->uneven;
  double before = -1.0, h = whole;
  int status = OK, go = 1;
  copy_state(&now, &kept, own);
  continue_steps(run, n);
  note_increments(&q, kept.whole, own);
  note_increments(&p, kept.whole_p, own);
  *error = 0.0;
  for (int k = 0; go && k < MOST_HALVINGS; k++) {
    double apart = INFINITY;
    copy_state(&kept, &now, own);
    if (make_halves(run, given, n, h, &kept, options) == OK)
      apart = difference(run, &q, n);
    if (momenta && k == 0 && apart < INFINITY)
      *error = difference(run, &p, n);
    *error = larger(*error, apart);
    if (!(apart <= GROSS_DIFFERENCE))
      status = STATUS(SPURIOUS_SOLUTION);
    go = status == OK && apart > RESOLVED_STEP && apart > before;
    before = apart;
    memcpy(kept.whole + own.first, kept.first + own.first, sizeof(double) * (size_t)(own.end - own.first));
    h /= 2;
    run->t = t, run->t_low = t_low;
  }
  copy_state(&kept, &now, own);
  run->h = whole;
  run->uneven = uneven;
  return status;
}

/* Step of an array system with a solver: error estimate, comparison with half steps, update of the state. Requires:
 * solve, continue_steps; tables LAST_ALONE, LAST, BEFORE; curve_error.h, sizes.h. */

/* Largest coordinate and largest momentum. */
static void find_size(const run_memory *run, long long n, double *q, double *p)
{
  sums all;
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double of_q = 0.0, of_p = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      of_q = larger(of_q, fabs(run->q[i]));
      of_p = larger(of_p, fabs(run->p[i]));
    }
    add_block(&all, of_q, of_p);
  }
  wait_at_barrier(run);
  *q = largest_of(&all, 0);
  *p = largest_of(&all, 1);
}

/* Advances the state to the end of the step; records its error and the number of steps for the next predictor. */
static void accept(run_memory *run, long long n, double error, long long guess)
{
  const int sized = is_sized(run), worse = is_worse(run, error);
  double start, start_p, q, p;
  if (sized || worse)
    find_size(run, n, &start, &start_p);
  continue_steps(run, n);
  if (sized || worse) {
    find_size(run, n, &q, &p);
    q = larger(start, q);
    p = larger(start_p, p);
  }
  if (sized)
    note_size(run, start, q, p);
  if (worse)
    note_error(run, run->t, error, q, p);
  run->guess = guess;
  run->turn = (run->turn + 1) % 3;
}

/* Returns 1 if a step is compared with its half steps: the first of a run, one of COMPARED later, and those whose error
 * estimate is clearly the largest so far. */
static inline int is_compared(const run_memory *run, double error)
{
  return ERROR_POWER > 0.0 && (run->step % COMPARED == 0 || error > DOUBTFUL * run->error);
}

/* Replaces the error estimate by the difference from the half steps if that is larger. If the half steps have no
 * solution, the step fails unless its estimate is at round-off level. */
static SELDOM int compare(run_memory *run, const problem *given, long long n, const solver_options *options,
    double *error)
{
  double apart;
  const int status = compare_with_halves(run, given, n, 0, options, &apart);
  if (status == OK)
    *error = larger(*error, pow(apart, 1 / ERROR_POWER));
  return status != OK && pow(*error, ERROR_POWER) < ROUNDOFF_LEVEL ? OK : status;
}

/* Performs a step of the same size as the previous one. */
static int take_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  const struct predictor_tables_of tables = {LAST_ALONE, LAST, BEFORE};
  const double decay = now_and_then(run);
  long long guess = run->guess;
  double error, again;
  int status = solve(run, given, n, &tables, &guess, decay, &error, options, report);
  if (status == OK && is_compared(run, error)) {
    solver_report unread = {0};
    status = compare(run, given, n, options, &error);
    guess = run->guess;
    if (status == OK)
      status = solve(run, given, n, &tables, &guess, decay, &again, options, &unread);
    run->guess = status == OK ? run->guess : 0;
  }
  if (status == OK)
    accept(run, n, error, guess);
  return status;
}

#endif
