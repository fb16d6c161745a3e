#include "curve.h"

/* Fixed-point iteration of a collocation method, z_n = h a(q_n, v_n) on the curve of curve.h. The momenta at the ends
 * are quadratures of the action (NODES) or Legendre transforms. */
#ifdef NODES
/* Momenta at both ends of a curve by quadrature of the action; p0 determines the initial velocity. Requires: the tables
 * of the contributions of the points to p0 and p1, the kernel action_lanes. */
typedef struct {
  lanes start, end; /* h times the weights of forces */
} iteration_data;

static void prepare_iteration(const step_data *step, iteration_data *data)
{
  data->start = step->h * START_FORCE;
  data->end = step->h * END_FORCE;
}

/* Forces and momenta at the points. */
static inline void act(const step_data *step, const curve_data *curve, lanes *action)
{
  lanes u[2 * M];
  place_points(step, curve, u);
  action_lanes(u, step->t + step->h * POINT_TIME, step->parameters, action);
}

/* Corrects the initial velocity; returns the squared relative change. */
static inline double correct_start(const step_data *step, const iteration_data *data, const lanes *mass,
    const double *inverse_size, curve_data *curve)
{
  lanes action[2 * M];
  double misfit[M];
  act(step, curve, action);
  for (int i = 0; i < M; i++)
    misfit[i] =
        -(step->p0[i] + (step->carry_p[i] + lanes_total(data->start * action[i] + START_MOMENTUM * action[M + i])));
  return correct_velocity(mass, misfit, inverse_size, curve->v0);
}

/* p1 - p0 of a curve. */
static inline void momentum_increment(const step_data *step, const iteration_data *data, const curve_data *curve,
    const double *dq, double *dp)
{
  lanes action[2 * M];
  act(step, curve, action);
  for (int i = 0; i < M; i++)
    dp[i] = lanes_total(data->end * action[i] + END_MOMENTUM * action[M + i]);
}
#else
/* Momentum at the end of a curve by the Legendre transform of the velocity there; the initial velocity is known. */
typedef int iteration_data; /* not used */

#define prepare_iteration(step, data) (void)(*(data) = 0)
#define correct_start(step, data, mass, inverse_size, curve) 0.0

/* p1 - p0, with p1 the momentum at the end of a curve with the increment dq; NaN if it is undefined. */
static void momentum_increment(const step_data *step, const iteration_data *data, const curve_data *curve,
    const double *dq, double *dp)
{
  double u[2 * M];
  for (int i = 0; i < M; i++) {
    u[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    u[M + i] = end_velocity(curve, i);
  }
  if (find_momentum(step->t + step->h, u, u + M, step->parameters, dp, step->scratch) != OK)
    for (int i = 0; i < M; i++)
      dp[i] = NAN;
  for (int i = 0; i < M; i++)
    dp[i] = (dp[i] - step->p0[i]) - step->carry_p[i];
}
#endif

/* Step of a collocation method by fixed-point iteration. Requires: the momenta at the ends of a curve, the table
 * NODE_TIME, the kernel applied_force_lanes. */

/* Computes the increments of one step. Each iteration corrects the accelerations at the nodes and, where it is unknown,
 * the initial velocity. On failure the increments are undefined. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report)
{
  curve_data curve;
  lanes u[2 * M], force[M], mass[MASS];
  double inverse_size[M] = {0.0};
  progress now = before_iterations();
  TRY(first_curve(step, past, *steps, &curve));
  for (int k = 0; needs_iteration(&now); k++) {
    lanes change = lanes_of(0.0);
    double total;
    place_nodes(step, &curve, u);
    if (!DIAGONAL)
      memset(mass, 0, sizeof mass);
    applied_force_lanes(u, step->t + step->h * NODE_TIME, step->parameters, force, mass);
    factor_mass(mass);
    solve_mass(mass, force);
    for (int i = 0; i < M; i++) {
      const lanes z = step->h * force[i];
      force[i] = z - curve.z[0][i];
      curve.z[0][i] = z;
    }
    if (k == 0)
      measure_curve(step, &curve, options, inverse_size);
    for (int i = 0; i < M; i++) {
      const lanes moved = force[i] * inverse_size[i];
      change += moved * moved;
    }
    total = lanes_total(change);
    total += correct_start(step, data, mass, inverse_size, &curve);
    take_change(&now, total, options, k, report);
    if (is_stagnant(&now, options, k))
      measure_by_largest(stagnant(&now), inverse_size);
  }
  TRY(outcome(&now, report));
  end_increment(step, &curve, dq);
  momentum_increment(step, data, &curve, dq, dp);
  TRY(accept(step, dq, dp));
  save_curve(&curve, past);
  *steps = next_guess(*steps, &now, report);
  return OK;
}
