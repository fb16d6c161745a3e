#include "../newton/band.h"

/* Matrix of the Legendre transform y = L_v(q, v, t), or y = H_p(q, p, t), in a band. Requires: the kernel legendre, y
 * at u = (q, x) and its derivatives dy/dx, MASS_ENTRY, their indices, and MASS_POSITION, the position of each
 * coordinate in the band matrix. */

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
