#include "../newton/band.h"

/* Matrix of the Legendre transform y = L_v(q, v, t), or y = H_p(q, p, t), in a band. Requires: the kernel legendre, y
 * at u = (q, x) and its derivatives dy/dx, MASS_ENTRY, their indices, and MASS_POSITION, the position of each
 * coordinate in the band matrix. */

/* Stores the derivatives dy/dx, or their transpose, in a band matrix. */
static void store_masses(const real *derivative, int transposed, real *mass)
{
  const band shape = band_of(M, 1);
  memset(mass, 0, sizeof(real) * band_size(&shape));
  for (int e = 0; e < MASS_ENTRIES; e++)
    mass[shape.first + MASS_POSITION[MASS_ENTRY[e][!transposed]] * shape.stride +
        MASS_POSITION[MASS_ENTRY[e][transposed]]] = derivative[e];
}

/* y at u = (q, x), and dy/dx in the first numbers of scratch. */
static void transform_and_derivatives(real t, const real *u, const real *parameters, real *y, real *scratch)
{
  const band shape = band_of(M, 1);
  legendre(u, t, parameters, y, scratch + band_size(&shape));
  store_masses(scratch + band_size(&shape), 0, scratch);
}

/* Factorises this matrix; SINGULAR, or NOT_FINITE. */
static inline int factorise_masses(real *mass, real *pivot)
{
  const band shape = band_of(M, 1);
  TRY(all_finite(mass, (int)band_size(&shape)) ? OK : NOT_FINITE);
  return factorise(mass, &shape, pivot) ? OK : SINGULAR;
}

/* Replaces x by the solution with these factors. */
static inline void solve_masses(const real *mass, const real *pivot, real *x)
{
  const band shape = band_of(M, 1);
  real placed[M];
  for (int i = 0; i < M; i++)
    placed[MASS_POSITION[i]] = x[i];
  back_substitute(mass, &shape, pivot, placed);
  for (int i = 0; i < M; i++)
    x[i] = placed[MASS_POSITION[i]];
}
