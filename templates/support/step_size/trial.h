#ifndef SUPPORT_TRIAL_H
#define SUPPORT_TRIAL_H

#include "observed_error.h"
#include "step_size_levels.h"

/* Trial of an adaptive step, by fixed-point iteration or by Newton's method (NEWTON_ALONE; for arrays
 * NEWTON_KRYLOV). */
#ifdef ARRAYS
#define SHARE_OF_TRIAL ALL

/* State of a run: vectors of the caller. */
typedef struct {
  double t, t_low, *q, *p, *carry_q, *carry_p;
} state;
#else
#include "../run/run.h"

#define SHARE_OF_TRIAL EACH
#endif

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
/* Trial of an adaptive step by fixed-point iteration. Requires: run.h or array_step.h, curve_error.h,
 * step_size_levels.h, predictor_tables.h. */
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
#ifdef NEWTON_KRYLOV
  status = solve(step, data, STORED(run, step), guess, dq, dp, options, report, NULL);
#else
  status = fixed_point(step, data, STORED(run, step), guess, dq, dp, options, report);
#endif
  step->tables = NULL;
  if (status != OK)
    return INFINITY;
  return curve_error(step, data, STORED(run, step), dq, SHARE_OF_TRIAL, decay, least);
}
#endif

#ifdef NEWTON_KRYLOV
#define DOUBTS 0 /* steps may leave vibrations unresolved */
#else
#define DOUBTS SHORT_STEPS_FAIL
#endif

/* Data shared by the trials of a step. */
typedef struct {
  state at;
  step_data step;
  solver_data data;
  error_limits limits;
  real t_end, error;
#ifdef ARRAYS
  double *dq, *dp;
#else
  real dq[2 * M], dp[2 * M]; /* increments, then their low words */
#endif
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
static SELDOM int changes_little(const trial *now)
{
  const step_data *step = &now->step;
  sums all;
  begin_blocks(&all, step);
  EACH_BLOCK (all) {
    real change = 0, size = 0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      change = larger(change, MATH(fabs)(now->dp[i]));
      size = larger(size, MATH(fabs)(now->at.p[i]));
    }
    add_block(&all, change, size);
  }
  meet(step);
  return largest_over(&all, 0) < SMALL_PART * largest_over(&all, 1);
}

/* Compares a trial with two half steps, in momenta too if requested. */
static inline int compare_trial(const trial *now, int momenta, const solver_options *options, real *apart)
{
  return compare_with_halves(&now->step, now->dq, momenta ? now->dp : NULL, options, apart);
}

#endif
