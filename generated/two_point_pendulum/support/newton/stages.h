#ifndef SUPPORT_STAGES_H
#define SUPPORT_STAGES_H

#include "../core/numbers.h"

/* Interpolation from the unknowns z to values at points. Requires: real, B, MOST_POINTS. Unknown b of site i is z[i B +
 * b]. */

/* u[n * across + i * along] = scale sum_b table[b][n] z_b for sites i from z on and every point n. */
static inline void gather(const real *table, int points, real scale, const real *z, int sites, real *u, int across,
    int along)
{
  for (int i = 0; i < sites; i++) {
    real sum[MOST_POINTS] = {0};
    for (int b = 0; b < B; b++)
      for (int n = 0; n < points; n++)
        sum[n] += table[b * points + n] * z[i * B + b];
    for (int n = 0; n < points; n++)
      u[n * across + i * along] = scale * sum[n];
  }
}

/* Entry of the Jacobian of the stage equations. Requires: real, SITES, POSITION_IN_MATRIX, band.h. */

/* Address of the entry in row (i, r), column (j, b): sites i, j, blocks r, b. */
static inline real *entry(real *jacobian, const band *shape, int i, int r, int j, int b)
{
  const int blocks = shape->rows / SITES;
  return jacobian + shape->first + (POSITION_IN_MATRIX[j] * blocks + b) * shape->stride +
      POSITION_IN_MATRIX[i] * blocks + r;
}

#endif
