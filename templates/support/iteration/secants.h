#ifndef SUPPORT_SECANTS_H
#define SUPPORT_SECANTS_H

#include "point_weights.h"

/* Anderson acceleration of a fixed-point iteration g(z) = z + r(z) (D. G. Anderson, J. ACM 12 (1965), 547-560): with
 * the changes dr, dg of r and g over the last iterations, the part of r in the span of the dr is removed,
 *   z = g - sum_j <dr_j, r> dg_j,
 * where the pairs are combined such that the dr_j are orthonormal. Requires: points.h. */
enum { SECANTS = 8 };
#define DEPENDENT 1e-8 /* relative to its square: a change that the earlier ones span is not stored */
#define ACCELERATED_LEVEL 1e-18 /* changes below 1e-9 of the state after the first iterations need no acceleration */

/* known: whether r and g are those of the iteration before; count: of pairs since the last start. */
typedef struct {
  int known, count;
  lanes r[GROUPS][M], g[GROUPS][M], dr[SECANTS][GROUPS][M], dg[SECANTS][GROUPS][M];
} secants;

/* Inner product of values at the points, with weights of the coordinates. */
static inline double inner_product(lanes (*x)[M], lanes (*y)[M], const double *unit)
{
  lanes sum = lanes_of(0.0);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      sum += x[n][i] * y[n][i] * (unit[i] * unit[i]);
  return lanes_total(sum);
}

/* x += factor y. */
static inline void add_multiple(double factor, lanes (*y)[M], lanes (*x)[M])
{
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      x[n][i] += factor * y[n][i];
}

/* Replaces z = g by the accelerated iterate, and stores r and g; restart: whether earlier ones are forgotten. */
static inline void accelerate(secants *past, int restart, const double *unit, lanes (*r)[M], lanes (*z)[M])
{
  lanes g[GROUPS][M];
  memcpy(g, z, sizeof g);
  if (restart)
    past->known = past->count = 0;
  if (past->known) {
    const int last = past->count % SECANTS, known = past->count < SECANTS ? past->count : SECANTS;
    lanes dr[GROUPS][M], dg[GROUPS][M];
    double size, rest;
    memcpy(dr, r, sizeof dr);
    memcpy(dg, g, sizeof dg);
    add_multiple(-1.0, past->r, dr);
    add_multiple(-1.0, past->g, dg);
    size = inner_product(dr, dr, unit);
    for (int j = 0; j < known; j++)
      if (j != last) {
        const double along = inner_product(past->dr[j], dr, unit);
        add_multiple(-along, past->dr[j], dr);
        add_multiple(-along, past->dg[j], dg);
      }
    rest = inner_product(dr, dr, unit);
    if (rest > DEPENDENT * size) {
      memset(past->dr[last], 0, sizeof dr);
      memset(past->dg[last], 0, sizeof dg);
      add_multiple(1.0 / sqrt(rest), dr, past->dr[last]);
      add_multiple(1.0 / sqrt(rest), dg, past->dg[last]);
      past->count++;
    }
  }
  past->known = 1;
  memcpy(past->r, r, sizeof past->r);
  memcpy(past->g, g, sizeof past->g);
  for (int j = 0; j < past->count && j < SECANTS; j++)
    add_multiple(-inner_product(past->dr[j], r, unit), past->dg[j], z);
}

#endif
