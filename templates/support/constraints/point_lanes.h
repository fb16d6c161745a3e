#define POINTS POINT_LANES /* in vectors */
#include "../core/vectors.h"
#include "../newton/newton.h"

/* Points of a constrained step as SIMD lanes, in groups that fill a register. trajectory_lanes.h defines the same
 * names. Requires: POINT_LANES, a power of two. */
#define RATTLE
#if LANES == 1
#define FORMER_LANES 1
#elif LANES == 2
#define FORMER_LANES 3, 0
#elif LANES == 4
#define FORMER_LANES 7, 0, 1, 2
#elif LANES == 8
#define FORMER_LANES 15, 0, 1, 2, 3, 4, 5, 6
#else
#define FORMER_LANES 31, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14
#endif

enum {
  DEGREE = B - 1, /* of B points; point n + 1 of positions is point n of forces and multipliers */
  GROUPS = (DEGREE + LANES - 1) / LANES, /* of points; point n is lane n % LANES of group n / LANES */
  GROUP_LANES = GROUPS * LANES,
  LAST_GROUP = (DEGREE - 1) / LANES
};
typedef real_bits lane_numbers __attribute__((vector_size(LANES * REAL_BYTES)));

typedef real number; /* a value of the trajectory */
typedef int condition;

#define FIRST_LANE(x) (x)[0] /* value at the first point, of group 0 */
#define LAST_LANE(x) (x)[(DEGREE - 1) % LANES] /* at the last one, of LAST_GROUP */

#ifdef __clang__
#define FORMER(x, before) __builtin_shufflevector(x, before, FORMER_LANES)
#else
#define FORMER(x, before) __builtin_shuffle(x, before, (lane_numbers){FORMER_LANES})
#endif

#define LANE_FUNCTION static inline __attribute__((always_inline)) /* vectors are not passed to functions */

#define IN_MEMORY(values) __asm__("" : "+m"(values)) /* after they were stored */

/* Group g of the values x at the points. */
LANE_FUNCTION lanes load(const real *x, int g)
{
  lanes loaded;
  memcpy(&loaded, x + g * LANES, sizeof loaded);
  return loaded;
}

LANE_FUNCTION void store(real *x, int g, lanes values)
{
  memcpy(x + g * LANES, &values, sizeof values);
}

#define weights(table, g) load(table, g) /* group g of the numbers of a table, one for each point */
#define lanes_of_number(x) lanes_of(x)
#define magnitude(x) MATH(fabs)(x)
#define larger_number(a, b) larger(a, b)
#define all_of(holds) (holds)

/* Group g of x at the points before, first at the first point. */
LANE_FUNCTION lanes former(const real *x, real first, int g)
{
  return FORMER(load(x, g), g > 0 ? load(x, g - 1) : lanes_of(first));
}

/* a / b, 0 unless a is positive. */
static inline number share(number a, number b)
{
  return a > 0 ? a / b : 0;
}

/* The larger of x and y, x where y is NaN. */
LANE_FUNCTION lanes greater_lanes(lanes x, lanes y)
{
  const lane_numbers chosen = (lane_numbers)(y > x);
  return (lanes)(((lane_numbers)y & chosen) | ((lane_numbers)x & ~chosen));
}

LANE_FUNCTION real largest_lane(const lanes *x)
{
  real largest[LANES];
  memcpy(largest, x, sizeof largest);
  for (int half = LANES / 2; half > 0; half /= 2)
    for (int n = 0; n < half; n++)
      largest[n] = larger(largest[n + half], largest[n]);
  return largest[0];
}
