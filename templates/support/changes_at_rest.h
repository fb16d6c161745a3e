/* When sweeps of changes are at rest. Before it: contraction.h. */

#define MOVED_BY_ROUNDING (4.0 * DBL_EPSILON * DBL_EPSILON) /* squared: what a sweep moves by rounding alone */
#define LEFT_TO_COME (DBL_EPSILON * DBL_EPSILON / 16.0) /* what is left to come */

/* Whether a sweep that moved changes by so much of their size, both squared, was the last: 1; 0: go on; -1: they do
 * not contract. Changes are looked at from sweep *look on: one before the last of the time before, as all steps of a
 * run are much alike. */
static inline int changes_rest(double moved, double size, double *last, int k, int *look)
{
  const double before = *last, relative = size > 0.0 ? moved / size : moved;
  const int first = !(before < INFINITY);
  const int small = relative <= (first ? MOVED_BY_ROUNDING : LEFT_TO_COME);
  const int last_but_one = !first && relative * relative <= LEFT_TO_COME * before;
  const int stopped = !first && relative >= before && relative < ROUNDING_LEVEL;
  const int shrinks = first || relative < 0.5 * before || relative < PROGRESS_LEVEL;
  *last = relative;
  if (small || last_but_one || stopped) {
    *look = k - 1;
    return 1;
  }
  return relative < INFINITY && k < MAX_ITERATIONS && shrinks ? 0 : -1;
}
