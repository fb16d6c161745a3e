/* Interpolation from the unknowns z to values at points. Requires: real, B, POINTS. Unknown b of site i is z[i B +
 * b]. */

/* u[n * across + i * along] = scale sum_b table[b][n] z_b for sites i from z on and every point n. */
static inline void gather(const real *table, int points, real scale, const real *z, int sites, real *u, int across,
    int along)
{
  for (int i = 0; i < sites; i++) {
    real sum[POINTS] = {0};
    for (int b = 0; b < B; b++)
      for (int n = 0; n < points; n++)
        sum[n] += table[b * points + n] * z[i * B + b];
    for (int n = 0; n < points; n++)
      u[n * across + i * along] = scale * sum[n];
  }
}
