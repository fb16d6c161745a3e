#include "../constraints/rattle_solver.h"
#include "mixed_newton.h"

/* Increments of a step in two words: RATTLE (rattle.h) is continued in pairs of vectors from its solution in
 * double: positions u and multipliers have two words, their corrections have one. With the residuals
 *   r = q0 + h c v0 + h^2 R a - u,    g(u),    a = M^-1 (F(u) + G^T lambda),
 * in pairs, which are small, so that one word of each has 16 digits, the correction of lambda solves P dlambda = -R^-1
 * (g + G r) / h^2, and that of u is r + h^2 R M^-1 G^T dlambda. What it neglects shrinks as the updates of RATTLE do.
 * Momenta are projected by multipliers of two words. Requires: rattle.h; the kernels constrained_force_of_points,
 * constraints_of_points (of vectors) and constrained_motion; RATTLE_ABSCISSA_LOW, RATTLE_WEIGHT_LOW. */
#define NEGLECTED 4.0 /* multiple of the next update, from the last two, that is below REFINED */

/* Values of a step at its points, as in rattle.h. */
typedef struct {
  dd t, h, drift[M], q0[M], first_force[M], first_derivative[CONSTRAINT_ENTRIES];
  ddl u[M][GROUPS], force[M][GROUPS], moved[M][GROUPS], lambda[CONSTRAINTS][GROUPS], f[M][GROUPS];
  ddl g[CONSTRAINTS][GROUPS], derivative[CONSTRAINT_ENTRIES][GROUPS];
} rattle_pairs;

/* Corrects the lower half of M^-1 to two words: X + X (1 - M X). */
static void invert_mass_pairs(const step_data *step, const double *inverse_mass, dd *result)
{
  dd u[2 * M], value[M + MASS_ENTRIES], rest[M];
  double x[M][M] = {{0.0}}, left[M][M];
  memset(u, 0, sizeof u);
  legendre_pairs(u, dd_word(step->t), step->parameters, value);
  for (int e = 0; e < INVERSE_MASSES; e++) {
    const int i = INVERSE_MASS_ENTRY[e][0], j = INVERSE_MASS_ENTRY[e][1];
    x[i][j] = x[j][i] = inverse_mass[e];
  }
  for (int j = 0; j < M; j++) {
    for (int i = 0; i < M; i++)
      rest[i] = dd_word(i == j);
    for (int e = 0; e < MASS_ENTRIES; e++) {
      const int i = MASS_ENTRY[e][0];
      rest[i] = dd_subtract(rest[i], dd_scale(value[M + e], x[MASS_ENTRY[e][1]][j]));
    }
    for (int i = 0; i < M; i++)
      left[i][j] = rest[i].high;
  }
  for (int e = 0; e < INVERSE_MASSES; e++) {
    double sum = 0.0;
    for (int k = 0; k < M; k++)
      sum += x[INVERSE_MASS_ENTRY[e][0]][k] * left[k][INVERSE_MASS_ENTRY[e][1]];
    result[e] = dd_two_sum(inverse_mass[e], sum);
  }
}

LANE_FUNCTION ddl former_pairs(const ddl *x, dd first, int g)
{
  const lanes high = g > 0 ? x[g - 1].high : lanes_of(first.high), low = g > 0 ? x[g - 1].low : lanes_of(first.low);
  return ddl_of_words(FORMER(x[g].high, high), FORMER(x[g].low, low));
}

LANE_FUNCTION dd pair_of_lane(const ddl *x, int n)
{
  double high[LANES], low[LANES];
  memcpy(high, &x[n / LANES].high, sizeof high);
  memcpy(low, &x[n / LANES].low, sizeof low);
  return dd_of(high[n % LANES], low[n % LANES]);
}

/* Group g of sum_n table_n x_n: Dot2 (Ogita, Rump & Oishi 2005), in two sums. */
LANE_FUNCTION ddl pair_times(const real (*table)[POINT_LANES], const real (*table_low)[POINT_LANES],
    const real *x, const real *x_low, int g)
{
  ddl sum[2] = {{{0.0}, {0.0}}, {{0.0}, {0.0}}};
#pragma GCC unroll 16
  for (int n = 0; n < DEGREE; n++) {
    const lanes high = lanes_of(x[n]), entry = load(table[n], g);
    const ddl product = ddl_two_product(entry, high), next = ddl_two_sum(sum[n % 2].high, product.high);
    sum[n % 2].high = next.high;
    sum[n % 2].low += multiply_add(entry, lanes_of(x_low[n]), load(table_low[n], g) * high) + (product.low + next.low);
  }
  const ddl both = ddl_two_sum(sum[0].high, sum[1].high);
  return ddl_fast_two_sum(both.high, both.low + (sum[0].low + sum[1].low));
}

/* x = M^-1 y in pairs of numbers. */
static inline void pair_accelerations(const dd *inverse_mass, const dd *y, dd *x)
{
  for (int i = 0; i < M; i++)
    x[i] = dd_multiply(inverse_mass[i], y[i]);
  for (int e = M; e < INVERSE_MASSES; e++) {
    const int i = INVERSE_MASS_ENTRY[e][0], j = INVERSE_MASS_ENTRY[e][1];
    x[i] = dd_add(x[i], dd_multiply(inverse_mass[e], y[j]));
    x[j] = dd_add(x[j], dd_multiply(inverse_mass[e], y[i]));
  }
}

static inline __attribute__((flatten)) void evaluate_pairs_of_points(const double *parameters, rattle_pairs *at)
{
  for (int g = 0; g < GROUPS; g++) {
    const ddl abscissa = {load(RATTLE_ABSCISSA + 1, g), load(RATTLE_ABSCISSA_LOW + 1, g)};
    const ddl t = ddl_add(ddl_of(at->t), ddl_multiply(abscissa, ddl_of(at->h)));
    ddl u[M], force[M], value[CONSTRAINTS + CONSTRAINT_ENTRIES];
    TAKE_LANE(u, M, at->u, g);
    constrained_force_of_points_pairs(u, t, parameters, force);
    constraints_of_points_pairs(u, t, parameters, value);
    PUT_LANE(at->force, M, g, force);
    PUT_LANE(at->g, CONSTRAINTS, g, value);
    PUT_LANE(at->derivative, CONSTRAINT_ENTRIES, g, value + CONSTRAINTS);
  }
}

/* a = M^-1 f at a group of points. */
static inline void vector_accelerations(const dd *inverse_mass, const ddl *f, ddl (*a)[GROUPS], int g)
{
  for (int i = 0; i < M; i++)
    a[i][g] = ddl_multiply(ddl_of(inverse_mass[i]), f[i]);
  for (int e = M; e < INVERSE_MASSES; e++) {
    const int i = INVERSE_MASS_ENTRY[e][0], j = INVERSE_MASS_ENTRY[e][1];
    a[i][g] = ddl_add(a[i][g], ddl_multiply(ddl_of(inverse_mass[e]), f[j]));
    a[j][g] = ddl_add(a[j][g], ddl_multiply(ddl_of(inverse_mass[e]), f[i]));
  }
}

#include "correct_points.h"

/* Projects the momenta p0 + dp at the end of the step, where the multipliers are nearly x. */
static void project_end(const solved_step *solved, const step_data *step, const rattle_pairs *at, const dd *q,
    const double *x, dd *dp)
{
  enum { ROUNDS = 2 };
  const dd weight = dd_multiply(at->h, dd_of(RATTLE_WEIGHT[DEGREE], RATTLE_WEIGHT_LOW[DEGREE]));
  factors l;
  lanes derivative[CONSTRAINT_ENTRIES], right[CONSTRAINTS];
  dd u[2 * M], p[M], mu[CONSTRAINTS], last[CONSTRAINT_ENTRIES], value[M + 2 * CONSTRAINTS];
  memcpy(u, q, sizeof(dd) * M);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    derivative[e] = at->derivative[e][LAST_GROUP].high;
    last[e] = dd_multiply(weight, pair_of_lane(at->derivative[e], DEGREE - 1));
  }
  for (int k = 0; k < CONSTRAINTS; k++)
    mu[k] = dd_word(x[k * B]);
  factorise_points(derivative, solved->now.inverse_mass, l);
  for (int n = 0; n <= ROUNDS; n++) {
    for (int i = 0; i < M; i++)
      p[i] = dp[i];
    for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
      const int i = CONSTRAINT_ENTRY[e][1];
      p[i] = dd_add(p[i], dd_multiply(last[e], mu[CONSTRAINT_ENTRY[e][0]]));
    }
    if (n == ROUNDS)
      break;
    for (int i = 0; i < M; i++)
      value[i] = dd_add(dd_of(step->p0[i], step->carry_p[i]), p[i]);
    pair_accelerations(solved->inverse_mass, value, u + M);
    constrained_motion_pairs(u, dd_add(at->t, at->h), step->parameters, value);
    for (int k = 0; k < CONSTRAINTS; k++)
      right[CONSTRAINT_POSITION[k]] = lanes_of(-value[M + k].high / weight.high);
    solve_points(l, right);
    for (int k = 0; k < CONSTRAINTS; k++)
      mu[k] = dd_add(mu[k], dd_word(right[CONSTRAINT_POSITION[k]][(DEGREE - 1) % LANES]));
  }
  memcpy(dp, p, sizeof p);
}

/* Values at the first point, and the solution in double. */
static inline void begin_rattle_pairs(const solved_step *solved, const step_data *step, double t_low, double h_low,
    rattle_pairs *at)
{
  dd p0[M], value[CONSTRAINTS + CONSTRAINT_ENTRIES];
  at->t = dd_of(step->t, t_low);
  at->h = dd_of(step->h, h_low);
  for (int i = 0; i < M; i++) {
    at->q0[i] = dd_of(step->q0[i], step->carry_q[i]);
    p0[i] = dd_of(step->p0[i], step->carry_p[i]);
  }
  pair_accelerations(solved->inverse_mass, p0, at->drift);
  for (int i = 0; i < M; i++)
    at->drift[i] = dd_multiply(at->h, at->drift[i]);
  constrained_force_pairs(at->q0, at->t, step->parameters, at->first_force);
  constraints_pairs(at->q0, at->t, step->parameters, value);
  memcpy(at->first_derivative, value + CONSTRAINTS, sizeof at->first_derivative);
  for (int g = 0; g < GROUPS; g++) {
    for (int i = 0; i < M; i++)
      at->u[i][g] = ddl_word(load(solved->now.u[i], g));
    for (int k = 0; k < CONSTRAINTS; k++)
      at->lambda[k][g] = ddl_word(solved->now.lambda[k][g]);
  }
}

/* Replaces the increments of a step that RATTLE solved; x: its last multipliers. */
static int refine_points(solved_step *solved, const step_data *step, const double *x, double t_low, double h_low,
    double *dq, double *dp)
{
  rattle_pairs at;
  factors l[GROUPS];
  lanes derivative[CONSTRAINT_ENTRIES], change[M * GROUPS];
  real r[M][GROUP_LANES], g_high[CONSTRAINTS][GROUP_LANES], last = INFINITY;
  unknown_sizes sizes = {.widened = 0};
  dd end[M], q[M];
  find_sizes(step, &solved->now, &sizes);
  for (int i = 0; i < M; i++)
    sizes.inverse[i] = 1 / (1 / sizes.inverse[i] + 1e-3 * sizes.largest);
  begin_rattle_pairs(solved, step, t_low, h_low, &at);
  for (int g = 0; g < GROUPS; g++) {
    former_derivatives(&solved->now, g, derivative);
    factorise_points(derivative, solved->now.inverse_mass, l[g]);
  }
  for (int k = 0;; k++) {
    evaluate_pairs_of_points(step->parameters, &at);
    find_pair_residuals(solved, &at, r, g_high);
    correct_points(&solved->now, &at, l, r, g_high);
    for (int n = 0; n < M * GROUPS; n++)
      change[n] = load(r[n / GROUPS], n % GROUPS);
    real moved = measure_change(change, sizes.inverse, sizes.largest).relative;
    const real next = moved * larger(moved / last, FASTEST_MULTIPLIERS);
    const int stagnates = !(moved < last / 4);
    TRY(is_finite(moved) ? OK : NOT_FINITE);
    if (moved <= REFINED || (k > 0 && NEGLECTED * next <= REFINED))
      break;
    if (stagnates && moved > REFINED_ROUNDING && !sizes.widened) { /* above the rounding of positions: that of g */
      widen_sizes(step, &solved->now, &sizes);
      moved = measure_change(change, sizes.inverse, sizes.largest).relative;
    }
    if (stagnates && moved <= REFINED_ROUNDING)
      break;
    if (k + 1 >= MOST_ITERATIONS || (k > TRANSIENT_ITERATIONS && moved > SLOWEST_MULTIPLIERS * last))
      return NOT_CONVERGED;
    last = moved;
  }
  all_pair_forces(&at);
  for (int i = 0; i < M; i++) {
    const dd moved = pair_of_lane(at.moved[i], DEGREE - 1);
    dd sum = dd_of(0.0, 0.0);
    for (int n = 0; n <= DEGREE; n++) {
      const dd force = n < DEGREE ? pair_of_lane(at.f[i], n) : pair_of_lane(at.force[i], DEGREE - 1);
      sum = dd_add(sum, dd_multiply(dd_of(RATTLE_WEIGHT[n], RATTLE_WEIGHT_LOW[n]), force));
    }
    end[i] = dd_multiply(at.h, sum);
    q[i] = dd_add(at.q0[i], moved);
    dq[i] = moved.high, dq[M + i] = moved.low;
  }
  project_end(solved, step, &at, q, x, end);
  for (int i = 0; i < M; i++)
    dp[i] = end[i].high, dp[M + i] = end[i].low;
  return all_finite(dq, 2 * M) && all_finite(dp, 2 * M) ? OK : NOT_FINITE;
}
