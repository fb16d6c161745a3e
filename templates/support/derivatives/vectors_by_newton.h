#ifndef SUPPORT_VECTORS_BY_NEWTON_H
#define SUPPORT_VECTORS_BY_NEWTON_H

#include "jvp_and_vjp.h"

/* Tangent and adjoint vectors over steps solved by Newton's method. Requires: jvp_and_vjp.h. */

/* Steps and the vectors propagated over them, of shape (steps + 1, count, STEP_INPUTS). */
typedef struct {
  const real *t, *h, *q, *p, *parameters;
  const solver_options *options;
  int back, count;
  real *vectors, *q1, *p1, *workspace;
  solver_report *report;
  long long guess; /* number of previous steps that the predictor uses (fixed-point iteration only) */
  int look; /* first iteration of the linearised equations whose convergence is tested */
} propagation;

static step_data step_of(const propagation *over, long long k, const real *nothing)
{
  const step_data step = {over->t[k], over->h[k], over->q + k * M, over->p + k * M, nothing, nothing, over->parameters,
      over->workspace, 1, NULL};
  return step;
}

/* Vectors at the side of step k where the propagation starts; vectors_to: where it ends. */
static const real *vectors_from(const propagation *over, long long k)
{
  return over->vectors + (k + over->back) * over->count * STEP_INPUTS;
}

static real *vectors_to(const propagation *over, long long k)
{
  return over->vectors + (k + !over->back) * over->count * STEP_INPUTS;
}

/* Propagates the vectors from index `first` on over step k. */
static int vectors_by_newton(propagation *over, long long k, int first)
{
  const real nothing[M] = {0};
  const step_data step = step_of(over, k, nothing);
  linearised_step at = linearised_in(&step, over->workspace);
  int status;
  over->report->t = step.t;
  status = linearise_step(&at, over->options, over->q1 ? over->q1 + k * M : NULL, over->q1 ? over->p1 + k * M : NULL,
      over->report);
  over->guess = 0;
  if (status == OK)
    status = propagate_vectors(&at, over->back, over->count - first, vectors_from(over, k) + first * STEP_INPUTS,
        vectors_to(over, k) + first * STEP_INPUTS);
  return status;
}

#endif
