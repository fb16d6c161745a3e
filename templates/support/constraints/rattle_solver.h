#include "point_lanes.h"

/* Constrained steps by an iteration for the multipliers at the points, then the multipliers that project p1 onto the
 * tangent space. Requires: rattle.h or coupled_rattle.h. */

/* Adds the sizes that the constraints give to positions to inverse sizes; returns the largest size. Stagnation above the
 * rounding of the positions may be that of g. */
static SELDOM real widen_sizes(const step_data *step, real *inverse_size)
{
  real size[M], largest = 0;
  for (int i = 0; i < M; i++)
    size[i] = 1 / inverse_size[i];
  add_constraint_sizes(step->t, step->q0, step->parameters, saddle_in(step->scratch), size);
  for (int i = 0; i < M; i++) {
    largest = larger(largest, size[i]);
    inverse_size[i] = 1 / size[i];
  }
  return largest;
}

/* Solves g(u) = 0 for lambda and u; evaluates forces and constraints there. Returns NOT_CONVERGED on failure. */
static int solve_constraints(const step_data *step, rattle_step *now, const solver_options *options,
    solver_report *report)
{
  factors l[GROUPS];
  lanes change[M * GROUPS];
  real inverse_size[M], largest_size = 0;
  const movement unknown = {(real)INFINITY, (real)INFINITY, (real)INFINITY, 0};
  movement last[2] = {unknown, unknown};
  int factorised = 0, widened = 0;
  for (int k = 0; k < least(options->max_iterations, MOST_ITERATIONS); k++) {
    movement moved;
    int verdict;
    iterate(step, now, l, factorised, change);
    if (k == 0)
      largest_size = invert_term_sizes(step, now, inverse_size);
    moved = measure_change(change, inverse_size, largest_size);
    report->iterations++;
    report->change = options->absolute ? moved.absolute : moved.relative;
    evaluate_points(step, now);
    verdict = accepts(&moved, last, options, k);
    if (verdict < 0 && !options->absolute && !widened) {
      widened = 1;
      largest_size = widen_sizes(step, inverse_size);
      moved = measure_change(change, inverse_size, largest_size);
      last[0] = last[1] = unknown;
      verdict = accepts(&moved, last, options, k);
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
