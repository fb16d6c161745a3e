#include "numbers.h"

/* Numbers of states: reals, or with DOUBLE_DOUBLE pairs, of which arrays contain all high words, then all low ones.
 * Requires: status_codes.h or trajectories.h. */
#ifdef DOUBLE_DOUBLE
typedef dd scalar;
typedef const double *instant;
enum { WORDS = 2 };
#define KERNEL_OF(name) name##_pairs
#define AND_DERIVATIVES(values, count) values /* which follow them */
#define HIGH_WORD(x) (x).high
#define TAKE_WORDS(words, count, i) dd_of((words)[i], (words)[(count) + (i)])
#define PUT_WORDS(words, count, i, x) ((words)[i] = (x).high, (words)[(count) + (i)] = (x).low)
#define TIME_AT(t, k) dd_of((t)[2 * (k)], (t)[2 * (k) + 1])
#define TIME_OF(t) TIME_AT(t, 0)
#define AS_TIME(t) (const real[]){t, 0}
#define REAL_TIME(t) (t)[0]
#define SCALAR dd_word
#define NEGATIVE dd_negative
#define ADD dd_add
#define SUBTRACT dd_subtract
#define MULTIPLY dd_multiply
#else
typedef real scalar;
typedef real instant;
enum { WORDS = 1 };
#define KERNEL_OF(name) name
#define AND_DERIVATIVES(values, count) values, (values) + (count)
#define HIGH_WORD(x) x
#define TAKE_WORDS(words, count, i) (words)[i]
#define PUT_WORDS(words, count, i, x) ((words)[i] = (x))
#define TIME_AT(t, k) (t)[k]
#define TIME_OF(t) t
#define AS_TIME(t) t
#define REAL_TIME(t) t
#define SCALAR(x) x
#define NEGATIVE(x) (-(x))
#define ADD(x, y) ((x) + (y))
#define SUBTRACT(x, y) ((x) - (y))
#define MULTIPLY(x, y) ((x) * (y))
#endif

static inline void load_scalars(const real *words, scalar *x)
{
  for (int i = 0; i < M; i++)
    x[i] = TAKE_WORDS(words, M, i);
}

/* Stores scalars if they are finite. */
static inline int store_scalars(const scalar *x, real *words)
{
  for (int i = 0; i < M; i++)
    TRY(is_finite(HIGH_WORD(x[i])) ? OK : NOT_FINITE);
  for (int i = 0; i < M; i++)
    PUT_WORDS(words, M, i, x[i]);
  return OK;
}
