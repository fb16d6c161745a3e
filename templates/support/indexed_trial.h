/* Trial of an adaptive step of an indexed system. Requires: rungs.h, ladder_tables.h, indexed_step.h. */
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
  double t_end, error;
  int last; /* 1 if the step ends at t_end */
} trial;

/* Performs one trial of the next step: its curve and error estimate, infinite if it failed. */
static void try_step(run_memory *run, trial *now, double least, const solver_options *options, solver_report *report)
{
  struct guess_tables tables = {NULL, NULL, NULL};
  (void)least;
  run->h = next_length(length_of(run->rung), (now->t_end - now->at.t) - now->at.t_low, &now->last);
  report->t = now->at.t;
  now->guess = now->last || !choose_tables(run, &tables) ? 0 : run->guess;
  if (solve(run, now->given, now->n, &tables, &now->guess, now->limits.decay, &now->error,
          options, report) != OK)
    now->error = INFINITY;
}
