#include "../core/points.h"
#include "../core/shifts.h"
#include "../core/step.h"
#include "../iteration/convergence.h"
#include "arrays.h"

/* Linear systems of Newton's method for the points of a step of an array system: (1 - A F') dX = the change by one
 * fixed-point iteration, where A gives the increments of the state by the forces (or rates of a Hamiltonian), of which
 * F' is the Jacobian at the points. F' is only multiplied by vectors, term group by term group. Positions, and momenta
 * if X_VECTORS is 2, are the parts of a vector: ROWS rows of n lanes. Requires: jacobian_times; jacobian_diagonal
 * unless FACTORS_ALONE; second_order_points.h or array_hamiltonian_iteration.h. */

enum { ROWS = GROUPS * X_VECTORS };

typedef struct {
  const step_data *step;
  const run_memory *run;
  const step_points *points;
  const work_arrays *work;
  long long n, count; /* coordinates, and lanes of a vector over all points */
  section own; /* coordinates of this thread */
  double scale[X_VECTORS], state; /* of the parts before they are squared, and the scaled size of the state */
  int by_factors; /* 1 if the preconditioner is that of envelope.h */
  int by_fourier, tried; /* 1 if the inverses are those of the Fourier modes; number of preconditioners for which one
                        * cycle was not enough */
  double left; /* reduction of the residual by the first of them */
} linear_system;

/* y = x - A F' x. */
static void multiply(const linear_system *of, const lanes *x, lanes *y)
{
  const long long n = of->n;
  jacobian_times(of->step, of->points->X, x, of->work->forces);
  for (int part = 0; part < X_VECTORS; part++)
    for (long long i = of->own.first; i < of->own.end; i++)
      for (int g = 0; g < GROUPS; g++) {
        const long long at = (g * X_VECTORS + part) * n + i;
        y[at] = x[at] - increment_at(of->points, part, g, i, of->work->forces);
      }
}

/* Derivative of an unknown by forces x averaged over the points: h^2 x / m, or h times a rate. */
static double mean_derivative(const linear_system *of, const lanes *x, long long i)
{
  const lanes *own = x + index_of_rate(of->n, i);
  double mean = 0.0;
  for (int j = 0; j < KEPT; j++)
    mean += at_point(own, F_VECTORS * of->n, j) / KEPT;
  return unit_of(of->points, i) * mean;
}

#ifndef FACTORS_ALONE
/* y = the inverses times x, per coordinate; x may be y. */
static void apply_inverses(const linear_system *of, const lanes *x, lanes *y, section here)
{
  for (long long i = here.first; i < here.end; i++) {
    lanes all[GROUPS];
    for (int g = 0; g < GROUPS; g++)
      all[g] = contribution_of_points(of->work->inverse + i * POINTS * GROUPS, g, x + i, of->n);
    for (int g = 0; g < GROUPS; g++)
      y[g * of->n + i] = all[g];
  }
}

/* Stores `by` times the inverse of 1 - derivative A for a coordinate, from eigenvectors of A; a positive (unstable)
 * derivative counts as 0. */
static void keep_inverse(linear_system *of, long long i, double derivative, double by)
{
  const double d = smaller(derivative, 0.0);
  const complex_shifts system = {1.0 - d * shifts_at(MU), -d * shifts_at(MU + SHIFTS)};
  const complex_shifts inverse = inverse_of_shifts(system);
  lanes *const column = of->work->inverse + i * POINTS * GROUPS;
  memset(column, 0, sizeof(lanes) * POINTS * GROUPS);
  for (int j = 0; j < MATRIX_POINTS; j++) {
    const double *into = TO_SHIFTS + 2 * SHIFTS * j;
    const complex_shifts unit = {by * shifts_at(into), by * shifts_at(into + SHIFTS)};
    from_shifts(product_of(inverse, unit), 1, column + j * GROUPS);
  }
}

/* Inverts 1 - h^2 A F'_ii / m of every coordinate. */
static void find_own_inverses(linear_system *of)
{
  jacobian_diagonal(of->step, of->points->X, of->work->forces);
  for (long long i = of->own.first; i < of->own.end; i++)
    keep_inverse(of, i, mean_derivative(of, of->work->forces, i), 1.0);
}

#endif

/* Vectors over all points of all coordinates; every thread computes its own part. */

/* Inner product of scaled vectors. */
static double inner_product(const linear_system *of, const lanes *x, const lanes *y)
{
  sums all;
  begin_sums(&all, of->run, of->n);
  while (next_block(&all)) {
    lanes a = lanes_of(0.0), b = lanes_of(0.0);
    for (int g = 0; g < ROWS; g++) {
      const double scale = of->scale[g % X_VECTORS];
      long long i = g * of->n + all.here.first;
      const long long end = g * of->n + all.here.end;
      for (; i + 1 < end; i += 2) {
        a += (scale * x[i]) * (scale * y[i]);
        b += (scale * x[i + 1]) * (scale * y[i + 1]);
      }
      if (i < end)
        a += (scale * x[i]) * (scale * y[i]);
    }
    add_block(&all, lanes_total(a + b), 0.0);
  }
  wait_at_barrier(of->run);
  return sum_of(&all, 0);
}

/* y += by x, for the coordinates of this thread. */
static void add_multiple(const linear_system *of, lanes *restrict y, double by, const lanes *restrict x)
{
  for (int g = 0; g < ROWS; g++)
    for (long long i = g * of->n + of->own.first; i < g * of->n + of->own.end; i++)
      y[i] += by * x[i];
}

/* x = by y, for the coordinates of this thread. */
static void set_multiple(const linear_system *of, lanes *x, double by, const lanes *y)
{
  for (int g = 0; g < ROWS; g++)
    for (long long i = g * of->n + of->own.first; i < g * of->n + of->own.end; i++)
      x[i] = by * y[i];
}

static void make_zero(const linear_system *of, lanes *x)
{
  for (int g = 0; g < ROWS; g++)
    memset(x + g * of->n + of->own.first, 0, sizeof(lanes) * (size_t)(of->own.end - of->own.first));
}
