#include "../core/numbers.h"

/* Interpolating polynomials of event functions on a part of a step: their crossings, extrema and error estimates.
 * Requires: EVENT_DEGREE; EVENT_COEFFICIENTS, from values at the nodes to coefficients of x^k, -1 <= x <= 1;
 * EVENT_DOUBTS, the factors of the last two coefficients in the error estimate. */
#define EVENT_BISECTIONS 30 /* for the abscissa of an extremum: an error of 2^-30 changes the extremum by 2^-60 */
#define EVENT_STEEPNESS 8.0 /* a zero is simple if the derivative exceeds so many error estimates */

static int changes_sign(real from, real to)
{
  return (from < 0.0 && to >= 0.0) || (from > 0.0 && to <= 0.0);
}

/* sum_k c[k] x^k */
static real polynomial(const real *c, int degree, real x)
{
  real sum = c[degree];
  for (int k = degree - 1; k >= 0; k--)
    sum = sum * x + c[k];
  return sum;
}

/* Zeros of c in -1 < x < 1, ascending; at most one between neighbouring extrema. Returns their number. */
static int polynomial_crossings(const real *c, int degree, real *x)
{
  real derivative[EVENT_DEGREE + 1] = {0.0}, ends[EVENT_DEGREE + 2];
  int count = 0, parts = 1;
  if (degree < 1)
    return 0;
  for (int k = 1; k <= degree; k++)
    derivative[k - 1] = k * c[k];
  ends[0] = -1.0;
  parts += polynomial_crossings(derivative, degree - 1, ends + 1);
  ends[parts] = 1.0;
  for (int i = 0; i < parts; i++) {
    real low = ends[i], high = ends[i + 1];
    const real start = polynomial(c, degree, low);
    if (!changes_sign(start, polynomial(c, degree, high)))
      continue;
    for (int k = 0; k < EVENT_BISECTIONS; k++) {
      const real middle = 0.5 * (low + high);
      if (changes_sign(start, polynomial(c, degree, middle)))
        high = middle;
      else
        low = middle;
    }
    x[count++] = 0.5 * (low + high);
  }
  return count;
}

/* Coefficients of the interpolating polynomial, its error estimate `doubt` from the last two Chebyshev coefficients,
 * and the range of its deviation from the value in the middle. */
static void interpolate(const real *g, real *c, real *doubt, real *range)
{
  *range = 0.0;
  for (int k = 0; k <= EVENT_DEGREE; k++) {
    c[k] = 0.0;
    for (int j = 0; j <= EVENT_DEGREE; j++)
      c[k] += EVENT_COEFFICIENTS[k][j] * g[j];
    *range += k > 0 ? fabs(c[k]) : 0.0;
  }
  *doubt = EVENT_DOUBTS[0] * fabs(c[EVENT_DEGREE - 1]) + EVENT_DOUBTS[1] * fabs(c[EVENT_DEGREE]);
}

static real nearer_middle(real a, real b)
{
  return fabs(a) < fabs(b) ? a : b;
}

/* Abscissa, nearest to the middle, where the sign of the polynomial c or the simplicity of a zero is uncertain, or 2 if
 * there is none; also returns the extrema and zeros, ascending. */
static real uncertain_abscissa(const real *c, real doubt, real *extrema, int *count, real *zeros, int *zero_count)
{
  real derivative[EVENT_DEGREE], place = 2.0;
  *zero_count = polynomial_crossings(c, EVENT_DEGREE, zeros);
  for (int k = 1; k <= EVENT_DEGREE; k++)
    derivative[k - 1] = k * c[k];
  *count = polynomial_crossings(derivative, EVENT_DEGREE - 1, extrema);
  for (int i = 0; i < *zero_count; i++) {
    const real rate = polynomial(derivative, EVENT_DEGREE - 1, zeros[i]);
    if (fabs(rate) <= EVENT_STEEPNESS * doubt)
      place = nearer_middle(zeros[i], place);
    else
      zeros[i] -= polynomial(c, EVENT_DEGREE, zeros[i]) / rate; /* from the error of bisection to rounding */
  }
  for (int i = 0; i < *count; i++)
    if (fabs(polynomial(c, EVENT_DEGREE, extrema[i])) <= doubt)
      place = nearer_middle(extrema[i], place);
  return place;
}
