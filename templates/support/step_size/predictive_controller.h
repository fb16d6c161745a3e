#include "step_size_levels.h"

/* Predictive step-size controller (Gustafsson, ACM Trans. Math. Softw. 20 (1994) 496). */

/* Change of level for the next step, down by a factor of two at most. The error is expected to continue its growth; a
 * decrease is only partly trusted. */
static int next_change(run_memory *run, real error, real before, const error_limits *limits)
{
  const real expected =
      before > 0 && error > before ? error * (error / before) : larger(error, before / (GROWTH * GROWTH));
  int change = expected < limits->fewer ? 2 : expected < limits->few;
  while (change > -LEVELS_PER_BINADE && error_at(expected, change) > limits->most)
    change--;
  return change;
}
