#include "../core/vector_width.h"
#include "../newton/newton.h"

/* Constrained steps on Lobatto points for a constant mass matrix M (RATTLE for two points; Lobatto IIIA-IIIB: L. Jay,
 * SIAM J. Numer. Anal. 33, 1996), without the full Newton matrix: iteration for the multipliers that give g = 0 at the
 * points, then the multipliers that project p1 onto the tangent space. With the accelerations a = M^-1 (F + G^T
 * lambda), F = L_q, positions are
 *
 *   u = q0 + h c v0 + h^2 R a,    v0 = M^-1 p0,
 *
 * c = RATTLE_DRIFT, R = RATTLE_RESPONSE. The correction of lambda at each point solves P dlambda = -G da - R^-1 g /
 * h^2, where da is the change of the accelerations since those of u, and P = G M^-1 G^T at this point is a band
 * matrix factorised as L D L^T (Golub & Van Loan, Matrix Computations, sec. 4.3.6). It neglects that G varies
 * between the points, an error of order h, and that F varies with u. SIMD lanes are points, in groups that fill a
 * register. With VELOCITY_FORCES F includes forces that depend on the velocities of the curve at the points,
 *
 *   v = (1 + s) v0 + h V a,
 *
 * s = RATTLE_VELOCITY_START, 0 except for rounding, V = RATTLE_VELOCITY with its low words. With MOMENTUM_TERMS
 * momenta are M v + A(q, t), as in a magnetic field or a rotating frame: then v0 = M^-1 (p0 - A0), and with w = M^-1
 * (A - A0) at all points but the first the positions are less h Q w, Q = RATTLE_SHIFT with its low words, v is less
 * RATTLE_VELOCITY_SHIFT w, and da less R^-1 Q dw / h.
 *
 * Requires: newton.h, constraints.h, the kernels constrained_force and, with MOMENTUM_TERMS, constrained_momentum, A;
 * the tables RATTLE_ABSCISSA, RATTLE_WEIGHT, RATTLE_START, RATTLE_MOMENTUM, RATTLE_RESPONSE and RATTLE_DRIFT with their
 * low words, RATTLE_INVERSE of R, and from the unknowns of the previous step RATTLE_POSITIONS, in units of h, and
 * RATTLE_MULTIPLIERS, padded with zeros; PRODUCT, {e, f, row, distance, entry}: the product of derivatives e and f and
 * this entry of M^-1 is part of the entry of P in this row at this distance below the diagonal; INVERSE_MASS_ENTRY, {i,
 * j}: the lower half of M^-1, the diagonal first; MASS_COLUMN, a number below MASS_COLUMNS that differs for coordinates
 * that masses couple; CONSTRAINT_POSITION of constraints, CONSTRAINT_REACH of P; POINT_LANES, a power of two; with
 * VELOCITY_FORCES also RATTLE_LAST_VELOCITY, from the velocities z of the step to that at the last point; with
 * MOMENTUM_TERMS RATTLE_SHIFT_RESPONSE, R^-1 Q, and RATTLE_PROJECTION, by which w reduces z. */
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

#ifdef SINGLE_PRECISION
#define REGISTER_LANES (VECTOR_BYTES / 4)
typedef int lane_number;
#define BUT_SIGN INT_MAX
#else
#define REGISTER_LANES (VECTOR_BYTES / 8)
typedef long long lane_number;
#define BUT_SIGN LLONG_MAX
#endif
#if POINT_LANES < REGISTER_LANES
#define LANES POINT_LANES
#else
#define LANES REGISTER_LANES
#endif
#if LANES == 1
#define FORMER_LANES 1
#elif LANES == 2
#define FORMER_LANES 3, 0
#elif LANES == 4
#define FORMER_LANES 7, 0, 1, 2
#elif LANES == 8
#define FORMER_LANES 15, 0, 1, 2, 3, 4, 5, 6
#else
#define FORMER_LANES 31, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14
#endif

enum {
  DEGREE = B - 1, /* of B points; point n + 1 of positions is point n of forces and multipliers */
  GROUPS = (DEGREE + LANES - 1) / LANES, /* of points; point n is lane n % LANES of group n / LANES */
  GROUP_LANES = GROUPS * LANES,
  LAST_GROUP = (DEGREE - 1) / LANES,
  LANE_BYTES = LANES * sizeof(real)
};
typedef real lanes __attribute__((vector_size(LANE_BYTES)));
typedef lane_number lane_numbers __attribute__((vector_size(LANE_BYTES)));

#if defined(__AVX512F__) && POINT_LANES >= 8 && !defined(__clang__)
#pragma GCC target("prefer-vector-width=512") /* loops over lanes become whole vectors, not halves */
#endif
#ifdef __clang__
#define FORMER(x, before) __builtin_shufflevector(x, before, FORMER_LANES)
#else
#define FORMER(x, before) __builtin_shuffle(x, before, (lane_numbers){FORMER_LANES})
#endif

/* Positions u, forces F, derivatives G and g at all points but the first, where the second and third are first_force
 * and first_derivative; multipliers and the accelerations a of u at all but the last. `base` is u without forces. With
 * VELOCITY_FORCES force, positions `at` and velocities v are at all points but the last, and base_v is v without
 * forces. With MOMENTUM_TERMS A, w and its last change, at all points but the first, where A is first_A. */
typedef struct {
  real u[M][GROUP_LANES], a[M][GROUP_LANES], force[M][GROUP_LANES], g[CONSTRAINTS][GROUP_LANES];
  real derivative[CONSTRAINT_ENTRIES][GROUP_LANES], first_force[M], first_derivative[CONSTRAINT_ENTRIES];
  real inverse_mass[INVERSE_MASSES];
  real v0[M];
  lanes base[M][GROUPS], lambda[CONSTRAINTS][GROUPS];
#ifdef VELOCITY_FORCES
  real at[M][GROUP_LANES], v[M][GROUP_LANES];
  lanes base_v[M][GROUPS];
#endif
#ifdef MOMENTUM_TERMS
  real A[M][GROUP_LANES], w[M][GROUP_LANES], change[M][GROUP_LANES], first_A[M];
#endif
} rattle_step;

typedef lanes factors[CONSTRAINTS][CONSTRAINT_REACH + 1]; /* L below its diagonal, D^-1 at distance 0 */

#define LANE_FUNCTION static inline __attribute__((always_inline)) /* vectors are not passed to functions */

#define IN_MEMORY(values) __asm__("" : "+m"(values)) /* after they were stored */

/* Group g of the values x at the points. */
LANE_FUNCTION lanes load(const real *x, int g)
{
  lanes loaded;
  memcpy(&loaded, x + g * LANES, sizeof loaded);
  return loaded;
}

LANE_FUNCTION void store(real *x, int g, lanes values)
{
  memcpy(x + g * LANES, &values, sizeof values);
}

LANE_FUNCTION lanes lanes_of(real x)
{
  const lanes zero = {0};
  return zero + x;
}

/* Group g of x at the points before, first at the first point. */
LANE_FUNCTION lanes former(const real *x, real first, int g)
{
  return FORMER(load(x, g), g > 0 ? load(x, g - 1) : lanes_of(first));
}

/* Group g of sum_n table_n x_n, of numbers in memory, from which vector instructions broadcast. */
LANE_FUNCTION lanes times(const real (*table)[POINT_LANES], int count, const real *x, int g)
{
  lanes sum = load(table[0], g) * x[0], other = lanes_of(0);
#pragma GCC unroll 16
  for (int n = 1; n < count; n += 2)
    other += load(table[n], g) * x[n];
#pragma GCC unroll 16
  for (int n = 2; n < count; n += 2)
    sum += load(table[n], g) * x[n];
  return sum + other;
}

/* factor table w of momentum terms. */
#ifdef MOMENTUM_TERMS
#define OF_MOMENTA(factor, table, w, g) ((factor) * times(table, DEGREE, w, g))
#else
#define OF_MOMENTA(factor, table, w, g) lanes_of(0)
#endif

/* a = M^-1 f. */
LANE_FUNCTION void find_accelerations(const real *inverse_mass, const lanes *f, lanes *a)
{
#pragma GCC unroll 64
  for (int i = 0; i < M; i++)
    a[i] = inverse_mass[i] * f[i];
#pragma GCC unroll 64
  for (int e = M; e < INVERSE_MASSES; e++) {
    const int i = INVERSE_MASS_ENTRY[e][0], j = INVERSE_MASS_ENTRY[e][1];
    a[i] += inverse_mass[e] * f[j];
    a[j] += inverse_mass[e] * f[i];
  }
}

/* v = M^-1 p. */
static inline void find_velocities(const real *inverse_mass, const real *p, real *v)
{
  for (int i = 0; i < M; i++)
    v[i] = inverse_mass[i] * p[i];
  for (int e = M; e < INVERSE_MASSES; e++) {
    const int i = INVERSE_MASS_ENTRY[e][0], j = INVERSE_MASS_ENTRY[e][1];
    v[i] += inverse_mass[e] * p[j];
    v[j] += inverse_mass[e] * p[i];
  }
}

/* Computes the lower half of M^-1; NaN if M is singular. Coordinates that no masses couple share a solution. */
static void invert_masses(const step_data *step, real *inverse_mass)
{
  const band shape = band_of(M, 1);
  real u[2 * M] = {0}, p[M], pivot[M], x[M], *mass = step->scratch;
  int regular;
  transform_and_derivatives(step->t, u, step->parameters, p, mass);
  regular = factorise(mass, &shape, pivot);
  for (int column = 0; column < MASS_COLUMNS; column++) {
    for (int i = 0; i < M; i++)
      x[MASS_POSITION[i]] = MASS_COLUMN[i] == column;
    if (regular)
      back_substitute(mass, &shape, pivot, x);
    for (int e = 0; e < INVERSE_MASSES; e++)
      if (MASS_COLUMN[INVERSE_MASS_ENTRY[e][1]] == column)
        inverse_mass[e] = regular ? x[MASS_POSITION[INVERSE_MASS_ENTRY[e][0]]] : (real)NAN;
  }
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
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      const lanes v = now->base_v[i][g] + step->h * times(RATTLE_VELOCITY, DEGREE, now->a[i], g);
      store(now->at[i], g, former(now->u[i], step->q0[i], g));
      store(now->v[i], g, v - OF_MOMENTA(1, RATTLE_VELOCITY_SHIFT, now->w[i], g));
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

#ifdef MOMENTUM_TERMS
/* Computes w at all points but the first, and its change. */
static inline __attribute__((flatten)) void evaluate_momenta(const step_data *step, rattle_step *restrict now)
{
  for (int n = 0; n < GROUP_LANES; n++) {
    real u[M], A[M];
    for (int i = 0; i < M; i++)
      u[i] = now->u[i][n];
    constrained_momentum(u, step->t + RATTLE_ABSCISSA[n + 1] * step->h, step->parameters, A);
    for (int i = 0; i < M; i++)
      now->A[i][n] = A[i] - now->first_A[i];
  }
  for (int g = 0; g < GROUPS; g++) {
    lanes A[M], w[M];
    for (int i = 0; i < M; i++)
      A[i] = load(now->A[i], g);
    find_accelerations(now->inverse_mass, A, w);
    for (int i = 0; i < M; i++) {
      store(now->change[i], g, w[i] - load(now->w[i], g));
      store(now->w[i], g, w[i]);
    }
  }
  IN_MEMORY(now->change);
  IN_MEMORY(now->w);
}
#else
static inline void evaluate_momenta(const step_data *step, rattle_step *now)
{
  (void)step, (void)now;
}
#endif

/* Evaluates forces, constraints and their derivatives. */
static __attribute__((flatten)) void evaluate_points(const step_data *step, rattle_step *restrict now)
{
  evaluate_momenta(step, now);
  move_points(step, now);
  for (int n = 0; n < GROUP_LANES; n++) {
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

/* Factorises P at a group of points with these derivatives. Singular matrices lead to solutions that are not finite. */
static inline void factorise_points(const lanes *derivative, const real *inverse_mass, factors l)
{
  memset(l, 0, sizeof(factors));
#pragma GCC unroll 64
  for (int q = 0; q < PRODUCTS; q++) {
    const int e = PRODUCT[q][0], f = PRODUCT[q][1];
    l[PRODUCT[q][2]][PRODUCT[q][3]] += inverse_mass[PRODUCT[q][4]] * derivative[e] * derivative[f];
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
static inline void former_derivatives(const rattle_step *now, int g, lanes *derivative)
{
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = former(now->derivative[e], now->first_derivative[e], g);
}

#ifdef VELOCITY_FORCES
#define FORCES_BEFORE_LAST(now, i, g) load((now)->force[i], g)
#define FIRST_FORCE(now, i) (now)->force[i][0]
#else
#define FORCES_BEFORE_LAST(now, i, g) former((now)->force[i], (now)->first_force[i], g)
#define FIRST_FORCE(now, i) (now)->first_force[i]
#endif

/* F + G^T lambda at all points but the last. */
static inline void all_forces(const rattle_step *now, const lanes *derivative, int g, lanes *f)
{
  for (int i = 0; i < M; i++)
    f[i] = FORCES_BEFORE_LAST(now, i, g);
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    f[CONSTRAINT_ENTRY[e][1]] += derivative[e] * now->lambda[CONSTRAINT_ENTRY[e][0]][g];
}

/* Inverse sizes of the terms of the displacements, whose largest size is returned: forces and reactions cancel at a
 * pinned coordinate, which may be 0. */
static real invert_term_sizes(const step_data *step, const rattle_step *now, real *size)
{
  real largest = 0, force[M], change[M], inverse_mass[INVERSE_MASSES];
  for (int i = 0; i < M; i++)
    force[i] = MATH(fabs)(FIRST_FORCE(now, i));
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    force[CONSTRAINT_ENTRY[e][1]] += MATH(fabs)(now->first_derivative[e] * now->lambda[CONSTRAINT_ENTRY[e][0]][0][0]);
  for (int i = 0; i < M; i++)
    force[i] = MATH(fabs)(step->p0[i]) + MATH(fabs)(step->h) * force[i];
  for (int e = 0; e < INVERSE_MASSES; e++)
    inverse_mass[e] = MATH(fabs)(step->h * now->inverse_mass[e]);
  find_velocities(inverse_mass, force, change);
  for (int i = 0; i < M; i++) {
    size[i] = MATH(fabs)(step->q0[i]) + change[i];
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

/* Updates lambda and a of a group of points. */
static inline void update_multipliers(const step_data *step, rattle_step *now, factors l, int factorised, int g)
{
  const real scale = 1 / (step->h * step->h);
  lanes derivative[CONSTRAINT_ENTRIES], f[M], a[M], x[CONSTRAINTS];
  former_derivatives(now, g, derivative);
  if (!factorised)
    factorise_points(derivative, now->inverse_mass, l);
  all_forces(now, derivative, g, f);
  find_accelerations(now->inverse_mass, f, a);
  for (int i = 0; i < M; i++)
    a[i] = a[i] - load(now->a[i], g) - OF_MOMENTA(1 / step->h, RATTLE_SHIFT_RESPONSE, now->change[i], g);
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = times(RATTLE_INVERSE, DEGREE, now->g[k], g) * scale;
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]] += derivative[e] * a[CONSTRAINT_ENTRY[e][1]];
  solve_points(l, x);
  for (int k = 0; k < CONSTRAINTS; k++)
    now->lambda[k][g] -= x[CONSTRAINT_POSITION[k]];
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    f[CONSTRAINT_ENTRY[e][1]] -= derivative[e] * x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]];
  find_accelerations(now->inverse_mass, f, a);
  for (int i = 0; i < M; i++)
    store(now->a[i], g, a[i]);
}

/* One iteration: updates lambda, a and u, the last by `change`. */
static inline void iterate(const step_data *step, rattle_step *now, factors *l, int factorised, lanes *change)
{
  const real hh = step->h * step->h;
  for (int g = 0; g < GROUPS; g++)
    update_multipliers(step, now, l[g], factorised, g);
  IN_MEMORY(now->a);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      const lanes moved = hh * times(RATTLE_RESPONSE, DEGREE, now->a[i], g);
      const lanes u = now->base[i][g] + (moved - OF_MOMENTA(step->h, RATTLE_SHIFT, now->w[i], g));
      change[i * GROUPS + g] = u - load(now->u[i], g);
      store(now->u[i], g, u);
    }
}

/* The larger of x and y, x where y is NaN. */
LANE_FUNCTION lanes larger_lanes(lanes x, lanes y)
{
  const lane_numbers chosen = (lane_numbers)(y > x);
  return (lanes)(((lane_numbers)y & chosen) | ((lane_numbers)x & ~chosen));
}

LANE_FUNCTION real largest_lane(const lanes *x)
{
  real largest[LANES];
  memcpy(largest, x, sizeof largest);
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      largest[n] = larger(largest[n + half], largest[n]);
  return largest[0];
}

/* Measures a change in units of these inverse sizes. Lanes beyond the points do not change. */
static inline movement measure_change(const lanes *change, const real *inverse_size, real largest_size)
{
  movement moved = no_movement();
  lanes relative = {0}, absolute = {0};
  for (int n = 0; n < M * GROUPS; n++) {
    const lanes size = (lanes)((lane_numbers)change[n] & BUT_SIGN);
    relative = larger_lanes(relative, size * inverse_size[n / GROUPS]);
    absolute = larger_lanes(absolute, size);
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
  factors l[GROUPS];
  lanes change[M * GROUPS];
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

/* Values at the first point, and v0. */
static inline void begin_first(const step_data *step, rattle_step *now)
{
  real constraint[CONSTRAINTS], p0[M];
  memcpy(p0, step->p0, sizeof p0);
#ifndef VELOCITY_FORCES
  constrained_force(step->q0, step->t, step->parameters, now->first_force);
#endif
  constraints(step->q0, step->t, step->parameters, constraint, now->first_derivative);
#ifdef MOMENTUM_TERMS
  constrained_momentum(step->q0, step->t, step->parameters, now->first_A);
  for (int i = 0; i < M; i++)
    p0[i] -= now->first_A[i];
  memset(now->w, 0, sizeof now->w);
#endif
  find_velocities(now->inverse_mass, p0, now->v0);
}

/* Initial values: the first point, and a guess of the others from the unknowns of the previous step, or if they are
 * NULL motion without forces. Rounded tables would be those of another method, whose energy drifts: the low words of R
 * act on the guess of the accelerations. */
static void begin(const step_data *step, const real *memory, rattle_step *now)
{
  begin_first(step, now);
  for (int i = 0; i < M; i++)
    for (int g = 0; g < GROUPS; g++) {
      const lanes z = memory ? times(RATTLE_POSITIONS, B, memory + i * B, g) : lanes_of(0);
      const lanes drift = load(RATTLE_DRIFT, g);
      const lanes moved = memory ? step->h * z : drift * (step->h * now->v0[i]);
      store(now->u[i], g, step->q0[i] + (step->carry_q[i] + moved));
      store(now->a[i], g, memory ? z - drift * now->v0[i] : z);
    }
  evaluate_momenta(step, now);
  for (int i = 0; i < M; i++) {
    const real v = now->v0[i], moved = step->h * v, rate = 1 / step->h;
    lanes a[GROUPS];
    for (int g = 0; g < GROUPS; g++)
      store(now->a[i], g, load(now->a[i], g) - OF_MOMENTA(-1, RATTLE_SHIFT, now->w[i], g));
    IN_MEMORY(now->a[i]);
    for (int g = 0; g < GROUPS; g++)
      a[g] = rate * times(RATTLE_INVERSE, DEGREE, now->a[i], g);
    for (int g = 0; g < GROUPS; g++)
      store(now->a[i], g, a[g]);
    IN_MEMORY(now->a[i]);
    for (int g = 0; g < GROUPS; g++) {
      const lanes low = load(RATTLE_DRIFT_LOW, g) * moved +
          step->h * step->h * times(RATTLE_RESPONSE_LOW, DEGREE, now->a[i], g) -
          OF_MOMENTA(step->h, RATTLE_SHIFT_LOW, now->w[i], g);
#ifdef VELOCITY_FORCES
      const lanes change = load(RATTLE_VELOCITY_START, g) * v +
          step->h * times(RATTLE_VELOCITY_LOW, DEGREE, now->a[i], g);
      now->base_v[i][g] = v + change;
#endif
      now->base[i][g] = step->q0[i] + (step->carry_q[i] + (low + load(RATTLE_DRIFT, g) * moved));
    }
  }
  for (int k = 0; k < CONSTRAINTS; k++)
    for (int g = 0; g < GROUPS; g++)
      now->lambda[k][g] = memory ? times(RATTLE_MULTIPLIERS, B, memory + (M + k) * B, g) : lanes_of(0);
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

/* Velocities at the end, where the momenta are p0 + dp. */
static inline void end_velocity(const rattle_step *now, const real *dp, real *v)
{
  find_velocities(now->inverse_mass, dp, v);
  for (int i = 0; i < M; i++) {
    v[i] += now->v0[i];
#ifdef MOMENTUM_TERMS
    v[i] -= now->w[i][DEGREE - 1];
#endif
  }
}

/* Computes p1 - p0 on the tangent space, and the unknowns z of the step. An unrolled loop keeps dp
 * in registers: a vector that is loaded soon after its parts were stored waits for them. */
static int finish_step(const step_data *step, rattle_step *now, newton_data *data, real *dp)
{
  const real weight = step->h * RATTLE_WEIGHT[DEGREE];
  factors l;
  lanes derivative[CONSTRAINT_ENTRIES], f[M], a[M], x[CONSTRAINTS];
  real u[2 * M], value[M + 2 * CONSTRAINTS], force[M], all[M][GROUP_LANES], z[GROUP_LANES];
  for (int g = 0; g < GROUPS; g++) {
    former_derivatives(now, g, derivative);
    all_forces(now, derivative, g, f);
    find_accelerations(now->inverse_mass, f, a);
    for (int i = 0; i < M; i++) {
      store(all[i], g, f[i]);
      store(now->a[i], g, a[i]);
    }
  }
  IN_MEMORY(now->a);
  for (int i = 0; i < M; i++) {
    for (int g = 0; g < GROUPS; g++) {
      const lanes push = times(RATTLE_MOMENTUM, DEGREE, now->a[i], g) +
          times(RATTLE_MOMENTUM_LOW, DEGREE, now->a[i], g);
      const lanes change = load(RATTLE_START, g) * now->v0[i] + step->h * push;
      store(z, g, now->v0[i] + (change - OF_MOMENTA(1, RATTLE_PROJECTION, now->w[i], g)));
    }
    memcpy(data->z + i * B, z, sizeof(real) * DEGREE);
  }
  last_force(step, now, data->z, force);
  for (int i = 0; i < M; i++) {
    real sum = RATTLE_WEIGHT[DEGREE] * force[i];
    for (int n = 0; n < DEGREE; n++)
      sum += RATTLE_WEIGHT[n] * all[i][n];
    dp[i] = step->h * sum;
    u[i] = now->u[i][DEGREE - 1];
  }
  end_velocity(now, dp, u + M);
  constrained_motion(u, step->t + step->h, step->parameters, value);
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    derivative[e] = load(now->derivative[e], LAST_GROUP);
  factorise_points(derivative, now->inverse_mass, l);
  for (int k = 0; k < CONSTRAINTS; k++)
    x[CONSTRAINT_POSITION[k]] = lanes_of(-value[M + k] / weight);
  solve_points(l, x);
#pragma GCC unroll 64
  for (int e = 0; e < CONSTRAINT_ENTRIES; e++)
    dp[CONSTRAINT_ENTRY[e][1]] += weight * now->derivative[e][DEGREE - 1] *
        x[CONSTRAINT_POSITION[CONSTRAINT_ENTRY[e][0]]][(DEGREE - 1) % LANES];
  end_velocity(now, dp, u);
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
static int rattle(const step_data *step, const real *inverse_mass, const real *memory, newton_data *data, real *dp,
    const solver_options *options, solver_report *report)
{
  rattle_step now;
  int status;
  memcpy(now.inverse_mass, inverse_mass, sizeof now.inverse_mass);
  begin(step, memory, &now);
  status = solve_constraints(step, &now, options, report);
  return status == OK ? finish_step(step, &now, data, dp) : status;
}
