/* Trial of an adaptive step of a system with few coordinates. Requires: step_size_levels.h, observed_error.h; attempt of a
 * solver, which tries a step. */
#define DOUBTS SHORT_STEPS_FAIL

/* Data shared by the trials of a step. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  error_limits limits;
  real t_end, error, dq[2 * M], dp[2 * M]; /* increments, then their low words */
  real apart; /* error estimate by two half steps, in the measure of `error`; 0 if they were not computed */
  long long guess, grid_level; /* level of the step size */
  long long change; /* of the level, from the previous step to this */
  real length; /* step size; 0 before the first trial */
  int last; /* 1 if the step ends at t_end */
} trial;

/* Performs one trial of the next step: its increments and the error estimate of the curve if it exceeds `least`,
 * infinite if the step failed. */
HOT void try_step(run_memory *run, trial *now, real least, const solver_options *options, solver_report *report)
{
  const real rest = (now->t_end - now->at.t) - now->at.t_low;
  real h;
  if (now->length == 0 || now->grid_level != run->grid_level) {
    now->grid_level = run->grid_level;
    now->length = size_of_level(run->grid_level);
  }
  h = next_size(now->length, rest, &now->last);
  report->t = now->step.t = now->at.t;
  if (now->last || now->step.h != h) {
    now->step.h = h;
    prepare(&now->step, &now->data);
  }
  now->error = attempt(run, &now->step, &now->data, now->last, &now->guess, now->dq, now->dp, now->limits.decay, least,
      options, report);
}

/* Returns 1 if the momenta change by a small part of the largest one, as they do where nonsmooth forces shorten a
 * step. */
static SELDOM int changes_little(const run_memory *run, const trial *now)
{
  real change = 0, size = 0;
  (void)run;
  for (int i = 0; i < M; i++) {
    change = larger(change, MATH(fabs)(now->dp[i]));
    size = larger(size, MATH(fabs)(now->at.p[i]));
  }
  return change < SMALL_PART * size;
}

/* Compares a trial with two half steps, in momenta too if requested. */
static inline int compare_trial(run_memory *run, trial *now, int momenta, const solver_options *options, real *apart)
{
  (void)run;
  return compare_with_halves(&now->step, now->dq, momenta ? now->dp : NULL, options, apart);
}
