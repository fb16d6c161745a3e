#ifndef SUPPORT_ARRAY_STEP_H
#define SUPPORT_ARRAY_STEP_H

#include "../step_size/observed_error.h"
#include "arrays.h"

/* Runs of array systems whose steps are solved by iteration. Requires: prepare and solve of a solver,
 * observed_error.h. */

static step_data step_of(const run_memory *run, const problem *given, long long n)
{
  const step_data step = {.t = run->t,
      .h = run->h,
      .q0 = run->q,
      .p0 = run->p,
      .carry_q = run->carry_q,
      .carry_p = run->carry_p,
      .scratch = run->work + (STATUS(WORK) - SCRATCH_VECTORS) * n,
      .run = run,
      .given = given,
      .n = n};
  return step;
}

/* Increments of q, their low words and increments of p. */
static double *increments_in(const step_data *step)
{
  return step->scratch + 11 * step->n;
}

/* Advances the state to the end of a solved step. */
static void continue_steps(run_memory *run, const step_data *step, const double *dq, const double *dp)
{
  const section own = own_part(step);
  for (long long i = own.first; i < own.end; i++) {
    add_compensated(&run->q[i], &run->carry_q[i], dq[i], dq[step->n + i]);
    add_compensated(&run->p[i], &run->carry_p[i], dp[i], 0.0);
  }
  run->turn = (run->turn + 1) % 3;
}

/* Performs a step of the same size as the previous one. */
static int perform_step(run_memory *run, const problem *given, long long n, const solver_options *options,
    solver_report *report)
{
  step_data step = step_of(run, given, n);
  double *const dq = increments_in(&step), *const dp = dq + 2 * n;
  solver_data data;
  int status;
  prepare(&step, &data);
  status = solve(&step, &data, history_in(&step), &run->guess, dq, dp, options, report, NULL);
  if (status != OK)
    return status;
  status = observe_error(run, &step, &data, dq, dp, options, NULL);
  if (status == OK)
    continue_steps(run, &step, dq, dp);
  else
    run->guess = 0;
  return status;
}

#endif
