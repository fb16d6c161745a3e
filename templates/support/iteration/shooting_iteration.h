#include "../core/progress.h"
#include "curve.h"
#include "mass_matrix.h"

/* Fixed-point iteration of a step of a shooting-based variational method (SCVI; Li, Wu & Leok, eqs. (33)-(34), in the
 * stationary form, with multipliers of the collocation equations). Requires: the tables, the kernels node_lanes and
 * action_lanes. */
#define ROUNDING_MARGIN 0.25 /* after one converged iteration, variations are rounding errors and do not decrease */

typedef struct {
  lanes weight; /* h w */
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  data->weight = step->h * POINT_WEIGHT;
}

/* p1 - p0 from the forces at the points and the gradient of m . E at the nodes. */
static inline double momentum_increment(const step_data *step, const iteration_data *data, lanes force,
    lanes derivative)
{
  return lanes_total(data->weight * force) + step->h * (step->h * lanes_total(NODE_MASK * derivative));
}

/* E, (m . E)_q, (m . E)_v and the mass at the nodes. */
static inline void evaluate_nodes(const step_data *step, const curve_data *curve, const lanes *m, lanes *node,
    lanes *mass)
{
  lanes u[4 * M];
  place_nodes(step, curve, u);
  for (int i = 0; i < M; i++) {
    u[2 * M + i] = curve->z[0][i] / step->h;
    u[3 * M + i] = m[i];
  }
  if (!DIAGONAL)
    memset(mass, 0, sizeof(lanes) * MASS);
  node_lanes(u, step->t + step->h * NODE_TIME, step->parameters, node, mass);
}

/* L_q and L_v at the points. */
static inline void evaluate_points(const step_data *step, const curve_data *curve, lanes *action)
{
  lanes u[2 * M];
  place_points(step, curve, u);
  action_lanes(u, step->t + step->h * POINT_TIME, step->parameters, action);
}

#ifdef RUN_ACTION
/* h sum w L. Requires: the kernel integrand_lanes. */
static inline double action_of_curve(const step_data *step, const iteration_data *data, const curve_data *curve)
{
  lanes u[2 * M], value;
  place_points(step, curve, u);
  integrand_lanes(u, step->t + step->h * POINT_TIME, step->parameters, &value);
  return lanes_total(data->weight * value);
}
#endif

/* Computes the increments of one step: accelerations, momentum, initial velocity and multipliers m are corrected in
 * turn until all converge. On failure the increments are undefined. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report)
{
  curve_data curve;
  lanes m[M], node[3 * M], action[2 * M], mass[MASS];
  const double h = step->h;
  double inverse_size[M] = {0.0};
  progress now = before_iterations();
  int settled = 0;
  TRY(first_curve(step, past, *steps, &curve));
  for (int i = 0; i < M; i++)
    m[i] = lanes_of(0.0);
  if (*steps > 0)
    memcpy(m, past + CURVE_MEMORY, sizeof m);
  for (int k = 0; needs_iteration(&now); k++) {
    lanes change = lanes_of(0.0), r[M], gamma[M], corrected[M];
    double total, misfit[M], last = now.last, before = now.before;
    evaluate_nodes(step, &curve, m, node, mass);
    factor_mass(mass);
    for (int i = 0; i < M; i++)
      r[i] = h * node[i];
    solve_mass(mass, r);
    for (int i = 0; i < M; i++) {
      corrected[i] = -r[i];
      curve.z[0][i] += corrected[i];
    }
    if (k == 0)
      measure_curve(step, &curve, options, inverse_size);
    for (int i = 0; i < M; i++) {
      const lanes moved = r[i] * inverse_size[i];
      change += moved * moved;
    }
    evaluate_points(step, &curve, action);
    for (int i = 0; i < M; i++) {
      const double p1 = step->p0[i] + (step->carry_p[i] + momentum_increment(step, data, action[i], node[M + i]));
      gamma[i] = apply_to(POINT_POSITION_T, data->weight * action[i]) +
          apply_to(POINT_VELOCITY_T, POINT_WEIGHT * action[M + i]) +
          h * (node[2 * M + i] + h * apply_to(COLLOCATION_T, node[M + i])) - NODE_END * p1;
      misfit[i] = lanes_total(NODE_MASK * gamma[i]);
      r[i] = apply_to(COLLOCATION_T, gamma[i] - NODE_CONSISTENCY * misfit[i]);
    }
    total = correct_velocity(mass, misfit, inverse_size, curve.v0);
    solve_mass(mass, r);
    for (int i = 0; i < M; i++) {
      const lanes moved = (r[i] + m[i]) * inverse_size[i];
      change += moved * moved;
      m[i] = -r[i];
    }
    total += lanes_total(change);
    take_change(&now, total, options, k, report);
    if (is_stagnant(&now, options, k))
      measure_by_largest(stagnant(&now), inverse_size);
    if (must_amplify(&now, options, k))
      for (int i = 0; i < M; i++)
        curve.z[0][i] += AMPLIFICATION * corrected[i];
    if (settled && now.status == 0) {
      now.status = is_small_remainder(total, last, before, options, ROUNDING_MARGIN, FINAL_ITERATIONS);
    } else if (now.status > 0 && !settled) { /* one more iteration: the convergence rate is known late */
      settled = 1;
      now.status = 0;
    }
  }
  TRY(outcome(&now, report));
  evaluate_nodes(step, &curve, m, node, mass);
  evaluate_points(step, &curve, action);
  end_increment(step, &curve, dq);
  for (int i = 0; i < M; i++)
    dp[i] = momentum_increment(step, data, action[i], node[M + i]);
  TRY(accept(step, dq, dp));
  save_curve(&curve, past);
  memcpy(past + CURVE_MEMORY, m, sizeof m);
#ifdef RUN_ACTION
  past[MEMORY - 1] = action_of_curve(step, data, &curve);
#endif
  *steps = next_guess(*steps, &now, report);
  return OK;
}

#ifdef RUN_ACTION
/* Action of a solved step, which `memory` contains. */
static inline void integrals_of_iteration(const step_data *step, const iteration_data *data, const double *memory,
    double *sum)
{
  *sum = memory[MEMORY - 1];
}
#endif
