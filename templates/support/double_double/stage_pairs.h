#include "../core/step.h"

/* Stage equations in pairs: sums between blocks of unknowns and points, as in stages.h. Unknown b of site i is
 * z[i B + b], row r of site i is rows[i (B + 1) + r]. Tables are followed by their low words. */

/* Arguments of a step, and its unknowns. */
typedef struct {
  dd t, h, q0[M], p0[M], z[N], rows[N + SITES];
  const double *parameters;
} pair_equations;

static inline dd power_of_pair(dd h, int k)
{
  dd product = dd_of(1.0, 0.0);
  for (int j = 0; j < (k < 0 ? -k : k); j++)
    product = dd_multiply(product, h);
  return k < 0 ? dd_divide(dd_of(1.0, 0.0), product) : product;
}

/* Product of an entry of a table, many of which are 0 or 1, with a pair. */
static inline dd times_entry(double high, double low, dd x)
{
  if (low == 0.0)
    return high == 1.0 ? x : dd_scale(x, high);
  return dd_multiply(dd_of(high, low), x);
}

/* u[n * across + i] = (q0_i +) scale sum_b table[b][n] z_b for sites i from z on and every point n; q0 may be NULL. */
static inline void gather_pairs(const double *table, const double *low, int points, dd scale, const dd *z,
    const dd *q0, int sites, dd *u, int across)
{
  for (int i = 0; i < sites; i++)
    for (int n = 0; n < points; n++) {
      dd sum = dd_of(0.0, 0.0);
      for (int b = 0; b < B; b++)
        if (table[b * points + n] != 0.0)
          sum = dd_add(sum, times_entry(table[b * points + n], low[b * points + n], z[i * B + b]));
      sum = dd_multiply(scale, sum);
      u[n * across + i] = q0 ? dd_add(q0[i], sum) : sum;
    }
}

/* rows_r += sum_n weight[n] scale table[n][r] value_n for `sites` sites. */
static inline void scatter_pairs(const double *table, const double *low, int points, const double *weight,
    const double *weight_low, dd scale, const dd *value, int across, int sites, dd *rows)
{
  for (int n = 0; n < points; n++) {
    const dd factor = dd_multiply(dd_of(weight[n], weight_low[n]), scale);
    for (int i = 0; i < sites; i++) {
      const dd term = dd_multiply(factor, value[n * across + i]);
      for (int r = 0; r <= B; r++) {
        const int k = n * (B + 1) + r;
        if (table[k] != 0.0)
          rows[i * (B + 1) + r] = dd_add(rows[i * (B + 1) + r], times_entry(table[k], low[k], term));
      }
    }
  }
}

/* Initial values of the rows from the state. Requires: MOMENTUM_ROW. */
static inline void begin_row_pairs(pair_equations *at)
{
  memset(at->rows, 0, sizeof at->rows);
  for (int i = 0; i < M; i++)
    for (int r = 0; r < B; r++)
      at->rows[i * (B + 1) + r] = times_entry(MOMENTUM_ROW[r], MOMENTUM_ROW_LOW[r], at->p0[i]);
}
