#include "observed_error.h"
#include "step_size_levels.h"

/* Adaptive steps: trials of a step until its error estimate is admissible (Hairer, Norsett & Wanner, Solving ODEs I,
 * sec. II.4), with comparisons with parts of it. The equations of a trial are solved by fixed-point iteration, by
 * Newton's method (NEWTON_ALONE) or, for arrays, by Newton-GMRES (NEWTON_KRYLOV). Requires: run.h or array_step.h,
 * and next_change of a step-size controller. */

#define ONE_COEFFICIENT (GROWTH < REAL(1.5)) /* of the curve, which vanishes where forces do */
#define ALLOWED_TO_PARTS (ONE_COEFFICIENT ? 1 : 100) /* admissible difference of parts, relative to the error
                                                      * estimate that is */
#define SPURIOUS REAL(1e-8) /* relative to the motion: spurious solutions of the equations differ by more */
#define MANY_ITERATIONS 10 /* of a step, after which the next one is not larger */
#define TOO_MANY_ITERATIONS 13 /* the next one is smaller: about ten iterations take the least time per unit of time */
#define TRUSTED_DECREASE (ONE_COEFFICIENT ? REAL(0.97) : 0) /* of the error by a step */
#define SMALL_PART REAL(0.1) /* of the largest momentum: smaller changes count as little */
#define NEVER_FAILED (1 << 16) /* level beyond all exponents of a number: the iteration failed at no size yet */
#define SHORT_PART REAL(0.125) /* of the time in which a state changes by its size, or of the span: early trial */
#ifdef COSTLY_POINTS
#define LEVELS_OUTSIDE MOST_UP /* by which the curve of a pilot is extrapolated */
#else
#define LEVELS_OUTSIDE 0
#endif
#define SHORT_LAST REAL(0.5) /* of the step before: a last step so short is made longer, and that one shorter */
#define AT_START (-NEVER_FAILED) /* trial->inside of the shortest one, whose increments are the rates at its start */
#define FAILURES_BEFORE_NEWTON 3 /* trials of a step in which the iteration of the multipliers fails */
#define TRIED_AGAIN (-1) /* run->avoiding of the step after those by Newton's method */
#define COST_OF_NEWTON (10LL * M * KEPT) /* of an update, in iterations: measured 1 to 10 times M KEPT */
#define UPDATES 4 /* of a step by Newton's method from a straight line */
#define LEAP 2 /* levels by which a free flight is larger than the step before */
#define PARTS_OF_LEAP 16
#define BEYOND_END REAL(0.125) /* of the step: part behind its end whose force is examined */
#define OTHER_FORCE REAL(0.5) /* relative difference beyond which another force sets in */
#define GROWTH_OF_TREND 2 /* of that of a force which goes on, from part to part: 1 of a straight one */
#define NO_FORCE REAL(1e-12) /* impulse relative to the largest momentum: coordinates that motion has not reached yet */
#define PARTS_OF_RUN 256 /* of the time that is left: a pulse between the points of a leap is seen by parts as short */

#ifdef ARRAYS
/* State of a run: vectors of the caller. */
typedef struct {
  double t, t_low, *q, *p, *carry_q, *carry_p;
} state;
#else
#include "../run/run.h"
#endif

/* Step-size control by default: errors of round-off size. */
step_control NAME(default_step_control)(void)
{
  return (step_control){.max_step = INFINITY};
}

#ifndef ARRAYS
#if !defined(NEWTON_ALONE) && !defined(NO_FALLBACK)
#define NEWTON_ADMITTED /* where the fixed-point iteration limits the steps */
#endif
#endif
#if defined(RATTLE) || defined(NEWTON_ADMITTED)
#define NEWTON_IN_PLACE /* of another iteration, in some steps */
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
  const step_control *control;
  long long largest_level; /* of the step sizes up to control->max_step */
  real t_end, error;
#ifdef ARRAYS
  double *dq, *dp;
#else
  real dq[2 * M], dp[2 * M]; /* increments, then their low words */
#endif
  real apart; /* error estimate by parts, in the measure of `error`; 0 if they were not computed */
  long long guess, grid_level; /* level of the step size */
  long long change; /* of the level, from the previous step to this */
  long long iterations; /* of the last trial */
#ifdef NEWTON_IN_PLACE
  long long fallbacks; /* 1 if Newton's method solved it */
#endif
#ifdef CONSTRAINED
  real pilots_above, pilot_error; /* longer trials than the former are pilots; estimate of the largest one solved */
#endif
  int status; /* other than OK if no smaller step can succeed */
  real length; /* step size; 0 before the first trial */
  real pilot; /* that of the largest trial so far, in the search for the first step, that was solved */
  int last; /* 1 if the step ends at t_end */
  int inside; /* levels above this one of a rejected step, whose curve is stored, or minus those below of a pilot; 0:
               * none */
#ifdef RATTLE
  int failures; /* trials of the step that failed */
#endif
#if defined(ERROR_GROWTH) || defined(MIXED_POINTS)
  POINTS_OF_STEP(points); /* of the last trial */
#endif
} trial;

/* Error estimate of the curve of a solved trial if it exceeds `least`. */
static inline real estimate(const run_memory *run, const trial *now, real least)
{
#ifdef NEWTON_ALONE
  return stage_error(&now->step, run->memory, now->dq, EACH, now->limits.decay, least, now->limits.most);
#else
  return curve_error(
      &now->step, &now->data, STORED(run, &now->step), now->dq, EACH, now->limits.decay, least, now->limits.most);
#endif
}

#ifdef NEWTON_ALONE
#define HOT static
#define AMPLIFIED 1e-14 /* last update beyond which unknowns do not resolve errors in two words */
#define SHORT_STEPS_FAIL 0

/* Returns 1 if the error grows as expected from that of a step shorter by `up` levels: that of fast vibrations, which
 * longer steps leave unresolved, does not. */
#define RISES(error, shorter, up) \
  ((error) > error_at(shorter, (up) / 2) && (error) < error_at(shorter, (up) + (up) / 2 + 1))
#define LEVELS_INSIDE 0 /* no predictor from a rejected step */

/* Returns 1 if the rounding of positions, by which rows of constraints and contacts are solved, is small beside the
 * displacement in a trial: shorter ones show nothing, since that rounding, divided by h, is a velocity. */
static int resolves_motion(const trial *now)
{
  real moved = 0, farthest = 0;
  for (int i = 0; i < M; i++) {
    moved = larger(moved, MATH(fabs)(now->dq[i]));
    farthest = larger(farthest, MATH(fabs)(now->step.q0[i]));
  }
  return SITES == M || rounding_of_displacement(farthest) <= SPURIOUS * moved;
}

/* Computes the increments; returns the error estimate of the curve if it exceeds `least`, or infinity if the step
 * failed. The predictor requires the step size of the previous step. */
static real attempt(run_memory *run, trial *now, real least, const solver_options *options, solver_report *report)
{
  step_data *const step = &now->step;
  real *const workspace = step->scratch + SCRATCH;
  now->guess = !now->last && run->change == 0 && run->guess > 0;
  if (solve(step, &now->data, run->memory, &now->guess, now->dq, now->dp, options, report, workspace) != OK)
    return INFINITY;
#ifdef DOUBLE_DOUBLE
  step->noise = report->change > AMPLIFIED ? report->change : 0;
  if (step->noise > 0) {
    real passed[2], both[2 * M], changes[2 * M];
    memcpy(both, now->dq, sizeof(real) * M), memcpy(changes, now->dp, sizeof(real) * M);
    if (refine_increments(step, run->memory, run->t_low, 0, both, changes, passed, workspace) != OK)
      return INFINITY;
  }
#endif
  now->guess = 1;
  return estimate(run, now, least);
}
#else
#ifdef ARRAYS
#define LEVELS_INSIDE 0 /* the stored curves are those of accepted steps */
#else
#define LEVELS_INSIDE INSIDE
#endif
#define SHORT_STEPS_FAIL 1 /* their changes are relative to velocities that may be little more than rounding */
#define resolves_motion(now) 1 /* else they do not end the search */
/* Errors rise, those of rounding do not, or from any to any size. */
#define RISES(error, shorter, up) ((error) > (shorter) && (error) < error_at(shorter, (up) + (up) / 2 + 1))

#ifdef COSTLY_POINTS
/* Table by Lagrange's formula, from the curve of a step to the points of another one, which begins at `begin` and takes
 * `ratio`, both in units of the former. */
static SELDOM void tabulate(double begin, double ratio, lanes *table)
{
  memset(table, 0, sizeof(lanes) * POINTS * GROUPS);
  for (int j = 0; j < KEPT; j++)
    for (int g = 0; g < GROUPS; g++) {
      lanes product = lanes_of(1.0);
      for (int k = 0; k < KEPT; k++)
        if (k != j)
          product *= (begin + ratio * ABSCISSA[g] - VECTOR_ENTRY(ABSCISSA, k)) /
              (VECTOR_ENTRY(ABSCISSA, j) - VECTOR_ENTRY(ABSCISSA, k));
      TABLE_ENTRY(table, g, j) = product;
    }
}

/* Table of the last step of a run, whose size is not on the grid, from the curve of the step before; or, if inside < 0,
 * of a trial in the search for the first step, from that of one that was shorter by -inside levels, of a much shorter
 * one from the velocity at the start. Returns 0 without a curve. */
static SELDOM int tables_off_grid(const run_memory *run, const step_data *step, int inside, lanes *table)
{
  const int begins_there = inside < 0;
  const long long level = run->grid_level + (begins_there ? inside : -run->change);
  if (!begins_there && run->guess <= 0)
    return 0;
  tabulate(begins_there ? 0.0 : 1.0, inside < -MOST_UP ? 0.0 : fabs(step->h) / size_of_level(level), table);
  return 1;
}

/* Increments of a very short step, and its curve, by the rates at the start; returns 0, or infinity from rest, where
 * they do not show how the motion begins. */
static SELDOM double step_by_rates(const step_data *step, history memory, double *dq, double *dp)
{
  lanes z[GROUPS][M], u[2 * M], rates[2 * M];
  double moved = 0.0;
  if (start_velocities(step, z) != OK)
    return INFINITY;
  for (int i = 0; i < M; i++)
    u[i] = lanes_of(step->q0[i]), u[M + i] = z[0][i];
  value_lanes(u, lanes_of(step->t), step->parameters, rates);
  for (int i = 0; i < M; i++) {
    dq[i] = step->h * at_first(&z[0][i]), dp[i] = step->h * at_first(&rates[i]);
    moved = larger(moved, fabs(dq[i]));
  }
  remember_curve(z, memory);
  return moved > 0.0 && reaches(step, dq, dp) ? 0.0 : INFINITY;
}
#endif

/* Computes the increments; returns the error estimate of the curve if it exceeds `least`, or infinity if the step
 * failed. The last step of a run has no predictor of the grid; rough: 1 without low words. */
static inline __attribute__((always_inline)) double attempt_at(run_memory *run, trial *now, double least,
    const solver_options *options, solver_report *report, int rough)
{
  struct predictor_tables_of tables = {NULL, NULL, NULL};
  step_data *const step = &now->step;
  const solver_data *const data = &now->data;
  const int afresh = now->last, inside = afresh ? 0 : now->inside;
  long long *const guess = &now->guess;
  int status;
#ifdef COSTLY_POINTS
  lanes table[POINTS * GROUPS];
  if (inside == AT_START)
    return step_by_rates(step, STORED(run, step), now->dq, now->dp);
#endif
  step->tables = &tables;
  if (inside > 0) {
    tables.alone = PREDICTOR_INSIDE[inside - 1];
    *guess = 1;
#ifdef COSTLY_POINTS
  } else if (afresh || inside < 0) {
    tables.alone = table;
    *guess = tables_off_grid(run, step, inside, table);
#endif
  } else
    *guess = afresh || run->guess < 0 || !choose_tables(run, &tables) ? 0 : run->guess;
#ifdef NEWTON_KRYLOV
  status = solve(step, data, STORED(run, step), guess, now->dq, now->dp, options, report, NULL);
#elif defined(ROUGH)
  status = adaptive_point(step, data, STORED(run, step), guess, now->dq, now->dp, options, report, rough);
#else
  status = fixed_point(step, data, STORED(run, step), guess, now->dq, now->dp, options, report);
#endif
  step->tables = NULL;
  if (inside != 0) /* the step before is no longer stored */
    *guess = 1;
  if (status != OK)
    return INFINITY;
#ifdef ARRAYS
  find_displacements(step, data, STORED(run, step), now->dq);
#endif
  step->noise = report->noise;
  return estimate(run, now, least);
}

/* Out of line, one copy compiles faster than two. Steps without low words have one of their own, so that others take no
 * longer. */
static __attribute__((noinline)) double attempt(run_memory *run, trial *now, double least,
    const solver_options *options, solver_report *report)
{
  return attempt_at(run, now, least, options, report, 0);
}

#ifdef ROUGH
static __attribute__((noinline)) double rough_attempt(run_memory *run, trial *now, double least,
    const solver_options *options, solver_report *report)
{
  return attempt_at(run, now, least, options, report, 1);
}
#endif
#endif

/* Returns 1 if Newton's method solved a trial, which then has no curve. */
static inline int by_newton(const trial *now)
{
#ifdef NEWTON_ADMITTED
  return now->fallbacks > 0;
#else
  return 0;
#endif
}

/* Lets V and A contain a solved trial. */
static inline void note_trial(run_memory *run, const trial *now)
{
#ifdef NEWTON_ALONE
  note_stages(run, &now->step, run->memory, now->dq);
#else
  note_curve(run, &now->step, &now->data, STORED(run, &now->step), now->dq, !by_newton(now));
#endif
}

#ifdef NEWTON_ADMITTED
/* A trial by Newton's method; returns the error estimate of its stages, converted to that of curves. */
static SELDOM double attempt_by_newton(trial *now, const solver_options *options, solver_report *report)
{
  double *workspace = now->step.scratch + SCRATCH, error;
  const error_measure measure = {EACH, now->limits.decay};
  const int status = fall_back(NOT_CONVERGED, &now->step, now->dq, now->dp, options, report, workspace, &measure);
  now->guess = 0;
  now->status = status > STATUS(SPURIOUS_SOLUTION) ? status : OK; /* Newton's method is not there */
  now->fallbacks = status == OK && reaches(&now->step, now->dq, now->dp);
  error = now->fallbacks ? fallback_error(&now->step, now->dq, workspace, &measure) : INFINITY;
  return error < INFINITY ? error : INFINITY;
}
#endif

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
  now->iterations = report->iterations;
  now->step.absolute = now->control->absolute_tolerance;
  report->t = now->step.t = now->at.t;
  if (now->last || now->step.h != h) {
    now->step.h = h;
    prepare(&now->step, &now->data);
  }
#ifdef CONSTRAINED
  solver_options few = *options;
  now->data.is_pilot = now->length > now->pilots_above;
  if (now->data.is_pilot && few.max_iterations > MANY_ITERATIONS)
    few.max_iterations = MANY_ITERATIONS;
  options = &few;
#endif
#ifdef RATTLE
  now->data.rattle_alone = run->avoiding >= 0;
  now->fallbacks = report->fallback_steps;
#endif
#ifdef NEWTON_ADMITTED
  now->fallbacks = 0;
  if (run->avoiding < TRIED_AGAIN) {
    now->error = larger(attempt_by_newton(now, options, report), least);
    now->iterations = report->iterations - now->iterations;
    return;
  }
#endif
#ifdef ROUGH
  now->error = (options->tolerance > ROUGH ? rough_attempt : attempt)(run, now, least, options, report);
#else
  now->error = attempt(run, now, least, options, report);
#endif
  now->iterations = report->iterations - now->iterations;
#ifdef RATTLE
  now->fallbacks = report->fallback_steps - now->fallbacks;
#endif
}

/* Returns 1 if the momenta change by a small part of the largest one, as they do where nonsmooth forces shorten a
 * step. */
static SELDOM int changes_little(const trial *now)
{
  real size;
  return largest_change(&now->step, now->at.p, now->dp, &size) < SMALL_PART * size;
}

/* Number of levels, at most `most`, by which the step size may be increased without exceeding the largest one. */
static inline int levels_within(const run_memory *run, const trial *now, int most)
{
  const long long left = now->largest_level - run->grid_level;
  return left < most ? (int)left : most;
}

/* Number of levels by which the first step may be increased at once. */
static int levels_up(const run_memory *run, const trial *now)
{
  const int most = levels_within(run, now, MOST_UP);
  real error = now->error;
  int up = 0;
  if (error < now->limits.fewer)
    for (; up < most && error * GROWTH <= now->limits.most; up++)
      error *= GROWTH;
  return up;
}

/* Levels by which the first trial, of size h, may be increased at once: to a part of the time in which positions or
 * momenta change by their size. Changes from rest or from the origin are of second order in time. */
static SELDOM int levels_of_first(const trial *now, real h, real span)
{
  real q, p, rate = 0, factor;
  int binades;
  const real dq = largest_change(&now->step, now->at.q, now->dq, &q);
  const real dp = largest_change(&now->step, now->at.p, now->dp, &p);
  if (q > 0)
    rate = larger(rate, dq / q);
  if (p > 0)
    rate = larger(rate, dp / p);
  if (!(q > 0 && p > 0))
    rate = MATH(sqrt)(rate);
  if (!(rate > 0 && rate < INFINITY && now->error < INFINITY))
    return 0;
  factor = SHORT_PART * (1 / rate < span / h ? 1 / rate : span / h);
  MATH(frexp)(factor, &binades);
  return binades > 1 ? (binades - 1) * LEVELS_PER_BINADE : 0;
}

/* A trial of the search for the first step size. V and A are those of the largest one that is solved: from rest a
 * displacement t^k with k above what the curve represents has a large error relative to itself at any step size, and
 * relative to V and A of a trial a little larger, so that each smaller one would be rejected, too. Where masses grow by
 * e^x in a step the weights of forces, relative to the momentum of an early point, do so, too: a trial of x >> 1 ends
 * far from any motion, and V of it would admit every error. */
static inline void try_pilot(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const int inside = now->inside;
  try_step(run, now, 0, options, report);
  now->inside = 0;
  if (!(now->error < INFINITY) && (inside == AT_START || (inside < 0 && inside >= -LEVELS_OUTSIDE)))
    try_step(run, now, 0, options, report);
  if (now->error < INFINITY && now->length > now->pilot && growth_of_step(&now->step, now->dq) <= 1) {
    now->pilot = now->length;
#ifdef CONSTRAINED
    now->pilot_error = now->error;
#endif
    begin_motion(run);
    note_trial(run, now);
  }
}

/* Determines the first step size by increasing one that is certainly too small. The smallest trials may fail, with
 * fixed-point iteration larger ones, too: if some velocities are zero, rounding dominates them. Or their error estimate
 * is only rounding, of any size; the estimate of a curve grows as expected. */
static SELDOM void try_first_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real span = MATH(fabs)(now->t_end - now->at.t);
  real shorter = INFINITY;
  int found = 0, up = 1, early;
  now->pilot = 0;
  if (run->avoiding == 0)
    run->failed = NEVER_FAILED;
  if (now->control->first_step) {
    run->grid_level = level_below(*now->control->first_step);
    run->grid_level += levels_within(run, now, 0);
    try_pilot(run, now, options, report);
    if (now->error < INFINITY)
      return;
  }
  run->grid_level = level_below(span * FIRST_STEP);
  run->grid_level += levels_within(run, now, 0);
  now->inside = LEVELS_OUTSIDE ? AT_START : 0;
  try_pilot(run, now, options, report);
  early = levels_within(run, now, levels_of_first(now, now->length, span));
  now->inside = LEVELS_OUTSIDE && now->error < INFINITY ? -early : 0;
  while (early > 0) {
    run->grid_level += early;
    try_pilot(run, now, options, report);
    if (levels_up(run, now) >= LEVELS_PER_BINADE)
      break;
    run->grid_level -= early;
    early -= early < 2 * MOST_UP ? early : MOST_UP;
    if (early == 0)
      try_pilot(run, now, options, report);
  }
  while (!now->last && up > 0) {
    const int failed = !(now->error < INFINITY), small = now->error <= now->limits.most;
    const int rises = failed ? !SHORT_STEPS_FAIL : RISES(now->error, shorter, up);
    found = found || (small && resolves_motion(now));
    up = small ? levels_up(run, now) : 0;
    if (SHORT_STEPS_FAIL && up > 0 && up < LEVELS_PER_BINADE) /* a further trial takes as long as a step */
      return;
    if (up == 0)
      up = found && rises ? 0 : levels_within(run, now, MOST_UP);
    shorter = now->error;
    run->grid_level += up;
    now->inside = up <= LEVELS_OUTSIDE && now->error < INFINITY ? -up : 0;
    if (up > 0)
      try_pilot(run, now, options, report);
  }
#ifdef RATTLE
  if (!found && run->avoiding >= 0) { /* the iteration of the multipliers converges at no size */
    run->avoiding = -AVOIDED;
    try_first_step(run, now, options, report);
  }
#endif
}

/* Levels from the step whose curve is stored down to the next trial, 0 without a predictor. A solved trial stored its
 * own; a failed one left that of the trial before. */
static inline int down_from_stored(const trial *now, int solved, int down)
{
  const int levels = solved ? down : now->inside > 0 ? now->inside + down
                                                     : 0;
  return levels <= LEVELS_INSIDE ? levels : 0;
}

/* Smallest step size relative to the time. Positions on constraints are rounded in each step, so that shorter ones
 * would not end: where a mechanism comes to a dead point, their errors are rounding errors of any size. */
#ifdef CONSTRAINED
#define SMALLEST_SHORTENED REAL_EPSILON
#else
#define SMALLEST_SHORTENED SMALLEST_RELATIVE_STEP
#endif

/* Reduces the step size after a failed or rejected trial, by 2 to `most` levels; returns 0 on step size underflow. */
static int shorten(run_memory *run, trial *now, int most)
{
  const int solved = now->error < INFINITY && now->length > 0 && !now->last;
  int down = 2;
  while (down < most && !(error_at(now->error, -down) <= now->limits.most))
    down++;
  now->inside = down_from_stored(now, solved, down);
  if (now->last && now->length > 0) /* shorter than its level */
    run->grid_level = level_below(MATH(fabs)(now->step.h));
  run->grid_level -= down;
  run->error_before = error_at(run->error_before, -down);
  run->guess = 0;
  run->rejected++;
  const real left = MATH(fabs)(now->t_end - now->at.t);
  return size_of_level(run->grid_level) > SMALLEST_SHORTENED * (MATH(fabs)(now->at.t) + REAL_EPSILON * left);
}

/* Excludes the size of a failed trial from the next steps. The iteration of the multipliers is cheaper at two smaller
 * steps than Newton's method at one, so its failure rejects a trial. Where it fails at any size, as near dead points of
 * a mechanism, Newton's method is admitted for some steps: run->avoiding is then minus their number. */
static SELDOM void avoid_size(run_memory *run, trial *now)
{
#ifdef NEWTON_ADMITTED
  if (run->avoiding < TRIED_AGAIN) /* not the iteration, but Newton's method failed */
    return;
#endif
  run->failed = run->grid_level;
  run->avoiding = AVOIDED;
#ifdef RATTLE
  if (++now->failures >= FAILURES_BEFORE_NEWTON)
    run->avoiding = -AVOIDED;
#endif
}

#ifdef NEWTON_ADMITTED
/* Returns 1 if a step that is larger by so many levels than the one before may have an admissible error: that of its
 * curve, which is still stored, grows to no more, or is rounding, or what the iteration leaves of its last update: its
 * tolerance, relative to the motion. Displacements are the largest so far. */
static SELDOM int may_grow(const run_memory *run, const trial *now, int levels)
{
  const real iterated = RESOLVED * ITERATION_PART * MATH(pow)(now->limits.most, ERROR_POWER);
  const real rounding = larger(limits_of(ROUNDOFF_ERROR).least, iterated), most = error_at(now->limits.most, -levels);
  step_data before = now->step;
  solver_data data = now->data;
  real moved[M];
  before.h = size_of_level(run->grid_level - run->change);
  prepare(&before, &data);
  for (int i = 0; i < M; i++)
    moved[i] = before.h * run->largest_v[i];
  return curve_error(&before, &data, STORED(run, &before), moved, EACH, now->limits.decay, 0, now->limits.most) <=
      GROWTH * larger(rounding, most);
}
#endif

#ifdef NEWTON_ADMITTED
/* Returns 1 if so many updates of a step by Newton's method take longer per unit of time than the iteration took. */
static inline int is_dear(const run_memory *run, long long updates)
{
  const real gain = size_of_level(run->grid_level) / size_of_level(run->failed);
  return (real)(updates * COST_OF_NEWTON) > MANY_ITERATIONS * gain;
}

/* Returns to the iteration and its size. */
static inline void leave_newton(run_memory *run)
{
  run->avoiding = 0;
  run->error_before = error_at(run->error_before, (int)(run->failed - run->grid_level));
  run->grid_level = run->failed;
}
#endif

/* Lets Newton's method solve the next steps, too, where the iteration, tried again, has no admissible one of the same
 * size, and leaves it where shorter ones take longer. Returns 1 after a trial. */
static inline int try_by_newton(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
#ifdef NEWTON_ADMITTED
  if (run->avoiding == TRIED_AGAIN) {
    run->avoiding = -AVOIDED;
    try_step(run, now, now->limits.least, options, report);
    return 1;
  }
  if (run->avoiding < TRIED_AGAIN && is_dear(run, UPDATES)) {
    leave_newton(run);
    try_step(run, now, now->limits.least, options, report);
    return 1;
  }
#endif
  return 0;
}

#ifdef CONSTRAINED
/* Ends the search for the first step: trials up to the largest pilot that was solved are steps. Errors grow with the
 * step size, so where that pilot's is inadmissible, shorter ones are tried at once, none between it and a failure. */
static SELDOM void end_pilots(run_memory *run, trial *now)
{
  now->pilots_above = now->pilot > 0 ? now->pilot : (real)INFINITY;
  if (now->pilot > 0 && !(now->error < INFINITY) && now->pilot_error > now->limits.most * GROWTH) {
    run->grid_level = level_below(now->pilot);
    now->error = now->pilot_error;
  }
}
#endif

/* Tries the next step with smaller and smaller sizes until its error is admissible, or STEP_SIZE_UNDERFLOW. */
HOT int find_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const real least = now->limits.least;
  now->change = run->change - run->grid_level;
  now->status = OK;
#ifdef RATTLE
  now->failures = 0;
#endif
#ifdef CONSTRAINED
  now->pilots_above = run->error_before > 0 ? (real)INFINITY : 0;
#endif
  if (run->error_before > 0)
    try_step(run, now, least, options, report);
  else {
    now->step.is_pilot = 1;
    try_first_step(run, now, options, report);
    now->step.is_pilot = 0;
    if (now->error < INFINITY && !by_newton(now))
      now->error = estimate(run, now, 0);
  }
#ifdef CONSTRAINED
  if (now->pilots_above == 0)
    end_pilots(run, now);
#endif
  while (now->status == OK && !(now->error <= now->limits.most * GROWTH)) {
    const int failed = run->error_before > 0 && !(now->error < INFINITY);
    if (try_by_newton(run, now, options, report))
      continue;
    if (failed)
      avoid_size(run, now);
    if (!shorten(run, now, failed ? DOWN_FAILED : MOST_DOWN))
      return STATUS(STEP_SIZE_UNDERFLOW);
    try_step(run, now, least, options, report);
  }
  now->error = larger(now->error, least);
  now->inside = 0;
  now->change += run->grid_level;
  return now->status;
}

/* Returns 1 for a free flight in doubt, as the error of its curve is rounding: one that is much larger than the step
 * before, or smaller, or after a step that was wrong. Estimates see forces only at the points of a step, and a wall or
 * a pulse may lie between them. */
static inline int is_leap(const run_memory *run, const trial *now)
{
  const int changes = run->step == 0 || now->change >= LEAP || now->change < 0;
  if (!(changes || run->steps_to_compare > 0) || now->error > now->limits.least)
    return 0;
  return by_newton(now) ? now->change >= LEVELS_PER_BINADE : estimate(run, now, 0) <= LEAST_UNRESOLVED;
}

/* Number of parts with which a leap is compared. */
static inline int parts_of_leap(const trial *now)
{
#ifdef LOCALISED_FORCES
  const real of_run = PARTS_OF_RUN * MATH(fabs)(now->step.h / (now->t_end - now->at.t));
  return of_run > PARTS_OF_LEAP ? (int)of_run : PARTS_OF_LEAP;
#else
  return PARTS_OF_LEAP;
#endif
}

/* Friction at a rate c ends the transient of a start at another velocity, by d, than the slow motion has, within 1/c,
 * and displaces by d/c. Gauss stages of h >> 1/c are those of the slow motion, while the velocity at the end keeps +-d
 * (Hairer & Wanner, Solving ODEs II, sec. IV.15): parts of about 1/c show both. */
#if defined(FRICTION) && defined(NEWTON_ALONE)
#define HAS_TRANSIENT(run) ((run)->error_before == 0)
#else
#define HAS_TRANSIENT(run) 0
#endif

/* Returns 1 if the momenta of a step are compared, too: after a step that was wrong, and where the step size fell by a
 * factor of two or more although the momenta change little. Near a singular time or a nonsmooth force the coefficients
 * of the curve do not decay and do not show its error; steps are then so short that the error is in the momenta. Not
 * for Newton's method, whose steps may leave vibrations of stiff systems unresolved. */
static inline int needs_momenta(const run_memory *run, const trial *now)
{
  const int shorter = now->change <= -LEVELS_PER_BINADE;
  return DOUBTS && !by_newton(now) && (run->steps_to_compare > 0 || (shorter && changes_little(now)));
}

/* Returns 1 if the force beyond the end of a flight is another one: a wall, or a force that sets in, may lie between
 * the last point of a step and the first of the next. The force of a smooth motion goes on as it changed before the
 * end: by as much from part to part, also where it passes zero. A smaller impulse than NO_FORCE is what rounding
 * leaves, and so is one that displaces by no more: at rest on constraints all are. */
static SELDOM int force_sets_in(const trial *now, const solver_options *options)
{
  const step_data *step = &now->step;
  real largest, least, rounded;
  sums all;
  VECTORS(nothing, 1, step);
  VECTORS(q, 1, step);
  VECTORS(p, 1, step);
  VECTORS(moved, 1, step);
  VECTORS(changes, 1, step);
  VECTORS(last, 1, step);
  VECTORS(last_two, 1, step);
  MEMORY_OF_PARTS(memory, step);
  real *const impulses[] = {last_two, last, changes};
  const real lengths[] = {-2 * BEYOND_END, -BEYOND_END, BEYOND_END};
  set_zero(step, nothing);
  for (int k = 0; k < 3; k++) {
    step_data part = part_of_step(step);
    set_zero(step, moved), set_zero(step, impulses[k]);
    begin_part(&part, step, now->dq, now->dp, q, p, nothing);
    part.h = lengths[k] * step->h;
    part.t = step->t + step->h;
    if (add_part(&part, memory, 0, options, moved, impulses[k]) != OK)
      return 0;
  }
  least = largest_change(step, p, now->dp, &largest);
  least = NO_FORCE * (least + largest);
  rounded = size_by_constraints(step);
  EACH_BLOCK (all, step) {
    int sets_in = 0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const real before = -last[i] / BEYOND_END, trend = 2 * MATH(fabs)(before + last_two[i] / (2 * BEYOND_END));
      const real change = MATH(fabs)(changes[i] / BEYOND_END - before);
      sets_in |= change > OTHER_FORCE * MATH(fabs)(before) + GROWTH_OF_TREND * trend &&
          change > SPURIOUS * (MATH(fabs)(p[i]) + MATH(fabs)(now->dp[i])) + least &&
          MATH(fabs)(moved[i]) * BEYOND_END * change >
              2 * ROUNDING_OF_PARTS * MATH(fabs)(p[i]) * (MATH(fabs)(q[i]) + rounded);
    }
    add_block(&all, (real)sets_in, 0);
  }
  meet(step);
  return largest_over(&all, 0) > 0;
}

/* Compares a step with parts of it, and shortens it while the difference is far above its error estimate. */
static SELDOM int compare_step(run_memory *run, trial *now, int parts, int momenta, const solver_options *options,
    solver_report *report)
{
  const real allowed = larger((parts == HALVED ? 1 : ALLOWED_TO_PARTS) * MATH(pow)(now->limits.most, ERROR_POWER),
      ONE_COEFFICIENT || momenta ? ROUNDOFF_LEVEL : SPURIOUS);
#ifdef NEWTON_ALONE
  const struct predictor_tables_of *half = NULL;
#else
  const struct predictor_tables_of of_curve = {PREDICTOR_INSIDE[LEVELS_PER_BINADE - 1], NULL, NULL};
  const struct predictor_tables_of *half = parts == 2 && !by_newton(now) ? &of_curve : NULL;
#endif
  for (;;) {
    real apart;
    const int status = compare_with_parts(&now->step, parts, now->dq, momenta ? now->dp : NULL, half, options, &apart);
    if (status > STATUS(SPURIOUS_SOLUTION))
      return status;
    if (status == OK && apart <= allowed && !(parts > 2 && parts != HALVED && force_sets_in(now, options))) {
      now->apart = MATH(pow)(apart, 1 / ERROR_POWER);
      run->steps_to_compare -= run->steps_to_compare > 0;
      return OK;
    }
    run->steps_to_compare = AVOIDED;
    now->error = INFINITY;
    now->inside = 0;
    if (!shorten(run, now, MOST_DOWN))
      return STATUS(STEP_SIZE_UNDERFLOW);
    run->error_before = now->limits.most;
    TRY(find_step(run, now, options, report));
  }
}

/* Compares steps in doubt: the first one, leaps, and those of which the momenta are. */
static inline int confirm_step(run_memory *run, trial *now, const solver_options *options, solver_report *report)
{
  const int leaps = is_leap(run, now), begins = HAS_TRANSIENT(run), momenta = begins || needs_momenta(run, now);
  const int parts = begins ? HALVED : leaps ? parts_of_leap(now)
                                            : 2;
  now->apart = 0;
  return leaps || momenta ? compare_step(run, now, parts, momenta, options, report) : OK;
}

/* Largest change of level after the iterations of a step. Where they are many, as in lattices whose waves are fast, the
 * time that a unit of time takes grows with the step size (cf. Gustafsson & Soederlind, SIAM J. Sci. Comput. 18 (1997)
 * 23). If a smaller step needs as many, the step size is not their cause, and the rule is suspended. */
static inline int limit_by_iterations(run_memory *run, const trial *now)
{
  const long long iterations = now->iterations;
  int most = MOST_UP;
  if (run->suspended > 0) {
    run->suspended--;
  } else if (run->many > 0 && iterations >= run->many) {
    run->many = 0;
    run->suspended = AVOIDED;
  } else {
    run->many = iterations > TOO_MANY_ITERATIONS ? iterations : 0;
    most = run->many > 0 ? -1 : iterations > MANY_ITERATIONS ? 0
                                                             : most;
  }
  return most;
}

#ifdef NEWTON_ALONE
/* Change of level that divides what is left of a run evenly where its last step would be short: what a step of Newton's
 * method leaves of stiff vibrations, however small beside its motion, is large beside that of a short step, which would
 * resolve them. */
static inline int even_out(const run_memory *run, const trial *now, int change)
{
  const real left = MATH(fabs)((now->t_end - now->at.t) - now->at.t_low);
  const real size = size_of_level(run->grid_level + change);
  if (size * (1 + LAST_STEP) < left && left < size * (1 + SHORT_LAST))
    while (change > -LEVELS_PER_BINADE && 2 * size_of_level(run->grid_level + change - 1) >= left)
      change--;
  return change;
}
#else
#define even_out(run, now, change) change
#endif

/* Lets Newton's method solve the next steps where the iteration, not the error, limits their size, if the error admits
 * steps so much larger that they take less time, and no longer than that. Asked after numbers of steps that are powers
 * of 2, the first of which took the iteration as long as ten updates: so Newton's method takes little longer than the
 * iteration did before, even if it is always in vain. */
static inline void change_to_newton(run_memory *run, const trial *now, int is_limited, real error)
{
#ifdef NEWTON_ADMITTED
  const int gain = (int)level_below(UPDATES * COST_OF_NEWTON / MANY_ITERATIONS) + 1;
  const int change = (int)run->change + gain;
  const long long steps = run->step + 1;
  if (by_newton(now) && is_dear(run, UPDATES / 2))
    leave_newton(run);
  if (!is_limited || run->change != 0 || by_newton(now) || run->avoiding < 0 || steps < COST_OF_NEWTON ||
      (steps & (steps - 1)) != 0)
    return;
  if (levels_within(run, now, gain) < gain || !may_grow(run, now, change))
    return;
  run->avoiding = -AVOIDED;
  run->failed = run->grid_level;
  run->change = change;
  run->grid_level += gain;
  run->error_before = error_at(error, change);
#endif
}

/* Chooses the size of the next step. The error of a loose tolerance may allow steps at which the iteration fails: the
 * size of such a step is not tried again for some steps (cf. Hairer & Wanner, Solving ODEs II, IV.8). */
static inline void choose_size(run_memory *run, const trial *now)
{
  const real error = larger(now->error, TRUSTED_DECREASE * run->error_before);
  int change = next_change(run, error, run->error_before, &now->limits);
  const int most = limit_by_iterations(run, now);
  int is_limited = change > most;
  change = is_limited ? most : change;
#ifdef NEWTON_IN_PLACE
  run->avoiding += run->avoiding < 0;
#endif
  if (run->avoiding > 0 && run->avoiding-- && run->grid_level + change >= run->failed) {
    change = (int)(run->failed - 1 - run->grid_level);
    is_limited = 1;
  }
  change = even_out(run, now, levels_within(run, now, change));
  run->guess = now->guess;
  run->change_before = run->change;
  run->change = change;
  run->grid_level += change;
  run->error_before = error_at(error, change);
  change_to_newton(run, now, is_limited, error);
}

/* Reduces the size of the next step of a continued run to the largest one. */
static void limit_size(run_memory *run, const trial *now)
{
  const int change = levels_within(run, now, 0);
  if (change < 0 && run->error_before > 0) {
    run->grid_level += change;
    run->change += change;
    run->error_before = error_at(run->error_before, change);
  }
}

/* Sets the admissible error of a step, and the tolerance of its equations accordingly. */
static void begin_trials(run_memory *run, trial *now, const step_control *control, solver_options *standard)
{
  const real tolerance = control->tolerance;
  now->control = control;
  now->largest_level = largest_level(control->max_step);
  limit_size(run, now);
  now->limits = limits_of(tolerance > 0 ? tolerance : ROUNDOFF_ERROR);
  standard->tolerance = larger(REAL_EPSILON, ITERATION_PART * tolerance);
  if ((real)run->direction * ((now->t_end - run->t) - run->t_low) < 0)
    run->guess = 0;
}

/* Records the accepted step of size h, and chooses the size of the next one. */
static inline void finish_trial(run_memory *run, trial *now, real h)
{
  if (now->last) {
    now->at.t = now->t_end;
    now->at.t_low = 0;
    run->guess = 0;
  } else {
    add_compensated(&now->at.t, &now->at.t_low, h, 0);
    choose_size(run, now);
  }
  run->step++;
}

/* Adds the increments of the accepted step to the state. */
static inline void accept_trial(run_memory *run, trial *now)
{
#ifdef ARRAYS
  continue_steps(run, &now->step, now->dq, now->dp);
#else
#ifdef ERROR_GROWTH
  if (by_newton(now))
    run->measures_growth = run->tangent_steps = 0; /* it has no points for the tangent vector */
  if (run->measures_growth)
    measure_growth(run, &now->step, &now->data, now->points, now->dq, now->control->tolerance, now->last);
#endif
#ifdef RUN_ACTION
  add_action(run, &now->step, &now->data, now->guess);
#endif
  add_increments(now->at.q, now->at.carry_q, now->dq);
  add_increments(now->at.p, now->at.carry_p, now->dp);
#endif
#ifdef NEWTON_IN_PLACE
  run->fallback_steps += now->fallbacks;
#endif
  forget_motion(run, now->step.h);
  note_trial(run, now);
  if (larger(now->error, now->apart) > run->error) {
    run->error = larger(now->error, now->apart);
    run->error_t = now->at.t;
  }
  finish_trial(run, now, now->step.h);
}

#ifdef ARRAYS
/* Adaptive integration of arrays to a given time. */
static int take_trials(run_memory *run, const job *way, solver_report *report)
{
  solver_options standard = NAME(default_options)();
  const solver_options *options = way->options ? way->options : &standard;
  trial now = {.at = {run->t, run->t_low, run->q, run->p, run->carry_q, run->carry_p}, .t_end = way->t_end};
  const work_arrays work = bind_work_arrays(run, coordinates_of(way->arrays));
  array_motion motion = {{0.0}, {0.0}};
  now.step = step_of(run, way->arrays, &work);
  now.step.h = 0.0;
  now.step.motion = &motion;
  now.dq = work.dq, now.dp = work.dp;
  begin_trials(run, &now, way->control, &standard);
  run->direction = (way->t_end - run->t) - run->t_low < 0 ? -1 : 1;
  while (report->steps < way->steps && (run->t != way->t_end || run->t_low != 0.0)) {
    const long long before = report->iterations;
    TRY(find_step(run, &now, options, report));
    TRY(confirm_step(run, &now, options, report));
    accept_trial(run, &now);
    run->t = now.at.t, run->t_low = now.at.t_low;
    run->iterations += report->iterations - before;
    report->steps++;
    store_state(run, way, report, now.step.n, run->t == way->t_end && run->t_low == 0.0);
  }
  return OK;
}

int NAME(advance_to)(run_memory *run, double t_end, const step_control *control, long long steps, long long every,
    const double *parameters, const solver_options *options, double *t, double *q, double *p, int *iterations,
    solver_report *report, double *workspace)
{
  const job way = {.go = take_trials,
      .t_end = t_end,
      .control = control,
      .steps = steps,
      .every = every,
      .t = t,
      .q = q,
      .p = p,
      .iterations = iterations};
  return perform(run, way, parameters, options, report);
}
#endif
