/* IRKGL16, a port to C: the Gauss method of 8 stages with its stages as lanes of one vector (M. Antonana, J. Makazaga,
 * A. Murua, SIMD-vectorized implicit symplectic integrators can outperform explicit symplectic ones, arXiv:2511.03655;
 * algorithm as in their package IRKGaussLegendre.jl 1.0, fixed step size, simd = true, fseq = false).
 *
 * Stages are iterated as U = u + sum_j mu_j L_j, L = h b f(U), with mu_ij + mu_ji = 1 in doubles, so that the method is
 * symplectic in spite of rounded coefficients; SECOND_ORDER: positions as Q = q + h (c v + sum_j eta_j L_j), L = h b g(Q),
 * with eta_ij - eta_ji = c_i - c_j. The iteration begins with the extrapolated stages of the last step and ends when no
 * component decreases its change any more; states are summed with compensation.
 *
 * Requires: D, the number of components; SECOND_ORDER, 0 or 1; field(x, t, f), of D / (1 + SECOND_ORDER) derivatives. */
#include "irkgl16.h"

#include <math.h>
#include <string.h>

#if defined(__AVX512F__) && !defined(__clang__)
#pragma GCC target("prefer-vector-width=512") /* loops over stages become whole vectors, not halves */
#endif

enum { S = 8, MAX_ITERATIONS = 100, WITHOUT_GUESS = 10 };

typedef double lanes __attribute__((vector_size(8 * S)));
typedef long long indices __attribute__((vector_size(8 * S)));
typedef union {
  lanes all;
  double lane[S];
} view;

#define LANES_FUNCTION(f)                     \
  static inline lanes lanes_##f(lanes x)      \
  {                                           \
    view of = {x};                            \
    _Pragma("omp simd") for (int j = 0; j < S; j++) \
      of.lane[j] = f(of.lane[j]);             \
    return of.all;                            \
  }

#pragma omp declare simd notinbranch
double sin(double);
#pragma omp declare simd notinbranch
double cos(double);
LANES_FUNCTION(sin)
LANES_FUNCTION(cos)
LANES_FUNCTION(sqrt)
LANES_FUNCTION(fabs)

static inline lanes larger(lanes a, lanes b)
{
  view x = {a}, y = {b};
  for (int j = 0; j < S; j++)
    x.lane[j] = y.lane[j] > x.lane[j] ? y.lane[j] : x.lane[j];
  return x.all;
}

static inline double largest(lanes x)
{
  x = larger(x, __builtin_shuffle(x, (indices){4, 5, 6, 7, 0, 1, 2, 3}));
  x = larger(x, __builtin_shuffle(x, (indices){2, 3, 0, 1, 6, 7, 4, 5}));
  x = larger(x, __builtin_shuffle(x, (indices){1, 0, 3, 2, 5, 4, 7, 6}));
  return x[0];
}

static inline double total(lanes x)
{
  x += __builtin_shuffle(x, (indices){4, 5, 6, 7, 0, 1, 2, 3});
  x += __builtin_shuffle(x, (indices){2, 3, 0, 1, 6, 7, 4, 5});
  x += __builtin_shuffle(x, (indices){1, 0, 3, 2, 5, 4, 7, 6});
  return x[0];
}

/* sum_j table_j x_j + start. */
static inline lanes weighted(const lanes *table, lanes x, lanes start)
{
  view of = {x};
  for (int j = 0; j < S; j++)
    start += table[j] * of.lane[j];
  return start;
}

typedef struct {
  double high, low;
} pair;

/* A product that is not fused with the sum it enters. */
static inline double rounded(double x)
{
#if defined(__x86_64__)
  __asm__("" : "+x"(x));
#else
  __asm__("" : "+m"(x));
#endif
  return x;
}

static inline pair two_sum(double x, double y)
{
  const double sum = x + y, z = sum - x;
  const pair result = {sum, (x - (sum - z)) + (y - z)};
  return result;
}

static inline pair plus(pair x, double y)
{
  const pair sum = two_sum(x.high, y);
  return two_sum(sum.high, sum.low + x.low);
}

static inline pair times(double x, pair y)
{
  return two_sum(rounded(x * y.high), rounded(x * y.low));
}

/* Tables: c, b, then the columns of mu, eta and nu, which extrapolates the stages of the last step. */
enum { C = 0, B = 1, MU = 2, ETA = MU + S, NU = ETA + S, TABLES = NU + S };

#define POSITIONS (SECOND_ORDER ? D / 2 : 0) /* components that are integrals of the others */

/* Positions at the stages from the velocities at the stages. */
static inline void integrate_velocities(const lanes *table, const double *u, const double *e, double h, lanes *U)
{
  for (int k = 0; k < POSITIONS; k++)
    U[k] = u[k] + weighted(table + MU, h * (table[B] * U[k + POSITIONS]), e[k] - (lanes){0.0});
}

/* Stages from the derivatives; returns with the positions if SECOND_ORDER, else with all components. */
static inline lanes stage(const lanes *table, const double *u, const double *e, double h, const lanes *L, int k)
{
#if SECOND_ORDER
  const lanes drift = table[C] * u[k + POSITIONS] + weighted(table + ETA, L[k + POSITIONS], (lanes){0.0});
  return u[k] + (e[k] + h * drift);
#else
  return u[k] + weighted(table + MU, L[k], e[k] - (lanes){0.0});
#endif
}

static inline void derivatives(const lanes *table, const lanes *U, double t, double h, lanes *F, lanes *L)
{
  field(U, t + h * table[C], F);
  for (int k = POSITIONS; k < D; k++)
    L[k] = h * (table[B] * F[k - POSITIONS]);
}

static inline void add_step(const lanes *table, double h, const lanes *L, double *u, double *e)
{
  for (int k = 0; k < POSITIONS; k++) {
    const lanes Lv = L[k + POSITIONS];
    const pair v = plus(two_sum(u[k + POSITIONS], e[k + POSITIONS]), total(Lv)), travelled = times(h, v);
    const pair rest = plus(two_sum(u[k], e[k]), -rounded(h * total(table[C] * Lv)));
    const pair sum = two_sum(rest.high, travelled.high), q = two_sum(sum.high, sum.low + rest.low + travelled.low);
    u[k] = q.high, e[k] = q.low;
  }
  for (int k = POSITIONS; k < D; k++) {
    const pair x = plus(two_sum(u[k], e[k]), total(L[k]));
    u[k] = x.high, e[k] = x.low;
  }
}

/* Performs steps of h from (u, e), values and compensations; L, of D lanes, carries the predictor. Returns the number of
 * iterations, or -1 if one does not converge. */
long long irkgl16(double *state, double *stages, double *time, double h, long long steps, const double *tables)
{
  lanes table[TABLES], U[D], L[D], F[D];
  double u[D], e[D], t = time[0], t_low = time[1];
  long long iterations = 0;
  memcpy(table, tables, sizeof table);
  memcpy(u, state, sizeof u);
  memcpy(e, state + D, sizeof e);
  memcpy(L, stages, sizeof L);
  for (long long n = 0; n < steps; n++) {
    const int most = MAX_ITERATIONS + (t == 0.0 ? WITHOUT_GUESS : 0);
    double least[D];
    int moves = 1, decreases = 1, once_more = 1, k = 0;
    for (int i = POSITIONS; i < D; i++)
      U[i] = u[i] + weighted(table + NU, L[i], e[i] - (lanes){0.0});
    integrate_velocities(table, u, e, h, U);
    for (int i = 0; i < D; i++)
      least[i] = INFINITY;
    for (; k < most && decreases; k++) {
      decreases = moves = 0;
      derivatives(table, U, t, h, F, L);
      for (int i = 0; i < (SECOND_ORDER ? POSITIONS : D); i++) {
        const lanes now = stage(table, u, e, h, L, i);
        const double change = largest(lanes_fabs(now - U[i]));
        U[i] = now;
        moves |= change > 0.0;
        if (change > 0.0 && change < least[i]) {
          least[i] = change;
          decreases = 1;
        }
      }
      if (!decreases && moves && once_more)
        decreases = 1, once_more = 0;
      else
        once_more = 1;
    }
    if (decreases)
      return -1;
    if (moves) {
      derivatives(table, U, t, h, F, L);
      k++;
    }
    add_step(table, h, L, u, e);
    const pair later = plus(two_sum(t, t_low), h);
    t = later.high, t_low = later.low;
    iterations += k;
  }
  memcpy(state, u, sizeof u);
  memcpy(state + D, e, sizeof e);
  memcpy(stages, L, sizeof L);
  time[0] = t, time[1] = t_low;
  return iterations;
}
