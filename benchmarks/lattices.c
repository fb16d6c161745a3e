/* Leapfrog and its compositions for a ring and for a field, written by hand: kicks of h KICK[k] f, each followed by a drift
 * of h DRIFT[k] v. `work` has room for as many numbers as there are coordinates. */
#include "lattices.h"

#include <math.h>

/* v += by f for the ring with potential d^2 / 2 + beta d^4 / 4 of every difference d; forces of springs are kept. */
static void kick_ring(const double *restrict q, double *restrict v, double *restrict pull, long n, double beta, double by)
{
  for (long i = 0; i + 1 < n; i++) {
    const double d = q[i + 1] - q[i];
    pull[i] = by * (d + beta * (d * d * d));
  }
  const double d = q[0] - q[n - 1];
  pull[n - 1] = by * (d + beta * (d * d * d));
  v[0] += pull[0] - pull[n - 1];
  for (long i = 1; i < n; i++)
    v[i] += pull[i] - pull[i - 1];
}

/* v += by f for u_tt = weight (five-point Laplacian of u) - sin u on a torus of n by n places. */
static void kick_field(const double *restrict u, double *restrict v, long n, double weight, double by)
{
  for (long i = 0; i < n; i++) {
    const double *row = u + i * n, *above = u + (i ? i - 1 : n - 1) * n, *below = u + (i + 1 < n ? i + 1 : 0) * n;
    double *out = v + i * n;
    for (long j = 1; j + 1 < n; j++)
      out[j] += by * (weight * (above[j] + below[j] + row[j - 1] + row[j + 1] - 4.0 * row[j]) - sin(row[j]));
    out[0] += by * (weight * (above[0] + below[0] + row[n - 1] + row[1] - 4.0 * row[0]) - sin(row[0]));
    out[n - 1] += by *
        (weight * (above[n - 1] + below[n - 1] + row[n - 2] + row[0] - 4.0 * row[n - 1]) - sin(row[n - 1]));
  }
}

static void drift(double *restrict q, const double *restrict v, long count, double by)
{
  for (long i = 0; i < count; i++)
    q[i] += by * v[i];
}

void leapfrog(int is_field, double *q, double *v, double *work, long n, double strength, double h, long steps,
    const double *kicks, const double *drifts, int leaps)
{
  const long count = is_field ? n * n : n;
  for (long step = 0; step < steps; step++)
    for (int k = 0; k < leaps; k++) {
      /* the last kick of a step and the first of the next are one */
      const int merged = k == 0 && step > 0 && kicks[leaps - 1] != 0.0 && drifts[leaps - 1] == 0.0;
      const int left = k == leaps - 1 && drifts[k] == 0.0 && step + 1 < steps;
      const double by = h * (kicks[k] + (merged ? kicks[leaps - 1] : 0.0));
      if (by != 0.0 && !left) {
        if (is_field)
          kick_field(q, v, n, strength, by);
        else
          kick_ring(q, v, work, n, strength, by);
      }
      if (drifts[k] != 0.0)
        drift(q, v, count, h * drifts[k]);
    }
}
