#include "multiplier_sizes.h"

/* Constrained steps by an iteration for the multipliers at the points, then the multipliers that project p1 onto the
 * tangent space. */

enum { LOST_DIGITS = -1 }; /* beside the status codes: Newton's method loses none */

/* Stagnation above the rounding of the positions may be that of g. */
static SELDOM __attribute__((noinline)) void widen_sizes(const step_data *step, rattle_step *now, unknown_sizes *sizes)
{
  sizes->widened = 1;
  term_sizes(step, now, 0, sizes->inverse);
  add_constraint_sizes(ACTUAL_FORCES, step->t, step->q0, step->parameters, saddle_in(step->scratch), sizes->inverse);
  sizes->largest = invert_sizes(sizes->inverse);
}

/* A change in units of other sizes. */
static inline movement measured_again(const lanes *change, unknown_sizes sizes)
{
  lanes copied[M * GROUPS];
  memcpy(copied, change, sizeof copied);
  IN_MEMORY(copied);
  return measure_change(copied, sizes.inverse, sizes.largest);
}

/* Solves g(u) = 0 for lambda and u; evaluates forces and constraints there. Returns NOT_CONVERGED on failure, or
 * LOST_DIGITS. */
static int solve_constraints(const step_data *step, rattle_step *now, const solver_options *options,
    solver_report *report)
{
  factors l[GROUPS];
  lanes change[M * GROUPS];
  unknown_sizes sizes = {.widened = options->absolute};
  real made[3] = {(real)INFINITY, (real)INFINITY, (real)INFINITY}; /* changes of the last iterations .. */
  real overall[3] = {(real)INFINITY, (real)INFINITY, (real)INFINITY}; /* .. in units of the largest size */
  int factorised = 0, begin = 0;
  for (int k = 0; k < least(options->max_iterations, MOST_ITERATIONS); k++) {
    movement moved;
    int verdict;
    iterate(step, now, l, factorised, (lanes(*)[GROUPS])change);
    if (k == 0)
      find_sizes(step, now, &sizes);
    moved = measure_change(change, sizes.inverse, sizes.largest);
    report->iterations++;
    report->change = made[0] = options->absolute ? moved.absolute : moved.relative;
    overall[0] = moved.overall;
    evaluate_points(step, now);
    verdict = accepts(made, overall, options, k - begin);
    if ((k == MULTIPLIERS_KNOWN || verdict > 0) && may_lose_digits(step, now, sizes.inverse)) {
      unknown_sizes seen = sizes; /* so that `sizes` may stay in registers, as `change` */
      if (loses_digits(step, now, verdict > 0 && !sizes.widened ? &seen : NULL))
        return LOST_DIGITS;
      if (verdict > 0 && !sizes.widened) {
        sizes = seen;
        moved = measured_again(change, sizes);
        made[0] = moved.relative, overall[0] = moved.overall;
        verdict = accepts(made, overall, options, k - begin);
      }
    }
    if (verdict < 0 && !sizes.widened) {
      unknown_sizes seen = sizes;
      widen_sizes(step, now, &seen);
      sizes = seen;
      moved = measured_again(change, sizes);
      made[0] = moved.relative, overall[0] = moved.overall;
      made[1] = overall[1] = (real)INFINITY;
      begin = k;
      verdict = 0;
    }
    if (verdict > 0)
      return OK;
    if (verdict < 0)
      return NOT_CONVERGED;
    factorised = moved.overall < REUSED_FACTORS;
    for (int n = 2; n > 0; n--)
      made[n] = made[n - 1], overall[n] = overall[n - 1];
  }
  return NOT_CONVERGED;
}

/* Computes the unknowns z of the step, and p1 - p0, with a guess from those of the previous step, if they are not NULL.
 * On failure they are undefined. */
static int rattle(const step_data *step, const rattle_data *run, const real *memory, newton_data *data, real *dp,
    const solver_options *options, solver_report *report)
{
  rattle_step local, *now = &local;
#ifdef RATTLE_IN_PAIRS
  solved_step *solved = (solved_step *)step->points;
  now = solved ? &solved->now : now;
#endif
  int status = OK;
  real v0[M] = {0};
#ifdef MASSES_OF_POINTS
  if (!memory)
    status = find_velocity(step->t, step->q0, step->p0, step->parameters, v0, step->scratch);
#endif
  if (status == OK) {
    begin(step, run, memory, v0, now);
    status = solve_constraints(step, now, options, report);
  }
  if (status == OK) {
    finish_step(step, now, data->z, dp);
    status = all_finite(data->z, N) ? OK : NOT_FINITE;
  }
#ifdef RATTLE_IN_PAIRS
  if (solved)
    solved->by_rattle = status == OK;
#endif
  return status;
}
