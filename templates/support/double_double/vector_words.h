#include "../core/vectors.h"
#include "words.h"

/* Operations on single words, lane by lane. */
#define LANE_OPERATION(f)                  \
  static inline lanes ddl_##f(lanes x)     \
  {                                        \
    lane_view view = {x};                  \
    for (int j = 0; j < LANES; j++)        \
      view.lane[j] = dd_##f(view.lane[j]); \
    return view.all;                       \
  }                                        \
  static inline lanes ddl_##f(lanes x)

LANE_OPERATION(root);
LANE_OPERATION(log_of);
LANE_OPERATION(asinh_of);
LANE_OPERATION(sign);
LANE_OPERATION(is_small);
LANE_OPERATION(angle);
LANE_OPERATION(power_of_2);

#define LANE_OPERATION_OF_TWO(f)                          \
  static inline lanes ddl_##f(lanes x, lanes y)           \
  {                                                       \
    lane_view view = {x}, other = {y};                    \
    for (int j = 0; j < LANES; j++)                       \
      view.lane[j] = dd_##f(view.lane[j], other.lane[j]); \
    return view.all;                                      \
  }                                                       \
  static inline lanes ddl_##f(lanes x, lanes y)

LANE_OPERATION_OF_TWO(atan2_of);
LANE_OPERATION_OF_TWO(are_equal);
LANE_OPERATION_OF_TWO(whole);

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
