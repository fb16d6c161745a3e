/* Comparisons and checks of numbers. Before it: real. */

#ifdef __clang__
#pragma clang diagnostic ignored "-Wunused-function" /* a method takes what it needs of what is inline here */
#endif

/* What is seldom run, with all that only it calls, is compiled for size: in half the time. Not on a board: functions
 * that are not inlined for it take more of the stack. */
#if defined(__GNUC__) && __STDC_HOSTED__
#define SELDOM __attribute__((cold))
#else
#define SELDOM
#endif

/* fmax without its care for NaN, and without a call. */
static inline real larger(real a, real b)
{
  return a > b ? a : b;
}

/* Whether no x is an infinity or a NaN. */
static int all_finite(const real *x, int n)
{
  int faults = 0;
  for (int i = 0; i < n; i++)
    faults |= 0 * x[i] != 0;
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
