/* Sums of vectors. Before it: nothing. */

static void add_to(double *restrict x, const double *restrict y, double by, long long n)
{
  for (long long i = 0; i < n; i++)
    x[i] += by * y[i];
}

/* x += y, and what rounding cuts off (Knuth). */
static void add_all(double *restrict x, const double *restrict y, double *restrict rest, long long n)
{
  for (long long i = 0; i < n; i++) {
    const double sum = x[i] + y[i], part = sum - x[i];
    rest[i] = (x[i] - (sum - part)) + (y[i] - part);
    x[i] = sum;
  }
}
