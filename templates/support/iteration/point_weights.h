#include "convergence.h"

/* Quadrature weights times h, constant during a run. Requires: the tables; with damping, damped_points.h. */
typedef struct {
  weight position_weight[GROUPS], momentum_weight[GROUPS]; /* h beta, h w: the same rounded numbers everywhere */
#ifdef DAMPED
  damping_data damping;
#endif
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  for (int n = 0; n < GROUPS; n++) {
    data->position_weight[n] = step->h * POSITION_WEIGHT[n];
    data->momentum_weight[n] = step->h * MOMENTUM_WEIGHT[n];
  }
#ifdef DAMPED
  prepare_damping(step, &data->damping);
#endif
}

/* Values at the points times the weights. */
static inline void scale(const weight *weights, lanes (*x)[M], lanes (*scaled)[M])
{
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      scaled[n][i] = weights[n] * x[n][i];
}

#ifndef ARRAYS
/* 1 / the size of x at both ends of the step, which makes its changes relative, or `absolute`; groups of points are
 * `apart` elements apart. */
static inline void measure_ends(const lanes *x, int apart, const solver_options *options, real absolute,
    number *inverse_size)
{
  for (int i = 0; i < M; i++)
    inverse_size[i] = magnitude(at_first(&x[i])) + magnitude(at_last(&x[i], apart));
  invert_sizes(options, absolute, inverse_size);
}
#endif
