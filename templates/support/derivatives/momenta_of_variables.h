#include "linear_maps.h"

/* Linearised momenta theta(q, y, parameters, t) of a first-order system, whose state is (q, y): entry e of
 * MOMENTUM_DERIVATIVE, {i, j}, is the derivative of theta_i with respect to input j. Requires: the kernel
 * momentum_derivatives, THETA_DERIVATIVES, the number of entries, newton_solver.h. */

/* Derivatives at the start and at the end of a step; factors of theta_y at the end and pivots; theta at the start. */
typedef struct {
  real start[THETA_DERIVATIVES], end[THETA_DERIVATIVES], factors[M * M], pivot[M], theta[M];
} momentum_factors;

static const band ALL_MOMENTA = {.rows = M, .reach = M - 1, .stride = M, .first = 0};

/* Computes the derivatives at the ends of the step, and the factors. */
static int linearise_momenta(const step_data *step, const real *q1, const real *y1, momentum_factors *in)
{
  real u[2 * M];
  memcpy(u, step->q0, sizeof(real) * M);
  memcpy(u + M, step->p0, sizeof(real) * M);
  momentum_derivatives(u, step->t, step->parameters, in->start);
  memcpy(u, q1, sizeof(real) * M);
  memcpy(u + M, y1, sizeof(real) * M);
  momentum_derivatives(u, step->t + step->h, step->parameters, in->end);
  memset(in->factors, 0, sizeof(real) * M * M);
  for (int e = 0; e < THETA_DERIVATIVES; e++) {
    const int i = MOMENTUM_DERIVATIVE[e][0], j = MOMENTUM_DERIVATIVE[e][1] - M;
    if (j >= 0 && j < M)
      in->factors[j * M + i] = in->end[e];
  }
  return factorise(in->factors, &ALL_MOMENTA, in->pivot) ? OK : SINGULAR;
}

/* From (q, y, parameters, t) to the momenta, in the place of y; back: the transpose. */
static void momenta_wide(const momentum_factors *in, int back, wide *v)
{
  wide theta[M];
  memcpy(theta, v + M, sizeof theta);
  if (!back)
    memset(theta, 0, sizeof theta);
  else
    memset(v + M, 0, sizeof theta);
  for (int e = 0; e < THETA_DERIVATIVES; e++)
    propagate(back, theta + MOMENTUM_DERIVATIVE[e][0], in->start[e], v + MOMENTUM_DERIVATIVE[e][1]);
  if (!back)
    memcpy(v + M, theta, sizeof theta);
}

/* From the momenta at the end of the step to y; back: the transpose. */
static void variables_wide(const momentum_factors *in, int back, wide *v)
{
  if (back)
    solve_wide(in->factors, &ALL_MOMENTA, in->pivot, 1, v + M);
  for (int e = 0; e < THETA_DERIVATIVES; e++) {
    const int j = MOMENTUM_DERIVATIVE[e][1];
    if (j < M || j >= 2 * M)
      propagate(back, v + M + MOMENTUM_DERIVATIVE[e][0], -in->end[e], v + j);
  }
  if (!back)
    solve_wide(in->factors, &ALL_MOMENTA, in->pivot, 0, v + M);
}
