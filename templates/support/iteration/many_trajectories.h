#ifndef SUPPORT_MANY_TRAJECTORIES_H
#define SUPPORT_MANY_TRAJECTORIES_H

#include "../core/trajectories.h"
#include "convergence.h"

/* Fixed-point iteration of many trajectories, which are SIMD lanes: predictor and termination. A step fails for single
 * trajectories, which become inactive, never for all. Requires: trajectories.h, convergence.h, and the tables
 * LAST_ALONE, LAST, BEFORE, which extrapolate stored values into the next step. */

/* Stored values at the points, of the last step and of the one before, which the next step overwrites. */
typedef struct {
  lanes (*last)[M], (*before)[M];
} history;

/* Memory for the values to be stored. */
static inline coordinates *kept(history past, coordinates *own)
{
  (void)own;
  return past.before;
}

/* Extrapolates the stored values into this step from the last one or from the last two. */
static inline void continue_curve(const step_data *step, history past, long long steps, lanes (*x)[M])
{
  (void)step;
  for (int i = 0; i < M; i++) {
    lanes next[S];
    for (int n = 0; n < S; n++)
      next[n] = steps == 1 ? apply(LAST_ALONE, n, past.last, i) : apply(LAST, n, past.last, i) + apply(BEFORE, n, x, i);
    for (int n = 0; n < S; n++)
      x[n][i] = next[n];
  }
}

static inline void remember_curve(lanes (*x)[M], history past)
{
  (void)x, (void)past; /* computed in place (kept) */
}

/* Velocities of the straight line; they are stored before the first step. */
static inline int start_velocities(const step_data *step, lanes (*z)[M])
{
  (void)step, (void)z;
  return OK;
}

/* Progress of the iteration of a step. */
typedef struct {
  lanes first, last, before;
  int pending;
} progress;

static inline progress before_iterations(void)
{
  const progress none = {lanes_of(0.0), lanes_of(INFINITY), lanes_of(INFINITY), 1};
  return none;
}

static inline int needs_iteration(const progress *now)
{
  return now->pending;
}

/* Trajectories that converge too slowly or left the domain become inactive. */
static inline void take_change(progress *now, lanes change, const solver_options *options, int k, solver_report *report)
{
  const lane_view after = {change}, last = {now->last}, before = {now->before};
  const solver_options wanted = *options; /* a copy, which cannot alias what is written */
  double *active = report->active;
  int pending = 0;
  for (int j = 0; j < LANES; j++) {
    const int status = iteration_status(after.lane[j], last.lane[j], before.lane[j], &wanted, k);
    active[j] = status < 0 ? 0.0 : active[j];
    pending += (active[j] > 0.0) & (status == 0);
  }
  now->pending = pending > 0;
  now->first = k == 0 ? change : now->first;
  now->before = now->last;
  now->last = change;
  report->iterations++;
}

/* Trajectories whose iteration stagnates are left to the solver of single trajectories. */
static inline int must_amplify(const progress *now, const solver_options *options, int k)
{
  (void)now, (void)options, (void)k;
  return 0;
}

#define AMPLIFICATION 0.0

static inline int outcome(const progress *now, const solver_report *report)
{
  (void)now, (void)report;
  return OK;
}

static inline int accept(const step_data *step, const lanes *dq, const lanes *dp, const solver_report *report)
{
  (void)step, (void)dq, (void)dp, (void)report;
  return 1;
}

static inline long long next_guess(long long steps, const progress *now, const solver_report *report)
{
  const lane_view view = {now->first};
  double largest = 0.0;
  for (int j = 0; j < LANES; j++)
    largest = report->active[j] > 0.0 ? larger(view.lane[j], largest) : largest;
  return steps_to_continue(steps, largest);
}

#endif
