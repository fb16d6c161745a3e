/* Gauss's method of eight stages for q'' = f(q), written by hand for one problem, to compare generated code with.
 *
 * The stages are the lanes of a vector. Sweeps X <- q + h c v + h^2 (A A) f(X) start from the forces of the last step or
 * two, continued as a polynomial; the last evaluation and the update have all digits of coefficients and of powers of h,
 * small terms first, so that the rounded method is symplectic too. Sums are compensated.
 *
 * The header holds the constants C, AA, B and BB = b A with their low parts, ALONE, LAST and BEFORE (forces of past steps to
 * AA times those of the next; tables by columns) and, for the pendulum, the macro PENDULUM; else the problem is Kepler's. */
#include "hand_written.h"

#include <math.h>

#pragma GCC diagnostic ignored "-Wpsabi"

enum { S = 8, MOST_SWEEPS = 50 };

#ifdef PENDULUM
enum { M = 1 };

#if defined(SCVI_LIBMVEC) && defined(__AVX512F__)
lanes _ZGVeN8v_sin(lanes);
static inline lanes sine(lanes x)
{
  return _ZGVeN8v_sin(x);
}
#else
static inline lanes sine(lanes x)
{
  for (int n = 0; n < S; n++)
    x[n] = sin(x[n]);
  return x;
}
#endif

static inline void force(double g, const lanes *x, lanes *f)
{
  f[0] = -g * sine(x[0]);
}
#else
enum { M = 2 };

/* x^(-3/2) */
static inline lanes inverse_cube_of_root(lanes x)
{
#ifdef __AVX512F__
  const lanes y = __builtin_ia32_rsqrt14pd512_mask(x, (lanes){0}, 255), square = y * y, e = 1.0 - x * square;
  const lanes cube = y * square;
  return cube + (cube * e) * ((1.5 + 1.875 * e) + (e * e) * (2.1875 + 2.4609375 * e));
#else
  for (int n = 0; n < S; n++)
    x[n] = 1.0 / (x[n] * sqrt(x[n]));
  return x;
#endif
}

static inline void force(double mu, const lanes *x, lanes *f)
{
  const lanes pull = -mu * inverse_cube_of_root(x[0] * x[0] + x[1] * x[1]);
  f[0] = pull * x[0];
  f[1] = pull * x[1];
}
#endif

/* Four independent sums hide the latency of the multiply-adds. */
static inline lanes apply(const lanes *column, lanes f)
{
  const lanes a = column[0] * f[0] + column[4] * f[4], b = column[1] * f[1] + column[5] * f[5];
  const lanes c = column[2] * f[2] + column[6] * f[6], d = column[3] * f[3] + column[7] * f[7];
  return (a + b) + (c + d);
}

static inline double total(lanes x)
{
  return ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]));
}

static inline void add(double *x, double *carry, double increment, double low)
{
  const double sum = *x + increment, part = sum - *x;
  const double rest = ((*x - (sum - part)) + (increment - part)) + (*carry + low);
  *x = sum + rest;
  *carry = rest - (*x - sum);
}

/* Returns the number of sweeps, or -1 if a step does not converge. */
long hand_written(double *q, double *v, double strength, double h, long steps, long every, double *out)
{
  const double h2 = h * h, h2_low = fma(h, h, -h2);
  const lanes hb = h * B;
  lanes aa[S], hb_low, x[M], f[M], before[M], base[M];
  double drift[M], drift_low[M], cut_q[M] = {0}, cut_v[M] = {0}, first = 1.0;
  long iterations = 0;
  for (int n = 0; n < S; n++) {
    aa[n] = h2 * AA[n];
    hb_low[n] = fma(h, B[n], -hb[n]) + h * B_LOW[n];
  }
  for (long step = 1; step <= steps; step++) {
    double last = INFINITY, size = 0.0;
    int count = 0, done = 0;
    for (int i = 0; i < M; i++) {
      drift[i] = h * v[i];
      drift_low[i] = fma(h, v[i], -drift[i]) + h * cut_v[i];
      base[i] = x[i] = q[i] + C * drift[i];
      size += q[i] * q[i] + drift[i] * drift[i];
      if (step > 1) {
        const lanes guess = step > 2 && first < 1e-6 ? apply(LAST, f[i]) + apply(BEFORE, before[i]) : apply(ALONE, f[i]);
        before[i] = f[i];
        x[i] += h2 * guess;
      }
    }
    force(strength, x, f);
    while (!done) { /* until what follows leaves nothing but round-off */
      lanes squares = {0};
      double change, ratio;
      for (int i = 0; i < M; i++) {
        const lanes new = base[i] + apply(aa, f[i]), moved = new - x[i];
        squares += moved * moved;
        x[i] = new;
      }
      force(strength, x, f);
      change = total(squares) / size;
      ratio = count ? fmin(fmax(change / last, 1e-6), 0.25) : 1.0;
      done = 16.0 * ratio * ratio * change <= 0x1p-104 || (count && change >= 0.0625 * last && change < 1e-25);
      first = count ? first : change;
      last = change;
      if (++count == MOST_SWEEPS || !(change < INFINITY))
        return -1;
    }
    for (int i = 0; i < M; i++) {
      const lanes sum = apply(AA, f[i]), low = apply(AA_LOW, f[i]);
      const lanes small = cut_q[i] + C * drift_low[i] + C_LOW * drift[i] + (h2 * low + h2_low * sum);
      const lanes y = C * drift[i] + h2 * sum, near = q[i] + y, part = near - q[i];
      x[i] = near + (((q[i] - (near - part)) + (y - part)) + small);
    }
    force(strength, x, f);
    for (int i = 0; i < M; i++) {
      const double sum = total(BB * f[i] + BB_LOW * f[i]);
      const double kick = h2 * sum, both = drift[i] + kick, part = both - drift[i];
      const double cut = (drift[i] - (both - part)) + (kick - part);
      add(q + i, cut_q + i, both, cut + (drift_low[i] + h2_low * sum));
      add(v + i, cut_v + i, total(hb * f[i] + hb_low * f[i]), 0.0);
    }
    iterations += count;
    if (step % every == 0)
      for (int i = 0; i < M; i++)
        *out++ = q[i];
  }
  return iterations;
}
