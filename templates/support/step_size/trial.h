#ifndef SUPPORT_TRIAL_H
#define SUPPORT_TRIAL_H

/* Trial of an adaptive step of arrays (ARRAYS) or of named coordinates, by fixed-point iteration or by Newton's
 * method (NEWTON_ALONE). */
#ifdef ARRAYS
/* Trial of an adaptive step of an array system. Requires: step_size_levels.h, predictor_tables.h, array_step.h;
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
#else

#ifdef NEWTON_ALONE
/* Trial of an adaptive step by Newton's method. Requires: run.h, newton_solver.h, stage_error.h. Include before
 * step_size_levels.h. */
#define HOT static
#define SHORT_STEPS_FAIL 0

static inline real smaller(real a, real b)
{
  return a < b ? a : b;
}

/* Computes the increments; returns the error estimate of the curve if it exceeds `least`, or infinity if the step
 * failed. afresh: without the predictor, which requires the step size of the previous step. */
static real attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess, real *dq,
    real *dp, real decay, real least, const solver_options *options, solver_report *report)
{
  *guess = !afresh && run->change == 0 && run->guess > 0;
  if (solve(step, data, run->memory, guess, dq, dp, options, report, step->scratch + SCRATCH) != OK)
    return INFINITY;
  *guess = 1;
  return stage_error(step, run->memory, dq, EACH, decay, least);
}
#else
/* Trial of an adaptive step by fixed-point iteration. Requires: run.h, curve_error.h, step_size_levels.h,
 * predictor_tables.h. */
#define SHORT_STEPS_FAIL 1 /* their changes are relative to velocities that may be little more than rounding */

/* Computes the increments; returns the error estimate of the curve if it exceeds `least`, or infinity if the step
 * failed. afresh: without the predictor. */
static inline double attempt(run_memory *run, step_data *step, const solver_data *data, int afresh, long long *guess,
    double *dq, double *dp, double decay, double least, const solver_options *options, solver_report *report)
{
  struct predictor_tables_of tables = {NULL, NULL, NULL};
  int status;
  step->tables = &tables;
  *guess = afresh || !choose_tables(run, &tables) ? 0 : run->guess;
  status = fixed_point(step, data, run->memory, guess, dq, dp, options, report);
  step->tables = NULL;
  if (status != OK)
    return INFINITY;
  return curve_error(step, data, run->memory, dq, EACH, decay, least);
}
#endif

/* Trial of an adaptive step of a system with few coordinates. Requires: step_size_levels.h, observed_error.h; attempt
 * of a solver, which tries a step. */
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
#endif

#endif
