/* When sweeps of changes are at rest. Before it: contraction.h. */

#define MOVED_BY_ROUNDING (4.0 * DBL_EPSILON * DBL_EPSILON) /* squared: what a sweep moves by rounding alone */
#define LEFT_TO_COME (DBL_EPSILON * DBL_EPSILON / 16.0) /* what is left to come */

#define LEAST_SIZE 1e-250 /* squared: of less, changes underflow */

/* Changes of two sweeps, squared and relative, infinite where there were none. */
typedef struct {
  double last, before;
} sweep_changes;

/* Whether a sweep that moved changes by so much of their size, both squared, was the last: 1; 0: go on; -1: they do
 * not contract, or their squares overflow or underflow. Changes are looked at from sweep *look on: one before the last
 * of the time before, as all steps of a run are much alike. */
static inline int changes_rest(double moved, double size, sweep_changes *past, int k, int *look)
{
  const double last = past->last, before = past->before, relative = size > 0.0 ? moved / size : moved;
  const int first = !(last < INFINITY), finite = size < INFINITY && (size > LEAST_SIZE || moved == 0.0);
  const int small = relative <= (first ? MOVED_BY_ROUNDING : LEFT_TO_COME);
  const int last_but_one = !first && relative * relative <= LEFT_TO_COME * last &&
      relative * SUDDEN_CONTRACTION * last <= LEFT_TO_COME * before;
  const int stopped = !first && relative >= last &&
      (relative < CERTAIN_ROUNDING || (relative < ROUNDING_LEVEL && relative >= STALLED * before));
  const int shrinks = first || relative < 0.5 * last || relative < STALLED * before || relative < PROGRESS_LEVEL;
  past->before = last;
  past->last = relative;
  if (finite && (small || last_but_one || stopped)) {
    *look = k - 1;
    return 1;
  }
  return finite && relative < INFINITY && k < MAX_ITERATIONS && shrinks ? 0 : -1;
}
