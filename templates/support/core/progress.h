#include "stagnation.h"
#include "status_codes.h"
#include "step.h"

/* Termination of the iteration of one trajectory. */
typedef trajectory_progress progress;

static inline progress before_iterations(void)
{
  return (progress){.last = INFINITY, .before = INFINITY, .earlier = INFINITY, .unmeasured = FINAL_ITERATIONS};
}

#define needs_iteration(now) ((now)->status == 0)

static inline void take_change(progress *now, double change, const solver_options *options, int k,
    solver_report *report)
{
  now->status = iteration_status(change, now->last, now->before, options, k, now->unmeasured);
  now->first = k == 0 ? change : now->first;
  now->earlier = now->before;
  now->before = now->last;
  now->last = change;
  report->iterations++;
}

/* 1 if the last change exceeds a level. */
static inline double undecided(const progress *now, double level)
{
  return now->last > level;
}

/* 1 if the stiffness is measured in iteration k: in the third, and in some of many, in which the fastest vibrations
 * come to dominate the changes. Of fewer iterations the last one shows it. */
static inline double measures_stiffness(const progress *now, int k)
{
  return (k == 2 || k % 8 == 5) && now->last > NO_REMAINDER;
}

/* Returns 1 if the remainder may count beside rounding errors: that of the coefficients times the rate, or the last
 * change times the square of the rate, by the last changes and, since rates vary, by the two iterations before. */
static inline int has_remainder(const progress *now, const solver_options *options)
{
  const double last = now->last, before = now->before;
  const double least = NEGLIGIBLE_REMAINDER * options->tolerance * options->tolerance;
  return last > SLOWLY * before || last * last * last > least * before * before || last * last > least * now->earlier;
}

#define any_positive(x) ((x) > 0.0)
#define is_stagnant is_one_stagnant
#define stagnant(now) 1.0 /* where is_stagnant returned 1 */
#define must_amplify is_to_amplify
#define amplification(now) AMPLIFICATION

/* Status of the finished iteration. */
static inline int outcome(const progress *now, solver_report *report)
{
  report->change = sqrt(now->last);
  report->noise = sqrt(now->amplified);
  if (now->status < 0)
    return now->last < INFINITY ? NOT_CONVERGED : NOT_FINITE;
  return OK;
}

/* Returns OK if the increments are finite and may be added. */
#define accept(step, dq, dp) (reaches(step, dq, dp) ? OK : NOT_FINITE)

#define next_guess(steps, now, report) steps_to_continue(steps, (now)->first)
