#ifndef SUPPORT_NUMBERS_H
#define SUPPORT_NUMBERS_H

/* Real numbers in double or single precision (SINGLE_PRECISION): comparisons, checks, compensated sums. */
/* Real numbers in double precision (binary64). */
typedef double real;

#define MATH(function) function /* function of libm */
#define REAL(literal) literal /* floating-point literal */
#define REAL_EPSILON DBL_EPSILON
#define REAL_MIN DBL_MIN
#define NEGLIGIBLE 1e-12 /* relative to the state: rounding leaves no resolvable curve of smaller displacements */
#define DECAY 0.1 /* ratio of successive coefficients of a curve that is resolved to some digits */
/* relative to t, which is double-double: steps below it indicate a singularity of the motion */
#define SMALLEST_RELATIVE_STEP 1e-22
#define ROUNDOFF_LEVEL 1e-11 /* relative updates below it may be rounding errors: 1000 times those of a sum */

#define EACH REAL_EPSILON /* share of the largest coordinate in each size, if each coordinate is to be accurate by
                           * itself */
#define ALL 1 /* the same if the state is to be accurate as a whole */

#ifdef __clang__
#pragma clang diagnostic ignored "-Wunused-function" /* a method uses only some of the inline functions here */
#endif

/* Rarely executed code is compiled for size, in half the time; not for embedded targets, where functions that are not
 * inlined need more stack. */
#if defined(__GNUC__) && __STDC_HOSTED__
#define SELDOM __attribute__((cold))
#else
#define SELDOM
#endif

/* Maximum without the special treatment of NaN by fmax, and without a call. */
static inline real larger(real a, real b)
{
  return a > b ? a : b;
}

/* Returns 1 if x is neither infinite nor NaN; vectorises, and requires IEEE arithmetic (no -ffast-math). */
static inline int is_finite(real x)
{
  return 0 * x == 0;
}

/* Returns 1 if no x is infinite or NaN. */
static inline int all_finite(const real *x, int n)
{
  int faults = 0;
  for (int i = 0; i < n; i++)
    faults |= !is_finite(x[i]);
  return !faults;
}

/* inverse_root_k, x^(-k/2), k odd: INVERSE_ROOT(k, inverse^((k+1)/2)); ends in a declaration, for the semicolon. */
#define INVERSE_ROOT(k, inverses)             \
  static inline real inverse_root_##k(real x) \
  {                                           \
    const real inverse = 1 / x;               \
    return inverses * MATH(sqrt)(x);          \
  }                                           \
  static inline real inverse_root_##k(real x)

/* x + low += increment + increment_low in double-double arithmetic (two-sum by Knuth, then fast two-sum by Dekker): x
 * is the rounded sum of any number of increments. */
static inline void add_compensated(real *x, real *low, real increment, real increment_low)
{
  const real sum = *x + increment, part = sum - *x;
  const real rest = ((*x - (sum - part)) + (increment - part)) + (*low + increment_low), rounded = sum + rest;
  *low = rest - (rounded - sum);
  *x = rounded;
}

#endif
