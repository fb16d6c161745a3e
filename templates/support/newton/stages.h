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

#ifdef UNROLLED_EQUATIONS
/* Entry of the Jacobian of the stage equations. Requires: real, SITES, POSITION_IN_MATRIX, band.h. */

/* Address of the entry in row (i, r), column (j, b): sites i, j, blocks r, b. */
static inline real *entry(real *jacobian, const band *shape, int i, int r, int j, int b)
{
  const int blocks = shape->rows / SITES;
  return jacobian + shape->first + (POSITION_IN_MATRIX[j] * blocks + b) * shape->stride +
      POSITION_IN_MATRIX[i] * blocks + r;
}
#else
/* Sums between blocks of unknowns z and points, for every method. Requires: real, M, B, POSITION_IN_MATRIX, band.h,
 * step.h. Row r of site i is rows[i (B + 1) + r], the last one for p1. The first M sites are the coordinates. */

/* u = q0 + u at every point, including the compensation of q0. */
static inline void offset(const step_data *step, int points, real *u, int across)
{
  for (int n = 0; n < points; n++)
    for (int i = 0; i < M; i++)
      u[n * across + i] = step->q0[i] + (step->carry_q[i] + u[n * across + i]);
}

/* rows_r += sum_n weight[n] scale table[n][r] value_n for `sites` sites; the last row is p1, the absolute values of
 * whose terms are added to size. */
static inline void scatter(const real *table, int points, const real *weight, real scale, const real *value, int across,
    int sites, real *rows, real *size)
{
  for (int i = 0; i < sites; i++) {
    real sum[B + 1], end = size[i];
    memcpy(sum, rows + i * (B + 1), sizeof sum);
    for (int n = 0; n < points; n++) {
      const real term = weight[n] * scale * value[n * across + i];
      for (int r = 0; r <= B; r++)
        sum[r] += table[n * (B + 1) + r] * term;
      end += MATH(fabs)(table[n * (B + 1) + B] * term);
    }
    memcpy(rows + i * (B + 1), sum, sizeof sum);
    size[i] = end;
  }
}

/* Adds sum_n weight[n] scale row[n][r] derivative_n column[b][n] to the entries of the Jacobian in rows (i, r), columns
 * (j, b), for every derivative and its pair of sites i, j. */
static inline void scatter_derivatives(const real *row, const real *column, int points, const real *weight, real scale,
    const int (*pair)[2], int count, const real *derivative, int across, real *jacobian, const band *shape)
{
  const int blocks = shape->rows / SITES;
  for (int e = 0; e < count; e++) {
    real *corner = jacobian + shape->first + POSITION_IN_MATRIX[pair[e][1]] * blocks * shape->stride +
        POSITION_IN_MATRIX[pair[e][0]] * blocks;
    for (int b = 0; b < B; b++) {
      real sum[B] = {0};
      for (int n = 0; n < points; n++) {
        const real term = weight[n] * scale * derivative[n * across + e] * column[b * points + n];
        if (term != 0)
          for (int r = 0; r < B; r++)
            sum[r] += row[n * (B + 1) + r] * term;
      }
      for (int r = 0; r < B; r++)
        corner[b * shape->stride + r] += sum[r];
    }
  }
}

/* Initial values of rows and sizes from the state, and a zero Jacobian. */
static inline void begin_rows(const step_data *step, const real *z, real *rows, real *size_p, real *size_q,
    real *jacobian, const band *shape)
{
#ifdef FIRST_ORDER_SYSTEM
  const real *p0 = step->theta0;
#else
  const real *p0 = step->p0;
#endif
  for (int i = 0; i < M; i++) {
    for (int r = 0; r < B; r++)
      rows[i * (B + 1) + r] = MOMENTUM_ROW[r] * p0[i];
    rows[i * (B + 1) + B] = 0;
    size_p[i] = MATH(fabs)(p0[i]);
    size_q[i] = MATH(fabs)(step->q0[i]);
    for (int b = 0; b < B; b++)
      size_q[i] += MATH(fabs)(step->h * END_POSITION[b] * z[i * B + b]);
  }
  memset(rows + M * (B + 1), 0, sizeof(real) * (SITES - M) * (B + 1));
  memset(size_p + M, 0, sizeof(real) * (SITES - M));
  if (jacobian)
    memset(jacobian, 0, sizeof(real) * band_size(shape));
}
#endif
