#ifndef SUPPORT_POINTS_H
#define SUPPORT_POINTS_H

#include "numbers.h"
#include "vectors.h"

/* SIMD lanes are quadrature points: one vector, or several if a register is smaller, contains the values at the points
 * of a step; numbers are those of one trajectory. trajectories.h defines the same names for solvers that serve both.
 * Requires: vectors.h. */
enum { GROUPS = POINTS / LANES }; /* vectors for all points */

typedef lanes coordinates[M]; /* values of all coordinates at a point */

typedef double number; /* a value of the trajectory */
typedef lanes weight; /* a value of each point, the same for all trajectories */

/* Predictor tables for values at the points: from the last step, or from the last and the one before. */
struct predictor_tables_of {
  const lanes *alone, *last, *before;
};

static inline number number_of(double x)
{
  return x;
}

static inline lanes lanes_of_number(number x)
{
  return lanes_of(x);
}

static inline number magnitude(number x)
{
  return fabs(x);
}

static inline number exponential(number x)
{
  return exp(x);
}

static inline number exponential_less_1(number x)
{
  return expm1(x);
}

/* Maximum of M numbers; for many in as many independent parts as a vector has lanes. */
static inline number largest_number(const number *x)
{
  const int whole = M > LANES ? M - M % LANES : 1;
  number largest = x[0];
  if (whole > 1) {
    lane_view parts;
    memcpy(&parts, x, sizeof parts);
    for (int i = LANES; i < whole; i += LANES)
      for (int j = 0; j < LANES; j++)
        parts.lane[j] = larger(parts.lane[j], x[i + j]);
    for (int j = 0; j < LANES; j++)
      largest = larger(largest, parts.lane[j]);
  }
  for (int i = whole; i < M; i++)
    largest = larger(largest, x[i]);
  return largest;
}

static inline number fused_numbers(number a, number b, number c)
{
  return fma(a, b, c);
}

static inline weight fused_weights(double a, weight b, weight c)
{
  return multiply_add(lanes_of(a), b, c);
}

/* Value at point j; groups are `apart` elements apart. */
static inline double at_point(const lanes *x, long long apart, int j)
{
  return ((const lane_view *)(x + j / LANES * apart))->lane[j % LANES];
}

/* Value at the first point. */
static inline number at_first(const lanes *x)
{
  return at_point(x, 0, 0);
}

/* Contribution of point j to those of a group: column j of the table times x at j; groups of x are `apart` apart. */
static inline lanes contribution_of_point(const lanes *table, int group, const lanes *x, long long apart, int j)
{
  return table[j * GROUPS + group] * at_point(x, apart, j);
}

/* Sum of contribution_of_point over all points, from eight points on in four independent sums. */
static inline lanes contribution_of_points(const lanes *table, int group, const lanes *x, long long apart)
{
#if POINTS >= 8
  lanes a = contribution_of_point(table, group, x, apart, 0), b = contribution_of_point(table, group, x, apart, 1);
  lanes c = contribution_of_point(table, group, x, apart, 2), d = contribution_of_point(table, group, x, apart, 3);
  for (int j = 4; j < POINTS; j += 4) {
    a += contribution_of_point(table, group, x, apart, j);
    b += contribution_of_point(table, group, x, apart, j + 1);
    c += contribution_of_point(table, group, x, apart, j + 2);
    d += contribution_of_point(table, group, x, apart, j + 3);
  }
  return (a + b) + (c + d);
#else
  lanes a = contribution_of_point(table, group, x, apart, 0);
  for (int j = 1; j < POINTS; j++)
    a += contribution_of_point(table, group, x, apart, j);
  return a;
#endif
}

/* sum_j table_nj x_j of one coordinate, for the points of a group. */
static inline lanes apply(const lanes *table, int group, lanes (*x)[M], int i)
{
  return contribution_of_points(table, group, &x[0][i], M);
}

/* lanes_apply: the same for all points in one vector. */
static inline lanes lanes_apply(const lanes *table, const lanes *x)
{
  return contribution_of_points(table, 0, x, 1);
}

static inline double lanes_total(lanes x)
{
  lane_view view = {x};
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int j = 0; j < half; j++)
      view.lane[j] += view.lane[j + half];
  return view.lane[0];
}

/* Sum over the points of all groups, in an order that does not depend on the vector length. */
static inline double points_total(lanes *x)
{
  for (int half = GROUPS / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      x[n] += x[n + half];
  return lanes_total(x[0]);
}

/* sum_n weights_n x_n of groups that are `apart` apart; weigh_apart_twice: with the low words of the weights. */
static inline number weigh_apart(const weight *weights, const lanes *x, long long apart)
{
  lanes part[GROUPS];
  for (int n = 0; n < GROUPS; n++)
    part[n] = weights[n] * x[n * apart];
  return points_total(part);
}

static inline number weigh_apart_twice(const weight *weights, const weight *low, const lanes *x, long long apart)
{
  lanes part[GROUPS];
  for (int n = 0; n < GROUPS; n++)
    part[n] = multiply_add(weights[n], x[n * apart], low[n] * x[n * apart]);
  return points_total(part);
}

/* The same for one coordinate. */
static inline number weigh(const weight *weights, lanes (*x)[M], int i)
{
  return weigh_apart(weights, &x[0][i], M);
}

/* Values at the first and at the last point. */
static inline number at_start(lanes (*x)[M], int i)
{
  return at_point(&x[0][i], M, 0);
}

static inline number at_end(lanes (*x)[M], int i)
{
  return at_point(&x[0][i], M, POINTS - 1);
}

/* Sum over the points: the change of the trajectory. */
static inline number total_change(lanes change)
{
  return lanes_total(change);
}

#endif
