#include "point_lanes.h"

#define MULTIPLIERS_KNOWN 1 /* iteration whose multipliers show the sizes of reactions */

/* Constrained steps by an iteration for the multipliers at the points, then the multipliers that project p1 onto the
 * tangent space. Requires: rattle.h or coupled_rattle.h. */

enum { LOST_DIGITS = -1 }; /* beside the status codes: Newton's method loses none */

/* Sizes of positions, inverted, and the largest one; widened: of their terms without reactions, and of those of g. */
typedef struct {
  real inverse[M], largest;
  int widened;
} unknown_sizes;

static inline void find_sizes(const step_data *step, rattle_step *now, unknown_sizes *sizes)
{
  term_sizes(step, now, 1, sizes->inverse);
  sizes->largest = invert_sizes(sizes->inverse);
}

/* Stagnation above the rounding of the positions may be that of g. */
static SELDOM __attribute__((noinline)) void widen_sizes(const step_data *step, rattle_step *now, unknown_sizes *sizes)
{
  sizes->widened = 1;
  term_sizes(step, now, 0, sizes->inverse);
  add_constraint_sizes(step->t, step->q0, step->parameters, saddle_in(step->scratch), sizes->inverse);
  sizes->largest = invert_sizes(sizes->inverse);
}

/* Returns 1 if forces and reactions may lose digits: of a body so light that they move it in a step by much more than
 * it moves, rounding errors of its position are relative to them. In Newton's method positions are unknowns. */
static inline int may_lose_digits(const step_data *step, const rattle_step *now, const real *inverse_size)
{
  int may = 0;
  for (int i = 0; i < M; i++) {
    const real moved = MATH(fabs)(step->q0[i]) + MATH(fabs)(now->u[i][DEGREE - 1] - step->q0[i]);
    may |= (2 * moved + REAL_MIN) * inverse_size[i] < 1;
  }
  return may;
}

/* Returns 1 if they do: where reactions exceed momenta and forces, as of light bodies, and displacements that change a
 * constraint by the size of its terms. A coordinate may be held at 0. Replaces the sizes, if they are not NULL. */
static SELDOM __attribute__((noinline)) int loses_digits(const step_data *step, rattle_step *now, unknown_sizes *sizes)
{
  real size[M], length[M] = {0}, rounding[CONSTRAINTS];
  unknown_sizes of_reactions = {.widened = 0};
  int loses = 0;
  find_sizes(step, now, &of_reactions);
  if (sizes)
    *sizes = of_reactions;
  term_sizes(step, now, 0, size);
  constraint_rounding(step->q0, step->t, step->parameters, rounding);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const int k = CONSTRAINT_ENTRY[e][0], i = CONSTRAINT_ENTRY[e][1];
    length[i] = larger(length[i], rounding[k] / MATH(fabs)(now->first_derivative[e]));
  }
  for (int i = 0; i < M; i++)
    loses |= larger(LARGEST_REACTION * size[i], length[i]) * of_reactions.inverse[i] < 1;
  return loses;
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
  const movement unknown = {(real)INFINITY, (real)INFINITY, (real)INFINITY, 0};
  movement last[2] = {unknown, unknown};
  int factorised = 0, begin = 0;
  for (int k = 0; k < least(options->max_iterations, MOST_ITERATIONS); k++) {
    movement moved;
    int verdict;
    iterate(step, now, l, factorised, change);
    if (k == 0)
      find_sizes(step, now, &sizes);
    moved = measure_change(change, sizes.inverse, sizes.largest);
    report->iterations++;
    report->change = options->absolute ? moved.absolute : moved.relative;
    evaluate_points(step, now);
    verdict = accepts(&moved, last, options, k - begin);
    if ((k == MULTIPLIERS_KNOWN || verdict > 0) && may_lose_digits(step, now, sizes.inverse)) {
      unknown_sizes seen = sizes; /* so that `sizes` may stay in registers, as `change` */
      if (loses_digits(step, now, verdict > 0 && !sizes.widened ? &seen : NULL))
        return LOST_DIGITS;
      if (verdict > 0 && !sizes.widened) {
        sizes = seen;
        moved = measured_again(change, sizes);
        verdict = accepts(&moved, last, options, k - begin);
      }
    }
    if (verdict < 0 && !sizes.widened) {
      unknown_sizes seen = sizes;
      widen_sizes(step, now, &seen);
      sizes = seen;
      moved = measured_again(change, sizes);
      last[0] = unknown;
      begin = k;
      verdict = 0;
    }
    if (verdict > 0)
      return OK;
    if (verdict < 0)
      return NOT_CONVERGED;
    factorised = moved.overall < REUSED_FACTORS;
    last[1] = last[0];
    last[0] = moved;
  }
  return NOT_CONVERGED;
}

/* Computes p1 - p0 on the tangent space, and the unknowns z of the step. An unrolled loop keeps dp
 * in registers: a vector that is loaded soon after its parts were stored waits for them. */
static int finish_step(const step_data *step, rattle_step *now, newton_data *data, real *dp)
{
  const real weight = step->h * RATTLE_WEIGHT[DEGREE];
  factors l;
  lanes derivative[CONSTRAINT_ENTRIES], x[CONSTRAINTS];
  real u[2 * M], value[M + 2 * CONSTRAINTS];
  finish_curve(step, now, data->z, dp);
  for (int i = 0; i < M; i++)
    u[i] = now->u[i][DEGREE - 1];
  end_velocity(step, now, dp, u + M);
  constrained_motion(u, step->t + step->h, step->parameters, value);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = load(now->derivative[e], LAST_GROUP);
  factorise_points(derivative, END_MASSES(now), l);
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = lanes_of(-value[M + k] / weight);
  solve_points(l, x);
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    dp[CONSTRAINT_ENTRY[e][1]] += weight * now->derivative[e][DEGREE - 1] *
        x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]][(DEGREE - 1) % LANES];
  end_velocity(step, now, dp, u);
  for (int i = 0; i < M; i++)
    data->z[i * B + DEGREE] = u[i];
  for (int k = 0; k < CONSTRAINTS; k++) {
    memcpy(data->z + (M + k) * B, now->lambda + k, sizeof(real) * DEGREE);
    data->z[(M + k) * B + DEGREE] = x[CONSTRAINT_POSITION[k]][(DEGREE - 1) % LANES];
  }
  return all_finite(data->z, N) ? OK : NOT_FINITE;
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
  int status = begin(step, run, memory, now);
  if (status == OK)
    status = solve_constraints(step, now, options, report);
  if (status == OK)
    status = finish_step(step, now, data, dp);
#ifdef RATTLE_IN_PAIRS
  if (solved)
    solved->by_rattle = status == OK;
#endif
  return status;
}
