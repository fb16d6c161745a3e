/* Trial of an adaptive step of an indexed system. Requires: step_size_levels.h, predictor_tables.h, indexed_step.h;
 * DOUBTS. */
#define HOT static
#define SHORT_STEPS_FAIL 1 /* their changes are relative to velocities that may be little more than rounding */

/* Data shared by the trials of a step. */
typedef struct {
  const problem *given;
  long long n, guess, change; /* change: of the step-size level, from the previous step */
  struct {
    double t, t_low;
  } at;
  error_limits limits;
  double t_end, error, apart; /* apart: error estimate by two half steps; 0 if they were not computed */
  int last; /* 1 if the step ends at t_end */
} trial;

/* Performs one trial of the next step: its curve and error estimate, infinite if it failed. */
static void try_step(run_memory *run, trial *now, double least, const solver_options *options, solver_report *report)
{
  struct predictor_tables_of tables = {NULL, NULL, NULL};
  (void)least;
  run->h = next_size(size_of_level(run->grid_level), (now->t_end - now->at.t) - now->at.t_low, &now->last);
  report->t = now->at.t;
  now->guess = now->last || !choose_tables(run, &tables) ? 0 : run->guess;
  if (solve(run, now->given, now->n, &tables, &now->guess, now->limits.decay, &now->error,
          options, report) != OK)
    now->error = INFINITY;
}

/* Returns 1 if the solved step changes the momenta by a small part of the largest one. */
static SELDOM int changes_little(run_memory *run, const trial *step)
{
  const long long n = step->n;
  const state_at_start kept = state_in(run, n), now = {run->q, run->p, run->carry_q, run->carry_p, NULL, NULL, NULL};
  const numbers p = momenta_of(run, &kept);
  const section own = mine(run, n);
  sums all;
  copy_state(&now, &kept, own);
  continue_steps(run, n);
  begin_sums(&all, run, n);
  while (next_block(&all)) {
    double change = 0.0, size = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      change = larger(change, fabs(increment_of(&p, i)));
      size = larger(size, fabs(p.start[i]));
    }
    add_block(&all, change, size);
  }
  wait_at_barrier(run);
  copy_state(&kept, &now, own);
  return largest_of(&all, 0) < SMALL_PART * largest_of(&all, 1);
}

/* Compares a trial with two half steps, in momenta too if requested, and solves it again. */
static SELDOM int compare_trial(run_memory *run, trial *now, int momenta, const solver_options *options, double *apart)
{
  const double error = now->error;
  solver_report unread = {0};
  const int status = compare_with_halves(run, now->given, now->n, momenta, options, apart);
  try_step(run, now, 0, options, &unread);
  if (status == OK && !(now->error < INFINITY))
    return STATUS(SPURIOUS_SOLUTION);
  now->error = error;
  return status;
}
