#ifdef TRAJECTORIES_AS_LANES
#include "trajectory_lanes.h"
#else
#include "point_lanes.h"
#endif
#include "../core/symmetric.h"

/* Iteration of a constrained step: systems of the multipliers, sizes, convergence. The matrix P = G M^-1 G^T of a
 * point is a symmetric band matrix (symmetric.h). Requires:
 * point_lanes.h or trajectory_lanes.h, the kernel constraints; PRODUCT, {e, f, row, distance, entry}: the product of
 * derivatives e and f and this entry of M^-1 is part of the entry of P in this row at this distance below the
 * diagonal; INVERSE_MASS_ENTRY, {i, j}: the lower half of M^-1, the diagonal first; MASS_COLUMN, a number below
 * MASS_COLUMNS that differs for coordinates that masses couple; CONSTRAINT_POSITION of constraints, CONSTRAINT_REACH
 * of P. MASSES_OF_POINTS: M^-1 differs from point to point. */
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
#define ROUNDED_SHRINKING REAL(0.25)
#endif

typedef lanes factors[CONSTRAINTS * (CONSTRAINT_REACH + 1)];
#ifdef MASSES_OF_POINTS
typedef lanes inverse_masses[INVERSE_MASSES];
#else
typedef number inverse_masses[INVERSE_MASSES];
#endif

/* to = from of a lane, and the other way. */
#define TAKE_LANE(to, count, from, lane)                              \
  _Pragma("GCC unroll 64") for (int each = 0; each < (count); each++) \
  {                                                                   \
    (to)[each] = (from)[each][lane];                                  \
  }

#define PUT_LANE(to, count, lane, from)                               \
  _Pragma("GCC unroll 64") for (int each = 0; each < (count); each++) \
  {                                                                   \
    (to)[each][lane] = (from)[each];                                  \
  }

/* Group g of sum_n table_n x_n, of numbers in memory, from which vector instructions broadcast. */
LANE_FUNCTION lanes times(const real (*table)[POINT_LANES], int count, const number *x, int g)
{
  lanes sum = weights(table[0], g) * x[0], other = lanes_of(0);
#pragma GCC unroll 16
  for (int n = 1; n < count; n += 2)
    other += weights(table[n], g) * x[n];
#pragma GCC unroll 16
  for (int n = 2; n < count; n += 2)
    sum += weights(table[n], g) * x[n];
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
static inline void find_velocities(const number *inverse_mass, const number *p, number *v)
{
  for (int i = 0; i < M; i++)
    v[i] = inverse_mass[i] * p[i];
  for (int e = M; e < INVERSE_MASSES; e++) {
    const int i = INVERSE_MASS_ENTRY[e][0], j = INVERSE_MASS_ENTRY[e][1];
    v[i] += inverse_mass[e] * p[j];
    v[j] += inverse_mass[e] * p[i];
  }
}

/* Factorises P at a group of points with these derivatives. */
static inline void factorise_points(const lanes *derivative, const inverse_masses inverse_mass, factors l)
{
  memset(l, 0, sizeof(factors));
#pragma GCC unroll 64
  for (int q = 0; q < PRODUCTS; q++) {
    const int e = PRODUCT[q][0], f = PRODUCT[q][1];
    l[(PRODUCT[q][2] + 1) * (CONSTRAINT_REACH + 1) - 1 - PRODUCT[q][3]] +=
        inverse_mass[PRODUCT[q][4]] * derivative[e] * derivative[f];
  }
  factorise_symmetric(l, CONSTRAINTS, CONSTRAINT_REACH, CONSTRAINT_REACH);
}

/* Factorises P, except where its factors are kept. */
static inline void refactorise_points(condition kept, const lanes *derivative, const inverse_masses inverse_mass,
    factors l)
{
#ifdef TRAJECTORIES_AS_LANES
  factors renewed;
  if (all_of(kept))
    return;
  factorise_points(derivative, inverse_mass, renewed);
  for (int n = 0; n < CONSTRAINTS * (CONSTRAINT_REACH + 1); n++)
    l[n] = where(kept, l[n], renewed[n]);
#else
  if (!kept)
    factorise_points(derivative, inverse_mass, l);
#endif
}

/* Solves P x = right with these factors, both in the order CONSTRAINT_POSITION. */
static inline void solve_points(const factors l, lanes *x)
{
  solve_symmetric(l, CONSTRAINTS, CONSTRAINT_REACH, CONSTRAINT_REACH, x);
}

/* Sizes of the terms of the displacements by momenta, forces and, unless lambda is NULL, reactions, from the forces and
 * derivatives at the first point: forces and reactions cancel at a pinned coordinate, which may be 0. */
static inline void find_term_sizes(const step_data *step, const number *first_force, const number *first_derivative,
    lanes (*lambda)[GROUPS], const number *inverse_mass, number *size)
{
  number force[M], change[M], term[INVERSE_MASSES];
  for (int i = 0; i < M; i++)
    force[i] = magnitude(first_force[i]);
  for (int e = 0; lambda && e < CONSTRAINT_ENTRIES; e++)
    force[CONSTRAINT_ENTRY[e][1]] += magnitude(first_derivative[e] * FIRST_LANE(lambda[CONSTRAINT_ENTRY[e][0]][0]));
  for (int i = 0; i < M; i++)
    force[i] = magnitude(step->p0[i]) + MATH(fabs)(step->h) * force[i];
  for (int e = 0; e < INVERSE_MASSES; e++)
    term[e] = magnitude(step->h * inverse_mass[e]);
  find_velocities(term, force, change);
  for (int i = 0; i < M; i++)
    size[i] = magnitude(step->q0[i]) + change[i];
}

/* Inverts sizes; returns the largest one. */
static inline number invert_sizes(number *size)
{
  number largest = {0};
  for (int i = 0; i < M; i++) {
    largest = larger_number(largest, size[i]);
    size[i] = 1 / (size[i] + REAL_MIN);
  }
  return largest;
}

/* Returns 1 if an iterate is accepted: its change, or the next one as predicted from the lower of the last two rates,
 * is below the tolerance, or rounding ended the decrease. 0: continue; -1: convergence is slow. The changes are those
 * of the last three iterations, the last one first. The rate is that of the largest coordinates: changes of one that
 * is held at 0 may be rounding errors of others. */
static inline int accepts(const real *change, const real *overall, const solver_options *options, int k)
{
  const int absolute = options->absolute, relative = !absolute, is_rounding = overall[0] <= MULTIPLIER_ROUNDOFF;
  const real tolerance = options->tolerance;
  const real next = PREDICTED * change[0] * larger(change[0], FASTEST_MULTIPLIERS * change[1]); /* times change[1] */
  const int stagnant = (overall[0] >= SLOWEST_MULTIPLIERS * overall[1]) &
      (overall[0] >= SLOWEST_MULTIPLIERS * SLOWEST_MULTIPLIERS * overall[2]);
  const int below = absolute ? change[0] < tolerance : change[0] <= tolerance;
  const int predicted = (k > 0) & (next <= tolerance * change[1]) &
      (PREDICTED * change[0] * change[1] <= tolerance * change[2]);
  const int rounded = (change[0] >= ROUNDED_SHRINKING * change[1]) | (stagnant & (overall[0] >= overall[1]));
  const int slow = (k > TRANSIENT_ITERATIONS) & stagnant & (overall[0] > MULTIPLIER_ROUNDOFF);
  return below | predicted | (relative & is_rounding & rounded) ? 1 : -slow;
}

/* Measures a change in units of these inverse sizes. Lanes beyond the points do not change. */
static inline movement measure_change(const lanes *change, const number *inverse_size, number largest_size)
{
  movement moved = {0};
  lanes relative = {0}, absolute = {0};
  for (int n = 0; n < M * GROUPS; n++) {
    const lanes size = (lanes)((lane_numbers)change[n] & BUT_SIGN);
    relative = greater_lanes(relative, size * inverse_size[n / GROUPS]);
    absolute = greater_lanes(absolute, size);
  }
  moved.relative = largest_lane(&relative);
  moved.absolute = largest_lane(&absolute);
  moved.overall = share(moved.absolute, largest_size);
  return moved;
}
