/* Operations on single words for pairs of numbers (pairs.h, functions.h). */
#if defined(__ASSOCIATIVE_MATH__) || (defined(__clang__) && defined(__FAST_MATH__))
#error "compile without -fassociative-math (part of -ffast-math and -Ofast), which removes rounding errors"
#endif
#if FLT_EVAL_METHOD == 2
#error "compile for SSE2 (-mfpmath=sse -msse2): x87 registers round twice"
#endif

#if defined(__GNUC__) && !defined(__clang__) && !defined(LANES)
/* A product that is vectorised and computed in numbers, too, may be rounded for its rounding error, and contracted to
 * an FMA where it is added, which adds the error again (gcc 12 with -ffp-contract=fast). */
#pragma GCC optimize("fp-contract=off")
#endif

#define TO_INTEGER 6755399441055744.0 /* 1.5 2^52: adding and subtracting it rounds to a whole number */

#define dd_root(x) sqrt(x)
#define dd_log_of(x) log(x)
#define dd_asinh_of(x) asinh(x)
#define dd_atan2_of(y, x) atan2(y, x)
#define dd_sign(x) copysign(1.0, x)
#define dd_is_small(x) (fabs(x) < 0.25 ? 1.0 : 0.0)
#define dd_are_equal(a, b) ((a) == (b) ? 1.0 : 0.0)
#define dd_select(chosen, a, b) ((chosen) != 0.0 ? (a) : (b))

/* The whole number nearest to x + rest. */
static inline double dd_whole(double x, double rest)
{
  const double whole = rint(x), half = x - whole;
  return fabs(half) == 0.5 && half * rest > 0.0 ? whole + 2.0 * half : whole;
}

static inline double dd_limited(double x, double most)
{
  return x > most ? most : x < -most ? -most
                                     : x;
}

/* An angle, NaN if reducing it would lose digits. */
static inline double dd_angle(double x)
{
  return fabs(x) <= 1e9 ? x : (double)NAN;
}

/* Row of a table of a power of two of rows, k modulo that, from the last bits of k + 1.5 2^52; any row for NaN. */
static inline int dd_row(double k, int rows)
{
  long long bits;
  k += TO_INTEGER;
  memcpy(&bits, &k, sizeof bits);
  return (int)(bits & (rows - 1));
}

/* 2^n with n = k / 64, rounded down: 0 below the normal numbers, infinite above. */
static inline double dd_power_of_2(double k)
{
  const long long n = (k == k ? (long long)k : 0) >> 6, biased = n < -1023 ? 0 : n > 1024 ? 2047
                                                                                          : n + 1023;
  const unsigned long long bits = (unsigned long long)biased << 52;
  double x;
  memcpy(&x, &bits, sizeof x);
  return x;
}
