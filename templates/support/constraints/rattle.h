#include "../newton/newton.h"

/* Constrained steps on Lobatto points for constant diagonal masses (RATTLE for two points; Lobatto IIIA-IIIB: L.
 * Jay, SIAM J. Numer. Anal. 33, 1996), without the full Newton matrix: iteration for the multipliers that give g = 0
 * at the points, then the multipliers that project p1 onto the tangent space. With the positions
 *
 *   u = q0 + h c M^-1 p0 + h^2 R M^-1 (F + G^T lambda),
 *
 * R = RATTLE_RESPONSE, the correction of lambda at point n solves P_n dlambda_n = -(R^-1 (g + G du))_n / h^2 with
 * P_n = G M^-1 G^T at this point, a band matrix factorised as L D L^T (Golub & Van Loan, Matrix Computations, sec.
 * 4.3.6). It neglects that F and G vary between the points and with u, an error of order h. SIMD lanes are points.
 * Requires: newton.h, constraints.h, the kernels constrained_force and constrained_mass; the tables RATTLE_ABSCISSA,
 * RATTLE_WEIGHT, RATTLE_START, RATTLE_MOMENTUM and its low words, RATTLE_POSITION, RATTLE_RESPONSE and its inverse,
 * padded with zeros; PRODUCT, {e, f, row, distance}: the product of derivatives e and f is part of the entry of P in
 * this row at this distance below the diagonal; CONSTRAINT_POSITION of constraints, CONSTRAINT_REACH of P. */
#define RATTLE
#pragma GCC diagnostic ignored "-Wpsabi" /* all functions with vector arguments are static */

#define PREDICTED REAL(4.0) /* multiple of the next update, from the convergence rate, that is below the tolerance */
#define FASTEST_MULTIPLIERS REAL(1e-3) /* credible convergence rate; a lower one is accidental .. */
#define SUDDEN REAL(0.03) /* .. as is a rate that is lower than this part of the previous one */
#define SLOWEST_MULTIPLIERS REAL(0.5) /* convergence rate of the multipliers beyond which Newton's method is faster */
#define MULTIPLIER_ROUNDOFF (64 * REAL_EPSILON) /* updates below it that decrease slowly are rounding errors */

enum {
  DEGREE = B - 1, /* of B points; lane n is point n + 1 of positions, point n of forces and multipliers */
  LANE_BYTES = POINT_LANES * sizeof(real)
};
typedef real lanes __attribute__((vector_size(LANE_BYTES)));

/* Positions u at all points but the first; forces L_q and derivatives G at all; multipliers at all but the last. */
typedef struct {
  real inverse_mass[M], force[M][POINT_LANES + 1], derivative[CONSTRAINT_ENTRIES][POINT_LANES + 1];
  lanes u[M], g[CONSTRAINTS], lambda[CONSTRAINTS];
} rattle_step;

typedef lanes factors[CONSTRAINTS][CONSTRAINT_REACH + 1]; /* L below its diagonal, D^-1 at distance 0 */

#define LANE_FUNCTION static inline __attribute__((always_inline)) /* vectors are not passed to functions */

LANE_FUNCTION lanes load(const real *x)
{
  lanes loaded;
  memcpy(&loaded, x, sizeof loaded);
  return loaded;
}

LANE_FUNCTION lanes lanes_of(real x)
{
  const lanes zero = {0};
  return zero + x;
}

/* sum_n table_n x_n. */
LANE_FUNCTION lanes times(const real (*table)[POINT_LANES], const lanes *x)
{
  lanes sum = load(table[0]) * (*x)[0], other = lanes_of(0);
#pragma GCC unroll 8
  for (int n = 1; n < DEGREE; n += 2)
    other += load(table[n]) * (*x)[n];
#pragma GCC unroll 8
  for (int n = 2; n < DEGREE; n += 2)
    sum += load(table[n]) * (*x)[n];
  return sum + other;
}

/* Evaluates forces, constraints and their derivatives at all points but the first. */
static inline void evaluate_points(const step_data *step, rattle_step *now)
{
  real u[M][POINT_LANES], f[M][POINT_LANES], g[CONSTRAINTS][POINT_LANES], d[CONSTRAINT_ENTRIES][POINT_LANES];
  memcpy(u, now->u, sizeof u);
  for (int n = 0; n < POINT_LANES; n++) {
    real x[M], force[M], value[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES];
    const real t = step->t + RATTLE_ABSCISSA[n + 1] * step->h;
    for (int i = 0; i < M; i++)
      x[i] = u[i][n];
    constrained_force(x, t, step->parameters, force);
    constraints(x, t, step->parameters, value, derivative);
    for (int i = 0; i < M; i++)
      f[i][n] = force[i];
    for (int k = 0; k < CONSTRAINTS; k++)
      g[k][n] = value[k];
    for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
      d[e][n] = derivative[e];
  }
  for (int i = 0; i < M; i++)
    memcpy(now->force[i] + 1, f[i], sizeof f[i]);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    memcpy(now->derivative[e] + 1, d[e], sizeof d[e]);
  memcpy(now->g, g, sizeof g);
}

/* Factorises P at points from `first` on. Singular matrices lead to solutions that are not finite. */
static inline void factorise_points(const rattle_step *now, int first, factors l)
{
  memset(l, 0, sizeof(factors));
  for (int q = 0; q < PRODUCTS; q++) {
    const int e = PRODUCT[q][0], f = PRODUCT[q][1];
    l[PRODUCT[q][2]][PRODUCT[q][3]] +=
        now->inverse_mass[CONSTRAINT_ENTRY[e][1]] * load(now->derivative[e] + first) * load(now->derivative[f] + first);
  }
  for (int k = 0; k < CONSTRAINTS; k++) {
    const int reach = least(k, CONSTRAINT_REACH);
    for (int b = reach - 1; b > 0; b--)
      for (int c = b + 1; c <= reach; c++)
        l[k][b] -= l[k][c] * l[k - b][c - b];
    for (int b = 1; b <= reach; b++) {
      const lanes scaled = l[k][b] * l[k - b][0];
      l[k][0] -= scaled * l[k][b];
      l[k][b] = scaled;
    }
    l[k][0] = 1 / l[k][0];
  }
}

/* Solves P x = right with these factors, both in the order CONSTRAINT_POSITION. */
static inline void solve_points(factors l, lanes *x)
{
  for (int k = 1; k < CONSTRAINTS; k++)
    for (int b = 1; b <= least(k, CONSTRAINT_REACH); b++)
      x[k] -= l[k][b] * x[k - b];
  for (int k = CONSTRAINTS - 1; k >= 0; k--) {
    x[k] *= l[k][0];
    for (int b = 1; b <= least(CONSTRAINTS - 1 - k, CONSTRAINT_REACH); b++)
      x[k] -= l[k + b][b] * x[k + b];
  }
}

/* f += G^T lambda at all points but the last; lambda_k is lambda[order[k]]. */
static inline void add_constraint_forces(const rattle_step *now, const lanes *lambda, const int *order, lanes *f)
{
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const int k = CONSTRAINT_ENTRY[e][0];
    f[CONSTRAINT_ENTRY[e][1]] += load(now->derivative[e]) * lambda[order ? order[k] : k];
  }
}

/* f = L_q + G^T lambda at all points but the last. */
static inline void all_forces(const rattle_step *now, lanes *f)
{
  for (int i = 0; i < M; i++)
    f[i] = load(now->force[i]);
  add_constraint_forces(now, now->lambda, NULL, f);
}

/* Inverse sizes of the terms of the displacements, whose largest size is returned: forces and reactions cancel at a
 * pinned coordinate, which may be 0. */
static real invert_term_sizes(const step_data *step, const rattle_step *now, real *size)
{
  real largest = 0;
  for (int i = 0; i < M; i++)
    size[i] = MATH(fabs)(now->force[i][0]);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    size[CONSTRAINT_ENTRY[e][1]] += MATH(fabs)(now->derivative[e][0] * now->lambda[CONSTRAINT_ENTRY[e][0]][0]);
  for (int i = 0; i < M; i++) {
    const real change = MATH(fabs)(step->p0[i]) + MATH(fabs)(step->h) * size[i];
    size[i] = MATH(fabs)(step->q0[i]) + MATH(fabs)(step->h * now->inverse_mass[i]) * change;
    largest = larger(largest, size[i]);
    size[i] = 1 / (size[i] + REAL_MIN);
  }
  return largest;
}

/* Returns 1 if the iterate that `moved` led to is accepted: its update, or the next one as predicted from the rate of
 * the last updates, is below the tolerance, or rounding ended the decrease. 0: continue; -1: convergence is slow. */
static inline int accepts(const movement *moved, const real *last, const solver_options *options, int k)
{
  const real now = options->absolute ? moved->absolute : moved->relative, tolerance = options->tolerance;
  const real rest = PREDICTED * larger(now, FASTEST_MULTIPLIERS * last[0]);
  if (options->absolute ? now < tolerance : now <= tolerance)
    return 1;
  if (k > 0 && rest * now <= tolerance * last[0] && PREDICTED * now * (SUDDEN * last[0]) <= tolerance * last[1])
    return 1;
  if (!options->absolute && moved->overall <= MULTIPLIER_ROUNDOFF && now >= STOPPED_SHRINKING * last[0])
    return 1;
  if (k > 1 && !(now < SLOWEST_MULTIPLIERS * last[0]))
    return !options->absolute && moved->overall <= ROUNDOFF_LEVEL && now >= last[0] ? 1
        : moved->overall > ROUNDOFF_LEVEL                                           ? -1
                                                                                    : 0;
  return 0;
}

/* One iteration: updates lambda and u by `change`. */
static inline void iterate(const step_data *step, rattle_step *now, const lanes *base, const real *scale, lanes *change)
{
  factors l;
  lanes f[M], next[M], residual[CONSTRAINTS], x[CONSTRAINTS];
  factorise_points(now, 0, l);
  all_forces(now, f);
  memcpy(residual, now->g, sizeof residual);
  for (int i = 0; i < M; i++)
    next[i] = base[i] + scale[i] * times(RATTLE_RESPONSE, &f[i]);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++) {
    const int i = CONSTRAINT_ENTRY[e][1];
    residual[CONSTRAINT_ENTRY[e][0]] += load(now->derivative[e] + 1) * (next[i] - now->u[i]);
  }
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = times(RATTLE_INVERSE, &residual[k]) * (-1 / (step->h * step->h));
  solve_points(l, x);
  for (int k = 0; k < CONSTRAINTS; k++)
    now->lambda[k] += x[CONSTRAINT_POSITION[k]];
  memset(f, 0, sizeof f);
  add_constraint_forces(now, x, CONSTRAINT_POSITION, f);
  for (int i = 0; i < M; i++) {
    next[i] += scale[i] * times(RATTLE_RESPONSE, &f[i]);
    change[i] = next[i] - now->u[i];
    now->u[i] = next[i];
  }
}

/* Measures a change in units of these inverse sizes. */
static inline movement measure_change(const lanes *change, const real *inverse_size, real largest_size)
{
  movement moved = no_movement();
  real relative[POINT_LANES] = {0}, absolute[POINT_LANES] = {0};
  for (int i = 0; i < M; i++)
    for (int n = 0; n < POINT_LANES; n++) {
      const real size = MATH(fabs)(change[i][n]);
      relative[n] = larger(size * inverse_size[i], relative[n]);
      absolute[n] = larger(size, absolute[n]);
    }
  for (int n = 0; n < DEGREE; n++) {
    moved.relative = larger(relative[n], moved.relative);
    moved.absolute = larger(absolute[n], moved.absolute);
  }
  moved.overall = moved.absolute > 0 ? moved.absolute / largest_size : 0;
  return moved;
}

/* Solves g(u) = 0 for lambda and u; evaluates forces and constraints there. Returns NOT_CONVERGED or NOT_FINITE on
 * failure. */
static int solve_constraints(const step_data *step, rattle_step *now, const solver_options *options,
    solver_report *report)
{
  lanes base[M], change[M];
  real scale[M], inverse_size[M], largest_size = 0, last[2] = {(real)INFINITY, (real)INFINITY};
  const lanes abscissa = load(RATTLE_ABSCISSA + 1);
  for (int i = 0; i < M; i++) {
    const real start = step->h * step->p0[i] * now->inverse_mass[i];
    base[i] = step->q0[i] + (step->carry_q[i] + abscissa * start);
    scale[i] = step->h * step->h * now->inverse_mass[i];
  }
  evaluate_points(step, now);
  for (int k = 0; k < least(options->max_iterations, MOST_ITERATIONS); k++) {
    movement moved;
    int verdict;
    iterate(step, now, base, scale, change);
    if (k == 0)
      largest_size = invert_term_sizes(step, now, inverse_size);
    moved = measure_change(change, inverse_size, largest_size);
    report->iterations++;
    report->change = options->absolute ? moved.absolute : moved.relative;
    evaluate_points(step, now);
    verdict = accepts(&moved, last, options, k);
    if (verdict > 0)
      return OK;
    if (verdict < 0)
      return NOT_CONVERGED;
    last[1] = last[0];
    last[0] = report->change;
  }
  return NOT_CONVERGED;
}

/* Initial values: the first point, and a guess of the others, from the unknowns in data->z. */
static void begin(const step_data *step, const newton_data *data, rattle_step *now)
{
  real force[M], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES];
  constrained_mass(NULL, step->t, step->parameters, now->inverse_mass);
  constrained_force(step->q0, step->t, step->parameters, force);
  constraints(step->q0, step->t, step->parameters, g, derivative);
  for (int i = 0; i < M; i++) {
    lanes z = {0};
    memcpy(&z, data->z + i * B, sizeof(real) * DEGREE);
    now->inverse_mass[i] = 1 / now->inverse_mass[i];
    now->force[i][0] = force[i];
    now->u[i] = step->q0[i] + (step->carry_q[i] + step->h * times(RATTLE_POSITION, &z));
  }
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    now->derivative[e][0] = derivative[e];
  for (int k = 0; k < CONSTRAINTS; k++) {
    now->lambda[k] = lanes_of(0);
    memcpy(now->lambda + k, data->z + (M + k) * B, sizeof(real) * DEGREE);
  }
}

/* Computes p1 - p0 on the tangent space, and the unknowns z of the step. */
static int finish_step(const step_data *step, const rattle_step *now, newton_data *data, real *dp)
{
  const real weight = step->h * RATTLE_WEIGHT[DEGREE];
  const lanes start = load(RATTLE_START);
  factors l;
  lanes f[M], x[CONSTRAINTS];
  real u[2 * M], value[M + 2 * CONSTRAINTS];
  all_forces(now, f);
  for (int i = 0; i < M; i++) {
    real sum = RATTLE_WEIGHT[DEGREE] * now->force[i][DEGREE];
    for (int n = 0; n < DEGREE; n++)
      sum += RATTLE_WEIGHT[n] * f[i][n];
    dp[i] = step->h * sum;
    u[i] = now->u[i][DEGREE - 1];
    u[M + i] = (step->p0[i] + dp[i]) * now->inverse_mass[i];
  }
  constrained_motion(u, step->t + step->h, step->parameters, value);
  factorise_points(now, 1, l);
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = lanes_of(-value[M + k] / weight);
  solve_points(l, x);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    dp[CONSTRAINT_ENTRY[e][1]] +=
        weight * now->derivative[e][DEGREE] * x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]][DEGREE - 1];
  for (int i = 0; i < M; i++) {
    const lanes push = times(RATTLE_MOMENTUM, &f[i]) + times(RATTLE_MOMENTUM_LOW, &f[i]);
    const lanes z = (step->p0[i] + (start * step->p0[i] + step->h * push)) * now->inverse_mass[i];
    memcpy(data->z + i * B, &z, sizeof(real) * DEGREE);
    data->z[i * B + DEGREE] = (step->p0[i] + dp[i]) * now->inverse_mass[i];
  }
  for (int k = 0; k < CONSTRAINTS; k++) {
    memcpy(data->z + (M + k) * B, now->lambda + k, sizeof(real) * DEGREE);
    data->z[(M + k) * B + DEGREE] = x[CONSTRAINT_POSITION[k]][DEGREE - 1];
  }
  return all_finite(data->z, N) ? OK : NOT_FINITE;
}

/* Computes the unknowns z of the step, from their initial guess, and p1 - p0. On failure they are undefined. */
static int rattle(const step_data *step, newton_data *data, real *dp, const solver_options *options,
    solver_report *report)
{
  rattle_step now;
  int status;
  begin(step, data, &now);
  status = solve_constraints(step, &now, options, report);
  return status == OK ? finish_step(step, &now, data, dp) : status;
}
