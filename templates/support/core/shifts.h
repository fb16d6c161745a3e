/* Vectors over the eigenvalues of the matrix A = V diag(mu) V^-1 of a step, of complex pairs one each: linear equations
 * 1 - A (x) B are independent systems 1 - mu B (J. C. Butcher, BIT 16 (1976), 237). Requires: points.h; SHIFTS, their
 * number; MATRIX_POINTS, the size of A; MU, TO_SHIFTS and FROM_SHIFTS, real parts, then imaginary parts. */
typedef double shifts __attribute__((vector_size(8 * SHIFTS)));
typedef struct {
  shifts re, im;
} complex_shifts;

static inline shifts shifts_at(const double *table)
{
  shifts x;
  memcpy(&x, table, sizeof x);
  return x;
}

static inline complex_shifts product_of(complex_shifts x, complex_shifts y)
{
  return (complex_shifts){x.re * y.re - x.im * y.im, x.re * y.im + x.im * y.re};
}

/* a - x y. */
static inline complex_shifts minus_product(complex_shifts a, complex_shifts x, complex_shifts y)
{
  a.re -= x.re * y.re - x.im * y.im;
  a.im -= x.re * y.im + x.im * y.re;
  return a;
}

/* 1 / x. */
static inline complex_shifts inverse_of_shifts(complex_shifts x)
{
  const shifts size = 1.0 / (x.re * x.re + x.im * x.im);
  return (complex_shifts){x.re * size, -x.im * size};
}

/* factor x in eigenvectors of A; groups of x are `apart` apart. */
static inline complex_shifts into_shifts(const lanes *x, long long apart, double factor)
{
  complex_shifts sum = {{0.0}, {0.0}};
#pragma GCC unroll 16
  for (int j = 0; j < MATRIX_POINTS; j++) {
    const double value = factor * at_point(x, apart, j);
    sum.re += value * shifts_at(TO_SHIFTS + 2 * SHIFTS * j);
    sum.im += value * shifts_at(TO_SHIFTS + 2 * SHIFTS * j + SHIFTS);
  }
  return sum;
}

/* Values at a group of points. */
static inline lanes from_shifts_at(complex_shifts z, int g)
{
  lanes sum = lanes_of(0.0);
#pragma GCC unroll 8
  for (int k = 0; k < SHIFTS; k++)
    sum += z.re[k] * FROM_SHIFTS[k * GROUPS + g] + z.im[k] * FROM_SHIFTS[(SHIFTS + k) * GROUPS + g];
  return sum;
}

/* Stores the values at all groups, which are `apart` apart. */
static inline void from_shifts(complex_shifts z, long long apart, lanes *y)
{
  for (int g = 0; g < GROUPS; g++)
    y[g * apart] = from_shifts_at(z, g);
}
