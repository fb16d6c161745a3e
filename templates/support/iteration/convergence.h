#include "../core/numbers.h"

/* Convergence criterion of the fixed-point iteration. Requires: FINAL_ITERATIONS, the number of iterations after the
 * last one that is measured, in a step with low words. Changes are squared, and so are the thresholds here. */

#ifdef SINGLE_PRECISION
#define LEVEL(squared) ((squared) * 2.9e17) /* the same number of round-off units */
#else
#define LEVEL(squared) squared
#endif
#define UNEXTRAPOLATED 16.0 /* the remaining change must be below 1/4 of the tolerance, or 1/2 at slow convergence */
#if defined(NEWTON_KRYLOV) || defined(FORCES_OF_VELOCITIES)
#define MARGIN UNEXTRAPOLATED
#else
#define MARGIN (FINAL_ITERATIONS ? 1.0 : UNEXTRAPOLATED) /* below the tolerance: remainder.h extrapolates most of it */
#endif
#define FASTEST_CONVERGENCE 1e-6 /* fastest credible convergence: a factor of 1000 per iteration */
#define SLOWEST_CONVERGENCE 0.5 /* slowest convergence rate assumed; a slower iteration ends where its changes stop
                                 * decreasing */
#define SUDDEN_CONVERGENCE 1e-3 /* an iteration reduces the change at most 30 times more than the previous one; more is
                                 * accidental */
#define STATE 1.0 /* largest change that shows a rate */
#define DIVERGED 1e6 /* changes above a thousand times the state: iterations are abandoned among the first, too */
#define LARGEST_CHANGE 1e75 /* the fourth power of a larger change may overflow */
#define ROUNDING_LEVEL LEVEL(1e-25) /* changes below 3e-13 of the state may be rounding errors */
#define CERTAIN_ROUNDING LEVEL(1e-28) /* changes below 1e-14 that do not decrease are rounding errors */
#define STAGNATION 0.25 /* changes above that only if they decreased by less than half in two iterations */
#define PROGRESS_LEVEL LEVEL(1e-20) /* above 1e-10, iterations that gain less than 1.4 (two: 2) are abandoned */
#define STAGNANT 0.8 /* changes that decrease by less, and by less than half in two iterations, stagnate */
#define FIRST_ITERATIONS 4 /* but not among the first ones, which need not contract */
#define LEAST_SQUARED 1e-100 /* squares of smaller numbers, or of small parts of them, may be subnormal */
#define LARGEST_SQUARED 1e100 /* squares of larger numbers, or sums of many, may overflow */
#define NO_REMAINDER LEVEL(1e-24) /* after changes below 1e-12 of the state, the remainder is far below rounding */
#define SLOWLY 1e-3 /* remainders of rounding errors count if the iteration gains less than a factor of 30 */
#define NEGLIGIBLE_REMAINDER 3e-4 /* 1/60 of the tolerance */
#define GOOD_GUESS 1e-6 /* after a prediction with an error below 1e-3 of the state, the next one uses two steps */

/* Part of |q| in the size of a coordinate, so that the tolerance of the iteration times this part is at least the
 * rounding error of q: a looser tolerance is one of the motion, wherever the origin is. */
static inline double part_of_position(const solver_options *options)
{
  return options->tolerance > REAL_EPSILON ? REAL_EPSILON / options->tolerance : 1.0;
}

/* Factor by which numbers of this size are scaled before they are squared: 1 unless squares overflow or underflow. */
static inline double scale_of(double size)
{
  return size > LEAST_SQUARED && size < LARGEST_SQUARED ? 1.0 : 1.0 / (size + DBL_MIN);
}

/* Returns 1 if all further iterations would change the points by less than the tolerance, with a margin: the remaining
 * change is change r / (1 - r), with r the convergence rate estimated from the previous change `last`, which is
 * infinite at first. Squared, 1 / (1 - r) is at most 2 / (1 - r^2); the 4 is part of MARGIN. The inequality is
 * multiplied out because a division costs as much as an iteration. If the eigenvalues of the iteration are complex, its
 * rate varies, so r is at least 1/30 of the rate that follows from the change `before` the last one. A change of the
 * size of the state shows the rate up to a factor of order 1, a larger one no more than it: where forces are bounded,
 * the first change may be of any size, and the next one is not. An iteration that follows `unmeasured` is expected to
 * gain another r. */
static inline int is_small_remainder(double change, double last, double before, const solver_options *options,
    double margin, int unmeasured)
{
  const double tolerance = options->tolerance * options->tolerance, rest = margin * change;
  const double former = smaller(last, STATE), earlier = smaller(before, STATE);
  const double seen = smaller(larger(change, FASTEST_CONVERGENCE * former), SLOWEST_CONVERGENCE * former);
  const double gap = former - seen, expected = SUDDEN_CONVERGENCE * former;
  const int rests = rest * seen * (unmeasured ? seen : former) <= tolerance * (gap * gap);
  const int sure = rest * expected * (unmeasured ? expected : earlier) <= tolerance * (earlier * earlier);
  if (options->absolute)
    return change <= tolerance;
  return last < LARGEST_CHANGE ? rests & sure : rest <= tolerance;
}

/* Returns 1 if the iteration that changed the points by sqrt(change) relative to the state is accepted: the remaining
 * change is below a quarter of the tolerance, or rounding stops the decrease; 0: continue; -1: it converges too slowly
 * or not at all. Branch-free, so that it vectorises over trajectories. */
static inline int iteration_status(double change, double last, double before, const solver_options *options, int k,
    int unmeasured)
{
  const int small = is_small_remainder(change, last, before, options, MARGIN, unmeasured);
  const int stagnated = (change < CERTAIN_ROUNDING) | ((change < ROUNDING_LEVEL) & (change >= STAGNATION * before));
  const int stopped = (change == 0.0) | ((k > 0) & (change >= last) & stagnated);
  const double least = k > FIRST_ITERATIONS ? PROGRESS_LEVEL : DIVERGED;
  const int creeping = (change > 0.5 * last) & (change > STAGNATION * before) & (change > least);
  const int slow = (k >= options->max_iterations) | creeping;
  return change < INFINITY ? (small | stopped ? 1 : -slow) : -1;
}

/* Number of previous steps for the next predictor: a polynomial of high degree through two steps is better while
 * predictions are accurate, and worse for large steps. */
static inline long long steps_to_continue(long long steps, double first_change)
{
  return steps > 0 && first_change < GOOD_GUESS ? 2 : 1;
}

#ifdef ARRAYS
#ifdef PLANS
#define LEAST_SIZE 1.0 /* rounding errors of Fourier transforms are relative to the largest coordinate */
#else
#define LEAST_SIZE 1e-6 /* relative to the largest coordinate: added to the size of each */
#endif

/* Added to the size of each coordinate: a little of the largest of all; in an array whose neighbouring elements forces
 * couple, the largest of it: at a node of a standing wave forces are rounding errors of terms that cancel. */
static inline double least_size(const coordinate_array *array, double largest_of_array, double largest)
{
  const double least = LEAST_SIZE * largest + DBL_MIN;
  return array->is_field ? larger(least, largest_of_array) : least;
}

/* Replaces sizes by inverse sizes whose squared changes add up to the mean over n coordinates, so that the sum of the
 * rounding errors of many is not above the tolerance; with absolute = 1, to the 2-norm. NaN if a size is not finite. */
static inline void invert_sizes(const solver_options *options, double largest, double least, long long n,
    section here, double *size)
{
  const double unit = 1.0 / sqrt((double)n);
  for (long long i = here.first; i < here.end; i++)
    size[i] = (options->absolute ? 1.0 : unit / (size[i] + least)) + 0.0 * largest;
}

/* Squared change relative to the squared size of a state in the 2-norm; NaN if that is not finite. */
static inline double relative_change(double change, double size)
{
  return (size == 0.0 ? change : change / size) + 0.0 * size;
}
#else
/* Inverse sizes, in units of which changes are measured. Requires: points.h or trajectories.h. */

/* Adds the largest size of an array whose neighbouring elements forces couple to the size of each element: at a node of
 * a standing wave forces are rounding errors of terms that cancel. */
static inline void add_largest_of_arrays(number *size)
{
#ifdef COUPLED_ELEMENTS
  static const int coupled[][2] = {COUPLED_ELEMENTS};
  for (size_t k = 0; k < sizeof coupled / sizeof coupled[0]; k++) {
    const number largest = largest_between(size, coupled[k][0], coupled[k][1]);
    for (int i = coupled[k][0]; i < coupled[k][1]; i++)
      size[i] += largest;
  }
#endif
}

/* 1 / (size + a little of the largest), so that a coordinate at 0 has a size, too; or `absolute`, which converts to
 * changes of q. An infinite size gives NaN. */
static inline void invert_sizes(const solver_options *options, real absolute, number *size)
{
  const number largest = largest_number(size);
  add_largest_of_arrays(size);
  const number least = REAL_EPSILON * largest + REAL_MIN;
  for (int i = 0; i < M; i++)
    size[i] = (options->absolute ? number_of(absolute) : 1.0 / (size[i] + least)) + 0.0 * largest;
}

/* Returns, of inverse sizes, the least where `stagnant` is 1, and those of each coordinate where it is 0. */
static SELDOM void find_least(number stagnant, const number *inverse_size, number *found)
{
  number least;
  for (int i = 0; i < M; i++)
    found[i] = -inverse_size[i];
  least = -largest_number(found);
  for (int i = 0; i < M; i++)
    found[i] = stagnant * least + (1.0 - stagnant) * inverse_size[i];
}

/* Replaces inverse sizes by that of the largest coordinate where `stagnant` is 1, not 0. */
static inline void measure_by_largest(number stagnant, number *inverse_size)
{
  number sizes[M], found[M]; /* copies, so that those of the iteration may stay in registers */
  memcpy(sizes, inverse_size, sizeof sizes);
  find_least(stagnant, sizes, found);
  memcpy(inverse_size, found, sizeof found);
}
#endif
