#ifndef SUPPORT_LEGENDRE_H
#define SUPPORT_LEGENDRE_H

#include "../core/status_codes.h"
#include "../newton/band.h"

/* Legendre transform y = L_v(q, v, t) of a Lagrangian, or y = H_p(q, p, t) of a Hamiltonian, and its inverse by
 * damped Newton iteration. On failure the result is unchanged. Requires: the kernel legendre, y at u = (q, x) and
 * its derivatives dy/dx, MASS_ENTRY, their indices, and MASS_POSITION, the position of each coordinate in the band
 * matrix. */

#define TRANSFORM_ROUNDING (64 * REAL_EPSILON) /* relative to y: a residual that may be rounding of its terms */
#define CREEPING REAL(0.5) /* a residual at round-off level that decreases by less would do so by one rounding at a
                            * time */

/* y at u = (q, x), and dy/dx in the first numbers of scratch. */
static void transform_and_derivatives(real t, const real *u, const real *parameters, real *y, real *scratch)
{
  const band shape = band_of(M, 1);
  real *mass = scratch, *derivative = scratch + band_size(&shape);
  legendre(u, t, parameters, y, derivative);
  memset(mass, 0, sizeof(real) * band_size(&shape));
  for (int e = 0; e < MASS_ENTRIES; e++)
    mass[shape.first + MASS_POSITION[MASS_ENTRY[e][1]] * shape.stride +
        MASS_POSITION[MASS_ENTRY[e][0]]] = derivative[e];
}

/* max |value - y|. */
static real largest_misfit(const real *value, const real *y)
{
  real largest = 0;
  for (int i = 0; i < M; i++)
    largest = larger(largest, MATH(fabs)(value[i] - y[i]));
  return largest;
}

static int transform(real t, const real *q, const real *x, const real *parameters, real *y, real *workspace)
{
  real u[2 * M], value[M];
  memcpy(u, q, sizeof(real) * M);
  memcpy(u + M, x, sizeof(real) * M);
  transform_and_derivatives(t, u, parameters, value, workspace);
  if (!all_finite(value, M))
    return NOT_FINITE;
  memcpy(y, value, sizeof(real) * M);
  return OK;
}

/* Bound of the rounding error of the residual: of y, and of the terms with x that cancel in it, as for a charge at p =
 * 0. */
static real rounding_of_terms(const real *y, const real *x, const real *derivative)
{
  real terms[M], largest = 0;
  for (int i = 0; i < M; i++)
    terms[i] = MATH(fabs)(y[i]);
  for (int e = 0; e < MASS_ENTRIES; e++)
    terms[MASS_ENTRY[e][0]] += MATH(fabs)(derivative[e] * x[MASS_ENTRY[e][1]]);
  for (int i = 0; i < M; i++)
    largest = larger(largest, terms[i]);
  return TRANSFORM_ROUNDING * largest;
}

/* Newton iteration for y(q, x) = y from the x in u; updates that leave the domain or do not reduce the residual are
 * halved. */
static int invert_from(real t, real *u, const real *y, const real *parameters, real *mass)
{
  const band shape = band_of(M, 1);
  real value[M], update[M], pivot[M], misfit;
  transform_and_derivatives(t, u, parameters, value, mass);
  misfit = largest_misfit(value, y);
  for (int k = 0; k < MAX_ITERATIONS; k++) {
    real scale = 1, nearer, start[M];
    const real roundoff = rounding_of_terms(y, u + M, mass + band_size(&shape));
    if (!all_finite(value, M) || !all_finite(mass, (int)band_size(&shape)))
      return NOT_FINITE;
    if (misfit == 0)
      return OK;
    if (!factorise(mass, &shape, pivot))
      return SINGULAR;
    for (int i = 0; i < M; i++)
      update[MASS_POSITION[i]] = y[i] - value[i];
    back_substitute(mass, &shape, pivot, update);
    memcpy(start, u + M, sizeof(real) * M);
    do {
      for (int i = 0; i < M; i++)
        u[M + i] = start[i] + scale * update[MASS_POSITION[i]];
      transform_and_derivatives(t, u, parameters, value, mass);
      nearer = all_finite(value, M) ? largest_misfit(value, y) : (real)INFINITY;
      scale /= 2;
    } while (!(nearer < misfit) && misfit > roundoff && scale > REAL_EPSILON);
    if (!(nearer < misfit)) { /* round-off: restore the better x */
      memcpy(u + M, start, sizeof(real) * M);
      return misfit <= roundoff ? OK : NOT_CONVERGED;
    }
    if (nearer > CREEPING * misfit && nearer <= roundoff)
      return OK;
    misfit = nearer;
  }
  return NOT_CONVERGED;
}

static int inverse_transform(real t, const real *q, const real *y, const real *parameters, real *x, real *workspace)
{
  int status = SINGULAR;
  for (int attempt = 0; attempt < 3; attempt++) { /* from x = 0, from x = y, from x = 1 */
    real u[2 * M];
    for (int i = 0; i < M; i++) {
      u[i] = q[i];
      u[M + i] = attempt == 1 ? y[i] : (real)(attempt == 2);
    }
    status = invert_from(t, u, y, parameters, workspace);
    if (status == OK) {
      memcpy(x, u + M, sizeof(real) * M);
      return status;
    }
  }
  return status;
}

#endif
