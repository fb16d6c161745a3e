#include "../core/vectors.h"
#include "words.h"

/* Operations on single words, lane by lane. */
LANE_BY_LANE(ddl_root, dd_root);
LANE_BY_LANE(ddl_log_of, dd_log_of);
LANE_BY_LANE(ddl_asinh_of, dd_asinh_of);
LANE_BY_LANE(ddl_sign, dd_sign);
LANE_BY_LANE(ddl_is_small, dd_is_small);
LANE_BY_LANE(ddl_angle, dd_angle);
LANE_BY_LANE(ddl_power_of_2, dd_power_of_2);
LANE_BY_LANE_OF_TWO(ddl_atan2_of, dd_atan2_of);
LANE_BY_LANE_OF_TWO(ddl_are_equal, dd_are_equal);
LANE_BY_LANE_OF_TWO(ddl_whole, dd_whole);

static inline lanes ddl_select(lanes chosen, lanes a, lanes b)
{
  lane_view view = {chosen}, x = {a}, y = {b};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = dd_select(view.lane[j], x.lane[j], y.lane[j]);
  return view.all;
}

static inline lanes ddl_limited(lanes x, double most)
{
  lane_view view = {x};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = dd_limited(view.lane[j], most);
  return view.all;
}

/* Entries of rows k of a table of a power of two of rows. */
static inline lanes ddl_entries(lanes k, const double *table, int rows, int columns)
{
  lane_view view = {k};
  for (int j = 0; j < LANES; j++)
    view.lane[j] = table[dd_row(view.lane[j], rows) * columns];
  return view.all;
}
