#ifndef SUPPORT_HAMILTONIAN_ITERATION_H
#define SUPPORT_HAMILTONIAN_ITERATION_H

#include "../core/progress.h"
#include "one_trajectory.h"
#include "point_weights.h"

/* Fixed-point iteration of a step for any Hamiltonian H(q, p, t) (Li, Wu & Leok, eq. (35)). With the weights beta and
 * w, the velocities z and forces f at the points are updated in turn:
 *   q_n = q0 + h sum_j POSITION_nj beta_j z_j,      p_n = p0 + h sum_j MOMENTUM_nj w_j f_j,
 *   f_n = -H_q(q_n, p_n),                           z_n = H_p(q_n, p_n).
 * With JOINT_RATES both are evaluated at once, at the same (q_n, p_n): a fifth more iterations, each of which takes
 * little more than half the time if H_p and H_q have most operations in common. If that does not converge, they are
 * evaluated in turn. Requires: one_trajectory.h, point_weights.h, the tables, the kernels velocity_lanes and
 * force_lanes, and with JOINT_RATES rate_lanes. */

/* Values u at the points, from those at the start and their rates: start + (carry + sum_j TABLE_nj weight_j rate_j). */
static inline void integrate(const lanes *table, const weight *weights, lanes (*rate)[M], const double *start,
    const double *carry, lanes (*u)[2 * M], int first)
{
  double scaled[M][POINTS] __attribute__((aligned(sizeof(lanes))));
  for (int i = 0; i < M; i++)
    for (int n = 0; n < GROUPS; n++) {
      const lanes value = weights[n] * rate[n][i];
      memcpy(scaled[i] + n * LANES, &value, sizeof value);
    }
  IN_MEMORY(scaled);
  for (int n = 0; n < GROUPS; n++)
    for (int i = 0; i < M; i++)
      u[n][first + i] = start[i] + (carry[i] + sum_over_points(table, n, scaled[i]));
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

/* 1 / the size of x at both ends of the step, which makes its changes relative, or `absolute`. */
static inline void measure_ends(lanes (*x)[M], const solver_options *options, double absolute, double *inverse_size)
{
  for (int i = 0; i < M; i++)
    inverse_size[i] = fabs(at_start(x, i)) + fabs(at_end(x, i));
  invert_sizes(options, absolute, inverse_size);
}

#ifdef MOVING_FRAME
/* Kernels have u = (Q, tau P) as arguments in place of (q, p), tau = t - t0 - h/2, and compute H_p / tau. */
static inline lanes frame_time(const step_data *step, int n)
{
  return step->h * (ABSCISSA[n] - 0.5);
}

static inline lanes *arguments(const step_data *step, int n, const lanes *u, lanes *at)
{
  for (int i = 0; i < M; i++) {
    at[i] = u[i];
    at[M + i] = frame_time(step, n) * u[M + i];
  }
  return at;
}

static inline void rescale(const step_data *step, int n, lanes *velocity)
{
  for (int i = 0; i < M; i++)
    velocity[i] *= frame_time(step, n);
}

/* Sizes of quaternions in place of their components. */
static inline void measure_quaternions(lanes (*u)[2 * M], int first, const solver_options *options, double unit,
    double *inverse_size)
{
  for (int i = 0; i < M; i += 4) {
    double square = DBL_MIN;
    for (int j = first + i; j < first + i + 4; j++)
      square += at_point(&u[0][j], 0, 0) * at_point(&u[0][j], 0, 0);
    for (int j = i; j < i + 4; j++)
      inverse_size[j] = options->absolute ? unit : 0.5 * unit / sqrt(square);
  }
}
#else
#define arguments(step, n, u, at) ((void)(at), (u))
#define rescale(step, n, velocity)
#endif

/* Forces at the points. */
static inline void forces(const step_data *step, lanes (*u)[2 * M], lanes (*force)[M])
{
  lanes at[2 * M];
  for (int n = 0; n < GROUPS; n++)
    force_lanes(arguments(step, n, u[n], at), step->t + step->h * ABSCISSA[n], step->parameters, force[n]);
}

#ifdef TURNS
/* Rotations of bodies, q <- q g, p <- p g, after a step of the other terms of H: turns about axes of symmetry, with
 * which they commute, and with MOVING_FRAME the second half of the free rotation, the first of which is at the start.
 * Requires: TURNS, the kernels rotations and turn_lanes. */
enum { ROTATION = 4 * TURNS };

/* Rotates vectors x and y at the points. */
static inline void turn_vectors(const step_data *step, const double *g, lanes (*x)[M], lanes (*y)[M])
{
  for (int n = 0; n < GROUPS; n++) {
    lanes u[2 * M + ROTATION], change[2 * M];
    for (int k = 0; k < ROTATION; k++)
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

/* sum = x + y, rounded; returns the rest. */
static inline double rest_of_sum(double x, double y, double *sum)
{
  const double total = x + y, part = total - x;
  *sum = total;
  return (x - (total - part)) + (y - part);
}

/* (|g|^2 - 1)/2 of d = g - 1, whose rounding errors are the same in every step: sums of products without rounding. */
static inline double excess(const double *d)
{
  double sum = 2.0 * d[0], rest = 0.0;
  for (int k = 0; k < 4; k++) {
    const double square = d[k] * d[k];
    rest += fma(d[k], d[k], -square) + rest_of_sum(sum, square, &sum);
  }
  return 0.5 * (sum + rest);
}

/* Computes the rotations at the state (q, p), and adds its change by those from index k on, in two words. */
static inline void turn_state(const step_data *step, const double *q, const double *p, int k, double *g, double *dq,
    double *dp)
{
  double u[2 * M];
  lanes state[2 * M + ROTATION], change[2 * M];
  for (int i = 0; i < M; i++) {
    state[i] = lanes_of(u[i] = q[i]);
    state[M + i] = lanes_of(p[i]);
    u[M + i] = step->h * p[i];
  }
  rotations(u, step->t, step->parameters, g);
  for (int j = 0; j < ROTATION; j++)
    state[2 * M + j] = lanes_of(g[k + j]);
  turn_lanes(state, lanes_of(step->t), step->parameters, change);
  for (int i = 0; i < M; i++) {
    const double of_q = at_first(&change[i]), of_p = at_first(&change[M + i]);
#ifdef MOVING_FRAME
    const double longer = excess(g + k + i / 4 * 4);
    dq[M + i] += rest_of_sum(dq[i], of_q, &dq[i]) - longer * (q[i] + of_q);
    dp[M + i] += rest_of_sum(dp[i], of_p, &dp[i]) - longer * (p[i] + of_p);
#else
    dq[i] += of_q;
    dp[i] += of_p;
#endif
  }
}

/* Adds the rotations to the increments, and rotates the values of this step and of the last one for the predictor. */
static inline void turn_step(const step_data *step, history past, lanes (*z)[M], lanes (*force)[M], double *dq,
    double *dp)
{
  lanes last[GROUPS][M], last_force[GROUPS][M];
  double q[M], p[M], g[3 * ROTATION];
#ifdef MOVING_FRAME
  const double *next = g + ROTATION;
#else
  const double *next = g;
#endif
  for (int i = 0; i < M; i++) {
    q[i] = step->q0[i] + (step->carry_q[i] + dq[i]);
    p[i] = step->p0[i] + (step->carry_p[i] + dp[i]);
  }
  turn_state(step, q, p, 0, g, dq, dp);
  turn_vectors(step, next, z, force);
  lanes_load(past, last);
  lanes_load(past + 2 * M * POINTS, last_force);
  turn_vectors(step, next, last, last_force);
  lanes_store(last, past);
  lanes_store(last_force, past + 2 * M * POINTS);
}
#endif

#ifdef MOVING_FRAME
/* State in the moving frame, after half of the free rotation, and its change in two words. */
typedef struct {
  double q[M], p[M], carry_q[M], carry_p[M], dq[2 * M], dp[2 * M];
} frame_state;

static inline step_data into_frame(const step_data *step, frame_state *to)
{
  step_data moving = *step;
  double g[3 * ROTATION];
  memset(to->dq, 0, sizeof to->dq);
  memset(to->dp, 0, sizeof to->dp);
  turn_state(step, step->q0, step->p0, 2 * ROTATION, g, to->dq, to->dp);
  for (int i = 0; i < M; i++) {
    to->carry_q[i] = step->carry_q[i] + (rest_of_sum(step->q0[i], to->dq[i], &to->q[i]) + to->dq[M + i]);
    to->carry_p[i] = step->carry_p[i] + (rest_of_sum(step->p0[i], to->dp[i], &to->p[i]) + to->dp[M + i]);
  }
  moving.q0 = to->q, moving.p0 = to->p, moving.carry_q = to->carry_q, moving.carry_p = to->carry_p;
  return moving;
}
#endif

/* Computes the increments of one step: forces, momenta and velocities are updated in turn until momenta and velocities
 * converge; the increments follow from the forces there. Velocities and forces are stored for the predictor. On failure
 * the increments are undefined. */
static inline int iterate(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report, int joint)
{
  lanes z[GROUPS][M], force[GROUPS][M], u[GROUPS][2 * M], value[GROUPS][M], momentum[GROUPS][M];
  double velocity_size[M], momentum_size[M];
  progress now = before_iterations();
  int status = OK;
#ifdef MOVING_FRAME
  frame_state start;
  const step_data moving = into_frame(step, &start), *fixed = step;
  step = &moving;
#endif
  if (*steps > 0) {
    continue_curve(step, past, *steps, z);
    continue_curve(step, past + 2 * M * POINTS, *steps, force);
  } else {
#ifdef MOVING_FRAME
    memset(z, 0, sizeof z);
#else
    status = start_velocities(step, z);
#endif
    memset(force, 0, sizeof force);
  }
  if (status != OK)
    return status;
  push(step, data, force, u);
  for (int k = 0; needs_iteration(&now); k++) {
    lanes change = lanes_of(0.0), before[GROUPS][M];
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++)
        before[n][i] = u[n][M + i];
    place(step, data, z, u);
#ifdef JOINT_RATES
    if (joint) {
      push(step, data, force, u);
      for (int n = 0; n < GROUPS; n++) {
        lanes rates[2 * M], at[2 * M];
        rate_lanes(arguments(step, n, u[n], at), step->t + step->h * ABSCISSA[n], step->parameters, rates);
        rescale(step, n, rates);
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
      for (int n = 0; n < GROUPS; n++) {
        lanes at[2 * M];
        velocity_lanes(arguments(step, n, u[n], at), step->t + step->h * ABSCISSA[n], step->parameters, value[n]);
        rescale(step, n, value[n]);
      }
    }
    if (k == 0) {
#ifdef MOVING_FRAME
      measure_quaternions(u, 0, options, fabs(step->h), velocity_size);
      measure_quaternions(u, M, options, 1.0, momentum_size);
#else
      for (int n = 0; n < GROUPS; n++)
        for (int i = 0; i < M; i++)
          momentum[n][i] = u[n][M + i];
      measure_ends(value, options, fabs(step->h), velocity_size);
      measure_ends(momentum, options, 1.0, momentum_size);
#endif
    }
    for (int n = 0; n < GROUPS; n++)
      for (int i = 0; i < M; i++) {
        const lanes correction = value[n][i] - z[n][i], moved = correction * velocity_size[i];
        const lanes pushed = (u[n][M + i] - before[n][i]) * momentum_size[i];
        change += moved * moved + pushed * pushed;
        z[n][i] = value[n][i];
        value[n][i] = correction;
      }
    take_change(&now, total_change(change), options, k, report);
    if (must_amplify(&now, options, k))
      for (int n = 0; n < GROUPS; n++)
        for (int i = 0; i < M; i++)
          z[n][i] += amplification(&now) * value[n][i];
  }
  status = outcome(&now, report);
  if (status != OK)
    return status;
  if (!joint) {
    place(step, data, z, u);
    forces(step, u, force);
  }
  scale(data->position_weight, z, value);
  scale(data->momentum_weight, force, momentum);
  for (int i = 0; i < M; i++) {
    dq[i] = weigh(POINT_END_POSITION, value, i);
    dp[i] = weigh(POINT_END_MOMENTUM, momentum, i);
  }
#ifdef MOVING_FRAME
  for (int i = 0; i < M; i++)
    dq[M + i] = dp[M + i] = 0.0;
#endif
#ifdef TURNS
  turn_step(step, past, z, force, dq, dp);
#endif
#ifdef MOVING_FRAME
  step = fixed;
  for (int i = 0; i < M; i++) {
    dq[M + i] += rest_of_sum(dq[i], start.dq[i], &dq[i]) + start.dq[M + i];
    dp[M + i] += rest_of_sum(dp[i], start.dp[i], &dp[i]) + start.dp[M + i];
  }
#endif
  if (!accept(step, dq, dp, report))
    return NOT_FINITE;
  remember_curve(z, past);
  remember_curve(force, past + 2 * M * POINTS);
  *steps = next_guess(*steps, &now, report);
  return OK;
}

HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report)
{
#ifdef JOINT_RATES
  if (*steps > 0 && iterate(step, data, past, steps, dq, dp, options, report, 1) == OK)
    return OK;
#endif
  return iterate(step, data, past, steps, dq, dp, options, report, 0);
}

#ifdef TIME_TRANSFORMATION
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
