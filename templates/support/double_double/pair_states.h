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

#ifdef NEWTON_ALONE
/* y at u = (q, x). */
static inline int transform_of_pairs(dd t, dd *u, const double *parameters, dd *y, double *workspace)
{
  dd value[M + MASS_ENTRIES];
  (void)workspace;
  legendre_pairs(u, t, parameters, value);
  memcpy(y, value, sizeof(dd) * M);
  return OK;
}

/* Replaces x in u = (q, x) by that with the given y. */
static inline int invert_pairs(dd t, dd *u, const dd *y, const double *parameters, double *workspace)
{
#ifdef INVERSE_LEGENDRE
  dd x[M];
  memcpy(u + M, y, sizeof(dd) * M);
  inverse_legendre_pairs(u, t, parameters, x);
  memcpy(u + M, x, sizeof x);
  (void)workspace;
#else
  enum { CORRECTIONS = 3 };
  const band shape = band_of(M, 1);
  double q[M], high[2 * M], value[M], pivot[M];
  int status;
  for (int i = 0; i < M; i++)
    q[i] = u[i].high, high[i] = y[i].high;
  status = inverse_transform(t.high, q, high, parameters, value, workspace);
  if (status != OK)
    return status;
  for (int i = 0; i < M; i++)
    high[i] = q[i], high[M + i] = value[i], u[M + i] = dd_word(value[i]);
  transform_and_derivatives(t.high, high, parameters, value, workspace);
  if (!factorise(workspace, &shape, pivot))
    return SINGULAR;
  for (int k = 0; k < CORRECTIONS; k++) {
    dd now[M];
    transform_of_pairs(t, u, parameters, now, NULL);
    for (int i = 0; i < M; i++)
      value[MASS_POSITION[i]] = dd_subtract(y[i], now[i]).high;
    back_substitute(workspace, &shape, pivot, value);
    for (int i = 0; i < M; i++)
      u[M + i] = dd_add(u[M + i], dd_word(value[MASS_POSITION[i]]));
  }
#endif
  return OK;
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
  int status = OK;
  memcpy(u, q, sizeof(dd) * M);
  if (inverse) {
    status = MASS_ENTRIES || !MOMENTA_INVERTED ? invert_pairs(t, u, x, parameters, workspace) : SINGULAR;
    memcpy(y, u + M, sizeof(dd) * M);
    return status;
  }
  memcpy(u + M, x, sizeof(dd) * M);
  return transform_of_pairs(t, u, parameters, y, workspace);
}

static inline int momenta_of(dd t, const dd *q, const dd *v, const double *parameters, dd *p, double *workspace)
{
  return state_transform(MOMENTA_INVERTED, t, q, v, parameters, p, workspace);
}

static inline int velocities_of(dd t, const dd *q, const dd *p, const double *parameters, dd *v, double *workspace)
{
  return state_transform(!MOMENTA_INVERTED, t, q, p, parameters, v, workspace);
}
#else
static inline int momenta_of(dd t, const dd *q, const dd *v, const double *parameters, dd *p, double *workspace)
{
  dd masses[M];
  (void)q, (void)workspace;
  mass_pairs(NULL, t, parameters, masses);
  for (int i = 0; i < M; i++)
    p[i] = dd_multiply(masses[i], v[i]);
  return OK;
}

static inline int velocities_of(dd t, const dd *q, const dd *p, const double *parameters, dd *v, double *workspace)
{
  dd masses[M];
  (void)q, (void)workspace;
  mass_pairs(NULL, t, parameters, masses);
  for (int i = 0; i < M; i++)
    v[i] = dd_divide(p[i], masses[i]);
  return OK;
}
#endif
