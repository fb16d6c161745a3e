/* When sweeps have come near enough to their fixed point. Before it: SWEEPS_AFTER, how many sweeps follow the last one
 * that is measured. Changes are squared, as are the thresholds here. */

#define MARGIN 16.0 /* what is left is to be less than a quarter of the tolerance */
#define FASTEST_CONTRACTION 1e-6 /* what a thousandfold contraction in one sweep is believed to be */
#define SLOWEST_CONTRACTION 0.5 /* and what slower ones are taken for: they end where they stop shrinking */
#define ROUNDING_LEVEL 1e-25 /* changes below 3e-13 of the state may be rounding */
#define PROGRESS_LEVEL 1e-20 /* above 1e-10, sweeps that gain less than a factor of 1.4 are given up */
#define FIRST_SWEEPS 4 /* but not at once: the first ones need not contract */
#define GOOD_GUESS 1e-6 /* a guess this near, 1e-3 of the state, is continued from two steps the next time */

static inline double smaller(double a, double b)
{
  return a < b ? a : b;
}

/* Whether all that follows a sweep would change the points by less than the tolerance, with a margin: by change r /
 * (1 - r), r being the rate of contraction from the sweep before, whose change is infinite before the first. Squared,
 * 1 / (1 - r) is at most 2 / (1 - r^2); the 4 is in MARGIN. Multiplied out: divisions would last as long as a sweep. */
static inline int comes_to_rest(double change, double last, const solver_options *options, double margin)
{
  const double tolerance = options->tolerance * options->tolerance, rest = margin * change;
  const double seen = smaller(larger(change, FASTEST_CONTRACTION * last), SLOWEST_CONTRACTION * last);
  const double gap = last - seen;
  const int rests = rest * seen * (SWEEPS_AFTER ? seen : last) <= tolerance * (gap * gap);
  if (options->absolute)
    return change <= tolerance;
  return last < INFINITY ? rests : rest <= tolerance;
}

/* Whether a sweep that changed the points by the root of `change` (relative to the state) was good enough: what follows
 * it would change them by less than a quarter of the tolerance, or rounding stops the shrinking: 1; 0: go on; -1: it
 * contracts too slowly or not at all. Without branches, for many at once. */
static inline int sweep_status(double change, double last, const solver_options *options, int k)
{
  const int small = comes_to_rest(change, last, options, MARGIN);
  const int stopped = (change == 0.0) | ((k > 0) & (change >= last) & (change < ROUNDING_LEVEL));
  const int slow =
      (k >= options->max_iterations) | ((k > FIRST_SWEEPS) & (change > 0.5 * last) & (change > PROGRESS_LEVEL));
  return change < INFINITY ? (small | stopped ? 1 : -slow) : -1;
}

/* From how many steps the next guess is best continued: a polynomial of high degree through two is the better one while
 * guesses are good, and the worse one when the steps are long. */
static inline long long steps_to_continue(long long steps, double first_change)
{
  return steps > 0 && first_change < GOOD_GUESS ? 2 : 1;
}
