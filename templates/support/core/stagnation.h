#include "../iteration/convergence.h"

/* Stagnation of the iteration of one trajectory, by rounding or by slow convergence. */

/* Progress of the iteration of a step of one trajectory: the first change, the last three; the change that was
 * amplified by AMPLIFICATION, if any, and the number of iterations since; by_largest: 1 if changes are relative to the
 * largest coordinate; unmeasured: the number of iterations after the last one that is measured. */
typedef struct {
  double first, last, before, earlier, amplified;
  int status, since, by_largest, unmeasured;
} trajectory_progress;

/* factor by which the last change is amplified; it has to decrease to about its former size */
#define AMPLIFICATION 1e3
#define AMPLIFIED_ITERATIONS 3 /* within so many iterations */
#define ABOUT 16.0 /* a factor of four, squared */
#define AMPLIFIED_LEVEL 1e-16 /* only changes below 1e-8 of the state are amplified */

/* Decides whether an iteration that stagnates has converged; returns 1 if the last change has to be amplified. */
static SELDOM int check_stagnation(trajectory_progress *now, const solver_options *options, int k)
{
  if (now->amplified > 0.0) {
    now->since++;
    now->status = now->last <= ABOUT * now->amplified ? 1 : -(now->since == AMPLIFIED_ITERATIONS);
    return 0;
  }
  if (options->absolute || !(now->last < AMPLIFIED_LEVEL) || k + AMPLIFIED_ITERATIONS >= options->max_iterations)
    return 0;
  now->amplified = now->last;
  now->last = INFINITY;
  now->status = 0;
  return 1;
}

/* Begins to measure changes relative to the largest coordinate; returns 0 if they already are or the step fails. */
static SELDOM int begin_by_largest(trajectory_progress *now, const solver_options *options, int k)
{
  if (options->absolute || !(now->last < INFINITY) || k >= options->max_iterations || now->amplified > 0.0 ||
      now->by_largest)
    return 0;
  now->by_largest = 1;
  now->status = 0;
  now->last = now->before = now->earlier = INFINITY;
  return 1;
}

/* Returns 1 if changes relative to the size of each coordinate stagnate; the following ones are then relative to the
 * largest. At a coordinate that vanishes, such as a node of a standing wave, forces are rounding errors of terms that
 * cancel, and its relative changes do not decrease. */
static inline int is_one_stagnant(trajectory_progress *now, const solver_options *options, int k)
{
  if (k > 1 && now->status <= 0 &&
      (now->status < 0 || (now->last > STAGNANT * now->before && now->last > STAGNATION * now->earlier))) {
    trajectory_progress seen = *now; /* so that `now` may stay in registers */
    const int stagnant = begin_by_largest(&seen, options, k);
    *now = seen;
    return stagnant;
  }
  return 0;
}

/* Returns 1 if the last change has to be amplified to test whether it decreases. If mass matrices are nearly singular,
 * rounding alone changes velocities by more than any fixed level; but slowly converging iterations stagnate there, too.
 * An amplified rounding error vanishes within an iteration or two, a slowly converging component does not. Since with
 * complex eigenvalues one iteration in two may reduce little, two are compared. */
static inline int is_to_amplify(trajectory_progress *now, const solver_options *options, int k)
{
  const int stagnated = now->last >= now->before && now->last >= STAGNATION * now->earlier;
  if (now->status <= 0 && (now->amplified > 0.0 || stagnated)) {
    trajectory_progress seen = *now; /* so that `now` may stay in registers */
    const int amplify = check_stagnation(&seen, options, k);
    *now = seen;
    return amplify;
  }
  return 0;
}
