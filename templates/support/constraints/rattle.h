#include "../newton/newton.h"

/* Constrained steps on Lobatto points for constant diagonal masses (RATTLE for two points; Lobatto IIIA-IIIB: L.
 * Jay, SIAM J. Numer. Anal. 33, 1996), without the full Newton matrix: iteration for the multipliers that give g = 0
 * at the points, then the multipliers that project p1 onto the tangent space. With the forces f = F + G^T lambda, F =
 * L_q, positions are
 *
 *   u = q0 + h c M^-1 p0 + h^2 R M^-1 f,
 *
 * c = RATTLE_DRIFT, R = RATTLE_RESPONSE. The correction of lambda at each point solves P dlambda = -G M^-1 df -
 * R^-1 g / h^2, where df is the change of the forces since those of u, and P = G M^-1 G^T at this point is a band
 * matrix factorised as L D L^T (Golub & Van Loan, Matrix Computations, sec. 4.3.6). It neglects that G varies
 * between the points, an error of order h, and that F varies with u. SIMD lanes are points. With VELOCITY_FORCES F
 * includes forces that depend on the velocities of the curve at the points,
 *
 *   v = (1 + s) M^-1 p0 + h V M^-1 f,
 *
 * s = RATTLE_VELOCITY_START, 0 except for rounding, V = RATTLE_VELOCITY with its low words.
 *
 * Requires: newton.h, constraints.h, the kernels constrained_force and constrained_mass; the tables
 * RATTLE_ABSCISSA, RATTLE_WEIGHT, RATTLE_START, RATTLE_MOMENTUM, RATTLE_RESPONSE and RATTLE_DRIFT with their low
 * words, RATTLE_INVERSE of R, and from the unknowns of the previous step RATTLE_POSITIONS, in units of h, and
 * RATTLE_MULTIPLIERS, padded with zeros; PRODUCT, {e, f, row, distance}: the product of derivatives e and f is part
 * of the entry of P in this row at this distance below the diagonal; CONSTRAINT_POSITION of constraints,
 * CONSTRAINT_REACH of P; POINT_LANES; FORMER_POINTS, the indices that shift lanes by one point; with VELOCITY_FORCES
 * also RATTLE_LAST_VELOCITY, from the velocities z of the step to that at the last point. */
#define RATTLE
#pragma GCC diagnostic ignored "-Wpsabi" /* all functions with vector arguments are static */

#define PREDICTED REAL(4.0) /* multiple of the next update, from the convergence rate, that is below the tolerance */
#define SLOWEST_MULTIPLIERS REAL(0.5) /* convergence rate of the multipliers beyond which Newton's method is faster */
#define TRANSIENT_ITERATIONS 2 /* that need not contract */
#define REUSED_FACTORS REAL(1e-2) /* relative update below which the factors of P are reused in the next iteration */
#ifdef VELOCITY_FORCES
#define MULTIPLIER_ROUNDOFF (16 * REAL_EPSILON) /* updates below it that decrease slowly are rounding errors */
#define ROUNDED_SHRINKING 1
#define FASTEST_MULTIPLIERS REAL(2e-2) /* credible convergence rate; a lower one is accidental */
#define STAGNANT_ROUNDOFF MULTIPLIER_ROUNDOFF /* complex convergence rates: updates that grow may shrink later */
#else
#define FASTEST_MULTIPLIERS REAL(1e-3)
#define MULTIPLIER_ROUNDOFF (64 * REAL_EPSILON)
#define ROUNDED_SHRINKING STOPPED_SHRINKING
#define STAGNANT_ROUNDOFF ROUNDOFF_LEVEL
#endif

enum {
  DEGREE = B - 1, /* of B points; lane n is point n + 1 of positions, point n of forces and multipliers */
  LANE_BYTES = POINT_LANES * sizeof(real)
};
typedef real lanes __attribute__((vector_size(LANE_BYTES)));

#if defined(__AVX512F__) && POINT_LANES >= 8 && !defined(__clang__)
#pragma GCC target("prefer-vector-width=512") /* loops over lanes become whole vectors, not halves */
#endif
#ifdef __clang__
#define FORMER(x, first) __builtin_shufflevector(x, first, FORMER_POINTS)
#else
#ifdef SINGLE_PRECISION
typedef int lane_numbers __attribute__((vector_size(LANE_BYTES)));
#else
typedef long long lane_numbers __attribute__((vector_size(LANE_BYTES)));
#endif
#define FORMER(x, first) __builtin_shuffle(x, first, (lane_numbers){FORMER_POINTS})
#endif

/* Positions u, forces F, derivatives G and g at all points but the first, where the second and third are first_force
 * and first_derivative; multipliers and the forces f of u at all but the last. `base` is u without forces. With
 * VELOCITY_FORCES force, positions `at` and velocities v are at all points but the last, and base_v is v without
 * forces. */
typedef struct {
  real u[M][POINT_LANES], f[M][POINT_LANES], force[M][POINT_LANES], g[CONSTRAINTS][POINT_LANES];
  real derivative[CONSTRAINT_ENTRIES][POINT_LANES], first_force[M], first_derivative[CONSTRAINT_ENTRIES];
  real inverse_mass[M];
  lanes base[M], lambda[CONSTRAINTS];
#ifdef VELOCITY_FORCES
  real at[M][POINT_LANES], v[M][POINT_LANES];
  lanes base_v[M];
#endif
} rattle_step;

typedef lanes factors[CONSTRAINTS][CONSTRAINT_REACH + 1]; /* L below its diagonal, D^-1 at distance 0 */

#define LANE_FUNCTION static inline __attribute__((always_inline)) /* vectors are not passed to functions */

#define IN_MEMORY(values) __asm__("" : "+m"(values)) /* after they were stored */

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

/* sum_n table_n x_n of numbers in memory, from which vector instructions broadcast. */
LANE_FUNCTION lanes times(const real (*table)[POINT_LANES], int count, const real *x)
{
  lanes sum = load(table[0]) * x[0], other = lanes_of(0);
#pragma GCC unroll 16
  for (int n = 1; n < count; n += 2)
    other += load(table[n]) * x[n];
#pragma GCC unroll 16
  for (int n = 2; n < count; n += 2)
    sum += load(table[n]) * x[n];
  return sum + other;
}

#ifdef VELOCITY_FORCES
/* Forces at the point of a lane. */
LANE_FUNCTION void force_of_lane(const step_data *step, const rattle_step *now, int n, real *force)
{
  real u[2 * M];
#pragma GCC unroll 64
  for (int i = 0; i < M; i++)
    u[i] = now->at[i][n];
#pragma GCC unroll 64
  for (int i = 0; i < M; i++)
    u[M + i] = now->v[i][n];
  constrained_force(u, step->t + RATTLE_ABSCISSA[n] * step->h, step->parameters, force);
}

/* Positions and velocities at all points but the last, of u and f. */
static inline void move_points(const step_data *step, rattle_step *now)
{
  for (int i = 0; i < M; i++) {
    const lanes at = FORMER(load(now->u[i]), lanes_of(step->q0[i]));
    const lanes v = now->base_v[i] +
        step->h * now->inverse_mass[i] * times(RATTLE_VELOCITY, DEGREE, now->f[i]);
    memcpy(now->at[i], &at, sizeof at);
    memcpy(now->v[i], &v, sizeof v);
  }
}
#else
LANE_FUNCTION void force_of_lane(const step_data *step, const rattle_step *now, int n, real *force)
{
  real u[M];
#pragma GCC unroll 64
  for (int i = 0; i < M; i++)
    u[i] = now->u[i][n];
  constrained_force(u, step->t + RATTLE_ABSCISSA[n + 1] * step->h, step->parameters, force);
}

static inline void move_points(const step_data *step, rattle_step *now)
{
  (void)step, (void)now;
}
#endif

/* Evaluates forces, constraints and their derivatives. */
static __attribute__((flatten)) void evaluate_points(const step_data *step, rattle_step *restrict now)
{
  move_points(step, now);
  for (int n = 0; n < POINT_LANES; n++) {
    real u[M], force[M], g[CONSTRAINTS], derivative[CONSTRAINT_ENTRIES];
    const real t = step->t + RATTLE_ABSCISSA[n + 1] * step->h;
#pragma GCC unroll 64
    for (int i = 0; i < M; i++)
      u[i] = now->u[i][n];
    force_of_lane(step, now, n, force);
    constraints(u, t, step->parameters, g, derivative);
#pragma GCC unroll 64
    for (int i = 0; i < M; i++)
      now->force[i][n] = force[i];
#pragma GCC unroll 64
    for (int k = 0; k < CONSTRAINTS; k++)
      now->g[k][n] = g[k];
#pragma GCC unroll 64
    for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
      now->derivative[e][n] = derivative[e];
  }
}

/* Factorises P with these derivatives. Singular matrices lead to solutions that are not finite. */
static inline void factorise_points(const lanes *derivative, const real *inverse_mass, factors l)
{
  memset(l, 0, sizeof(factors));
#pragma GCC unroll 64
  for (int q = 0; q < PRODUCTS; q++) {
    const int e = PRODUCT[q][0], f = PRODUCT[q][1];
    l[PRODUCT[q][2]][PRODUCT[q][3]] += inverse_mass[CONSTRAINT_ENTRY[e][1]] * derivative[e] * derivative[f];
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

/* Derivatives at all points but the last. */
static inline void former_derivatives(const rattle_step *now, lanes *derivative)
{
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = FORMER(load(now->derivative[e]), lanes_of(now->first_derivative[e]));
}

#ifdef VELOCITY_FORCES
#define FORCES_BEFORE_LAST(now, i) load((now)->force[i])
#define FIRST_FORCE(now, i) (now)->force[i][0]
#else
#define FORCES_BEFORE_LAST(now, i) FORMER(load((now)->force[i]), lanes_of((now)->first_force[i]))
#define FIRST_FORCE(now, i) (now)->first_force[i]
#endif

/* f = F + G^T lambda at all points but the last. */
static inline void all_forces(const rattle_step *now, const lanes *derivative, lanes *f)
{
  for (int i = 0; i < M; i++)
    f[i] = FORCES_BEFORE_LAST(now, i);
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    f[CONSTRAINT_ENTRY[e][1]] += derivative[e] * now->lambda[CONSTRAINT_ENTRY[e][0]];
}

/* Inverse sizes of the terms of the displacements, whose largest size is returned: forces and reactions cancel at a
 * pinned coordinate, which may be 0. */
static real invert_term_sizes(const step_data *step, const rattle_step *now, real *size)
{
  real largest = 0;
  for (int i = 0; i < M; i++)
    size[i] = MATH(fabs)(FIRST_FORCE(now, i));
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    size[CONSTRAINT_ENTRY[e][1]] += MATH(fabs)(now->first_derivative[e] * now->lambda[CONSTRAINT_ENTRY[e][0]][0]);
  for (int i = 0; i < M; i++) {
    const real change = MATH(fabs)(step->p0[i]) + MATH(fabs)(step->h) * size[i];
    size[i] = MATH(fabs)(step->q0[i]) + MATH(fabs)(step->h * now->inverse_mass[i]) * change;
    largest = larger(largest, size[i]);
    size[i] = 1 / (size[i] + REAL_MIN);
  }
  return largest;
}

/* Returns 1 if the iterate that `moved` led to is accepted: its update, or the next one as predicted from the lower of
 * the last two rates, is below the tolerance, or rounding ended the decrease. 0: continue; -1: convergence is slow.
 * The rate is that of the largest coordinates: updates of one that is held at 0 may be rounding errors of others. */
static inline int accepts(const movement *moved, const movement *last, const solver_options *options, int k)
{
  const int absolute = options->absolute;
  const real now = absolute ? moved->absolute : moved->relative, tolerance = options->tolerance;
  const real before = absolute ? last[0].absolute : last[0].relative;
  const real earlier = absolute ? last[1].absolute : last[1].relative;
  const real next = PREDICTED * now * larger(now, FASTEST_MULTIPLIERS * before); /* times `before` */
  const int stagnant = moved->overall >= SLOWEST_MULTIPLIERS * last[0].overall &&
      moved->overall >= SLOWEST_MULTIPLIERS * SLOWEST_MULTIPLIERS * last[1].overall;
  if (absolute ? now < tolerance : now <= tolerance)
    return 1;
  if (k > 0 && next <= tolerance * before && PREDICTED * now * before <= tolerance * earlier)
    return 1;
  if (!absolute && moved->overall <= MULTIPLIER_ROUNDOFF && now >= ROUNDED_SHRINKING * before)
    return 1;
  if (!absolute && stagnant && moved->overall <= STAGNANT_ROUNDOFF && moved->overall >= last[0].overall)
    return 1;
  return k > TRANSIENT_ITERATIONS && stagnant && moved->overall > STAGNANT_ROUNDOFF ? -1 : 0;
}

/* One iteration: updates lambda, f and u, the last by `change`. */
static inline void iterate(const step_data *step, rattle_step *now, factors l, int factorised, lanes *change)
{
  const real hh = step->h * step->h, scale = 1 / hh;
  lanes derivative[CONSTRAINT_ENTRIES], push[M], x[CONSTRAINTS];
  former_derivatives(now, derivative);
  if (!factorised)
    factorise_points(derivative, now->inverse_mass, l);
  all_forces(now, derivative, push);
  for (int i = 0; i < M; i++)
    push[i] = (push[i] - load(now->f[i])) * now->inverse_mass[i];
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = times(RATTLE_INVERSE, DEGREE, now->g[k]) * scale;
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]] += derivative[e] * push[CONSTRAINT_ENTRY[e][1]];
  solve_points(l, x);
  for (int k = 0; k < CONSTRAINTS; k++)
    now->lambda[k] -= x[CONSTRAINT_POSITION[k]];
  all_forces(now, derivative, push);
  memcpy(now->f, push, sizeof push);
  IN_MEMORY(now->f);
  for (int i = 0; i < M; i++) {
    const real by = hh * now->inverse_mass[i];
    const lanes u = now->base[i] + by * times(RATTLE_RESPONSE, DEGREE, now->f[i]);
    change[i] = u - load(now->u[i]);
    memcpy(now->u[i], &u, sizeof u);
  }
}

/* Replaces x by the larger of x and |y|. */
LANE_FUNCTION void keep_larger(lanes *x, const lanes *y)
{
  real largest[POINT_LANES], other[POINT_LANES];
  memcpy(largest, x, sizeof largest);
  memcpy(other, y, sizeof other);
  for (int n = 0; n < POINT_LANES; n++) {
    const real size = MATH(fabs)(other[n]);
    largest[n] = size > largest[n] ? size : largest[n];
  }
  memcpy(x, largest, sizeof largest);
}

LANE_FUNCTION real largest_lane(const lanes *x)
{
  real largest[POINT_LANES];
  memcpy(largest, x, sizeof largest);
  for (int half = POINT_LANES / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      largest[n] = larger(largest[n + half], largest[n]);
  return largest[0];
}

/* Measures a change in units of these inverse sizes. Lanes beyond the points do not change. */
static inline movement measure_change(const lanes *change, const real *inverse_size, real largest_size)
{
  movement moved = no_movement();
  lanes relative = {0}, absolute = {0};
  for (int i = 0; i < M; i++) {
    const lanes ratio = change[i] * inverse_size[i];
    keep_larger(&relative, &ratio);
    keep_larger(&absolute, &change[i]);
  }
  moved.relative = largest_lane(&relative);
  moved.absolute = largest_lane(&absolute);
  moved.overall = moved.absolute > 0 ? moved.absolute / largest_size : 0;
  return moved;
}

/* Solves g(u) = 0 for lambda and u; evaluates forces and constraints there. Returns NOT_CONVERGED on failure. */
static int solve_constraints(const step_data *step, rattle_step *now, const solver_options *options,
    solver_report *report)
{
  factors l;
  lanes change[M];
  real inverse_size[M], largest_size = 0;
  const movement unknown = {(real)INFINITY, (real)INFINITY, (real)INFINITY, 0};
  movement last[2] = {unknown, unknown};
  int factorised = 0;
  evaluate_points(step, now);
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

/* Initial values: the first point, and a guess of the others from the unknowns of the previous step, or if they are
 * NULL motion without forces. Rounded tables would be those of another method, whose energy drifts: the low words of R
 * act on the guess of the forces. */
static void begin(const step_data *step, const real *memory, rattle_step *now)
{
  const lanes drift = load(RATTLE_DRIFT), drift_low = load(RATTLE_DRIFT_LOW);
  real g[CONSTRAINTS], mass[M];
  constrained_mass(NULL, step->t, step->parameters, mass);
#ifndef VELOCITY_FORCES
  constrained_force(step->q0, step->t, step->parameters, now->first_force);
#endif
  constraints(step->q0, step->t, step->parameters, g, now->first_derivative);
  for (int i = 0; i < M; i++) {
    const real v = step->p0[i] / mass[i], moved = step->h * v;
    lanes low = drift_low * moved, x = drift * moved, f = lanes_of(0);
    now->inverse_mass[i] = 1 / mass[i];
    now->base[i] = x;
    if (memory) {
      const lanes z = times(RATTLE_POSITIONS, B, memory + i * B), bend = z - drift * v;
      x = step->h * z;
      memcpy(now->f[i], &bend, sizeof bend);
      IN_MEMORY(now->f[i]);
      f = mass[i] / step->h * times(RATTLE_INVERSE, DEGREE, now->f[i]);
    }
    memcpy(now->f[i], &f, sizeof f);
    IN_MEMORY(now->f[i]);
#ifdef VELOCITY_FORCES
    const lanes change = load(RATTLE_VELOCITY_START) * v +
        step->h * now->inverse_mass[i] * times(RATTLE_VELOCITY_LOW, DEGREE, now->f[i]);
    now->base_v[i] = v + change;
#endif
    low += step->h * step->h * now->inverse_mass[i] * times(RATTLE_RESPONSE_LOW, DEGREE, now->f[i]);
    x = step->q0[i] + (step->carry_q[i] + x);
    now->base[i] = step->q0[i] + (step->carry_q[i] + (low + now->base[i]));
    memcpy(now->u[i], &x, sizeof x);
  }
  for (int k = 0; k < CONSTRAINTS; k++)
    now->lambda[k] = memory ? times(RATTLE_MULTIPLIERS, B, memory + (M + k) * B) : lanes_of(0);
}

/* Force at the last point, where the velocity is that of the curve with velocities z. */
static inline void last_force(const step_data *step, const rattle_step *now, const real *z, real *force)
{
#ifdef VELOCITY_FORCES
  real u[2 * M] = {0};
  for (int i = 0; i < M; i++) {
    u[i] = now->u[i][DEGREE - 1];
    for (int b = 0; b < DEGREE; b++)
      u[M + i] += RATTLE_LAST_VELOCITY[b] * z[i * B + b];
  }
  constrained_force(u, step->t + RATTLE_ABSCISSA[DEGREE] * step->h, step->parameters, force);
#else
  (void)step, (void)z;
  for (int i = 0; i < M; i++)
    force[i] = now->force[i][DEGREE - 1];
#endif
}

/* Computes p1 - p0 on the tangent space, and the unknowns z of the step. */
static int finish_step(const step_data *step, rattle_step *now, newton_data *data, real *dp)
{
  const real weight = step->h * RATTLE_WEIGHT[DEGREE];
  const lanes start = load(RATTLE_START);
  factors l;
  lanes derivative[CONSTRAINT_ENTRIES], f[M], x[CONSTRAINTS];
  real u[2 * M], value[M + 2 * CONSTRAINTS], force[M];
  former_derivatives(now, derivative);
  all_forces(now, derivative, f);
  memcpy(now->f, f, sizeof f);
  IN_MEMORY(now->f);
  for (int i = 0; i < M; i++) {
    const lanes push = times(RATTLE_MOMENTUM, DEGREE, now->f[i]) +
        times(RATTLE_MOMENTUM_LOW, DEGREE, now->f[i]);
    const lanes z = (step->p0[i] + (start * step->p0[i] + step->h * push)) * now->inverse_mass[i];
    memcpy(data->z + i * B, &z, sizeof(real) * DEGREE);
  }
  last_force(step, now, data->z, force);
  for (int i = 0; i < M; i++) {
    real sum = RATTLE_WEIGHT[DEGREE] * force[i];
    for (int n = 0; n < DEGREE; n++)
      sum += RATTLE_WEIGHT[n] * now->f[i][n];
    dp[i] = step->h * sum;
    u[i] = now->u[i][DEGREE - 1];
    u[M + i] = (step->p0[i] + dp[i]) * now->inverse_mass[i];
  }
  constrained_motion(u, step->t + step->h, step->parameters, value);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = load(now->derivative[e]);
  factorise_points(derivative, now->inverse_mass, l);
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = lanes_of(-value[M + k] / weight);
  solve_points(l, x);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    dp[CONSTRAINT_ENTRY[e][1]] += weight * now->derivative[e][DEGREE - 1] *
        x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]][DEGREE - 1];
  for (int i = 0; i < M; i++)
    data->z[i * B + DEGREE] = (step->p0[i] + dp[i]) * now->inverse_mass[i];
  for (int k = 0; k < CONSTRAINTS; k++) {
    memcpy(data->z + (M + k) * B, now->lambda + k, sizeof(real) * DEGREE);
    data->z[(M + k) * B + DEGREE] = x[CONSTRAINT_POSITION[k]][DEGREE - 1];
  }
  return all_finite(data->z, N) ? OK : NOT_FINITE;
}

/* Computes the unknowns z of the step, and p1 - p0, with a guess from those of the previous step, if they are not NULL.
 * On failure they are undefined. */
static int rattle(const step_data *step, const real *memory, newton_data *data, real *dp, const solver_options *options,
    solver_report *report)
{
  rattle_step now;
  int status;
  begin(step, memory, &now);
  status = solve_constraints(step, &now, options, report);
  return status == OK ? finish_step(step, &now, data, dp) : status;
}
