#include "../core/points.h"

/* Sums over points of a step in pairs; groups of points are vectors. Requires: vector_pairs.h. */

/* sum_j table_gj x_j of a coordinate: Dot2 (Ogita, Rump & Oishi 2005) with the low words of both factors. */
static inline ddl sum_of_pairs(const lanes *table, const lanes *low, int g, const ddl (*x)[M], int i)
{
  ddl sum[2] = {{{0.0}, {0.0}}, {{0.0}, {0.0}}};
#pragma GCC unroll 16
  for (int j = 0; j < POINTS; j++) {
    const lanes a = table[j * GROUPS + g], b = low[j * GROUPS + g];
    const ddl *at = &x[j / LANES][i];
    const lanes high = lanes_of(lane_of(&at->high, j % LANES)), rest = lanes_of(lane_of(&at->low, j % LANES));
    const ddl product = ddl_two_product(a, high), next = ddl_two_sum(sum[j % 2].high, product.high);
    sum[j % 2].high = next.high;
    sum[j % 2].low += multiply_add(a, rest, b * high) + (product.low + next.low);
  }
  const ddl both = ddl_two_sum(sum[0].high, sum[1].high);
  return ddl_fast_two_sum(both.high, both.low + (sum[0].low + sum[1].low));
}

/* x + y with an unnormalised low word: the sum of the low words and the rounding error. */
static inline ddl add_loosely(ddl x, ddl y)
{
  ddl sum = ddl_two_sum(x.high, y.high);
  sum.low += x.low + y.low;
  return sum;
}

/* Sum over all points, in an order that does not depend on the vector length. */
static inline dd total_of_pairs(ddl *x)
{
  enum { WHOLE = (POINTS & -POINTS) / LANES };
  for (int n = WHOLE; n < GROUPS; n++)
    x[n % WHOLE] = add_loosely(x[n % WHOLE], x[n]);
  for (int half = WHOLE / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      x[n] = add_loosely(x[n], x[n + half]);
  ddl sum = x[0];
  for (int half = LANES / 2; half > 0; half /= 2) {
    lane_view high = {sum.high}, low = {sum.low};
    for (int j = 0; j < half; j++) {
      high.lane[j] = high.lane[j + half];
      low.lane[j] = low.lane[j + half];
    }
    const ddl other = {high.all, low.all};
    sum = add_loosely(sum, other);
  }
  return dd_fast_two_sum(lane_of(&sum.high, 0), lane_of(&sum.low, 0));
}

static inline dd weighted_total(const lanes *weights, const lanes *low, const ddl (*x)[M], int i)
{
  ddl part[GROUPS];
  for (int n = 0; n < GROUPS; n++) {
    const lanes high = x[n][i].high, lower = low[n] * high;
    part[n] = ddl_two_product(weights[n], high);
    part[n].low += multiply_add(weights[n], x[n][i].low, lower);
  }
  return total_of_pairs(part);
}
