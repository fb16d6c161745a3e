/* What a core can do: STREAM's triad, a = b + s c, and multiply-adds in registers. */
#include "machine_limits.h"

#include <math.h>

void triad(double *restrict a, const double *restrict b, const double *restrict c, double s, long n)
{
  for (long i = 0; i < n; i++)
    a[i] = b[i] + s * c[i];
}

enum { CHAINS = 96 }; /* that do not wait for each other, in vectors */

double multiply_adds(long count)
{
  double x[CHAINS], total = 0.0;
  for (int j = 0; j < CHAINS; j++)
    x[j] = 1.0 + j;
  for (long i = 0; i < count; i++)
    for (int j = 0; j < CHAINS; j++)
      x[j] = fma(x[j], 0.5, 1.0);
  for (int j = 0; j < CHAINS; j++)
    total += x[j];
  return total;
}
