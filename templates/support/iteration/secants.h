#include "point_weights.h"

/* Anderson acceleration of a fixed-point iteration g(z) = z + r(z) (D. G. Anderson, J. ACM 12 (1965), 547-560): with
 * the changes dr, dg of r and g over the last iterations, the part of r in the span of the dr is removed,
 *   z = g - sum_j <dr_j, r> dg_j,
 * where the pairs are combined such that the dr_j are orthonormal. Requires: points.h, or trajectories.h, where every
 * trajectory has its own factors and its own start, and the pair of an iteration has the same index for all. */
#define DEPENDENT 1e-8 /* relative to its square: a change that the earlier ones span is not stored */
#define ACCELERATED_LEVEL 1e-18 /* changes below 1e-9 of the state after the first iterations need no acceleration */

/* normalisation: 1 / sqrt(rest), or 0 if rest is small. */
#ifdef POINTS
enum { SECANTS = 8 };

static inline number normalisation(number size, number rest)
{
  return rest > DEPENDENT * size ? 1.0 / sqrt(rest) : 0.0;
}

#define PAIR_INDEX(past, k) ((past)->count % SECANTS)
#define PAIRS(past) ((past)->count < SECANTS ? (past)->count : SECANTS)
#define IS_PAIR(factor) any_positive(factor)
#else
enum { SECANTS = 4 }; /* of each trajectory: less memory */

static inline number normalisation(number size, number rest)
{
  const lane_view whole = {size};
  lane_view part = {rest};
  for (int j = 0; j < LANES; j++)
    part.lane[j] = part.lane[j] > DEPENDENT * whole.lane[j] ? 1.0 / sqrt(part.lane[j]) : 0.0;
  return part.all;
}

#define PAIR_INDEX(past, k) ((k) % SECANTS)
#define PAIRS(past) SECANTS /* those that a trajectory lacks are 0 */
#define IS_PAIR(factor) 1
#endif

/* begun: 1 if iterations are accelerated; known: 1 if r and g are those of the iteration before; count: of pairs since
 * the last start. */
typedef struct {
  number begun, known;
  int count;
  lanes r[GROUPS][M], g[GROUPS][M], dr[SECANTS][GROUPS][M], dg[SECANTS][GROUPS][M];
} secants;

/* Inner product of values at the points, with weights of the coordinates. */
static inline number inner_product(lanes (*x)[M], lanes (*y)[M], const number *unit)
{
  lanes sum = lanes_of(0.0);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      sum += x[n][i] * y[n][i] * (unit[i] * unit[i]);
  return total_change(sum);
}

/* x += factor y. */
static inline void add_multiple(number factor, lanes (*y)[M], lanes (*x)[M])
{
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      x[n][i] += factor * y[n][i];
}

/* Forgets all pairs. */
static inline void forget(secants *past)
{
  past->known = number_of(0.0);
  past->count = 0;
  if (PAIRS(past)) {
    memset(past->dr, 0, sizeof past->dr);
    memset(past->dg, 0, sizeof past->dg);
    memset(past->r, 0, sizeof past->r);
    memset(past->g, 0, sizeof past->g);
  }
}

/* Begins where iterations converge slowly; returns 1 if some are accelerated. */
static inline int begins(secants *past, number slow)
{
  if (any_positive(slow) && !any_positive(past->begun))
    forget(past);
  past->begun += slow * (1.0 - past->begun);
  return any_positive(past->begun);
}

/* Replaces z = g by the accelerated iterate of iteration k, and stores r and g; restart: whether earlier ones are
 * forgotten; share: 1, or 0 for trajectories that have converged, which the iterations of others do not move, and whose
 * changes are rounding errors: the quotients of their differences are of any size. */
static inline void accelerate(secants *past, int k, int restart, const number *unit, number share, lanes (*r)[M],
    lanes (*z)[M])
{
  lanes g[GROUPS][M];
  memcpy(g, z, sizeof g);
  if (restart)
    forget(past);
  if (any_positive(past->known)) {
    const int last = PAIR_INDEX(past, k), known = PAIRS(past);
    lanes dr[GROUPS][M], dg[GROUPS][M];
    number size, factor;
    memcpy(dr, r, sizeof dr);
    memcpy(dg, g, sizeof dg);
    add_multiple(number_of(-1.0), past->r, dr);
    add_multiple(number_of(-1.0), past->g, dg);
    size = inner_product(dr, dr, unit);
    for (int j = 0; j < known; j++)
      if (j != last) {
        const number along = inner_product(past->dr[j], dr, unit);
        add_multiple(-along, past->dr[j], dr);
        add_multiple(-along, past->dg[j], dg);
      }
    factor = past->known * normalisation(size, inner_product(dr, dr, unit));
    if (IS_PAIR(factor)) {
      memset(past->dr[last], 0, sizeof dr);
      memset(past->dg[last], 0, sizeof dg);
      add_multiple(factor, dr, past->dr[last]);
      add_multiple(factor, dg, past->dg[last]);
      past->count++;
    }
  }
  past->known = past->begun;
  memcpy(past->r, r, sizeof past->r);
  memcpy(past->g, g, sizeof past->g);
  for (int j = 0; j < PAIRS(past); j++)
    add_multiple(-share * inner_product(past->dr[j], r, unit), past->dg[j], z);
}
