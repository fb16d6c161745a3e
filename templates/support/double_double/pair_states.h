#include "../core/status_codes.h"

/* Momenta and velocities of states in pairs. Requires: of separable systems the kernel mass_pairs, of others
 * legendre.h and the kernels legendre_pairs, y at u = (q, x), or inverse_legendre_pairs. */

static inline void load_pairs(const double *words, dd *x)
{
  for (int i = 0; i < M; i++)
    x[i] = dd_of(words[i], words[M + i]);
}

static inline int store_pairs(const dd *x, double *words)
{
  for (int i = 0; i < M; i++)
    words[i] = x[i].high, words[M + i] = x[i].low;
  return all_finite(words, 2 * M) ? OK : NOT_FINITE;
}

#ifdef NEWTON_IN_PAIRS
/* y at u = (q, x). */
static inline int transform_of_pairs(dd t, dd *u, const double *parameters, dd *y, double *workspace)
{
  dd value[M + MASS_ENTRIES];
  legendre_pairs(u, t, parameters, value);
  memcpy(y, value, sizeof(dd) * M);
  return OK;
}

#ifndef INVERSE_LEGENDRE
/* Corrects the x in u = (q, x), which is accurate to one word, to that with the given y. */
static inline int correct_transform(dd t, dd *u, const dd *y, const double *parameters, double *workspace)
{
  enum { CORRECTIONS = 3 };
  const band shape = band_of(M, 1);
  double high[2 * M], value[M], pivot[M];
  for (int i = 0; i < 2 * M; i++)
    high[i] = u[i].high;
  transform_and_derivatives(t.high, high, parameters, value, workspace);
  TRY(factorise(workspace, &shape, pivot) ? OK : SINGULAR);
  for (int k = 0; k < CORRECTIONS; k++) {
    dd now[M];
    transform_of_pairs(t, u, parameters, now, NULL);
    for (int i = 0; i < M; i++)
      value[MASS_POSITION[i]] = dd_subtract(y[i], now[i]).high;
    back_substitute(workspace, &shape, pivot, value);
    for (int i = 0; i < M; i++)
      u[M + i] = dd_add(u[M + i], dd_word(value[MASS_POSITION[i]]));
  }
  return OK;
}
#endif

/* Replaces x in u = (q, x) by that with the given y. */
static inline int invert_pairs(dd t, dd *u, const dd *y, const double *parameters, double *workspace)
{
#ifdef INVERSE_LEGENDRE
  dd x[M];
  memcpy(u + M, y, sizeof(dd) * M);
  inverse_legendre_pairs(u, t, parameters, x);
  memcpy(u + M, x, sizeof x);
  return OK;
#else
  double q[M], high[M], value[M];
  for (int i = 0; i < M; i++)
    q[i] = u[i].high, high[i] = y[i].high;
  TRY(inverse_transform(t.high, q, high, parameters, value, workspace));
  for (int i = 0; i < M; i++)
    u[M + i] = dd_word(value[i]);
  return correct_transform(t, u, y, parameters, workspace);
#endif
}

#ifdef HAMILTONIAN_SYSTEM
#define MOMENTA_INVERTED 1
#else
#define MOMENTA_INVERTED 0
#endif

static inline int state_transform(int inverse, dd t, const dd *q, const dd *x, const double *parameters, dd *y,
    double *workspace)
{
  dd u[2 * M];
  memcpy(u, q, sizeof(dd) * M);
  if (inverse) {
    TRY(MASS_ENTRIES || !MOMENTA_INVERTED ? invert_pairs(t, u, x, parameters, workspace) : SINGULAR);
    memcpy(y, u + M, sizeof(dd) * M);
    return OK;
  }
  memcpy(u + M, x, sizeof(dd) * M);
  return transform_of_pairs(t, u, parameters, y, workspace);
}

static inline int momenta_of(dd t, const dd *q, const dd *v, const double *parameters, dd *p, double *workspace)
{
#ifdef FIRST_ORDER_SYSTEM
  return SINGULAR;
#else
  return state_transform(MOMENTA_INVERTED, t, q, v, parameters, p, workspace);
#endif
}

static inline int velocities_of(dd t, const dd *q, const dd *p, const double *parameters, dd *v, double *workspace)
{
#ifdef FIRST_ORDER_SYSTEM
  enum { SOLUTIONS = 4 }; /* of theta_y^T v = H_y: the first one, and corrections */
  const band shape = band_of(M, 1);
  double right[M], pivot[M];
  dd u[2 * M], theta[M + MASS_ENTRIES], rates[M];
  memcpy(u, q, sizeof(dd) * M);
  memcpy(u + M, p, sizeof(dd) * M);
  legendre_pairs(u, t, parameters, theta);
  first_order_rates_pairs(u, t, parameters, rates);
  memset(workspace, 0, sizeof(double) * band_size(&shape));
  for (int e = 0; e < MASS_ENTRIES; e++)
    workspace[shape.first + MASS_POSITION[MASS_ENTRY[e][0]] * shape.stride + MASS_POSITION[MASS_ENTRY[e][1]]] =
        theta[M + e].high;
  TRY(all_finite(workspace, (int)band_size(&shape)) ? OK : NOT_FINITE);
  TRY(factorise(workspace, &shape, pivot) ? OK : SINGULAR);
  memset(v, 0, sizeof(dd) * M);
  for (int k = 0; k < SOLUTIONS; k++) {
    dd rest[M];
    memcpy(rest, rates, sizeof rest);
    for (int e = 0; e < MASS_ENTRIES; e++)
      rest[MASS_ENTRY[e][1]] = dd_subtract(rest[MASS_ENTRY[e][1]], dd_multiply(theta[M + e], v[MASS_ENTRY[e][0]]));
    for (int i = 0; i < M; i++)
      right[MASS_POSITION[i]] = rest[i].high;
    back_substitute(workspace, &shape, pivot, right);
    for (int i = 0; i < M; i++)
      v[i] = dd_add(v[i], dd_word(right[MASS_POSITION[i]]));
  }
  return OK;
#else
  return state_transform(!MOMENTA_INVERTED, t, q, p, parameters, v, workspace);
#endif
}
#else
static inline int momenta_of(dd t, const dd *q, const dd *v, const double *parameters, dd *p, double *workspace)
{
  dd masses[M];
  mass_pairs(NULL, t, parameters, masses);
  for (int i = 0; i < M; i++)
    p[i] = dd_multiply(masses[i], v[i]);
  return OK;
}

static inline int velocities_of(dd t, const dd *q, const dd *p, const double *parameters, dd *v, double *workspace)
{
  dd masses[M];
  mass_pairs(NULL, t, parameters, masses);
  for (int i = 0; i < M; i++)
    v[i] = dd_divide(p[i], masses[i]);
  return OK;
}
#endif
