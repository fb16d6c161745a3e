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

/* Adds products of entries of a table and x to sums of n words and their remainders: Dot2 (Ogita, Rump & Oishi 2005)
 * with the low words of both factors. */
static inline void add_products(int n, const double *table, const double *low, dd x, double *sum, double *rest)
{
  for (int k = 0; k < n; k++) {
    const dd product = dd_two_product(table[k], x.high), next = dd_two_sum(sum[k], product.high);
    sum[k] = next.high;
    rest[k] += fma(table[k], x.low, fma(low[k], x.high, product.low + next.low));
  }
}

/* u[n * across + i] = (q0_i +) scale sum_b table[b][n] z_b for sites i from z on and every point n; q0 may be NULL. */
static inline void gather_pairs(const double *table, const double *low, int points, dd scale, const dd *z,
    const dd *q0, int sites, dd *u, int across)
{
  for (int i = 0; i < sites; i++) {
    double sum[MOST_POINTS] = {0.0}, rest[MOST_POINTS] = {0.0};
    for (int b = 0; b < B; b++)
      add_products(points, table + b * points, low + b * points, z[i * B + b], sum, rest);
    for (int n = 0; n < points; n++) {
      const dd moved = dd_multiply(scale, dd_two_sum(sum[n], rest[n]));
      u[n * across + i] = q0 ? dd_add(q0[i], moved) : moved;
    }
  }
}

/* rows_r += sum_n weight[n] scale table[n][r] value_n for `sites` sites. */
static inline void scatter_pairs(const double *table, const double *low, int points, const double *weight,
    const double *weight_low, dd scale, const dd *value, int across, int sites, dd *rows)
{
  dd factor[MOST_POINTS];
  for (int n = 0; n < points; n++)
    factor[n] = dd_multiply(dd_of(weight[n], weight_low[n]), scale);
  for (int i = 0; i < sites; i++) {
    dd *row = rows + i * (B + 1);
    double sum[B + 1], rest[B + 1];
    for (int r = 0; r <= B; r++)
      sum[r] = row[r].high, rest[r] = row[r].low;
    for (int n = 0; n < points; n++)
      add_products(B + 1, table + n * (B + 1), low + n * (B + 1), dd_multiply(factor[n], value[n * across + i]), sum,
          rest);
    for (int r = 0; r <= B; r++)
      row[r] = dd_two_sum(sum[r], rest[r]);
  }
}

#ifdef DAMPED
/* gamma h. Requires: the kernel damping_pairs. */
static inline dd growth_of_pairs(const pair_equations *at)
{
  dd rate;
  damping_pairs(NULL, at->t, at->parameters, &rate);
  return dd_multiply(rate, at->h);
}

/* Weights of the points, and their low words, with the damping factor (damping.h). */
static inline void grown_weight_pairs(const pair_equations *at, int points, const double *abscissa,
    const double *abscissa_low, double *weight, double *low)
{
  const dd growth = growth_of_pairs(at);
  for (int n = 0; n < points; n++) {
    const dd factor = dd_exp(dd_multiply(growth, dd_of(abscissa[n], abscissa_low[n])));
    const dd grown = dd_multiply(dd_of(weight[n], low[n]), factor);
    weight[n] = grown.high, low[n] = grown.low;
  }
}

/* p1 - p0 from e^(gamma h) p1 - p0 in the rows. */
static inline void shrink_pairs(pair_equations *at)
{
  const dd factor = dd_exp(dd_negative(growth_of_pairs(at))), loss = dd_subtract(factor, dd_of(1.0, 0.0));
  for (int i = 0; i < M; i++) {
    dd *p = at->rows + i * (B + 1) + B;
    *p = dd_add(dd_multiply(factor, *p), dd_multiply(loss, at->p0[i]));
  }
}
#endif

/* Initial values of the rows from the state. Requires: MOMENTUM_ROW. */
static inline void begin_row_pairs(pair_equations *at)
{
  memset(at->rows, 0, sizeof at->rows);
  for (int i = 0; i < M; i++)
    for (int r = 0; r < B; r++)
      at->rows[i * (B + 1) + r] = times_entry(MOMENTUM_ROW[r], MOMENTUM_ROW_LOW[r], at->p0[i]);
}
