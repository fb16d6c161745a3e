/* Slopes times changes. Before it: real. */

/* value_i += slope_e u_j at every point, for each pair (i, j) of an entry e. */
static inline void multiply(const int (*pair)[2], int count, int points, const real *slope, int slopes, const real *u,
    int arguments, real *value, int values)
{
  for (int n = 0; n < points; n++)
    for (int e = 0; e < count; e++)
      value[n * values + pair[e][0]] += slope[n * slopes + e] * u[n * arguments + pair[e][1]];
}
