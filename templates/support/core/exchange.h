#ifndef SUPPORT_EXCHANGE_H
#define SUPPORT_EXCHANGE_H

#include "vectors.h"

/* Sums over the points of a step by exchanges of lanes, of which there are half as many as broadcasts in points.h.
 * Requires: vectors.h.
 *   sum_j table_nj x_j = sum_c S_c(n ^ c),  S_c(k) = sum_(m < INNER) T_(c + m)k x_(k ^ m),
 * with ^ the exclusive or and c the multiples of INNER. T_(c + m)k is the entry (k ^ c, k ^ m) of the table. */

enum { INNER = POINTS < 4 ? POINTS : 4 };

/* x with lanes j and j ^ m exchanged. */
static inline lanes exchanged(lanes x, int m)
{
#ifdef __clang__
  const lane_view from = {x};
  lane_view to;
  for (int j = 0; j < LANES; j++)
    to.lane[j] = from.lane[j ^ m];
  return to.all;
#else
  typedef long long indices __attribute__((vector_size(8 * LANES)));
  const indices own[8 / LANES] = {0, 1, 2, 3, 4, 5, 6, 7};
  return __builtin_shuffle(x, own[0] ^ m);
#endif
}

/* Sum over all points for those of a group; groups of x are `apart` apart. */
static inline lanes contribution_of_points(const lanes *table, int group, const lanes *x, long long apart)
{
  lanes sum[POINTS / INNER][INNER / 2 + 1]; /* of two terms each, which are independent */
#pragma GCC unroll 4
  for (int m = 0; m < INNER; m++)
#pragma GCC unroll 4
    for (int c = 0; c < POINTS / INNER; c++) {
      const int own = group ^ c * INNER / LANES;
      const lanes other = exchanged(x[(own ^ m / LANES) * apart], m % LANES);
      const lanes term = table[(c * INNER + m) * (POINTS / LANES) + own] * other;
      sum[c][m / 2] = m % 2 == 0 ? term : sum[c][m / 2] + term;
    }
#pragma GCC unroll 4
  for (int c = 0; c < POINTS / INNER; c++) {
    if (INNER == 4)
      sum[c][0] += sum[c][1];
    if (c > 0)
      sum[0][0] += exchanged(sum[c][0], c * INNER % LANES);
  }
  return sum[0][0];
}

#endif
