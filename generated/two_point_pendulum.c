/* planar pendulum: Spectral-collocation variational integrator, degree 1, chebyshev-lobatto nodes, gauss-legendre:2;
 * see two_point_pendulum.h. A step: solve; a run: two_point_pendulum_advance. */
#include "two_point_pendulum.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

#define NAME(word) two_point_pendulum_##word /* prefix of every exported name */
#define STATUS(word) TWO_POINT_PENDULUM_##word
#define TOLERANCE 2.220446049250313e-16 /* default */

/* Choices of this integrator among the alternatives of the support headers. */
#define UNROLLED_EQUATIONS /* stage equations without loops */
#define SPURIOUS_TESTED /* solutions of Newton's method */
#define DISCRETE_LAGRANGIAN
#ifndef __GNUC__ /* no vector extensions */
#define NEWTON_ALONE
#endif

enum {
  M = 1, /* coordinates */
  SITES = 1, /* coordinates, then the components of other unknowns */
  B = 1, /* unknowns per site */
  N = 1, /* unknowns */
  MOST_POINTS = 2, /* largest number of points of a stage group, or of blocks */
  JACOBIAN = 4, /* entries of its factors */
  POINT = 0, /* numbers that describe where a reused Jacobian was evaluated */
  MOST_ITERATIONS = INT_MAX, /* whatever the options are */
  MAX_ITERATIONS = 50, /* default */
  SUMS = 1, /* integrals along the curve of a step */
  BAND = 0, /* largest distance of coupled coordinates in the ordering POSITION_IN_MATRIX */
  MASS_ENTRIES = 1, /* nonzero entries of the Legendre transform */
  MEMORY = 4, /* numbers kept from step to step */
  SCRATCH = 12 /* arguments, values and derivatives at all points, or the mass matrix with its derivatives */
};

#include "support/core/numbers.h"
#include "support/core/status_codes.h"
#include "support/core/step.h"

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r contains MOMENTUM_ROW[r] p0; the straight-line guess of z_b is
 * STRAIGHT[b] v0 + MOMENTA[b] p0; h z_b is a displacement if MOVES[b]. */
static const double END_POSITION[1] = {1.0};
static const double MOMENTUM_ROW[1] = {1.0};
static const double STRAIGHT[1] = {1.0};
static const double MOMENTA[1] = {0.0};
static const double MOVES[1] = {1.0};
static const double QUADRATURE_WEIGHT[2] = {0.5, 0.5};

/* Position of each coordinate in a bandwidth-reducing ordering; {i, j}: d y_i / d x_j. */
static const int POSITION_IN_MATRIX[SITES] = {0};
#define MASS_POSITION POSITION_IN_MATRIX
static const int MASS_ENTRY[1][2] = {{0, 0}};

/* L_q and L_v at u = (q, v). Operations: 6 *, 1 neg, 1 sin. */
static void quadrature_value(const double *u, double t, const double *parameters, double *value)
{
  value[0] = -(parameters[2] * parameters[1] * parameters[0] * sin(u[0]));
  value[1] = parameters[0] * (parameters[1] * parameters[1]) * u[1];
}

/* The same, and the nonzero derivatives with respect to u = (q, v). Operations: 7 *, 1 cos, 2 neg, 1 sin. */
static void quadrature_derivatives(const double *u, double t, const double *parameters, double *value,
    double *derivative)
{
  const double w0 = parameters[2] * parameters[1] * parameters[0];
  value[0] = -(w0 * sin(u[0]));
  derivative[0] = -(w0 * cos(u[0]));
  const double w1 = parameters[0] * (parameters[1] * parameters[1]);
  value[1] = w1 * u[1];
  derivative[1] = w1;
}

/* Momenta L_v and mass matrix L_vv at u = (q, v). Operations: 3 *. */
static void legendre(const double *u, double t, const double *parameters, double *value, double *derivative)
{
  const double w0 = parameters[0] * (parameters[1] * parameters[1]);
  value[0] = w0 * u[1];
  derivative[0] = w0;
}

/* L at u = (q, v). Operations: 9 *, 1 +, 1 cos. */
static void lagrangian(const double *u, double t, const double *parameters, double *value)
{
  /* clang-format off */
  value[0] = 0.5 * (parameters[0] * (parameters[1] * parameters[1]) * (u[1] * u[1]) + 2.0 * parameters[0] *
      parameters[1] * parameters[2] * cos(u[0]));
  /* clang-format on */
}

#include "support/newton/band.h"
#include "support/mechanics/legendre.h"
#include "support/mechanics/energies.h"
#include "support/newton/stages.h"

/* Quadrature points, 2: u = (q, v) at each. */
static void quadrature_points(const step_data *step, const double *z, double *u)
{
  const double h = step->h;
  u[0] = step->q0[0] + (step->carry_q[0] + h * (0.21132486540518713 * z[0]));
  u[1] = z[0];
  u[2] = step->q0[0] + (step->carry_q[0] + h * (0.7886751345948129 * z[0]));
  u[3] = z[0];
}

/* Evaluates the stage equations: for every coordinate B residuals and p1 - p0 in rows; the sizes of p1 and q1 before
 * cancellation; and the Jacobian in the given shape, unless it is NULL. */
static void evaluate(const step_data *step, const double *z, double *rows, double *size_p, double *size_q,
    double *jacobian, const band *shape)
{
  const double h = step->h;
  double u[4], value[4], derivative[4];
  quadrature_points(step, z, u);
  for (int n = 0; n < 2; n++) {
    const double t = step->t;
    if (jacobian)
      quadrature_derivatives(u + n * 2, t, step->parameters, value + n * 2, derivative + n * 2);
    else
      quadrature_value(u + n * 2, t, step->parameters, value + n * 2);
  }

  /* (34d) = 0, with q1 = q0 + h sum_b END_POSITION[b]
   * z_b, (34c). */
  rows[0] = step->p0[0] + 0.7886751345948129 * (0.5 * h * value[0]) + 0.21132486540518713 * (0.5 * h * value[2]) -
      0.5 * value[1] - 0.5 * value[3];
  /* p1 - p0, (34e). */
  rows[1] = 0.5 * h * value[0] + 0.5 * h * value[2];
  size_p[0] = MATH(fabs)(step->p0[0]) + MATH(fabs)(0.5 * h * value[0]) + MATH(fabs)(0.5 * h * value[2]);
  size_q[0] = MATH(fabs)(step->q0[0]) + MATH(fabs)(h * z[0]);
  if (!jacobian)
    return;
  memset(jacobian, 0, sizeof(double) * band_size(shape));
  *entry(jacobian, shape, 0, 0, 0, 0) = 0.7886751345948129 * (0.5 * (h * h) * derivative[0] * 0.21132486540518713) +
      0.21132486540518713 * (0.5 * (h * h) * derivative[2] * 0.7886751345948129) +
      (-0.5 * derivative[1] - 0.5 * derivative[3]);
}

#include "support/newton/newton.h"
#include "support/newton/newton_from_line.h"

#ifndef NEWTON_ALONE
#define POINTS 2
#define HOT static inline __attribute__((always_inline))
#define FINAL_ITERATIONS 1
#define LARGEST_STIFFNESS 5.4

#define VECTOR_LIBRARY
#include "support/core/vectors.h"
#include "support/core/points.h"

LANES_LIBRARY_FUNCTION(lanes_sin, sin);

static const lanes ABSCISSA[GROUPS] = {0.2113248654051871, 0.7886751345948129};
static const lanes DRIFT[GROUPS] = {0.2113248654051871, 0.7886751345948129};
static const lanes DRIFT_LOW[GROUPS] = {1.1030435245950743e-17, 1.6725140369678172e-17};
static const lanes PRODUCT[POINTS * GROUPS] = {
    0.08333333333333333, 0.3110042339640731,
    0.022329099369260225, 0.08333333333333333};
static const lanes PRODUCT_LOW[POINTS * GROUPS] = {
    4.625929269271485e-18, -1.0141146892246857e-17,
    8.892883537038856e-19, 4.625929269271485e-18};
static const lanes POINT_END_POSITION[GROUPS] = {0.39433756729740643, 0.10566243270259355};
static const lanes POINT_END_POSITION_LOW[GROUPS] = {8.362570184839086e-18, 5.515217622975371e-18};
static const lanes POINT_END_MOMENTUM[GROUPS] = {0.5, 0.5};
static const lanes POINT_END_MOMENTUM_LOW[GROUPS] = {0.0, 0.0};
static const lanes REMAINDER_POSITION[POINTS * GROUPS] = {-0.06572292788290107, -0.01761040545043226, 0.0, 0.0};
static const lanes REMAINDER_MOMENTUM[POINTS * GROUPS] = {-0.19716878364870322, -0.05283121635129678, 0.0, 0.0};
static const lanes REMAINDER_DETERMINANT[GROUPS] = {0.16666666666666666, 0.0};
static const lanes LAST_ALONE[POINTS * GROUPS] = {
    -0.09967936855888598, -0.37200846792814624,
    0.20534180126147955, 0.7663460352255527};
static const lanes LAST[POINTS * GROUPS] = {
    -0.8823714390099913, -3.2930550415329503,
    0.45972170819961705, 1.7157047723433247};
static const lanes BEFORE[POINTS * GROUPS] = {
    -0.1323714390099913, -0.4940169358562924,
    0.6606836025229591, 2.4657047723433245};

/* L_q at all points. Operations: 3 *, 1 neg, 1 sin. */
static inline void force_lanes(const lanes *u, lanes t, const double *parameters, lanes *value)
{
  value[0] = -(parameters[2] * parameters[1] * parameters[0] * lanes_sin(u[0]));
}

/* The constant masses. Operations: 2 *. */
static void mass(const double *u, double t, const double *parameters, double *value)
{
  value[0] = parameters[0] * (parameters[1] * parameters[1]);
}

#include "support/iteration/convergence.h"
#include "support/core/progress.h"
#include "support/iteration/one_trajectory.h"
#include "support/iteration/separable_iteration.h"
#include "support/iteration/iteration_solver.h"

/* Error estimate of a curve, and its exponent in the relative error of the end of the step. */
#define KEPT 2
#define KEPT_VELOCITIES 0
#define KEPT_UNIT(i) (data->square * data->inverse_mass[i])
#define RESOLVED 1.0
#define NEXT_RESOLVED 1.0
#define ERROR_POWER 1.75
static const lanes HIGHEST[GROUPS] = {0.5, 0.5};
static const lanes NEXT[GROUPS] = {0.0, 0.0};

#else
static const double EXTRAPOLATION[1][1] = {{1.0}};

#include "support/newton/newton_solver.h"
#define ESTIMATED_BY_HALVES /* errors of steps without a curve */
#define ERROR_POWER 1
#endif

#include "support/run/run.h"

/* Adds h^1 sum_n w_n lagrangian along the curve with unknowns z. */
static void add_quadrature_sums(const step_data *step, const double *z, double *sum)
{
  const double h = step->h;
  double *u = step->scratch, own[SUMS] = {0};
  quadrature_points(step, z, u);
  for (int n = 0; n < 2; n++) {
    double value[SUMS];
    lagrangian(u + n * 2, step->t, step->parameters, value);
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
