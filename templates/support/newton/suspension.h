#include "../core/numbers.h"

/* Suspension of an iteration that fails at fixed steps, in favour of Newton's method. A negative number -n takes the
 * place of the number of former steps that the predictor uses: n = 2^k + r, and the next r steps are solved without the
 * iteration. If it fails again in the step after them, it is suspended for 2^(k + 1) - 1 steps; if it succeeds, n is
 * forgotten. So the steps that it could have solved are at most as many as those that it could not. */
#define MOST_SUSPENDED 64 /* 2^k at most */

/* Returns 1 if the step is solved without the iteration. */
static inline int is_suspended(long long guess)
{
  return guess < 0 && (-guess & (-guess - 1)) != 0;
}

/* Number after a step that Newton's method solved. */
static inline long long after_fallback(long long guess)
{
  if (guess >= 0)
    return -1;
  if (is_suspended(guess))
    return guess + 1;
  return (guess > -MOST_SUSPENDED ? 4 : 2) * guess + 1;
}
