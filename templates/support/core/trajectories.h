#include "numbers.h"
#include "vectors.h"

/* SIMD lanes are trajectories: a vector contains values of LANES trajectories at one point. points.h defines the same
 * names. */
enum {
#ifdef TRAJECTORIES_AS_LANES
  GROUPS = S - 1, /* vectors for all points of a constrained step but one */
#else
  GROUPS = S, /* vectors for all points */
#endif
  TERMS = S < 8 ? S : 8 /* of a polynomial with a coefficient per point: no more are needed */
};
#define TABLE_ENTRY(table, point, j) (table)[point][j]
#define VECTOR_ENTRY(table, j) (table)[j]

typedef lanes coordinates[M]; /* values of all coordinates at a point */

typedef lanes number; /* a value of each trajectory */
typedef real weight; /* a value of a point, the same for all trajectories */
typedef const real (*point_table)[S];

#define number_of(x) lanes_of(x)
#define lanes_of_number(x) (x)

LANE_BY_LANE(magnitude, MATH(fabs));
LANE_BY_LANE(exponential, MATH(exp));
LANE_BY_LANE(exponential_less_1, MATH(expm1));

/* Maximum of x_first .. x_(end - 1). */
static inline number largest_between(const number *x, int first, int end)
{
  lane_view largest = {x[first]};
  for (int i = first + 1; i < end; i++) {
    const lane_view view = {x[i]};
    for (int j = 0; j < LANES; j++)
      largest.lane[j] = larger(largest.lane[j], view.lane[j]);
  }
  return largest.all;
}

/* Maximum of M numbers. */
static inline number largest_number(const number *x)
{
  return largest_between(x, 0, M);
}

/* a / b in each lane, at most `bound` in size; 0 unless b is positive and the quotient a number. */
static inline number bounded_ratio(number a, number b, real bound)
{
  lane_view x = {a};
  const lane_view y = {b};
  for (int j = 0; j < LANES; j++) {
    const real size = MATH(fabs)(x.lane[j]), large = MATH(copysign)(bound, x.lane[j]);
    const real ratio = size < bound * y.lane[j] ? x.lane[j] / y.lane[j] : large;
    x.lane[j] = y.lane[j] > 0.0 && size < INFINITY ? ratio : 0.0;
  }
  return x.all;
}

/* No trajectory decides for the others. */
#define is_within(x, bound) 0

static inline number rest_of_numbers(number a, number b, number product)
{
  return multiply_add(a, b, -product);
}

static inline weight rest_of_weights(real a, weight b, weight product)
{
  return (weight)rest_of_product(a, b, product);
}

/* Sums over points add in the order of points.h, so that trajectories have the bits of single runs: POINTS_THERE is the
 * number of points with those that fill vectors, PARTS its largest factor that is a power of two. */
enum {
  POINTS_THERE = S > 16 ? (S + 7) / 8 * 8 : S > 8 ? 16
      : S > 4                                     ? 8
      : S > 2                                     ? 4
                                                  : S,
  PARTS = POINTS_THERE & -POINTS_THERE,
  SUMS = POINTS_THERE < WIDEST ? POINTS_THERE : WIDEST /* of changes, one for each lane there */
};

/* sum_j table_nj x_j in `parts` independent sums; values at successive points are `apart` elements apart. */
static inline __attribute__((always_inline)) lanes sum_in_parts(const real *row, const lanes *x, long long apart,
    int parts)
{
  lanes sum[4];
  for (int j = S; j < parts; j++)
    sum[j] = lanes_of(0.0);
  for (int j = 0; j < S; j++)
    sum[j % parts] = j < parts ? row[j] * x[j * apart] : sum[j % parts] + row[j] * x[j * apart];
  return parts == 1 ? sum[0] : (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

static inline lanes contribution_of_points(const real (*table)[S], int n, const lanes *x, long long apart)
{
  return sum_in_parts(table[n], x, apart, POINTS_THERE < 8 ? 1 : 4);
}

/* The same of stored values of a coordinate. */
typedef lanes (*stored_forces)[M];

static inline lanes sum_of_stored(const real (*table)[S], int n, stored_forces x, int i)
{
  return sum_in_parts(table[n], &x[0][i], M, POINTS_THERE < 4 ? 1 : 4);
}

/* Products of values and weights of the points. */
typedef struct {
  coordinates of[S];
} point_products;

static inline void store_products(const weight *weights, lanes (*x)[M], point_products *products)
{
  for (int n = 0; n < S; n++)
    for (int i = 0; i < M; i++)
      products->of[n][i] = weights[n] * x[n][i];
}

/* Sum over the points. */
static inline lanes points_total(lanes *x)
{
  for (int n = PARTS; n < S; n++)
    x[n % PARTS] += x[n];
  for (int half = PARTS / 2; half > 0; half /= 2)
    for (int n = 0; n < half && n + half < S; n++)
      x[n] += x[n + half];
  return x[0];
}

/* Weight of a point in sums of changes: in single runs further lanes, of at least two, repeat the last point. */
#define CHANGES_OF(n) ((weight)((n) < S - 1 ? 1.0 : S > 1 ? 1.0 + POINTS_THERE - S \
                                                          : 2.0))

#define at_first(x) (x)[0] /* value at the first point */
#define at_last(x, apart) (x)[(S - 1) * (apart)]

#define LANES_OF_WEIGHT(x) lanes_of(x)
#include "weighted_points.h"

/* Sums over coordinates, of each point, and the place of those of a point. */
typedef lanes point_sums[SUMS];

static inline lanes *sum_at(lanes *sums, int n)
{
  return sums + n % SUMS;
}

static inline number total_of(lanes *sums)
{
  for (int half = SUMS / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      sums[n] += sums[n + half];
  return sums[0];
}

/* Change of each trajectory. */
#define total_change(change) (change)

/* Arguments and report of a batched step. Requires: the header, NAME, STATUS. */
enum {
  OK = STATUS(OK),
  NOT_CONVERGED = STATUS(FAILED),
  SINGULAR = STATUS(FAILED),
  NOT_FINITE = STATUS(FAILED)
};

typedef NAME(options) solver_options;
typedef NAME(block) block_memory;

/* Which trajectories the iteration still serves, and the number of iterations. */
typedef struct {
  real *active;
  long long iterations;
} solver_report;

/* Arguments of a step. */
typedef struct {
  real t, h;
#ifdef DOUBLE_DOUBLE
  double t_low, h_low;
#endif
#ifdef MIXED_POINTS
  double *points; /* for the points of the solved step */
#endif
  const lanes *q0, *p0, *carry_q, *carry_p, *parameters;
} step_data;

/* Stored values at the points, of the last step and of the one before, which the next step overwrites. */
typedef struct {
  lanes (*last)[M], (*before)[M];
} history;
