/* Sums of vectors. Requires: nothing. */

static void add_to(double *restrict x, const double *restrict y, double by, long long n)
{
  for (long long i = 0; i < n; i++)
    x[i] += by * y[i];
}

/* x += y, with the rounding error in rest (two-sum; Knuth, TAOCP vol. 2, sec. 4.2.2). */
static void add_all(double *restrict x, const double *restrict y, double *restrict rest, long long n)
{
  for (long long i = 0; i < n; i++) {
    const double sum = x[i] + y[i], part = sum - x[i];
    rest[i] = (x[i] - (sum - part)) + (y[i] - part);
    x[i] = sum;
  }
}
