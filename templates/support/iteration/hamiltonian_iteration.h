#include "convergence.h"
#include "point_weights.h"

/* Fixed-point iteration of a step for any Hamiltonian H(q, p, t) (Li, Wu & Leok, eq. (35)). With the weights beta and
 * w, the velocities z and forces f at the points are updated in turn:
 *   q_n = q0 + h sum_j POSITION_nj beta_j z_j,      p_n = p0 + h sum_j MOMENTUM_nj w_j f_j,
 *   f_n = -H_q(q_n, p_n),                           z_n = H_p(q_n, p_n).
 * With JOINT_RATES both are evaluated at once, at the same (q_n, p_n): a fifth more iterations, each of which takes
 * little more than half the time if H_p and H_q have most operations in common. If that does not converge, they are
 * evaluated in turn. Requires: points.h or trajectories.h with what they require, point_weights.h, the tables, the
 * kernels velocity_lanes and force_lanes, and with JOINT_RATES rate_lanes. */

/* Values u at the points, from those at the start and their rates: start + (carry + sum_j TABLE_nj weight_j rate_j). */
static inline void integrate(const point_table table, const weight *weights, lanes (*rate)[M], const number *start,
    const number *carry, lanes (*u)[2 * M], int first)
{
  point_products scaled;
  store_products(weights, rate, &scaled);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      u[n][first + i] = start[i] + (carry[i] + sum_of_stored(table, n, scaled.of, i));
}

/* Positions at the points of the curve with velocities z. */
static inline void place(const step_data *step, const iteration_data *data, lanes (*z)[M], lanes (*u)[2 * M])
{
  integrate(POSITION, data->position_weight, z, step->q0, step->carry_q, u, 0);
}

/* Momenta at the points from the forces. */
static inline void push(const step_data *step, const iteration_data *data, lanes (*force)[M], lanes (*u)[2 * M])
{
  integrate(MOMENTUM, data->momentum_weight, force, step->p0, step->carry_p, u, M);
}

#ifdef MOVING_FRAME
#include "moving_frame.h"
#else

/* Forces at the points. */
static inline void forces(const step_data *step, lanes (*u)[2 * M], lanes (*force)[M])
{
  for (int n = 0; n < GROUPS; n++)
    force_lanes(u[n], step->t + step->h * ABSCISSA[n], step->parameters, force[n]);
}

#ifdef TURNS
/* Turns of bodies about axes of symmetry, q <- q g, p <- p g, g = exp(kappa h Pi_k e_k/2), after a step of the other
 * terms of H, with which they commute. Requires: TURNS, the kernels rotations and turn_lanes. */

/* Turns vectors x and y at the points. */
static inline void turn_vectors(const step_data *step, const double *g, lanes (*x)[M], lanes (*y)[M])
{
  for (int n = 0; n < GROUPS; n++) {
    lanes u[2 * M + 4 * TURNS], change[2 * M];
    for (int k = 0; k < 4 * TURNS; k++)
      u[2 * M + k] = lanes_of(g[k]);
    memcpy(u, x[n], sizeof x[n]);
    memcpy(u + M, y[n], sizeof y[n]);
    turn_lanes(u, lanes_of(step->t), step->parameters, change);
    for (int i = 0; i < M; i++) {
      x[n][i] += change[i];
      y[n][i] += change[M + i];
    }
  }
}

/* Adds the turns to the increments, and turns the values of this step and of the last one for the predictor. */
static inline void turn_step(const step_data *step, history past, lanes (*z)[M], lanes (*force)[M], double *dq,
    double *dp)
{
  lanes last[GROUPS][M], last_force[GROUPS][M], change[2 * M], end[2 * M + 4 * TURNS];
  double u[2 * M], g[4 * TURNS];
  for (int i = 0; i < M; i++) {
    const double q = step->q0[i] + (step->carry_q[i] + dq[i]), p = step->p0[i] + (step->carry_p[i] + dp[i]);
    end[i] = lanes_of(u[i] = q);
    end[M + i] = lanes_of(p);
    u[M + i] = step->h * p;
  }
  rotations(u, step->t, step->parameters, g);
  for (int k = 0; k < 4 * TURNS; k++)
    end[2 * M + k] = lanes_of(g[k]);
  turn_lanes(end, lanes_of(step->t), step->parameters, change);
  for (int i = 0; i < M; i++) {
    dq[i] += at_first(&change[i]);
    dp[i] += at_first(&change[M + i]);
  }
  turn_vectors(step, g, z, force);
  lanes_load(past, last);
  lanes_load(past + 2 * M * POINTS, last_force);
  turn_vectors(step, g, last, last_force);
  lanes_store(last, past);
  lanes_store(last_force, past + 2 * M * POINTS);
}
#endif

/* Forces at the converged velocities, which rates evaluated at once are already. */
static inline void converged_forces(const step_data *step, const iteration_data *data, lanes (*z)[M], lanes (*u)[2 * M],
    lanes (*force)[M], int joint)
{
  if (!joint) {
    place(step, data, z, u);
    forces(step, u, force);
  }
}

#ifndef POINTS
/* Stores the velocities and forces of the trajectories that converge before others. */
static __attribute__((noinline)) void keep_early(const step_data *step, const iteration_data *data, lanes (*z)[M],
    lanes (*u)[2 * M], lanes (*force)[M], int joint, progress *now, coordinates (*stored)[S])
{
  converged_forces(step, data, z, u, force, joint);
  store_early(now, z[0], stored[0][0]);
  store_early(now, force[0], stored[1][0]);
  mark_stored(now);
}
#endif

/* Computes the increments of one step: forces, momenta and velocities are updated in turn until momenta and velocities
 * converge; the increments follow from the forces there. Velocities and forces are stored for the predictor. On failure
 * the increments are undefined. */
static inline int iterate(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp, const solver_options *options, solver_report *report, int joint)
{
  coordinates own[2][GROUPS], *z = kept(past, own[0]), *force = kept(second_curve(past), own[1]);
  lanes u[GROUPS][2 * M], value[GROUPS][M], momentum[GROUPS][M];
  number velocity_size[M], momentum_size[M];
#ifndef POINTS
  coordinates stored[2][S];
#endif
  progress now = before_iterations();
  if (*steps > 0) {
    continue_curve(step, past, *steps, z);
    continue_curve(step, second_curve(past), *steps, force);
  } else {
    TRY(start_velocities(step, z));
    memset(force, 0, sizeof(coordinates) * GROUPS);
  }
  push(step, data, force, u);
  for (int k = 0; needs_iteration(&now); k++) {
    lanes before[GROUPS][M];
    point_sums change = {lanes_of(0.0)};
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++)
        before[n][i] = u[n][M + i];
    place(step, data, z, u);
#ifdef JOINT_RATES
    if (joint) {
      push(step, data, force, u);
      for (int n = 0; n < GROUPS; n++) {
        lanes rates[2 * M];
        rate_lanes(u[n], step->t + step->h * ABSCISSA[n], step->parameters, rates);
        for (int i = 0; i < M; i++) {
          value[n][i] = rates[i];
          force[n][i] = rates[M + i];
        }
      }
    } else
#endif
    {
      forces(step, u, force);
      push(step, data, force, u);
      for (int n = 0; n < GROUPS; n++)
        velocity_lanes(u[n], step->t + step->h * ABSCISSA[n], step->parameters, value[n]);
    }
    if (k == 0) {
      measure_ends(value[0], M, options, fabs(step->h), velocity_size);
      measure_ends(u[0] + M, 2 * M, options, 1.0, momentum_size);
    }
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++) {
        const lanes correction = value[n][i] - z[n][i], moved = correction * velocity_size[i];
        const lanes pushed = (u[n][M + i] - before[n][i]) * momentum_size[i];
        *sum_at(change, n) += CHANGES_OF(n) * (moved * moved + pushed * pushed);
        z[n][i] = value[n][i];
        value[n][i] = correction;
      }
    take_change(&now, total_of(change), options, k, report);
    if (is_stagnant(&now, options, k)) {
      measure_by_largest(stagnant(&now), velocity_size);
      measure_by_largest(stagnant(&now), momentum_size);
    }
    if (must_amplify(&now, options, k))
      for (int n = 0; n < GROUPS; n++)
        for (int i = 0; i < M; i++)
          z[n][i] += amplification(&now) * value[n][i];
#ifndef POINTS
    if (converge_early(&now))
      keep_early(step, data, z, u, force, joint, &now, stored);
#endif
  }
  TRY(outcome(&now, report));
  converged_forces(step, data, z, u, force, joint);
#ifndef POINTS
  restore_early(&now, stored[0][0], z[0]);
  restore_early(&now, stored[1][0], force[0]);
#endif
  scale(data->position_weight, z, value);
  scale(data->momentum_weight, force, momentum);
  for (int i = 0; i < M; i++) {
    dq[i] = weigh(POINT_END_POSITION, value, i);
    dp[i] = weigh(POINT_END_MOMENTUM, momentum, i);
  }
#ifdef TURNS
  turn_step(step, past, z, force, dq, dp);
#endif
  TRY(accept(step, dq, dp));
  remember_curve(z, past);
  remember_curve(force, second_curve(past));
  *steps = next_guess(*steps, &now, report);
  return OK;
}

HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, number *dq,
    number *dp, const solver_options *options, solver_report *report)
{
#ifdef JOINT_RATES
  if (*steps > 0 && iterate(step, data, past, steps, dq, dp, options, report, 1) == OK)
    return OK;
#endif
  return iterate(step, data, past, steps, dq, dp, options, report, 0);
}

#if defined(TIME_TRANSFORMATION) || defined(RUN_ACTION)
/* Integrals along a step solved by fixed-point iteration. Requires: the kernel integrand_lanes. */

/* Quadrature of the momenta at the converged velocities and forces, which `memory` contains. */
static inline void integrals_of_iteration(const step_data *step, const iteration_data *data, const double *memory,
    double *sum)
{
  lanes z[GROUPS][M], force[GROUPS][M], u[GROUPS][2 * M], value[INTEGRALS], part[INTEGRALS][GROUPS];
  lanes_load(memory, z);
  lanes_load(memory + 2 * M * POINTS, force);
  place(step, data, z, u);
  push(step, data, force, u);
  for (int n = 0; n < GROUPS; n++) {
    integrand_lanes(u[n], step->t + step->h * ABSCISSA[n], step->parameters, value);
    for (int k = 0; k < INTEGRALS; k++)
      part[k][n] = POINT_END_MOMENTUM[n] * (data->momentum_weight[n] * value[k]);
  }
  for (int k = 0; k < INTEGRALS; k++)
    sum[k] = points_total(part[k]);
}
#endif

#endif
