#ifndef SUPPORT_OBSERVED_ERROR_H
#define SUPPORT_OBSERVED_ERROR_H

#include "../core/status_codes.h"
#include "../core/step.h"

/* Comparison of a step with two steps of half its size. It detects errors that the curve of the step does not show: too
 * few points, forces that vanish at them, or a spurious solution of the stage equations. Requires: prepare
 * and solve of a solver, step_duration; for arrays history_of_halves. */

#define COMPARED 512 /* one of so many steps is compared */
#define FALLBACK_COMPARED 8 /* one of so many steps that the fixed-point iteration did not solve */
#define DOUBTFUL REAL(4.0) /* steps whose error estimate exceeds the largest one so far by this factor (squared) are
                            * compared */
#define RESOLVED_STEP REAL(1e-6) /* relative to the state: if the halves differ by more, those of the first half are
                                  * compared */
#define MOST_HALVINGS 24
#define GROSS_DIFFERENCE REAL(10.0) /* relative to the state: beyond it the step is a spurious solution */
#define ROUNDING_OF_HALVES (64 * REAL_EPSILON)
#define SMALL_PART REAL(0.1) /* of the largest momentum: smaller changes count as little */

#define VECTORS(name, count, place, step) real name[(count) * M]
#define MEMORY_OF_HALVES(name, step) real name[MEMORY]

static real step_duration(const step_data *step, const solver_data *data, const real *memory, long long guess,
    real *workspace);

static void set_zero(const step_data *step, real *x)
{
  const section own = own_part(step);
  memset(x + own.first, 0, sizeof(real) * (size_t)(own.end - own.first));
}

static void copy_numbers(const step_data *step, const real *x, real *y)
{
  const section own = own_part(step);
  memcpy(y + own.first, x + own.first, sizeof(real) * (size_t)(own.end - own.first));
}

/* Solves a step without a predictor and adds its increments, without their low words, to dq and dp. */
static SELDOM int add_part(step_data *part, const solver_options *options, real *dq, real *dp)
{
  const section own = own_part(part);
  MEMORY_OF_HALVES(memory, part);
  VECTORS(own_q, 2, 0, part);
  VECTORS(own_p, 2, 2, part);
  solver_report report = {0};
  solver_data data;
  long long guess = 0;
  int status;
  prepare(part, &data);
  status = solve(part, &data, memory, &guess, own_q, own_p, options, &report, part->scratch + SCRATCH);
  if (status != OK)
    return status;
  part->t += step_duration(part, &data, memory, guess, part->scratch + SCRATCH);
  for (long long i = own.first; i < own.end; i++) {
    dq[i] += own_q[i];
    dp[i] += own_p[i];
  }
  return is_finite(part->t) ? OK : NOT_FINITE;
}

/* Solves two steps of h/2: the increments of both, and those of q by the first. */
static SELDOM int solve_halves(const step_data *step, real h, const solver_options *options, real *dq, real *dp,
    real *first)
{
  const section own = own_part(step);
  VECTORS(nothing, 1, 3, step);
  VECTORS(q, 1, 4, step);
  VECTORS(p, 1, 5, step);
  step_data part = *step;
  int status;
  part.h = h / 2;
  part.first = 1;
  part.tables = NULL;
  set_zero(step, nothing);
  set_zero(step, dq);
  set_zero(step, dp);
  status = add_part(&part, options, dq, dp);
  if (status != OK)
    return status;
  copy_numbers(step, dq, first);
  for (long long i = own.first; i < own.end; i++) {
    q[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    p[i] = step->p0[i] + (step->carry_p[i] + dp[i]);
  }
  part.q0 = q;
  part.p0 = p;
  part.carry_q = part.carry_p = nothing;
  return add_part(&part, options, dq, dp);
}

/* Largest difference of the increments of x relative to the state after the half steps; 0 if it may be rounding. */
static real difference(const step_data *step, const real *x, const real *whole, const real *halves)
{
  real largest, most;
  sums all;
  begin_blocks(&all, step);
  EACH_BLOCK (all) {
    real of_block = 0;
    for (long long i = all.here.first; i < all.here.end; i++)
      of_block = larger(of_block, MATH(fabs)(x[i]) + MATH(fabs)(halves[i]));
    add_block(&all, of_block, 0);
  }
  meet(step);
  largest = largest_over(&all, 0);
  begin_blocks(&all, step);
  EACH_BLOCK (all) {
    real of_block = 0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      const real size = MATH(fabs)(x[i]) + MATH(fabs)(halves[i]) + largest + REAL_MIN;
      of_block = larger(of_block, MATH(fabs)(whole[i] - halves[i]) / size);
    }
    add_block(&all, of_block, 0);
  }
  meet(step);
  most = largest_over(&all, 0);
  return most > ROUNDING_OF_HALVES ? most : 0;
}

/* Computes the error of the end of a step relative to the state. Since the step and its halves may both miss forces
 * near the start, e.g. near a centre, a large difference is followed by comparing the first half with its own halves
 * as long as the difference grows. Momenta of the whole step are compared unless dp is NULL. Returns
 * SPURIOUS_SOLUTION if the half steps have no solution or differ by far more than the state. */
static SELDOM int compare_with_halves(const step_data *step, const real *dq, const real *dp,
    const solver_options *options, real *error)
{
  VECTORS(whole, 1, 6, step);
  VECTORS(halves, 1, 7, step);
  VECTORS(changes, 1, 8, step);
  VECTORS(first, 1, 9, step);
  real before = -1, h = step->h;
  copy_numbers(step, dq, whole);
  *error = 0;
  for (int k = 0; k < MOST_HALVINGS; k++) {
    const int status = solve_halves(step, h, options, halves, changes, first);
    real apart;
    if (status != OK)
      return status > STATUS(SPURIOUS_SOLUTION) ? status : STATUS(SPURIOUS_SOLUTION);
    apart = difference(step, step->q0, whole, halves);
    *error = larger(*error, apart);
    if (dp && k == 0)
      *error = larger(*error, difference(step, step->p0, dp, changes));
    if (!(apart <= GROSS_DIFFERENCE))
      return STATUS(SPURIOUS_SOLUTION);
    if (!(apart > RESOLVED_STEP && apart > before))
      break;
    before = apart;
    copy_numbers(step, first, whole);
    h /= 2;
  }
  return OK;
}

/* Sizes of the states of a run, relative to which errors of its steps are measured. A state may accidentally be near
 * rest at the origin: the error of such a step is measured relative to the largest states so far, or to those that the
 * first steps lead to. Positions alone are not sufficient: during close encounters they are small and momenta are
 * large. */

#define STEPS_FROM_REST 16 /* steps, by which a constant force has moved a state from rest by hundreds of first steps */
#define SIZED 4 /* one of so many steps is measured */

/* Returns 1 if the size of a step is recorded whatever its error is. */
static inline int is_sized(const run_memory *run)
{
  return run->step % SIZED == 0 || run->steps_from_rest > 0;
}

/* Size of a state relative to a largest coordinate and a largest momentum; the momentum counts squared, as in the
 * energy. */
static inline real part_of_size(real q, real p, real largest_q, real largest_p)
{
  const real part = larger(q / largest_q, p / largest_p * (p / largest_p));
  return part < 1 ? part : 1;
}

/* Records a step that began with a largest coordinate `start`, where q and p are the largest numbers of both its
 * states. */
static inline void note_size(run_memory *run, real start, real q, real p)
{
  if (start == 0 && (run->step == 0 || run->steps_from_rest > 0)) {
    run->steps_from_rest = STEPS_FROM_REST;
  } else if (run->steps_from_rest > 0) {
    const real part = part_of_size(run->largest_q, run->largest_p, q, p);
    run->error *= part;
    run->steps_from_rest = part < 1 ? run->steps_from_rest - 1 : 0;
  }
  run->largest_q = larger(run->largest_q, q);
  run->largest_p = larger(run->largest_p, p);
}

/* Records the error of a step. */
static inline void note_error(run_memory *run, real t, real error, real q, real p)
{
  error *= part_of_size(q, p, run->largest_q, run->largest_p);
  if (!(error <= run->error)) {
    run->error = error;
    run->error_t = t;
  }
}

static inline int is_worse(const run_memory *run, real error)
{
  return run->error == run->error && !(error <= run->error);
}

/* Largest error estimate of the steps of a run so far: of the stages (NEWTON_ALONE), or of the curve. Steps that the
 * fixed-point iteration did not solve have the estimate of the fallback, converted to the same power, or NaN. */
#ifndef NEWTON_ALONE
#include "curve_error.h"

static SELDOM double fallback_error(const step_data *step, const double *dq, double *workspace)
{
  (void)step, (void)dq, (void)workspace;
  return NAN;
}

static double largest_error(const run_memory *run, const step_data *step, const solver_data *data, const double *dq,
    double *workspace)
{
  if (run->guess > 0)
    return curve_error(step, data, STORED(run, step), dq, ALL, now_and_then(run), run->error);
  return larger(run->error, fallback_error(step, dq, workspace));
}
#else
#include "stage_error.h"

static real largest_error(const run_memory *run, const step_data *step, const solver_data *data, const real *dq,
    real *workspace)
{
  (void)data, (void)workspace;
  return stage_error(step, run->memory, dq, ALL, DECAY, run->error);
}
#endif

/* Largest error estimate of the steps of a run, with occasional comparisons with half steps. Requires: ERROR_POWER. */

/* Largest number of a state, and of that and the state after it. */
static void find_size(const step_data *step, const real *x, const real *dx, real *start, real *both)
{
  sums all;
  begin_blocks(&all, step);
  EACH_BLOCK (all) {
    real at_start = 0, at_end = 0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      at_start = larger(at_start, MATH(fabs)(x[i]));
      at_end = larger(at_end, MATH(fabs)(x[i] + dx[i]));
    }
    add_block(&all, at_start, at_end);
  }
  meet(step);
  *start = largest_over(&all, 0);
  *both = larger(*start, largest_over(&all, 1));
}

/* Returns 1 if a step is compared with its half steps: the first of a run, one of COMPARED later, one of
 * FALLBACK_COMPARED without a predictor, and those whose error estimate is clearly the largest so far. */
static inline int is_compared(const run_memory *run, real error)
{
  return ERROR_POWER > 0 &&
      (run->step % COMPARED == 0 || error > DOUBTFUL * run->error ||
          (run->guess == 0 && run->step % FALLBACK_COMPARED == 0));
}

/* Replaces the error estimate by the difference from the half steps if that is larger. If the half steps have no
 * solution, the step fails unless its estimate is at round-off level. */
static SELDOM int compare(step_data *step, const real *dq, const solver_options *options, real *error)
{
  real apart;
  const int status = compare_with_halves(step, dq, NULL, options, &apart);
  step->first = 1;
  if (status == OK)
    *error = larger(*error, MATH(pow)(apart, 1 / ERROR_POWER));
  return status != OK && MATH(pow)(*error, ERROR_POWER) < ROUNDOFF_LEVEL ? OK : status;
}

/* Records the error of a step; returns an error status if the step is a spurious solution. */
static int observe_error(run_memory *run, step_data *step, const solver_data *data, const real *dq,
    const real *dp, const solver_options *options, real *workspace)
{
  const int sized = is_sized(run);
  real start = 0, q = 0, start_p = 0, p = 0, error;
  if (sized) {
    find_size(step, step->q0, dq, &start, &q);
    find_size(step, step->p0, dp, &start_p, &p);
    note_size(run, start, q, p);
  }
  error = largest_error(run, step, data, dq, workspace);
  step->first = 0;
  if (is_compared(run, error)) {
    const int status = compare(step, dq, options, &error);
    if (status != OK)
      return status;
  }
  if (is_worse(run, error)) {
    if (!sized) {
      find_size(step, step->q0, dq, &start, &q);
      find_size(step, step->p0, dp, &start_p, &p);
    }
    note_error(run, step->t, error, q, p);
  }
  return OK;
}

real NAME(step_error)(const run_memory *run)
{
  return MATH(pow)(run->error, ERROR_POWER);
}

#endif
