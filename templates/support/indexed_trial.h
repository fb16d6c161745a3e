/* A trial of a step of any number of coordinates. Before it: rungs.h, ladder_tables.h, indexed_step.h. */
#define HOT static
#define SHORT_STEPS_FAIL 1 /* their changes are held against velocities that are hardly more than rounding */

/* What the trials of a step share. */
typedef struct {
  const problem *given;
  long long n, guess, change; /* the last: of rungs, from the step before */
  struct {
    double t, t_low;
  } at;
  error_limits limits;
  double t_end, error;
  int last; /* whether the step ends at t_end */
} trial;

/* One trial of the step that the run is at: its curve, and what that leaves unresolved; infinity without one. */
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
