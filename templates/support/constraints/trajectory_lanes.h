#include "../core/trajectories.h"
#include "../core/choices.h"

/* Trajectories as SIMD lanes of a constrained step, whose points are in turn: group g is point g. point_lanes.h defines
 * the same names, and the order of sums is the same. Requires: POINT_LANES, columns of the tables. */
#define RATTLE
#define LANE_FUNCTION static inline __attribute__((always_inline)) /* vectors are not passed to functions */
#define IN_MEMORY(values) (void)0
#define FIRST_LANE(x) (x)
#define LAST_LANE(x) (x)
#define load(x, g) (x)[g]
#define store(x, g, values) ((x)[g] = (values))
#define weights(table, g) lanes_of((table)[g])
#define largest_lane(x) (*(x))

enum {
  DEGREE = B - 1, /* of B points; point n + 1 of positions is point n of forces and multipliers */
  GROUP_LANES = DEGREE,
  LAST_GROUP = DEGREE - 1
};
typedef real_bits lane_numbers __attribute__((vector_size(REAL_BYTES * LANES)));

/* Change of an iteration: the largest ratio to the own size, the ratio of the largest to the largest size, and the
 * largest itself. */
typedef struct {
  number relative, overall, absolute;
} movement;

LANE_FUNCTION lanes former(const lanes *x, lanes first, int g)
{
  return g > 0 ? x[g - 1] : first;
}

LANE_FUNCTION lanes greater_lanes(lanes x, lanes y)
{
  return where((condition)(y > x), y, x);
}

static inline number share(number a, number b)
{
  return where((condition)(a > 0.0), a / b, lanes_of(0));
}
