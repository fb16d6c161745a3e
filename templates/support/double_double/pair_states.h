#include "../core/scalars.h"
#include "../core/status_codes.h"

/* Momenta and velocities of states in pairs. Requires: of separable systems the kernel mass_pairs, of others
 * legendre.h and the kernels legendre_pairs, y at u = (q, x), or inverse_legendre_pairs. */

#ifdef NEWTON_IN_PAIRS
/* y at (q, x). */
static inline int transform_of(dd t, const dd *q, const dd *x, const double *parameters, dd *y)
{
  dd u[2 * M], value[M + MASS_ENTRIES];
  memcpy(u, q, sizeof(dd) * M);
  memcpy(u + M, x, sizeof(dd) * M);
  legendre_pairs(u, t, parameters, value);
  memcpy(y, value, sizeof(dd) * M);
  return OK;
}

#ifndef INVERSE_LEGENDRE
/* Corrects the x in u = (q, x), which is accurate to one word, to that with the given y. */
static inline int correct_transform(dd t, dd *u, const dd *y, const double *parameters, double *workspace)
{
  enum { CORRECTIONS = 3 };
  double high[2 * M], value[M], pivot[M];
  for (int i = 0; i < 2 * M; i++)
    high[i] = u[i].high;
  transform_and_derivatives(t.high, high, parameters, value, workspace);
  TRY(factorise_masses(workspace, pivot));
  for (int k = 0; k < CORRECTIONS; k++) {
    dd now[M];
    transform_of(t, u, u + M, parameters, now);
    for (int i = 0; i < M; i++)
      value[i] = dd_subtract(y[i], now[i]).high;
    solve_masses(workspace, pivot, value);
    for (int i = 0; i < M; i++)
      u[M + i] = dd_add(u[M + i], dd_word(value[i]));
  }
  return OK;
}
#endif

/* The x with the given y. */
static inline int inverse_of(dd t, const dd *q, const dd *y, const double *parameters, dd *x, double *workspace)
{
  dd u[2 * M];
  memcpy(u, q, sizeof(dd) * M);
#ifdef INVERSE_LEGENDRE
  memcpy(u + M, y, sizeof(dd) * M);
  inverse_legendre_pairs(u, t, parameters, x);
#else
  double high[2 * M], value[M];
  for (int i = 0; i < M; i++)
    high[i] = q[i].high, high[M + i] = y[i].high;
  TRY(inverse_transform(t.high, high, high + M, parameters, value, workspace));
  for (int i = 0; i < M; i++)
    u[M + i] = dd_word(value[i]);
  TRY(correct_transform(t, u, y, parameters, workspace));
  memcpy(x, u + M, sizeof(dd) * M);
#endif
  return OK;
}

static inline int momenta_of(dd t, const dd *q, const dd *v, const double *parameters, dd *p, double *workspace)
{
#ifdef FIRST_ORDER_SYSTEM
  return SINGULAR;
#elif defined(HAMILTONIAN_SYSTEM)
  return MASS_ENTRIES ? inverse_of(t, q, v, parameters, p, workspace) : SINGULAR;
#else
  return transform_of(t, q, v, parameters, p);
#endif
}

static inline int velocities_of(dd t, const dd *q, const dd *p, const double *parameters, dd *v, double *workspace)
{
#ifdef FIRST_ORDER_SYSTEM
  enum { SOLUTIONS = 4 }; /* of theta_y^T v = H_y: the first one, and corrections */
  double right[M], pivot[M], derivative[MASS_ENTRIES];
  dd u[2 * M], theta[M + MASS_ENTRIES], rates[M];
  memcpy(u, q, sizeof(dd) * M);
  memcpy(u + M, p, sizeof(dd) * M);
  legendre_pairs(u, t, parameters, theta);
  first_order_rates_pairs(u, t, parameters, rates);
  for (int e = 0; e < MASS_ENTRIES; e++)
    derivative[e] = theta[M + e].high;
  store_masses(derivative, 1, workspace);
  TRY(factorise_masses(workspace, pivot));
  memset(v, 0, sizeof(dd) * M);
  for (int k = 0; k < SOLUTIONS; k++) {
    dd rest[M];
    memcpy(rest, rates, sizeof rest);
    for (int e = 0; e < MASS_ENTRIES; e++)
      rest[MASS_ENTRY[e][1]] = dd_subtract(rest[MASS_ENTRY[e][1]], dd_multiply(theta[M + e], v[MASS_ENTRY[e][0]]));
    for (int i = 0; i < M; i++)
      right[i] = rest[i].high;
    solve_masses(workspace, pivot, right);
    for (int i = 0; i < M; i++)
      v[i] = dd_add(v[i], dd_word(right[i]));
  }
  return OK;
#elif defined(HAMILTONIAN_SYSTEM)
  return transform_of(t, q, p, parameters, v);
#else
  return inverse_of(t, q, p, parameters, v, workspace);
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
