/* Entry of the Jacobian of the stage equations. Requires: real, SITES, POSITION_IN_MATRIX, band.h. */

/* Address of the entry in row (i, r), column (j, b): sites i, j, blocks r, b. */
static inline real *entry(real *jacobian, const band *shape, int i, int r, int j, int b)
{
  const int blocks = shape->rows / SITES;
  return jacobian + shape->first + (POSITION_IN_MATRIX[j] * blocks + b) * shape->stride +
      POSITION_IN_MATRIX[i] * blocks + r;
}
