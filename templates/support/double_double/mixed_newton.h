#include "../newton/newton.h"
#include "pair_states.h"
#include "stage_pairs.h"

/* Step in double-double arithmetic by mixed precision (iterative refinement; Higham, Accuracy and Stability of
 * Numerical Algorithms, ch. 12). Newton's method solves the stage equations in double, to 1e-16; their residual in
 * pairs has 16 digits as one word, and is solved in double with the factors of the Jacobian at the solution. Each
 * correction gains up to 16 digits, so that two evaluations in pairs suffice; the second shows that they do. Requires:
 * evaluate_pairs, the rows in pairs. */

#define REFINED 1e-34 /* change by the last correction, relative to the state: momenta are those before it */
#define REFINED_ROUNDING 1e-24 /* changes that may be rounding errors, if they stop decreasing */
#define MOST_REFINEMENTS 8

/* Solves for a correction of the unknowns and adds it; returns its size relative to the state. */
static inline double correct_pairs(pair_equations *at, newton_data *data, const band *shape, const double *inverse_size)
{
  double change = 0.0;
  for (int i = 0; i < SITES; i++)
    for (int b = 0; b < B; b++)
      data->update[POSITION_IN_MATRIX[i] * B + b] = at->rows[i * (B + 1) + b].high;
  back_substitute(data->factors, shape, data->pivot, data->update);
  for (int i = 0; i < SITES; i++)
    for (int b = 0; b < B; b++) {
      const double update = data->update[POSITION_IN_MATRIX[i] * B + b];
      at->z[i * B + b] = dd_add(at->z[i * B + b], dd_word(-update));
      if (!is_finite(update))
        return update;
      if (i < M && MOVES[b] != 0)
        change = larger(change, fabs(at->h.high * update) * inverse_size[i]);
    }
  return change;
}

#ifdef FIRST_ORDER_SYSTEM
/* Increments of y, whose high words dp has, from those of the momenta theta(q, y) in the rows. */
static inline int variable_pairs(const step_data *step, const pair_equations *at, const double *dq, double *dp)
{
  dd u[2 * M], theta[M];
  for (int i = 0; i < M; i++) {
    u[i] = dd_add(at->q0[i], dd_of(dq[i], dq[M + i]));
    u[M + i] = dd_word(step->p0[i] + (step->carry_p[i] + dp[i]));
    theta[i] = dd_add(at->p0[i], at->rows[i * (B + 1) + B]);
  }
  TRY(correct_transform(dd_add(at->t, at->h), u, theta, at->parameters, step->scratch));
  for (int i = 0; i < M; i++) {
    const dd change = dd_subtract(u[M + i], dd_of(step->p0[i], step->carry_p[i]));
    dp[i] = change.high, dp[M + i] = change.low;
  }
  return OK;
}
#endif

/* Replaces the increments of a step, solved in double, by those in two words, and its unknowns, which `memory` has. The
 * workspace then has the factors of the Jacobian at the former ones. On failure they are undefined. */
static int refine_unknowns(const step_data *step, double *memory, double t_low, double h_low, double *dq, double *dp,
    double *passed, double *workspace)
{
  newton_data *data = newton_in(workspace);
  const band shape = band_of(SITES, B);
  pair_equations at = {.t = dd_of(step->t, t_low), .h = dd_of(step->h, h_low), .parameters = step->parameters};
  double size_p[SITES], size_q[M], inverse_size[M], last = INFINITY;
  int widened = 0;
  for (int i = 0; i < M; i++) {
    at.q0[i] = dd_of(step->q0[i], step->carry_q[i]);
    at.p0[i] = dd_of(step->p0[i], step->carry_p[i]);
  }
#ifdef FIRST_ORDER_SYSTEM
  double theta[M];
  step_data with_momenta = *step;
  TRY(transform_of(at.t, at.q0, at.p0, at.parameters, at.p0));
  for (int i = 0; i < M; i++)
    theta[i] = at.p0[i].high;
  with_momenta.theta0 = theta;
  step = &with_momenta;
#endif
  memcpy(data->z, memory, sizeof(double) * N);
  evaluate(step, data->z, data->rows, size_p, size_q, data->factors, &shape);
  TRY(all_finite(data->rows, N + SITES) && all_finite(size_q, M) ? OK : NOT_FINITE);
  TRY(linearise(step, data, &shape) ? OK : SINGULAR);
  memcpy(memory + N, data->point, sizeof(double) * POINT);
  const double largest = largest_magnitude(size_q, M);
  for (int i = 0; i < M; i++)
    inverse_size[i] = 1.0 / (size_q[i] + 1e-3 * largest + DBL_MIN);
  for (int k = 0; k < N; k++)
    at.z[k] = dd_word(data->z[k]);
  for (int k = 0;; k++) {
    evaluate_pairs(&at);
    const double change = correct_pairs(&at, data, &shape, inverse_size);
    const int stagnates = !(change < last / 4);
    TRY(is_finite(change) ? OK : NOT_FINITE);
    if (change <= REFINED || (change <= REFINED_ROUNDING && stagnates))
      break;
    if (k + 1 >= MOST_REFINEMENTS)
      return NOT_CONVERGED;
    last = change;
    if (stagnates && !widened) { /* above the rounding of positions */
      widened = 1;
      add_sizes_of_arguments(step, data->z, size_q);
      for (int i = 0; i < M; i++)
        inverse_size[i] = 1.0 / (size_q[i] + 1e-3 * largest + DBL_MIN);
      last = 0.0;
    }
  }
  for (int k = 0; k < N; k++)
    memory[k] = at.z[k].high;
#ifdef TIME_TRANSFORMATION
  const dd duration = duration_of_pairs(&at);
  passed[0] = duration.high, passed[1] = duration.low;
#endif
#ifdef DAMPED
  shrink_pairs(&at);
#endif
  for (int i = 0; i < M; i++) {
    dd q = dd_of(0.0, 0.0);
    for (int b = 0; b < B; b++)
      q = dd_add(q, times_entry(END_POSITION[b], END_POSITION_LOW[b], at.z[i * B + b]));
    q = dd_multiply(at.h, q);
    dq[i] = q.high, dq[M + i] = q.low;
#ifndef FIRST_ORDER_SYSTEM
    const dd p = at.rows[i * (B + 1) + B];
    dp[i] = p.high, dp[M + i] = p.low;
#endif
  }
#ifdef FIRST_ORDER_SYSTEM
  TRY(variable_pairs(step, &at, dq, dp));
#endif
  return all_finite(dq, 2 * M) && all_finite(dp, 2 * M) ? OK : NOT_FINITE;
}
