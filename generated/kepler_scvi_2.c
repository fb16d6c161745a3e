/* Kepler problem: Spectral-collocation variational integrator, degree 2, chebyshev-lobatto nodes, gauss-legendre:2; see
 * kepler_scvi_2.h. */
#include "kepler_scvi_2.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

#define NAME(word) kepler_scvi_2_##word /* prefix of every exported name */
#define STATUS(word) KEPLER_SCVI_2_##word
#define TOLERANCE 2.220446049250313e-16 /* default */

/* Choices of this integrator among the alternatives of the support headers. */
#define MOMENTUM_MAPS /* first integrals from symmetries */
#ifndef __GNUC__ /* no vector extensions */
#define NEWTON_ALONE
#endif
#define SPURIOUS_TESTED /* solutions of Newton's method */
#define DISCRETE_LAGRANGIAN

enum {
  M = 2, /* coordinates */
  SITES = 2, /* coordinates, then the components of other unknowns */
  B = 5, /* unknowns per site */
  N = 10, /* unknowns */
  MOST_POINTS = 5, /* largest number of points of a stage group, or of blocks */
  JACOBIAN = 144, /* entries of its factors */
  POINT = 0, /* numbers that describe where a reused Jacobian was evaluated */
  MOST_ITERATIONS = INT_MAX, /* whatever the options are */
  MAX_ITERATIONS = 50, /* default */
  MAPS = 1, /* first integrals from symmetries */
  SUMS = 1, /* integrals along the curve of a step */
  BAND = 1, /* largest distance of coupled coordinates in the ordering POSITION_IN_MATRIX */
  MASS_ENTRIES = 2, /* nonzero entries of the Legendre transform */
  MEMORY = 14, /* numbers kept from step to step */
  SCRATCH = 64 /* arguments, values and derivatives at all points, or the mass matrix with its derivatives */
};

#include "support/core/numbers.h"
#include "support/core/status_codes.h"
#include "support/core/step.h"

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r contains MOMENTUM_ROW[r] p0; the straight-line guess of z_b is
 * STRAIGHT[b] v0 + MOMENTA[b] p0; h z_b is a displacement if MOVES[b]. */
static const double END_POSITION[5] = {1.0, 0.75, -0.25, 0.0, 0.0};
static const double MOMENTUM_ROW[5] = {1.0, 0.75, -0.25, 0.0, 0.0};
static const double STRAIGHT[5] = {1.0, 0.0, 0.0, 0.0, 0.0};
static const double MOMENTA[5] = {0.0, 0.0, 0.0, 0.0, 0.0};
static const double MOVES[5] = {1.0, 1.0, 1.0, 1.0, 1.0};

/* Quadrature: 2 points. Gather tables have one row
 * per block and one column per point, scatter tables one row per point and one column per row of equations, the last
 * one for p1. {i, j}: derivative d value_i / d u_j. */
static const double QUADRATURE_WEIGHT[2] = {0.5, 0.5};
static const double QUADRATURE_GATHER_0[5][2] = {
    {0.21132486540518713, 0.7886751345948129},
    {0.11682698238722367, 0.5498396842794431},
    {-0.09449788301796347, -0.2388354503153698},
    {0.0, 0.0},
    {0.0, 0.0}};
static const double QUADRATURE_GATHER_1[5][2] = {
    {1.0, 1.0},
    {0.6056624327025936, 0.8943375672974064},
    {-0.39433756729740643, -0.10566243270259355},
    {0.0, 0.0},
    {0.0, 0.0}};
static const double QUADRATURE_SCATTER_0[2][6] = {
    {0.7886751345948129, 0.6331730176127763, -0.15550211698203653, 0.0, 0.0, 1.0},
    {0.21132486540518713, 0.20016031572055693, -0.01116454968463021, 0.0, 0.0, 1.0}};
static const double QUADRATURE_SCATTER_1[2][6] = {
    {-1.0, -0.6056624327025936, 0.39433756729740643, 0.0, 0.0, 0.0},
    {-1.0, -0.8943375672974064, 0.10566243270259355, 0.0, 0.0, 0.0}};
static const int QUADRATURE_DERIVATIVES_0[4][2] = {{0, 0}, {0, 1}, {1, 0}, {1, 1}};
static const int QUADRATURE_DERIVATIVES_1[2][2] = {{0, 0}, {1, 1}};

/* Node: 2 points. Gather tables have one row
 * per block and one column per point, scatter tables one row per point and one column per row of equations, the last
 * one for p1. {i, j}: derivative d value_i / d u_j. */
static const double NODE_WEIGHT[2] = {1.0, 1.0};
static const double NODE_GATHER_0[5][2] = {{0.5, 1.0}, {0.3125, 0.75}, {-0.1875, -0.25}, {0.0, 0.0}, {0.0, 0.0}};
static const double NODE_GATHER_1[5][2] = {{1.0, 1.0}, {0.75, 1.0}, {-0.25, 0.0}, {0.0, 0.0}, {0.0, 0.0}};
static const double NODE_GATHER_2[5][2] = {{0.0, 0.0}, {1.0, 0.0}, {0.0, 1.0}, {0.0, 0.0}, {0.0, 0.0}};
static const double NODE_GATHER_3[5][2] = {{0.0, 0.0}, {0.0, 0.0}, {0.0, 0.0}, {1.0, 0.0}, {0.0, 1.0}};
static const double NODE_SCATTER_0[2][6] = {{0.5, 0.4375, -0.0625, 0.0, 0.0, 1.0}, {0.0, 0.0, 0.0, 0.0, 0.0, 1.0}};
static const double NODE_SCATTER_1[2][6] = {{-1.0, -0.75, 0.25, 0.0, 0.0, 0.0}, {-1.0, -1.0, 0.0, 0.0, 0.0, 0.0}};
static const double NODE_SCATTER_2[2][6] = {{0.0, -1.0, 0.0, 0.0, 0.0, 0.0}, {0.0, 0.0, -1.0, 0.0, 0.0, 0.0}};
static const double NODE_SCATTER_3[2][6] = {{0.0, 0.0, 0.0, -1.0, 0.0, 0.0}, {0.0, 0.0, 0.0, 0.0, -1.0, 0.0}};
static const int NODE_DERIVATIVES_0[4][2] = {{0, 0}, {0, 1}, {1, 0}, {1, 1}};
static const int NODE_DERIVATIVES_1[4][2] = {{0, 0}, {0, 1}, {1, 0}, {1, 1}};
static const int NODE_DERIVATIVES_2[2][2] = {{0, 0}, {1, 1}};
static const int NODE_DERIVATIVES_3[4][2] = {{0, 0}, {0, 1}, {1, 0}, {1, 1}};
static const int NODE_DERIVATIVES_4[2][2] = {{0, 0}, {1, 1}};

/* Position of each coordinate in a bandwidth-reducing ordering; {i, j}: d y_i / d x_j. */
static const int POSITION_IN_MATRIX[SITES] = {0, 1};
#define MASS_POSITION POSITION_IN_MATRIX
static const int MASS_ENTRY[2][2] = {{0, 0}, {1, 1}};

INVERSE_ROOT(1, (inverse));
INVERSE_ROOT(3, (inverse * inverse));
INVERSE_ROOT(5, (inverse * inverse * inverse));
INVERSE_ROOT(7, (inverse * inverse * inverse * inverse));

/* L_q and L_v at u = (q, v). Operations: 5 *, 1 +, 1 inverse_root_3, 2 neg. */
static void quadrature_value(const double *u, double t, const double *parameters, double *value)
{
  (void)t;
  value[2] = u[2];
  value[3] = u[3];
  const double w0 = parameters[0] * inverse_root_3(u[0] * u[0] + u[1] * u[1]);
  value[0] = -(w0 * u[0]);
  value[1] = -(w0 * u[1]);
}

/* The same, and the nonzero derivatives with respect to u = (q, v). Operations: 13 *, 1 +, 2 -, 1 inverse_root_3, 1
 * inverse_root_5, 4 neg. */
static void quadrature_derivatives(const double *u, double t, const double *parameters, double *value,
    double *derivative)
{
  (void)t;
  value[2] = u[2];
  value[3] = u[3];
  derivative[4] = 1.0;
  derivative[5] = 1.0;
  const double w0 = u[0] * u[0];
  const double w1 = u[1] * u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0] * inverse_root_3(w2);
  value[0] = -(w3 * u[0]);
  value[1] = -(w3 * u[1]);
  const double w4 = 3.0 * parameters[0];
  const double w5 = inverse_root_5(w2);
  derivative[0] = -(w3 - w4 * w0 * w5);
  derivative[3] = -(w3 - w4 * w1 * w5);
  const double w6 = w4 * w5 * u[0] * u[1];
  derivative[1] = w6;
  derivative[2] = w6;
}

/* Derivatives of lambda . E at u = (q, v, a, lambda). Operations: 21 *, 3 +, 4 -, 1 inverse_root_3, 1 inverse_root_5.
 * */
static void node_value(const double *u, double t, const double *parameters, double *value)
{
  (void)t;
  value[2] = 0.0;
  value[3] = 0.0;
  value[4] = u[6];
  value[5] = u[7];
  const double w0 = u[0] * u[0];
  const double w1 = u[1] * u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0] * inverse_root_3(w2);
  value[6] = w3 * u[0] + u[4];
  value[7] = w3 * u[1] + u[5];
  const double w4 = 3.0 * parameters[0];
  const double w5 = inverse_root_5(w2);
  const double w6 = w4 * w5;
  value[0] = w3 * u[6] - w4 * w0 * w5 * u[6] - w6 * u[0] * u[1] * u[7];
  value[1] = w3 * u[7] - w4 * w1 * w5 * u[7] - w6 * u[6] * u[0] * u[1];
}

/* The same, and the nonzero derivatives with respect to u = (q, v, a, lambda). Operations: 55 *, 6 +, 12 -, 1
 * inverse_root_3, 1 inverse_root_5, 1 inverse_root_7, 1 neg. */
static void node_derivatives(const double *u, double t, const double *parameters, double *value, double *derivative)
{
  (void)t;
  value[2] = 0.0;
  value[3] = 0.0;
  value[4] = u[6];
  value[5] = u[7];
  derivative[8] = 1.0;
  derivative[9] = 1.0;
  derivative[14] = 1.0;
  derivative[15] = 1.0;
  const double w0 = u[0] * u[0];
  const double w1 = u[1] * u[1];
  const double w2 = w0 + w1;
  const double w3 = parameters[0] * inverse_root_3(w2);
  value[6] = w3 * u[0] + u[4];
  value[7] = w3 * u[1] + u[5];
  const double w4 = 3.0 * parameters[0];
  const double w5 = inverse_root_5(w2);
  const double w6 = w4 * w0 * w5;
  const double w7 = w4 * w5;
  const double w8 = w7 * u[0] * u[1];
  value[0] = w3 * u[6] - w6 * u[6] - w8 * u[7];
  const double w9 = w4 * w1 * w5;
  const double w10 = w7 * u[6] * u[0];
  value[1] = w3 * u[7] - w9 * u[7] - w10 * u[1];
  const double w11 = parameters[0] * w5;
  const double w12 = 5.0 * parameters[0];
  const double w13 = inverse_root_7(w2);
  const double w14 = w12 * w0 * w13;
  derivative[0] = (-3.0) * (w10 + w11 * u[1] * u[7] - w12 * (w0 * u[0]) * w13 * u[6] - w14 * u[1] * u[7]);
  const double w15 = w11 * u[6];
  const double w16 = w12 * w1 * w13;
  derivative[3] = (-3.0) * (w15 * u[0] + w7 * u[1] * u[7] - w12 * w13 * (w1 * u[1]) * u[7] - w16 * u[6] * u[0]);
  const double w17 = (-3.0) * (w11 * u[0] * u[7] + w15 * u[1] - w16 * u[0] * u[7] - w14 * u[6] * u[1]);
  derivative[1] = w17;
  derivative[2] = w17;
  const double w18 = w3 - w6;
  derivative[4] = w18;
  derivative[10] = w18;
  const double w19 = -w8;
  derivative[5] = w19;
  derivative[6] = w19;
  derivative[11] = w19;
  derivative[12] = w19;
  const double w20 = w3 - w9;
  derivative[7] = w20;
  derivative[13] = w20;
}

/* Momenta L_v and mass matrix L_vv at u = (q, v). Operations: constants. */
static void legendre(const double *u, double t, const double *parameters, double *value, double *derivative)
{
  (void)t, (void)parameters;
  value[0] = u[2];
  value[1] = u[3];
  derivative[0] = 1.0;
  derivative[1] = 1.0;
}

/* L at u = (q, v). Operations: 7 *, 3 +, 1 inverse_root_1. */
static void lagrangian(const double *u, double t, const double *parameters, double *value)
{
  (void)t;
  value[0] = 0.5 * (u[2] * u[2] + u[3] * u[3] + 2.0 * parameters[0] * inverse_root_1(u[0] * u[0] + u[1] * u[1]));
}

/* Momentum maps at u = (q, p), then the sums of the squares of their terms. Operations: 8 *, 1 +, 1 -. */
static void momentum_maps(const double *u, double t, const double *parameters, double *value)
{
  (void)t, (void)parameters;
  value[0] = u[3] * u[0] - u[2] * u[1];
  value[1] = u[2] * u[2] * (u[1] * u[1]) + u[3] * u[3] * (u[0] * u[0]);
}

#include "support/newton/band.h"
#include "support/mechanics/legendre.h"
#include "support/mechanics/energies.h"
#include "support/newton/stages.h"

/* Quadrature points: adds their part of the rows, and of the Jacobian unless it is NULL. */
static void add_quadrature(const step_data *step, const double *z, double *rows, double *size, double *jacobian,
    const band *shape)
{
  const double h = step->h;
  double *u = step->scratch, *value = u + 8, *derivative = value + 8;
  gather(QUADRATURE_GATHER_0[0], 2, h, z, 2, u + 0, 4, 1);
  offset(step, 2, u + 0, 4);
  gather(QUADRATURE_GATHER_1[0], 2, 1, z, 2, u + 2, 4, 1);
  for (int n = 0; n < 2; n++) {
    if (jacobian)
      quadrature_derivatives(u + n * 4, step->t, step->parameters, value + n * 4, derivative + n * 6);
    else
      quadrature_value(u + n * 4, step->t, step->parameters, value + n * 4);
  }
  scatter(QUADRATURE_SCATTER_0[0], 2, QUADRATURE_WEIGHT, h, value + 0, 4, 2, rows, size);
  scatter(QUADRATURE_SCATTER_1[0], 2, QUADRATURE_WEIGHT, 1, value + 2, 4, 2, rows, size);
  if (!jacobian)
    return;
  scatter_derivatives(QUADRATURE_SCATTER_0[0], QUADRATURE_GATHER_0[0], 2, QUADRATURE_WEIGHT, h * h,
      QUADRATURE_DERIVATIVES_0, 4, &derivative[0], 6, jacobian, shape);
  scatter_derivatives(QUADRATURE_SCATTER_1[0], QUADRATURE_GATHER_1[0], 2, QUADRATURE_WEIGHT, 1,
      QUADRATURE_DERIVATIVES_1, 2, &derivative[4], 6, jacobian, shape);
}

/* Node points: adds their part of the rows, and of the Jacobian unless it is NULL. */
static void add_node(const step_data *step, const double *z, double *rows, double *size, double *jacobian,
    const band *shape)
{
  const double h = step->h;
  double *u = step->scratch, *value = u + 16, *derivative = value + 16;
  gather(NODE_GATHER_0[0], 2, h, z, 2, u + 0, 8, 1);
  offset(step, 2, u + 0, 8);
  gather(NODE_GATHER_1[0], 2, 1, z, 2, u + 2, 8, 1);
  gather(NODE_GATHER_2[0], 2, 1 / (h), z, 2, u + 4, 8, 1);
  gather(NODE_GATHER_3[0], 2, 1, z, 2, u + 6, 8, 1);
  for (int n = 0; n < 2; n++) {
    if (jacobian)
      node_derivatives(u + n * 8, step->t, step->parameters, value + n * 8, derivative + n * 16);
    else
      node_value(u + n * 8, step->t, step->parameters, value + n * 8);
  }
  scatter(NODE_SCATTER_0[0], 2, NODE_WEIGHT, h * h, value + 0, 8, 2, rows, size);
  scatter(NODE_SCATTER_1[0], 2, NODE_WEIGHT, h, value + 2, 8, 2, rows, size);
  scatter(NODE_SCATTER_2[0], 2, NODE_WEIGHT, 1, value + 4, 8, 2, rows, size);
  scatter(NODE_SCATTER_3[0], 2, NODE_WEIGHT, h, value + 6, 8, 2, rows, size);
  if (!jacobian)
    return;
  scatter_derivatives(NODE_SCATTER_0[0], NODE_GATHER_0[0], 2, NODE_WEIGHT, h * h * h, NODE_DERIVATIVES_0, 4,
      &derivative[0], 16, jacobian, shape);
  scatter_derivatives(NODE_SCATTER_0[0], NODE_GATHER_3[0], 2, NODE_WEIGHT, h * h, NODE_DERIVATIVES_1, 4, &derivative[4],
      16, jacobian, shape);
  scatter_derivatives(NODE_SCATTER_2[0], NODE_GATHER_3[0], 2, NODE_WEIGHT, 1, NODE_DERIVATIVES_2, 2, &derivative[8], 16,
      jacobian, shape);
  scatter_derivatives(NODE_SCATTER_3[0], NODE_GATHER_0[0], 2, NODE_WEIGHT, h * h, NODE_DERIVATIVES_3, 4,
      &derivative[10], 16, jacobian, shape);
  scatter_derivatives(NODE_SCATTER_3[0], NODE_GATHER_2[0], 2, NODE_WEIGHT, 1, NODE_DERIVATIVES_4, 2, &derivative[14],
      16, jacobian, shape);
}

/* Evaluates the stage equations: for every coordinate B residuals and p1 - p0 in rows; the sizes of p1 and q1 before
 * cancellation; and the Jacobian in the given shape, unless it is NULL. */
static void evaluate(const step_data *step, const double *z, double *rows, double *size_p, double *size_q,
    double *jacobian, const band *shape)
{
  begin_rows(step, z, rows, size_p, size_q, jacobian, shape);
  add_quadrature(step, z, rows, size_p, jacobian, shape);
  add_node(step, z, rows, size_p, jacobian, shape);
}

#include "support/newton/newton.h"

#define STAGE_POWER 1.375 /* exponent from the curve's estimate to the error of the end */
#define FEW_STAGE_COEFFICIENTS /* their ratio is not that of further ones */
static const double STAGE_HIGHEST[5] = {0.0, -1.0, 1.0, 0.0, 0.0};
static const double STAGE_NEXT[5] = {0.0, 1.0, 0.0, 0.0, 0.0};
static const double STAGE_CURVATURE[5] = {0.0, 1.0, 0.0, 0.0, 0.0};
static const double STAGE_OTHER_CURVATURE[5] = {0.0, 0.0, 1.0, 0.0, 0.0};

#include "support/step_size/stage_error.h"
#include "support/newton/newton_from_line.h"

#ifndef NEWTON_ALONE
#define POINTS 2
#define LANES 2
#define HOT static inline __attribute__((always_inline))
#define FINAL_ITERATIONS 0
#define NODES 2
#define DIAGONAL_MASS 1

#define INVERSE_ROOTS
#include "support/core/vectors.h"
#include "support/core/points.h"

LANES_INVERSE_ROOT(3, (square * y), (inverse * inverse));
LANES_INVERSE_ROOT(5, (square * square * y), (inverse * inverse * inverse));

static const lanes NODE_TIME = {0.5, 1.0};
static const lanes COLLOCATION[POINTS * GROUPS] = {0.75, 1.0, -0.25, 0.0};
static const lanes NODE_END = {1.0, 0.0};
static const lanes NODE_MASK = {1.0, 1.0};
static const lanes POINT_TIME = {0.2113248654051871, 0.7886751345948129};
static const lanes POINT_POSITION[POINTS * GROUPS] = {
    0.37799153207185376, 0.9553418012614795,
    -0.16666666666666666, -0.16666666666666666};
static const lanes POINT_VELOCITY[POINTS * GROUPS] = {
    1.5773502691896257, 0.4226497308103742,
    -0.5773502691896257, 0.5773502691896257};
static const lanes COLLOCATION_T[POINTS * GROUPS] = {0.75, -0.25, 1.0, 0.0};
static const lanes POINT_POSITION_T[POINTS * GROUPS] = {
    0.37799153207185376, -0.16666666666666666,
    0.9553418012614795, -0.16666666666666666};
static const lanes POINT_VELOCITY_T[POINTS * GROUPS] = {
    1.5773502691896257, -0.5773502691896257,
    0.4226497308103742, 0.5773502691896257};
static const lanes POINT_WEIGHT = {0.5, 0.5};
static const lanes NODE_CONSISTENCY = {1.0, 0.0};
static const lanes LAST_ALONE[POINTS * GROUPS] = {-1.0, -2.0, 2.0, 3.0};
static const lanes LAST[POINTS * GROUPS] = {-6.0, -20.0, 4.0, 10.0};
static const lanes BEFORE[POINTS * GROUPS] = {-1.0, -4.0, 4.0, 15.0};

/* E, (m . E)_q, (m . E)_v and the lower triangle of L_vv at all nodes, u = (q, v, a, m). Operations: 19 *, 3 +, 4 -, 1
 * inverse_root_3, 1 inverse_root_5. */
static inline void node_lanes(const lanes *u, lanes t, const double *parameters, lanes *value, lanes *derivative)
{
  (void)t;
  value[4] = lanes_of(0.0);
  value[5] = lanes_of(0.0);
  derivative[0] = lanes_of(1.0);
  derivative[1] = lanes_of(1.0);
  const lanes w0 = u[0] * u[0];
  const lanes w1 = u[1] * u[1];
  const lanes w2 = w0 + w1;
  const lanes w3 = parameters[0] * lanes_inverse_root_3(w2);
  value[0] = w3 * u[0] + u[4];
  value[1] = w3 * u[1] + u[5];
  const double w4 = 3.0 * parameters[0];
  const lanes w5 = lanes_inverse_root_5(w2);
  const lanes w6 = w4 * w5 * u[0] * u[1];
  value[2] = w3 * u[6] - w4 * w0 * w5 * u[6] - w6 * u[7];
  value[3] = w3 * u[7] - w4 * w1 * w5 * u[7] - w6 * u[6];
}

/* L_q and L_v at all points, u = (q, v). Operations: 4 *, 1 +, 2 inverse_root_3_times, 2 neg. */
static inline void action_lanes(const lanes *u, lanes t, const double *parameters, lanes *value)
{
  (void)t;
  value[2] = u[2];
  value[3] = u[3];
  const lanes w0 = u[0] * u[0] + u[1] * u[1];
  value[0] = lanes_inverse_root_3_times(w0, -(parameters[0] * u[0]));
  value[1] = lanes_inverse_root_3_times(w0, -(parameters[0] * u[1]));
}

#include "support/iteration/convergence.h"
#include "support/core/progress.h"
#include "support/iteration/one_trajectory.h"
#include "support/iteration/mass_matrix.h"
#include "support/iteration/curve.h"
#include "support/iteration/shooting_iteration.h"
#include "support/iteration/iteration_solver.h"

/* Error estimate of a curve, and its exponent in the relative error of the end of the step. */
#define KEPT 2
#define KEPT_VELOCITIES 0
#define KEPT_UNIT(i) (step->h)
#define RESOLVED 1.0
#define NEXT_RESOLVED 1.0
#define ERROR_POWER 1.375
static const lanes HIGHEST[GROUPS] = {-1.0, 1.0};
static const lanes NEXT[GROUPS] = {1.0, 0.0};

#else
static const double EXTRAPOLATION[5][5] = {
    {1.0, 0.0, 0.0, 0.0, 0.0},
    {1.0, -1.0, -2.0, 0.0, 0.0},
    {0.0, 2.0, 3.0, 0.0, 0.0},
    {0.0, 0.0, 0.0, 1.0, 0.0},
    {0.0, 0.0, 0.0, 0.0, 1.0}};

#include "support/newton/newton_solver.h"
#define ERROR_POWER STAGE_POWER
#endif

#include "support/run/run.h"

/* Adds h^1 sum_n w_n lagrangian along the curve with unknowns z. */
static void add_quadrature_sums(const step_data *step, const double *z, double *sum)
{
  const double h = step->h;
  double *u = step->scratch, own[SUMS] = {0};
  gather(QUADRATURE_GATHER_0[0], 2, h, z, 2, u + 0, 4, 1);
  offset(step, 2, u + 0, 4);
  gather(QUADRATURE_GATHER_1[0], 2, 1, z, 2, u + 2, 4, 1);
  for (int n = 0; n < 2; n++) {
    double value[SUMS];
    lagrangian(u + n * 4, step->t, step->parameters, value);
    for (int k = 0; k < SUMS; k++)
      own[k] += QUADRATURE_WEIGHT[n] * value[k];
  }
  for (int k = 0; k < SUMS; k++)
    sum[k] += h * own[k];
}

static void sums_along(const step_data *step, const double *z, double *sum)
{
  memset(sum, 0, sizeof(double) * SUMS);
  add_quadrature_sums(step, z, sum);
}

#include "support/mechanics/discrete_legendre.h"
