#include "../core/shifts.h"
#include "array_newton.h"

/* Linear part of a step of coordinates that are coupled to near ones (meshes, beams, chains): the inverse of 1 - A F'
 * with the mean F' over the points. In eigenvectors of A = V diag(mu) V^-1 these are the systems m - mu h^2 F', for a
 * Hamiltonian 1 - mu h F', of a complex pair only one (J. C. Butcher, BIT 16 (1976), 237). They are factorised as L D U
 * within the envelope of the rows (A. Jennings, Comput. J. 9 (1966), 281), where U is L^T if F' is symmetric (SIDES =
 * 1). With FORCES_OF_VELOCITIES they are m - mu h F_v - mu^2 h^2 F_q, for the velocities. Requires: UNKNOWNS, their
 * number per coordinate; SHIFTS, the number of systems, MU, TO_SHIFTS and FROM_SHIFTS, real parts, then imaginary
 * parts. */

enum { PROBES = X_VECTORS / UNKNOWNS }; /* parts of the state by which the forces of an unknown are differentiated */

/* Rows i of L and columns i of U in a certain order of the unknowns, positions and momenta: entries first[i] to i, at
 * start[i]. Column j of F' has entries in `row`, from column[j] on. Columns of equal `colour` have no common row, the
 * last `apart` columns have colours of their own. */
typedef struct {
  long long n, stride, entries; /* unknowns; lanes of a group of points; entries of a side */
  int width, apart;
  const int *order, *first, *start, *column, *row;
  complex_shifts *unknown, *factor;
  double *valid_for; /* step size */
} envelope;

/* Reads the pattern for n coordinates. */
static envelope envelope_in(const int *pattern, long long n)
{
  envelope all = {.n = UNKNOWNS * n, .stride = X_VECTORS * n, .width = pattern[0], .order = pattern + 2};
  all.apart = pattern[1];
  all.first = all.order + all.n;
  all.start = all.first + all.n;
  all.column = all.start + all.n;
  all.row = all.column + all.n + 1;
  all.entries = all.start[all.n - 1] + all.n - all.first[all.n - 1];
  return all;
}

/* Length of the memory of the factors. */
static long long numbers_of_factors(const int *pattern, long long n)
{
  const envelope all = envelope_in(pattern, n);
  return 8 + 2 * SHIFTS * (all.n + SIDES * all.entries);
}

static envelope envelope_of(const linear_system *of)
{
  double *memory = of->step->first == COMPARISON ? of->run->compared_factors : of->run->factors;
  envelope all = envelope_in(of->run->pattern, of->n);
  all.valid_for = memory;
  all.unknown = (complex_shifts *)(memory + 8);
  all.factor = all.unknown + all.n;
  return all;
}

/* Row i of L, or column i of U; in the last one the entry i is the inverse of the pivot. */
static inline complex_shifts *row_of(const envelope *all, int side, long long i)
{
  return all->factor + (side * all->entries + all->start[i] - all->first[i]);
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

/* Sets x to a value at the columns of a colour. */
static void set_columns(const envelope *all, int colour, double value, lanes *x)
{
  const long long alike = all->n - all->apart, first = colour < all->width ? colour : alike + colour - all->width;
  for (long long j = first; j < (colour < all->width ? alike : first + 1); j += all->width)
    for (int g = 0; g < GROUPS; g++)
      x[g * all->stride + all->order[j]] = lanes_of(value);
}

/* Eigenvalues by which derivatives with respect to a part of the state are multiplied. */
static inline complex_shifts eigenvalues_of(int part)
{
  const complex_shifts mu = {shifts_at(MU), shifts_at(MU + SHIFTS)};
  return part + 1 < PROBES ? product_of(mu, mu) : mu;
}

/* Stores the columns of a colour, of which `answer` is F' times their sum, by positions (part 0) or velocities. */
static void keep_columns(const linear_system *of, const envelope *all, int colour, int part, const lanes *answer)
{
  const complex_shifts mu = eigenvalues_of(part);
  const double unit = part == 1 ? of->step->h : 1.0;
  const long long alike = all->n - all->apart, first = colour < all->width ? colour : alike + colour - all->width;
  for (long long j = first; j < (colour < all->width ? alike : first + 1); j += all->width)
    for (int k = all->column[j]; k < all->column[j + 1]; k++) {
      const long long row = all->row[k], i = all->order[row];
      const double mass = mass_of(of->points, i), entry = mass * mean_derivative(of, answer, i) / unit;
      complex_shifts *at = row > j ? row_of(all, 0, row) + j : row_of(all, SIDES - 1, j) + row;
      at->re -= entry * mu.re, at->im -= entry * mu.im;
      if (part == 0)
        at->re += row == j ? mass : 0.0;
    }
}

static void factorise(const envelope *all)
{
  for (long long i = 0; i < all->n; i++) {
    complex_shifts *row = row_of(all, 0, i), *column = row_of(all, SIDES - 1, i), own = column[i];
    for (int side = 0; side < SIDES; side++) {
      complex_shifts *line = side == 0 ? row : column;
      for (long long j = all->first[i]; j < i; j++) {
        const long long low = all->first[i] > all->first[j] ? all->first[i] : all->first[j];
        line[j] = minus_products(line[j], line + low, row_of(all, SIDES - 1 - side, j) + low, j - low);
      }
    }
    for (long long j = all->first[i]; j < i; j++) {
      const complex_shifts pivot = row_of(all, SIDES - 1, j)[j], scaled = product_of(column[j], pivot);
      own = minus_product(own, row[j], scaled);
      if (SIDES == 2)
        row[j] = product_of(row[j], pivot);
      column[j] = scaled;
    }
    column[i].re = own.re / (own.re * own.re + own.im * own.im);
    column[i].im = -own.im / (own.re * own.re + own.im * own.im);
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
  make_zero(of, of->work->product);
  wait_at_barrier(of->run);
  if (is_first_thread(of))
    memset(all.factor, 0, sizeof(complex_shifts) * (size_t)(SIDES * all.entries));
  for (int part = 0; part < PROBES; part++)
    for (int colour = 0; colour < all.width + all.apart; colour++) {
      lanes *direction = of->work->product;
      if (is_first_thread(of))
        set_columns(&all, colour, 1.0, direction + part * of->n);
      wait_at_barrier(of->run);
      jacobian_times(of->step, of->points->X, direction, of->work->forces);
      if (is_first_thread(of)) {
        keep_columns(of, &all, colour, part, of->work->forces);
        set_columns(&all, colour, 0.0, direction + part * of->n);
      }
      wait_at_barrier(of->run);
    }
  if (is_first_thread(of)) {
    factorise(&all);
    *all.valid_for = of->step->h;
  }
  wait_at_barrier(of->run);
}

#ifdef FORCES_OF_VELOCITIES
/* Changes of positions, which follow from those of velocities: x_q + h B (y_v - x_v). */
static void follow_velocities(const linear_system *of, const lanes *x, lanes *y)
{
  for (long long i = of->own.first; i < of->own.end; i++) {
    lanes moved[GROUPS];
    for (int g = 0; g < GROUPS; g++)
      moved[g] = y[(2 * g + 1) * of->n + i] - x[(2 * g + 1) * of->n + i];
    for (int g = 0; g < GROUPS; g++)
      y[2 * g * of->n + i] = x[2 * g * of->n + i] + of->step->h * contribution_of_points(VELOCITY, g, moved, 1);
  }
}
#endif

/* y = the inverse of the linear part times x; with velocities for those x that are increments by the same forces. */
static void apply_factors(const linear_system *of, const lanes *x, lanes *y)
{
  const envelope all = envelope_of(of);
  const long long solved_part = (PROBES - 1) * of->n;
  complex_shifts *z = all.unknown;
  wait_at_barrier(of->run);
  for (long long i = 0; is_first_thread(of) && i < all.n; i++) {
    const long long at = all.order[i], first = all.first[i];
    z[i] = into_shifts(x + solved_part + at, all.stride, mass_of(of->points, at));
    z[i] = minus_products(z[i], row_of(&all, 0, i) + first, z + first, i - first);
  }
  for (long long i = 0; is_first_thread(of) && i < all.n; i++)
    z[i] = product_of(z[i], row_of(&all, SIDES - 1, i)[i]);
  for (long long i = all.n - 1; is_first_thread(of) && i >= 0; i--) {
    const complex_shifts *column = row_of(&all, SIDES - 1, i), solved = z[i];
    for (long long j = all.first[i]; j < i; j++)
      z[j] = minus_product(z[j], column[j], solved);
    from_shifts(solved, all.stride, y + solved_part + all.order[i]);
  }
  wait_at_barrier(of->run);
#ifdef FORCES_OF_VELOCITIES
  follow_velocities(of, x, y);
#endif
}
