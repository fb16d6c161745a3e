#ifndef SUPPORT_ENVELOPE_H
#define SUPPORT_ENVELOPE_H

#include "array_newton.h"

/* Linear part of a step of coordinates that are coupled to near ones (meshes, beams, chains): the inverse of 1 - h^2 A
 * F' / m with the mean F' over the points. In eigenvectors of A = V diag(mu) V^-1 these are the systems m - mu h^2 F',
 * of a complex pair only one (J. C. Butcher, BIT 16 (1976), 237), factorised as L D L^T within the envelope of the rows
 * (A. Jennings, Comput. J. 9 (1966), 281). Requires: array_newton.h; SHIFTS, the number of systems, MU, TO_SHIFTS
 * and FROM_SHIFTS, real parts, then imaginary parts. */

typedef double shifts __attribute__((vector_size(8 * SHIFTS)));
typedef struct {
  shifts re, im;
} complex_shifts;

/* Rows i of the factors in a certain order of the coordinates: columns first[i] to i, at start[i]. Column j of F' has
 * entries in `row`, from column[j] on. Columns of equal `colour` have no common row, the last `apart` columns have
 * colours of their own. */
typedef struct {
  long long n;
  int width, apart;
  const int *order, *first, *start, *column, *row;
  complex_shifts *unknown, *factor;
  double *valid_for; /* step size */
} envelope;

static envelope envelope_of(const linear_system *of)
{
  const int *pattern = of->run->pattern;
  double *memory = of->step->first == COMPARISON ? of->run->compared_factors : of->run->factors;
  envelope all = {.n = of->n, .width = pattern[0], .apart = pattern[1], .order = pattern + 2};
  all.first = all.order + all.n;
  all.start = all.first + all.n;
  all.column = all.start + all.n;
  all.row = all.column + all.n + 1;
  all.valid_for = memory;
  all.unknown = (complex_shifts *)(memory + 8);
  all.factor = all.unknown + all.n;
  return all;
}

static inline complex_shifts *row_of(const envelope *all, long long i)
{
  return all->factor + (all->start[i] - all->first[i]);
}

static inline shifts shifts_at(const double *table)
{
  shifts x;
  memcpy(&x, table, sizeof x);
  return x;
}

/* a - x y. */
static inline complex_shifts minus_product(complex_shifts a, complex_shifts x, complex_shifts y)
{
  a.re -= x.re * y.re - x.im * y.im;
  a.im -= x.re * y.im + x.im * y.re;
  return a;
}

/* a - sum of x_k y_k, in two independent sums. */
static inline complex_shifts minus_products(complex_shifts a, const complex_shifts *x, const complex_shifts *y,
    long long count)
{
  complex_shifts b = {{0.0}, {0.0}};
  for (; count > 1; count -= 2, x += 2, y += 2) {
    a = minus_product(a, x[0], y[0]);
    b = minus_product(b, x[1], y[1]);
  }
  a = count > 0 ? minus_product(a, *x, *y) : a;
  a.re += b.re, a.im += b.im;
  return a;
}

static inline complex_shifts product_of(complex_shifts x, complex_shifts y)
{
  const complex_shifts product = {x.re * y.re - x.im * y.im, x.re * y.im + x.im * y.re};
  return product;
}

/* Sets x to 1 at the columns of a colour. */
static void set_columns(const linear_system *of, const envelope *all, int colour, double value, lanes *x)
{
  const long long alike = all->n - all->apart, first = colour < all->width ? colour : alike + colour - all->width;
  for (long long j = first; j < (colour < all->width ? alike : first + 1); j += all->width)
    for (int g = 0; g < GROUPS; g++)
      x[g * of->n + all->order[j]] = lanes_of(value);
}

/* Stores the columns of a colour, of which `answer` is F' times their sum. */
static void keep_columns(const linear_system *of, const envelope *all, int colour, const lanes *answer)
{
  const long long alike = all->n - all->apart, first = colour < all->width ? colour : alike + colour - all->width;
  for (long long j = first; j < (colour < all->width ? alike : first + 1); j += all->width)
    for (int k = all->column[j]; k < all->column[j + 1]; k++) {
      const long long i = all->order[all->row[k]];
      const double mass = 1.0 / of->points->data->inverse_mass[i], entry = mass * mean_derivative(of, answer, i);
      complex_shifts *at = row_of(all, all->row[k]) + j;
      at->re -= entry * shifts_at(MU), at->im -= entry * shifts_at(MU + SHIFTS);
      at->re += all->row[k] == j ? mass : 0.0;
    }
}

static void factorise(const envelope *all)
{
  for (long long i = 0; i < all->n; i++) {
    complex_shifts *row = row_of(all, i), own = row[i];
    for (long long j = all->first[i]; j < i; j++) {
      const long long low = all->first[i] > all->first[j] ? all->first[i] : all->first[j];
      row[j] = minus_products(row[j], row + low, row_of(all, j) + low, j - low);
    }
    for (long long j = all->first[i]; j < i; j++) {
      const complex_shifts scaled = product_of(row[j], row_of(all, j)[j]);
      own = minus_product(own, row[j], scaled);
      row[j] = scaled;
    }
    row[i].re = own.re / (own.re * own.re + own.im * own.im);
    row[i].im = -own.im / (own.re * own.re + own.im * own.im);
  }
}

static inline int is_first_thread(const linear_system *of)
{
  return !of->run->thread_barrier || of->run->part == 0;
}

/* Computes the factors for this step size at the points of the step. */
static void find_factors(linear_system *of)
{
  const envelope all = envelope_of(of);
  const long long last = all.n - 1, entries = all.start[last] + last - all.first[last] + 1;
  make_zero(of, of->work->product);
  wait_at_barrier(of->run);
  if (is_first_thread(of))
    memset(all.factor, 0, sizeof(complex_shifts) * (size_t)entries);
  for (int colour = 0; colour < all.width + all.apart; colour++) {
    if (is_first_thread(of))
      set_columns(of, &all, colour, 1.0, of->work->product);
    wait_at_barrier(of->run);
    jacobian_times(of->step, of->points->X, of->work->product, of->work->forces);
    if (is_first_thread(of)) {
      keep_columns(of, &all, colour, of->work->forces);
      set_columns(of, &all, colour, 0.0, of->work->product);
    }
    wait_at_barrier(of->run);
  }
  if (is_first_thread(of)) {
    factorise(&all);
    *all.valid_for = of->step->h;
  }
  wait_at_barrier(of->run);
}

static inline int has_factors(const linear_system *of)
{
  return *envelope_of(of).valid_for == of->step->h;
}

/* Residual of a coordinate in eigenvectors of A, times its mass. */
static inline complex_shifts to_shifts(const linear_system *of, const lanes *x, double mass)
{
  complex_shifts sum = {{0.0}, {0.0}};
  for (int j = 0; j < KEPT; j++) {
    const double value = mass * at_point(x, of->n, j);
    sum.re += value * shifts_at(TO_SHIFTS + 2 * SHIFTS * j);
    sum.im += value * shifts_at(TO_SHIFTS + 2 * SHIFTS * j + SHIFTS);
  }
  return sum;
}

static inline void from_shifts(const linear_system *of, complex_shifts z, lanes *y)
{
  for (int g = 0; g < GROUPS; g++) {
    lanes sum = lanes_of(0.0);
    for (int k = 0; k < SHIFTS; k++)
      sum += z.re[k] * FROM_SHIFTS[k * GROUPS + g] + z.im[k] * FROM_SHIFTS[(SHIFTS + k) * GROUPS + g];
    y[g * of->n] = sum;
  }
}

/* y = the inverse of the linear part times x. */
static void apply_factors(const linear_system *of, const lanes *x, lanes *y)
{
  const envelope all = envelope_of(of);
  const double *inverse_mass = of->points->data->inverse_mass;
  complex_shifts *z = all.unknown;
  wait_at_barrier(of->run);
  for (long long i = 0; is_first_thread(of) && i < all.n; i++) {
    const long long at = all.order[i], first = all.first[i];
    z[i] = to_shifts(of, x + at, 1.0 / inverse_mass[at]);
    z[i] = minus_products(z[i], row_of(&all, i) + first, z + first, i - first);
  }
  for (long long i = 0; is_first_thread(of) && i < all.n; i++)
    z[i] = product_of(z[i], row_of(&all, i)[i]);
  for (long long i = all.n - 1; is_first_thread(of) && i >= 0; i--) {
    const complex_shifts *row = row_of(&all, i);
    for (long long j = all.first[i]; j < i; j++)
      z[j] = minus_product(z[j], row[j], z[i]);
    from_shifts(of, z[i], y + all.order[i]);
  }
  wait_at_barrier(of->run);
}

#endif
