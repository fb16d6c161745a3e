#ifndef SUPPORT_BAND_H
#define SUPPORT_BAND_H

#include "../core/numbers.h"

/* Band matrices and their LU factorisation with partial pivoting (Golub & Van Loan, Matrix Computations, sec. 4.3).
 * Requires: real, M, BAND, and POSITION_IN_MATRIX, the position of each site in a bandwidth-reducing ordering. */

/* A square matrix with `blocks` unknowns per site, sites in the order of POSITION_IN_MATRIX. Sites more than BAND
 * positions apart are not coupled: entry (i, j) is zero for |i - j| > reach. Entry (i, j) is element first + j
 * stride + i: band storage with room for the fill-in of row exchanges, or the full matrix if that is smaller. */
typedef struct {
  int rows, reach, stride, first;
} band;

static band band_within(int rows, int reach)
{
  const int full = 3 * reach + 1 >= rows;
  const band shape = {
      .rows = rows, .reach = reach, .stride = full ? rows : 3 * reach, .first = full ? 0 : 2 * reach};
  return shape;
}

static band band_of(int sites, int blocks)
{
  return band_within(sites * blocks, (BAND + 1) * blocks - 1);
}

/* Number of stored entries. */
static size_t band_size(const band *shape)
{
  return (size_t)shape->rows * (size_t)(shape->first ? shape->stride + 1 : shape->stride);
}

static int least(int a, int b)
{
  return a < b ? a : b;
}

static int most(int a, int b)
{
  return a > b ? a : b;
}

static void swap(real *a, real *b)
{
  const real kept = *a;
  *a = *b;
  *b = kept;
}

/* x_i -= factor column_i for begin <= i < end. */
static inline void subtract(const real *restrict column, real factor, int begin, int end, real *restrict x)
{
  for (int i = begin; i < end; i++)
    x[i] -= factor * column[i];
}

/* Applies the elimination steps begin <= k < end to x: row exchanges and subtraction of multiples. */
static void eliminate(const real *a, const band *shape, const real *pivot, int begin, int end, real *x)
{
  for (int k = begin; k < end; k++) {
    if ((int)pivot[k] != k)
      swap(x + k, x + (int)pivot[k]);
    if (x[k] != 0)
      subtract(a + shape->first + k * shape->stride, x[k], k + 1, least(k + shape->reach + 1, shape->rows), x);
  }
}

/* LU factorisation with partial pivoting. Returns 0 if a pivot is zero or NaN. pivot[k] is the row exchanged with k;
 * the diagonal stores the inverses of the pivots. */
static int factorise(real *a, const band *shape, real *pivot)
{
  for (int k = 0; k < shape->rows; k++) {
    real *column = a + shape->first + k * shape->stride;
    const int end = least(k + shape->reach + 1, shape->rows);
    int best = k;
    eliminate(a, shape, pivot, most(k - 2 * shape->reach, 0), k, column);
    for (int i = k + 1; i < end; i++)
      if (MATH(fabs)(column[i]) > MATH(fabs)(column[best]))
        best = i;
    pivot[k] = (real)best;
    if (!(MATH(fabs)(column[best]) > 0))
      return 0;
    swap(column + k, column + best);
    column[k] = 1 / column[k];
    for (int i = k + 1; i < end; i++)
      column[i] *= column[k];
  }
  return 1;
}

/* x = a^-1 x with the factors of a. */
static void back_substitute(const real *a, const band *shape, const real *pivot, real *x)
{
  eliminate(a, shape, pivot, 0, shape->rows, x);
  for (int k = shape->rows - 1; k >= 0; k--) {
    const real *column = a + shape->first + k * shape->stride;
    x[k] *= column[k];
    subtract(column, x[k], most(k - 2 * shape->reach, 0), k, x);
  }
}

#endif
