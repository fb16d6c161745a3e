#ifndef SUPPORT_VECTORS_BY_ITERATION_H
#define SUPPORT_VECTORS_BY_ITERATION_H

#include "vectors_by_newton.h"

/* Tangent and adjoint vectors over steps that are solved by fixed-point iteration. Blocks of STEPS_AT_ONCE steps are
 * solved first, each with a predictor from the previous one; then the vectors are propagated, forward or backward.
 * Requires: vectors_by_newton.h, which takes over where an iteration fails; iteration, store_step, linearise_points,
 * jvp_by_iteration and vjp_by_iteration, the iteration and its linearisation. */

static double *stored_of(const propagation *over, long long k)
{
  return over->workspace + LINEARISED + k * STORED_OF_STEP;
}

/* Solves the step with the predictor, then without it. Returns 1 on success. */
static int solve_by_iteration(propagation *over, const step_data *step, const iteration_data *data, double *dq,
    double *dp)
{
  for (int tries = over->guess > 0 ? 2 : 1; tries > 0; tries--) {
    if (fixed_point(step, data, over->workspace + SCRATCH, &over->guess, dq, dp, over->options, over->report) == OK)
      return 1;
    over->guess = 0;
  }
  return 0;
}

/* Solves steps first <= k < end; returns 0 if the iteration fails for one of them. */
static int solve_steps(propagation *over, long long first, long long end)
{
  const double nothing[M] = {0.0};
  for (long long k = first; k < end; k++) {
    const step_data step = step_of(over, k, nothing);
    double dq[2 * M] = {0.0}, dp[2 * M] = {0.0}; /* increments, then their low words */
    iteration_data data;
    prepare_iteration(&step, &data);
    over->report->t = step.t;
    if (!solve_by_iteration(over, &step, &data, dq, dp))
      return 0;
    for (int i = 0; over->q1 && i < M; i++) {
      over->q1[k * M + i] = step.q0[i] + (dq[i] + dq[M + i]);
      over->p1[k * M + i] = step.p0[i] + (dp[i] + dp[M + i]);
    }
    store_step(&step, &data, over->workspace + SCRATCH, dq, dp, stored_of(over, k - first));
  }
  return 1;
}

/* Propagates the vectors over a solved step; returns the number propagated before an iteration failed. */
static int propagate_by_iteration(propagation *over, long long k, const double *kept)
{
  const double nothing[M] = {0.0}, *from = vectors_from(over, k);
  const step_data step = step_of(over, k, nothing);
  double *to = vectors_to(over, k);
  iteration_data data;
  iterated_step at;
  prepare_iteration(&step, &data);
  linearise_points(&step, &data, kept, &at);
  for (int j = 0; j < over->count; j++) {
    double v[STEP_INPUTS];
    memcpy(v, from + j * STEP_INPUTS, sizeof v);
    if ((over->back ? vjp_by_iteration : jvp_by_iteration)(&at, v, &over->look) != OK)
      return j;
    for (int i = 0; i < STEP_INPUTS; i++)
      to[j * STEP_INPUTS + i] += v[i];
  }
  return over->count;
}

/* Propagates the vectors over steps first <= k < end. */
static int propagate_steps(propagation *over, long long first, long long end)
{
  int iterated, status = OK;
  over->guess = over->back ? 0 : over->guess;
  iterated = solve_steps(over, first, end);
  for (long long done = 0; status == OK && done < end - first; done++) {
    const long long k = over->back ? end - 1 - done : first + done;
    const int carried = iterated ? propagate_by_iteration(over, k, stored_of(over, k - first)) : 0;
    if (carried < over->count)
      status = vectors_by_newton(over, k, carried);
    else if (!all_finite(vectors_to(over, k), over->count * STEP_INPUTS))
      status = NOT_FINITE;
    over->report->steps += status == OK;
  }
  return status;
}

#endif
