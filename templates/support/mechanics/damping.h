#include "../core/step.h"

/* Uniform damping at a rate gamma, from the Lagrangian e^(gamma t) L: point n is weighted by e^(gamma c_n h), c_n h the
 * time since the step began, and the sums then give e^(gamma h) p1. Since time is measured from the start of each step,
 * no factor grows from step to step. Requires: real, M, step.h, the kernel damping. */
#define DAMPED

/* gamma h. */
static inline real growth_of(const step_data *step)
{
  real rate;
  damping(NULL, step->t, step->parameters, &rate);
  return rate * step->h;
}

/* Weights of the points with the damping factor. */
static inline void grown_weights(const step_data *step, int points, const real *abscissa, const real *weight,
    real *grown)
{
  const real growth = growth_of(step);
  for (int n = 0; n < points; n++)
    grown[n] = weight[n] * MATH(exp)(growth * abscissa[n]);
}

/* p1 - p0 from e^(gamma h) p1 - p0. */
static inline void shrink(const step_data *step, real *dp)
{
  const real growth = growth_of(step), factor = MATH(exp)(-growth), loss = MATH(expm1)(-growth);
  for (int i = 0; i < M; i++)
    dp[i] = factor * dp[i] + loss * (step->p0[i] + step->carry_p[i]);
}
