#include "../core/vector_width.h"
#include "../newton/newton.h"

/* Points of a constrained step as SIMD lanes, in groups that fill a register: vectors, systems of the multipliers,
 * convergence. The matrix P = G M^-1 G^T of a point is a band matrix factorised as L D L^T (Golub & Van Loan, Matrix
 * Computations, sec. 4.3.6). Requires: newton.h, constraints.h; PRODUCT, {e, f, row, distance, entry}: the product of
 * derivatives e and f and this entry of M^-1 is part of the entry of P in this row at this distance below the diagonal;
 * INVERSE_MASS_ENTRY, {i, j}: the lower half of M^-1, the diagonal first; MASS_COLUMN, a number below MASS_COLUMNS that
 * differs for coordinates that masses couple; CONSTRAINT_POSITION of constraints, CONSTRAINT_REACH of P; POINT_LANES, a
 * power of two. MASSES_OF_POINTS: M^-1 differs from point to point. */
#define RATTLE
#pragma GCC diagnostic ignored "-Wpsabi" /* all functions with vector arguments are static */

#define PREDICTED REAL(4.0) /* multiple of the next update, from the convergence rate, that is below the tolerance */
#define SLOWEST_MULTIPLIERS REAL(0.5) /* convergence rate of the multipliers beyond which Newton's method is faster */
#define TRANSIENT_ITERATIONS 2 /* that need not contract */
#define LARGEST_REACTION REAL(8.0) /* times the size of forces: larger ones indicate light bodies */
#define REUSED_FACTORS REAL(1e-2) /* relative update below which the factors of P are reused in the next iteration */
#ifdef VELOCITY_FORCES
#define MULTIPLIER_ROUNDOFF (16 * REAL_EPSILON) /* updates below it that decrease slowly are rounding errors, but with
                                                * complex convergence rates: updates that grow may shrink later */
#define ROUNDED_SHRINKING 1
#define FASTEST_MULTIPLIERS REAL(2e-2) /* credible convergence rate; a lower one is accidental */
#else
#define FASTEST_MULTIPLIERS REAL(1e-3)
#define MULTIPLIER_ROUNDOFF (64 * REAL_EPSILON)
#define ROUNDED_SHRINKING STOPPED_SHRINKING
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
#ifdef RATTLE_IN_PAIRS
#include "../core/vectors.h"
#else
typedef real lanes __attribute__((vector_size(LANE_BYTES)));
#endif
typedef lane_number lane_numbers __attribute__((vector_size(LANE_BYTES)));

#if defined(__AVX512F__) && POINT_LANES >= 8 && !defined(__clang__)
#pragma GCC target("prefer-vector-width=512") /* loops over lanes become whole vectors, not halves */
#endif
#ifdef __clang__
#define FORMER(x, before) __builtin_shufflevector(x, before, FORMER_LANES)
#else
#define FORMER(x, before) __builtin_shuffle(x, before, (lane_numbers){FORMER_LANES})
#endif

typedef lanes factors[CONSTRAINTS * (CONSTRAINT_REACH + 1)];
#ifdef MASSES_OF_POINTS
typedef lanes inverse_masses[INVERSE_MASSES];
#else
typedef real inverse_masses[INVERSE_MASSES];
#endif

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

#ifndef RATTLE_IN_PAIRS
LANE_FUNCTION lanes lanes_of(real x)
{
  const lanes zero = {0};
  return zero + x;
}
#endif

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

/* a = M^-1 f. */
LANE_FUNCTION void find_accelerations(const inverse_masses inverse_mass, const lanes *f, lanes *a)
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

/* Factorises a symmetric band matrix as L D L^T. The entry at distance b below the diagonal in row k is l[k (reach + 1)
 * + b]; the factors replace it, D^-1 at distance 0. Singular matrices lead to solutions that are not finite. */
LANE_FUNCTION void factorise_band(lanes *l, int count, int reach)
{
  const int width = reach + 1;
  for (int k = 0; k < count; k++) {
    lanes *row = l + k * width;
    const int below = least(k, reach);
    for (int b = below - 1; b > 0; b--)
      for (int c = b + 1; c <= below; c++)
        row[b] -= row[c] * l[(k - b) * width + c - b];
    for (int b = 1; b <= below; b++) {
      const lanes scaled = row[b] * l[(k - b) * width];
      row[0] -= scaled * row[b];
      row[b] = scaled;
    }
    row[0] = 1 / row[0];
  }
}

/* Solves a system with these factors. */
LANE_FUNCTION void solve_band(const lanes *l, int count, int reach, lanes *x)
{
  const int width = reach + 1;
  for (int k = 1; k < count; k++)
    for (int b = 1; b <= least(k, reach); b++)
      x[k] -= l[k * width + b] * x[k - b];
  for (int k = count - 1; k >= 0; k--) {
    x[k] *= l[k * width];
    for (int b = 1; b <= least(count - 1 - k, reach); b++)
      x[k] -= l[(k + b) * width + b] * x[k + b];
  }
}

/* Factorises P at a group of points with these derivatives. */
static inline void factorise_points(const lanes *derivative, const inverse_masses inverse_mass, factors l)
{
  memset(l, 0, sizeof(factors));
#pragma GCC unroll 64
  for (int q = 0; q < PRODUCTS; q++) {
    const int e = PRODUCT[q][0], f = PRODUCT[q][1];
    l[PRODUCT[q][2] * (CONSTRAINT_REACH + 1) + PRODUCT[q][3]] +=
        inverse_mass[PRODUCT[q][4]] * derivative[e] * derivative[f];
  }
  factorise_band(l, CONSTRAINTS, CONSTRAINT_REACH);
}

/* Solves P x = right with these factors, both in the order CONSTRAINT_POSITION. */
static inline void solve_points(const factors l, lanes *x)
{
  solve_band(l, CONSTRAINTS, CONSTRAINT_REACH, x);
}

/* Sizes of the terms of the displacements by momenta, forces and, unless lambda is NULL, reactions, from the forces and
 * derivatives at the first point: forces and reactions cancel at a pinned coordinate, which may be 0. */
static inline void find_term_sizes(const step_data *step, const real *first_force, const real *first_derivative,
    lanes (*lambda)[GROUPS], const real *inverse_mass, real *size)
{
  real force[M], change[M], term[INVERSE_MASSES];
  for (int i = 0; i < M; i++)
    force[i] = MATH(fabs)(first_force[i]);
  for (int e = 0; lambda && e < CONSTRAINT_ENTRIES; e++)
    force[CONSTRAINT_ENTRY[e][1]] += MATH(fabs)(first_derivative[e] * lambda[CONSTRAINT_ENTRY[e][0]][0][0]);
  for (int i = 0; i < M; i++)
    force[i] = MATH(fabs)(step->p0[i]) + MATH(fabs)(step->h) * force[i];
  for (int e = 0; e < INVERSE_MASSES; e++)
    term[e] = MATH(fabs)(step->h * inverse_mass[e]);
  find_velocities(term, force, change);
  for (int i = 0; i < M; i++)
    size[i] = MATH(fabs)(step->q0[i]) + change[i];
}

/* Inverts sizes; returns the largest one. */
static inline real invert_sizes(real *size)
{
  real largest = 0;
  for (int i = 0; i < M; i++) {
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
  if (!absolute && stagnant && moved->overall <= MULTIPLIER_ROUNDOFF && moved->overall >= last[0].overall)
    return 1;
  return k > TRANSIENT_ITERATIONS && stagnant && moved->overall > MULTIPLIER_ROUNDOFF ? -1 : 0;
}

#ifndef RATTLE_IN_PAIRS
/* The larger of x and y, x where y is NaN. */
LANE_FUNCTION lanes larger_lanes(lanes x, lanes y)
{
  const lane_numbers chosen = (lane_numbers)(y > x);
  return (lanes)(((lane_numbers)y & chosen) | ((lane_numbers)x & ~chosen));
}
#endif

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
