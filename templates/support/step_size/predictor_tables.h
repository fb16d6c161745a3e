#include "../core/points.h"
#include "../core/step.h"

/* Predictor tables for steps of different sizes. Requires: PREDICTOR_INSIDE, PREDICTOR_ALONE, PREDICTOR_LAST,
 * PREDICTOR_BEFORE.
 *
 * Step sizes are roots of 2 to the power of a level, so that few tables extrapolate the curve of former steps: from the
 * last step, one for each change of level; from the last two, one for each pair of changes. After a rejected step, from
 * whose curve the shorter one is interpolated, one for each number of levels between them. */
enum {
  INSIDE = sizeof PREDICTOR_INSIDE / sizeof *PREDICTOR_INSIDE,
  CHANGES = sizeof PREDICTOR_ALONE / sizeof *PREDICTOR_ALONE,
  REACH = CHANGES / 2
};

/* Selects the tables for the next step; returns 0 if there are none. */
static inline int choose_tables(const run_memory *run, struct predictor_tables_of *tables)
{
  const long long last = run->change_before + REACH, next = run->change + REACH;
  if (next < 0 || next >= CHANGES || (run->guess == 2 && (last < 0 || last >= CHANGES)))
    return 0;
  tables->alone = PREDICTOR_ALONE[next];
  if (run->guess == 2) {
    tables->last = PREDICTOR_LAST[last][next];
    tables->before = PREDICTOR_BEFORE[last][next];
  }
  return 1;
}
