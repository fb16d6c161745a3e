#ifndef SUPPORT_ARRAY_HAMILTONIAN_ITERATION_H
#define SUPPORT_ARRAY_HAMILTONIAN_ITERATION_H

#include "../core/progress.h"
#include "../iteration/one_trajectory.h"
#include "../iteration/point_weights.h"
#include "arrays.h"

/* Fixed-point iteration of a step of an array Hamiltonian system, with the equations of hamiltonian_iteration.h.
 * Since one function computes all rates from terms that contain positions and momenta, both are updated together
 * (Jacobi), not in turn. Requires: one_trajectory.h, point_weights.h, the tables, forces_at, which
 * computes the rates at the points: -H_q of the momenta, then H_p of the positions. Momenta follow positions in
 * memory. */

#define SUDDEN_GROWTH 1e20 /* of the largest coordinate in one iteration: a larger one changes the whole state */
#define KEPT_FIRST(apart) ((apart) / 2) /* velocities follow forces */

/* Positions or momenta: the state and the points; their rates, a table and weights; the largest size so far. */
typedef struct {
  const double *start, *carry;
  lanes *y;
  const lanes *rates, *table, *end, *weights;
  double largest;
} half_state;

/* Rates of coordinate i at the points times the weights. */
static inline void weighted_rates(const half_state *of, long long apart, long long i, lanes *scaled)
{
  for (int g = 0; g < GROUPS; g++)
    scaled[g] = of->weights[g] * of->rates[g * apart + i];
}

/* Updates y from its rates; returns the mean of the squared changes relative to the size of each coordinate. */
static double improve(const step_data *step, half_state *of, const solver_options *options)
{
  const double before = of->largest, least = LEAST_SIZE * before + DBL_MIN;
  double change;
  sums all;
  begin_blocks(&all, step);
  EACH_BLOCK (all) {
    lanes total = lanes_of(0.0), increment[GROUPS], scaled[GROUPS];
    double largest = 0.0;
    for (long long i = all.here.first; i < all.here.end; i++) {
      double size, inverse;
      weighted_rates(of, 2 * step->n, i, scaled);
      for (int g = 0; g < GROUPS; g++)
        increment[g] = contribution_of_points(of->table, g, scaled, 1);
      size = fabs(of->start[i]) + fabs(at_point(increment, 1, POINTS - 1));
      inverse = options->absolute ? 1.0 : 1.0 / (size + least);
      largest = larger(largest, size);
      for (int g = 0; g < GROUPS; g++) {
        lanes *y = &of->y[g * 2 * step->n + i];
        const lanes x = of->start[i] + (of->carry[i] + increment[g]), moved = inverse * (x - *y);
        total += moved * moved;
        *y = x;
      }
    }
    add_block(&all, lanes_total(total), largest);
  }
  meet(step);
  change = sum_of(&all, 0) / (options->absolute ? 1.0 : (double)step->n);
  of->largest = largest_over(&all, 1);
  return of->largest > SUDDEN_GROWTH * before ? 1.0 : change;
}

/* Computes increments of positions or momenta at the end of the step. */
static void find_increments(const step_data *step, const half_state *of, double *increment)
{
  const section own = own_part(step);
  for (long long i = own.first; i < own.end; i++) {
    lanes scaled[GROUPS];
    weighted_rates(of, 2 * step->n, i, scaled);
    increment[i] = weigh_apart(of->end, scaled, 1);
  }
}

/* Computes the increments of one step: iterates until the points converge. Errors of positions become errors of momenta
 * in one iteration and back in the next, so that changes are judged in pairs. Starts from the rates of *steps former
 * steps; on success *steps is the number of steps for the next predictor. */
static int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report)
{
  const long long n = step->n;
  const section own = own_part(step);
  lanes *X = step->work->X;
  half_state q = {step->q0, step->carry_q, X, past.now + n, POSITION, POINT_END_POSITION, data->position_weight, 0.0};
  half_state p = {step->p0, step->carry_p, X + n, past.now, MOMENTUM, POINT_END_MOMENTUM, data->momentum_weight, 0.0};
  progress now = before_iterations();
  double last = 0.0;
  int status;
  for (int g = 0; g < GROUPS; g++)
    for (long long half = 0; half < 2 * n; half += n)
      for (long long i = half + own.first; i < half + own.end; i++)
        past.now[g * 2 * n + i] = extrapolated(step, past, *steps, g, i);
  for (int k = 0; needs_iteration(&now); k++) {
    const double of_q = improve(step, &q, options), both = of_q + improve(step, &p, options);
    forces_at(step, X, 2 * n, past.now);
    if (k > 0 && k % 2 == 0)
      take_change(&now, last + both, options, k / 2 - 1, report);
    last = both;
  }
  status = outcome(&now, report);
  if (status != OK)
    return status;
  find_increments(step, &q, dq);
  find_increments(step, &p, dp);
  memset(dq + n + own.first, 0, sizeof(double) * (size_t)(own.end - own.first));
  if (!accept(step, dq, dp, report))
    return NOT_FINITE;
  *steps = next_guess(*steps, &now, report);
  return OK;
}

#endif
