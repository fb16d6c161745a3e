#include "../core/progress.h"
#include "hamiltonian_iteration.h"
#include "one_trajectory.h"
#include "point_weights.h"

/* Method in the moving frame of bodies with axes of symmetry: z = Phi_tau(Z) with their free rotation Phi,
 * tau = t - t0 - h/2, leaves the Hamiltonian V(Phi_tau(Z)) = W(Q, u), u = tau P. A step begins and ends with half of
 * the free rotation. With v = u/(4A), m = Im(conj(Q) v), y = |m|^2 and the functions S, C, D of y below, positions are
 * Q r, r = C + S m (products of quaternions). With g = V_q there, G = conj(Q) g and w = S Im(G) + (D Im(G) . m - S
 * Re(G)) m,
 *   W_u = Q w/(4A),      W_Q = g conj(r) - v w.
 * All rates at the points are updated together. Requires: hamiltonian_iteration.h, which includes this header, TURNS,
 * the number of bodies, the kernels frame_lanes and rotations. */

#define LARGEST_IN_SERIES 4.0 /* 2^2: angles up to which the series are correct to round-off */

/* of = (S, C - 1, D) for S = sin(x)/x, C = cos(x), D = (C - S)/y, x^2 = y. */
static inline void frame_functions(lanes y, lanes *of)
{
  const lanes y2 = y * y, y4 = y2 * y2;
  lane_view largest = {y};
#pragma GCC unroll 16
  for (int n = LANES / 2; n > 0; n /= 2)
    for (int j = 0; j < n; j++)
      largest.lane[j] = larger(largest.lane[j], largest.lane[n + j]);
  if (largest.lane[0] <= LARGEST_IN_SERIES) {
    const lanes a = y * (1.0 / 120.0) - 1.0 / 6.0, b = y * (1.0 / 362880.0) - 1.0 / 5040.0;
    const lanes c = y * (1.0 / 6227020800.0) - 1.0 / 39916800.0;
    const lanes d = y * (1.0 / 355687428096000.0) - 1.0 / 1307674368000.0;
    const lanes e = y * (1.0 / 51090942171709440000.0) - 1.0 / 121645100408832000.0;
    const lanes sine = (a + y2 * b) + y4 * ((c + y2 * d) + y4 * (e - y2 * (1.0 / 25852016738884976640000.0)));
    const lanes f = y * (4.0 / 120.0) - 2.0 / 6.0, g = y * (8.0 / 362880.0) - 6.0 / 5040.0;
    const lanes h = y * (12.0 / 6227020800.0) - 10.0 / 39916800.0;
    const lanes k = y * (16.0 / 355687428096000.0) - 14.0 / 1307674368000.0;
    const lanes l = y * (20.0 / 51090942171709440000.0) - 18.0 / 121645100408832000.0;
    of[2] = (f + y2 * g) + y4 * ((h + y2 * k) + y4 * (l - y2 * (22.0 / 25852016738884976640000.0)));
    of[0] = 1.0 + y * sine;
    of[1] = y * (sine + of[2]);
  } else
    for (int j = 0; j < LANES; j++) {
      const double square = at_point(&y, 0, j) + DBL_MIN, x = sqrt(square), half = sin(0.5 * x);
      ((lane_view *)&of[0])->lane[j] = sin(x) / x;
      ((lane_view *)&of[1])->lane[j] = -2.0 * half * half;
      ((lane_view *)&of[2])->lane[j] = (cos(x) - sin(x) / x) / square;
    }
}

/* z = x w for a vector w. */
static inline void times_vector(const lanes *x, const lanes *w, lanes *z)
{
  z[0] = -(x[1] * w[0] + x[2] * w[1] + x[3] * w[2]);
  z[1] = x[0] * w[0] + (x[2] * w[2] - x[3] * w[1]);
  z[2] = x[0] * w[1] + (x[3] * w[0] - x[1] * w[2]);
  z[3] = x[0] * w[2] + (x[1] * w[1] - x[2] * w[0]);
}

/* z = conj(x) y. */
static inline void conjugate_times(const lanes *x, const lanes *y, lanes *z)
{
  z[0] = (x[0] * y[0] + x[1] * y[1]) + (x[2] * y[2] + x[3] * y[3]);
  z[1] = (x[0] * y[1] - x[1] * y[0]) - (x[2] * y[3] - x[3] * y[2]);
  z[2] = (x[0] * y[2] - x[2] * y[0]) - (x[3] * y[1] - x[1] * y[3]);
  z[3] = (x[0] * y[3] - x[3] * y[0]) - (x[1] * y[2] - x[2] * y[1]);
}

/* Free rotation of a body by u: v = u/(4A), m after a real part, and the functions of y. */
typedef struct {
  lanes scale, v[4], m[4], of[3];
} free_rotation;

static inline free_rotation rotation_by(const lanes *q, const lanes *p, lanes tau, lanes scale)
{
  free_rotation by;
  const lanes *m = by.m + 1;
  by.scale = scale;
  for (int i = 0; i < 4; i++)
    by.v[i] = scale * tau * p[i];
  conjugate_times(q, by.v, by.m);
  frame_functions(m[0] * m[0] + (m[1] * m[1] + m[2] * m[2]), by.of);
  return by;
}

/* value = V_q at the positions, and 1/(4A) of each body, which does not depend on them; squares are |q|^2. */
static inline void potential_rates(const step_data *step, int n, const lanes *q, const lanes *square, lanes *value)
{
  lanes u[M + TURNS];
  memcpy(u, q, sizeof(lanes) * M);
  memcpy(u + M, square, sizeof(lanes) * TURNS);
  frame_lanes(u, step->t + step->h * ABSCISSA[n], step->parameters, value);
}

/* (tau W_u, -W_Q, h W_u / 2) at the points of a group. */
static inline __attribute__((always_inline)) void rate_in_frame(const step_data *step, int n, const lanes *u,
    lanes *rates)
{
  const lanes tau = step->h * (ABSCISSA[n] - 0.5);
  lanes q[M], square[TURNS], value[M + TURNS], turned[4], w[3];
  free_rotation by[TURNS];
  potential_rates(step, n, u, u, value);
  for (int k = 0; k < TURNS; k++) {
    const lanes *own = u + 4 * k;
    square[k] = (own[0] * own[0] + own[1] * own[1]) + (own[2] * own[2] + own[3] * own[3]);
    by[k] = rotation_by(own, u + M + 4 * k, tau, value[M + k]);
    times_vector(own, by[k].m + 1, turned);
    for (int i = 0; i < 4; i++)
      q[4 * k + i] = (own[i] + by[k].of[1] * own[i]) + by[k].of[0] * turned[i];
  }
  potential_rates(step, n, q, square, value);
  for (int k = 0; k < TURNS; k++) {
    const lanes *g = value + 4 * k, *m = by[k].m + 1, *of = by[k].of;
    lanes G[4], velocity[4], back[4], along;
    conjugate_times(u + 4 * k, g, G);
    along = of[2] * (G[1] * m[0] + (G[2] * m[1] + G[3] * m[2])) - of[0] * G[0];
    for (int i = 0; i < 3; i++)
      w[i] = of[0] * G[1 + i] + along * m[i];
    times_vector(u + 4 * k, w, velocity);
    times_vector(by[k].v, w, back);
    times_vector(g, m, turned);
    for (int i = 0; i < 4; i++) {
      rates[4 * k + i] = by[k].scale * tau * velocity[i];
      rates[2 * M + 4 * k + i] = 0.5 * step->h * by[k].scale * velocity[i];
      rates[M + 4 * k + i] = back[i] - ((g[i] + of[1] * g[i]) - of[0] * turned[i]);
    }
  }
}

/* h / the size of quaternions in place of their components: factors of changes of velocities and forces. */
static inline void measure_quaternions(lanes (*u)[2 * M], const solver_options *options, double h,
    double *velocity_size, double *momentum_size)
{
  for (int i = 0; i < M; i += 4) {
    double q = DBL_MIN, p = DBL_MIN;
    for (int j = i; j < i + 4; j++) {
      q += at_point(&u[0][j], 0, 0) * at_point(&u[0][j], 0, 0);
      p += at_point(&u[0][M + j], 0, 0) * at_point(&u[0][M + j], 0, 0);
    }
    for (int j = i; j < i + 4; j++) {
      velocity_size[j] = options->absolute ? fabs(h) : 0.5 * fabs(h) / sqrt(q);
      momentum_size[j] = options->absolute ? fabs(h) : 0.5 * fabs(h) / sqrt(p);
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

/* State (q, p) in two words. */
typedef struct {
  double q[M], p[M], low_q[M], low_p[M];
} frame_state;

/* x + low += change + low_change. */
static inline void add_change(double *x, double *low, double change, double low_change)
{
  *low += rest_of_sum(*x, change, x) + low_change;
}

/* (|g|^2 - 1)/2 of d = g - 1, whose rounding errors are similar in every step: sums of products without rounding. */
static inline double excess(const double *d)
{
  double sum = 2.0 * d[0], rest = 0.0, square[4];
  for (int k = 0; k < 4; k++)
    square[k] = d[k] * d[k];
  IN_MEMORY(square); /* rounded, not part of fused operations */
  for (int k = 0; k < 4; k++)
    rest += rest_of_product(d[k], d[k], square[k]) + rest_of_sum(sum, square[k], &sum);
  return 0.5 * (sum + rest);
}

/* q <- q g, p <- p g for g - 1 of each body; its length is corrected. High words are in one lane, low in another. */
static inline void rotate_state(frame_state *at, const double *g)
{
  for (int i = 0; i < M; i += 4) {
    const lanes w[3] = {lanes_of(g[i + 1]), lanes_of(g[i + 2]), lanes_of(g[i + 3])};
    lanes x[2][4], turned[4];
    for (int j = 0; j < 4; j++) {
      lane_view q = {lanes_of(at->q[i + j])}, p = {lanes_of(at->p[i + j])};
      q.lane[1] = at->low_q[i + j];
      p.lane[1] = at->low_p[i + j];
      x[0][j] = q.all;
      x[1][j] = p.all;
    }
    for (int half = 0; half < 2; half++) {
      double *high = half ? at->p : at->q, *low = half ? at->low_p : at->low_q, longer = excess(g + i);
      times_vector(x[half], w, turned);
      for (int j = 0; j < 4; j++) {
        const lanes change = g[i] * x[half][j] + turned[j];
        add_change(&high[i + j], &low[i + j], at_point(&change, 0, 0), at_point(&change, 0, 1));
        low[i + j] -= longer * high[i + j];
      }
    }
  }
}

/* f <- f g for f - 1 and g - 1. */
static inline void join(double *f, const double *g)
{
  const double a = f[0], b = f[1], c = f[2], d = f[3];
  f[0] += g[0] + (a * g[0] - b * g[1] - c * g[2] - d * g[3]);
  f[1] += g[1] + (a * g[1] + b * g[0] + c * g[3] - d * g[2]);
  f[2] += g[2] + (a * g[2] - b * g[3] + c * g[0] + d * g[1]);
  f[3] += g[3] + (a * g[3] + b * g[2] - c * g[1] + d * g[0]);
}

/* Free rotation during half of the step, and at its end the turns about axes of symmetry. */
static inline void rotate_freely(const step_data *step, frame_state *at, int end)
{
  lanes q[M], p[M], value[M + TURNS];
  double u[2 * M], g[4 * TURNS], turn[4 * TURNS];
  for (int i = 0; i < M; i++) {
    const double momentum = at->p[i] + at->low_p[i];
    q[i] = lanes_of(u[i] = at->q[i] + at->low_q[i]);
    p[i] = lanes_of(momentum);
    u[M + i] = step->h * momentum;
  }
  potential_rates(step, 0, q, q, value);
  for (int k = 0; k < TURNS; k++) {
    const free_rotation by = rotation_by(q + 4 * k, p + 4 * k, lanes_of(0.5 * step->h), value[M + k]);
    g[4 * k] = at_first(&by.of[1]);
    for (int j = 1; j < 4; j++)
      g[4 * k + j] = at_first(&by.of[0]) * at_first(&by.m[j]);
  }
  if (end) {
    rotations(u, step->t, step->parameters, turn);
    for (int k = 0; k < 4 * TURNS; k += 4)
      join(g + k, turn + k);
  }
  rotate_state(at, g);
}

/* Returns the step from the state in the moving frame, which is stored in `at`. */
static inline step_data into_frame(const step_data *step, frame_state *at)
{
  step_data moving = *step;
  memcpy(at->q, step->q0, sizeof at->q);
  memcpy(at->p, step->p0, sizeof at->p);
  memcpy(at->low_q, step->carry_q, sizeof at->low_q);
  memcpy(at->low_p, step->carry_p, sizeof at->low_p);
  rotate_freely(step, at, 0);
  moving.q0 = at->q, moving.p0 = at->p, moving.carry_q = at->low_q, moving.carry_p = at->low_p;
  return moving;
}

/* Replaces increments in the moving frame by those of the step, in two words. */
static inline void out_of_frame(const step_data *step, frame_state *at, double *dq, double *dp)
{
  for (int i = 0; i < M; i++) {
    add_change(&at->q[i], &at->low_q[i], dq[i], 0.0);
    add_change(&at->p[i], &at->low_p[i], dp[i], 0.0);
  }
  rotate_freely(step, at, 1);
  for (int i = 0; i < M; i++) {
    dq[M + i] = rest_of_sum(at->q[i], -step->q0[i], &dq[i]) + (at->low_q[i] - step->carry_q[i]);
    dp[M + i] = rest_of_sum(at->p[i], -step->p0[i], &dp[i]) + (at->low_p[i] - step->carry_p[i]);
  }
}

/* Computes the increments of one step by fixed-point iteration from W = 0: there is no predictor, as rates vary with
 * the nutation. On failure the increments are undefined. */
HOT int fixed_point(const step_data *step, const iteration_data *data, history past, long long *steps, double *dq,
    double *dp, const solver_options *options, solver_report *report)
{
  lanes z[GROUPS][M], force[GROUPS][M], u[GROUPS][2 * M], scaled[GROUPS][M], curve[GROUPS][M];
  double velocity_size[M], momentum_size[M];
  frame_state state;
  const step_data moving = into_frame(step, &state);
  progress now = before_iterations();
  memset(z, 0, sizeof z);
  memset(force, 0, sizeof force);
  for (int k = 0; needs_iteration(&now); k++) {
    lanes change = lanes_of(0.0);
    place(&moving, data, z, u);
    push(&moving, data, force, u);
    if (k < 2)
      measure_quaternions(u, options, step->h, velocity_size, momentum_size);
    for (int n = 0; n < GROUPS; n++) {
      lanes rates[3 * M];
      rate_in_frame(&moving, n, u[n], rates);
      for (int i = 0; i < M; i++) {
        const lanes moved = (rates[i] - z[n][i]) * velocity_size[i];
        const lanes pushed = (rates[M + i] - force[n][i]) * momentum_size[i];
        change += moved * moved + pushed * pushed;
        z[n][i] = rates[i];
        force[n][i] = rates[M + i];
        curve[n][i] = rates[2 * M + i];
      }
    }
    take_change(&now, total_change(change) / POINTS, options, k, report);
  }
  TRY(outcome(&now, report));
  scale(data->position_weight, z, scaled);
  for (int i = 0; i < M; i++)
    dq[i] = weigh(POINT_END_POSITION, scaled, i);
  scale(data->momentum_weight, force, scaled);
  for (int i = 0; i < M; i++)
    dp[i] = weigh(POINT_END_MOMENTUM, scaled, i);
  out_of_frame(step, &state, dq, dp);
  TRY(accept(step, dq, dp));
  remember_curve(curve, past);
  remember_curve(force, past + 2 * M * POINTS);
  *steps = next_guess(*steps, &now, report);
  return OK;
}
