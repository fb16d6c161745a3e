/* An entry of the Jacobian. Before it: real, SITES, PLACE, band.h. */

/* That in row (i, r), column (j, b), sites first. */
static inline real *entry(real *jacobian, const band *shape, int i, int r, int j, int b)
{
  const int blocks = shape->rows / SITES;
  return jacobian + shape->first + (PLACE[j] * blocks + b) * shape->stride + PLACE[i] * blocks + r;
}
