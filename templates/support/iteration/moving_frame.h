#ifndef SUPPORT_MOVING_FRAME_H
#define SUPPORT_MOVING_FRAME_H

#include "../core/points.h"
#include "../core/step.h"
#include "convergence.h"

/* Method in the moving frame of bodies with axes of symmetry: z = Phi_tau(Z) with the free rotation Phi, tau = t - t0 -
 * h/2, leaves K = V(Phi_tau(Z)) = W(Q, tau P). Kernels have u = (Q, tau P, functions of y for each body) as arguments in
 * place of (q, p), and compute K_P / tau in place of H_p. A step begins and ends with half of the free rotation.
 * Requires: points.h, step.h, TURNS, the number of bodies, the kernels angle_lanes, rotations, turn_lanes. */
enum { FRAME = 2 * M + 3 * TURNS };

#define LARGEST_IN_SERIES 4.0 /* 2^2: angles up to which the series are correct to round-off */

/* of = (S, C - 1, D) for S = sin(x)/x, C = cos(x), D = (C - S)/y, x^2 = y. */
static inline void frame_functions(lanes y, lanes *of)
{
  const lanes y2 = y * y, y4 = y2 * y2;
  double largest = 0.0;
  for (int j = 0; j < LANES; j++)
    largest = larger(largest, at_point(&y, 0, j));
  if (largest <= LARGEST_IN_SERIES) {
    const lanes sine = ((y * (1.0 / 120.0) - 1.0 / 6.0) + y2 * (y * (1.0 / 362880.0) - 1.0 / 5040.0)) +
        y4 * (((y * (1.0 / 6227020800.0) - 1.0 / 39916800.0) +
                  y2 * (y * (1.0 / 355687428096000.0) - 1.0 / 1307674368000.0)) +
                 y4 * ((y * (1.0 / 51090942171709440000.0) - 1.0 / 121645100408832000.0) -
                          y2 * (1.0 / 25852016738884976640000.0)));
    of[2] = ((y * (4.0 / 120.0) - 2.0 / 6.0) + y2 * (y * (8.0 / 362880.0) - 6.0 / 5040.0)) +
        y4 * (((y * (12.0 / 6227020800.0) - 10.0 / 39916800.0) +
                  y2 * (y * (16.0 / 355687428096000.0) - 14.0 / 1307674368000.0)) +
                 y4 * ((y * (20.0 / 51090942171709440000.0) - 18.0 / 121645100408832000.0) -
                          y2 * (22.0 / 25852016738884976640000.0)));
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

/* Adds the functions of y to u = (q, tau p). */
static inline void add_functions(const step_data *step, lanes *u, lanes *y)
{
  angle_lanes(u, lanes_of(step->t), step->parameters, y);
  for (int k = 0; k < TURNS; k++)
    frame_functions(y[k], &u[2 * M + 3 * k]);
}

/* Arguments of the kernels at the points of a group. */
static inline const lanes *in_frame(const step_data *step, int n, const lanes *u, lanes *at)
{
  lanes y[TURNS];
  for (int i = 0; i < M; i++) {
    at[i] = u[i];
    at[M + i] = step->h * (ABSCISSA[n] - 0.5) * u[M + i];
  }
  add_functions(step, at, y);
  return at;
}

static inline void rescale(const step_data *step, int n, lanes *velocity)
{
  for (int i = 0; i < M; i++)
    velocity[i] *= step->h * (ABSCISSA[n] - 0.5);
}

/* 1 / the size of quaternions in place of their components, of positions in units of h times their velocities. */
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
      momentum_size[j] = options->absolute ? 1.0 : 0.5 / sqrt(p);
    }
  }
}

/* sum = x + y, rounded; returns the rest. */
static inline double rest_of_sum(double x, double y, double *sum)
{
  __asm__("" : "+x"(x), "+x"(y)); const double total = x + y, part = total - x;
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
  double sum = 2.0 * d[0], rest = 0.0;
  for (int k = 0; k < 4; k++) {
    const double square = d[k] * d[k];
    rest += fma(d[k], d[k], -square) + rest_of_sum(sum, square, &sum);
  }
  return 0.5 * (sum + rest);
}

/* q <- q g, p <- p g for g - 1 of each body, whose length is corrected: high words are in one lane, low ones in another. */
static inline void rotate(const step_data *step, frame_state *at, const double *g)
{
  lanes u[2 * M + 4 * TURNS], change[2 * M];
  for (int i = 0; i < M; i++) {
    lane_view q = {lanes_of(at->q[i])}, p = {lanes_of(at->p[i])};
    q.lane[1] = at->low_q[i];
    p.lane[1] = at->low_p[i];
    u[i] = q.all;
    u[M + i] = p.all;
  }
  for (int k = 0; k < 4 * TURNS; k++)
    u[2 * M + k] = lanes_of(g[k]);
  turn_lanes(u, lanes_of(step->t), step->parameters, change);
  for (int i = 0; i < M; i += 4) {
    const double longer = excess(g + i);
    for (int j = i; j < i + 4; j++) {
      add_change(&at->q[j], &at->low_q[j], at_point(&change[j], 0, 0), at_point(&change[j], 0, 1));
      add_change(&at->p[j], &at->low_p[j], at_point(&change[M + j], 0, 0), at_point(&change[M + j], 0, 1));
      at->low_q[j] -= longer * at->q[j];
      at->low_p[j] -= longer * at->p[j];
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
  lanes u[2 * M], m[3 * TURNS];
  double scalar[2 * M], g[4 * TURNS], turn[4 * TURNS];
  for (int i = 0; i < M; i++) {
    u[i] = lanes_of(scalar[i] = at->q[i]);
    u[M + i] = lanes_of(scalar[M + i] = step->h * at->p[i]);
  }
  axis_lanes(u, lanes_of(step->t), step->parameters, m);
  for (int k = 0; k < TURNS; k++) {
    const lanes *v = m + 3 * k;
    lanes of[3];
    frame_functions(v[0] * v[0] + v[1] * v[1] + v[2] * v[2], of);
    g[4 * k] = at_first(&of[1]);
    for (int j = 0; j < 3; j++)
      g[4 * k + 1 + j] = at_first(&of[0]) * at_first(&v[j]);
  }
  if (end) {
    rotations(scalar, step->t, step->parameters, turn);
    for (int k = 0; k < 4 * TURNS; k += 4)
      join(g + k, turn + k);
  }
  rotate(step, at, g);
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

#endif
