/* Kepler problem: Galerkin spectral variational integrator, degree 4, gauss-legendre:4; see kepler_svi_4.h. A step:
 * solve; a run: kepler_svi_4_advance. */
#include "kepler_svi_4.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

#define NAME(word) kepler_svi_4_##word /* prefix of every exported name */
#define STATUS(word) KEPLER_SVI_4_##word
#define TOLERANCE 2.220446049250313e-16 /* default */

/* Choices of this integrator among the alternatives of the support headers. */
#define MOMENTUM_MAPS /* first integrals from symmetries */
#define SPURIOUS_TESTED /* solutions of Newton's method */
#define DISCRETE_LAGRANGIAN
#ifndef __GNUC__ /* no vector extensions */
#define NEWTON_ALONE
#endif

enum {
  M = 2, /* coordinates */
  SITES = 2, /* coordinates, then the components of other unknowns */
  B = 4, /* unknowns per site */
  N = 8, /* unknowns */
  MOST_POINTS = 4, /* largest number of points of a stage group, or of blocks */
  JACOBIAN = 100, /* entries of its factors */
  POINT = 0, /* numbers that describe where a reused Jacobian was evaluated */
  MOST_ITERATIONS = INT_MAX, /* whatever the options are */
  MAX_ITERATIONS = 50, /* default */
  MAPS = 1, /* first integrals from symmetries */
  SUMS = 1, /* integrals along the curve of a step */
  BAND = 1, /* largest distance of coupled coordinates in the ordering POSITION_IN_MATRIX */
  MASS_ENTRIES = 2, /* nonzero entries of the Legendre transform */
  MEMORY = 16, /* numbers kept from step to step */
  SCRATCH = 56 /* arguments, values and derivatives at all points, or the mass matrix with its derivatives */
};

#include "support/core/numbers.h"
#include "support/core/status_codes.h"
#include "support/core/step.h"

/* q1 = q0 + h sum_b END_POSITION[b] z_b; row r contains MOMENTUM_ROW[r] p0; the straight-line guess of z_b is
 * STRAIGHT[b] v0 + MOMENTA[b] p0; h z_b is a displacement if MOVES[b]. */
static const double END_POSITION[4] = {
    0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684};
static const double MOMENTUM_ROW[4] = {
    0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684};
static const double STRAIGHT[4] = {1.0, 1.0, 1.0, 1.0};
static const double MOMENTA[4] = {0.0, 0.0, 0.0, 0.0};
static const double MOVES[4] = {1.0, 1.0, 1.0, 1.0};

/* Quadrature: 4 points. Gather tables have one row
 * per block and one column per point, scatter tables one row per point and one column per row of equations, the last
 * one for p1. {i, j}: derivative d value_i / d u_j. */
static const double QUADRATURE_WEIGHT[4] = {
    0.17392742256872684, 0.32607257743127316, 0.32607257743127316, 0.17392742256872684};
static const double QUADRATURE_GATHER_0[4][4] = {
    {0.08696371128436353, 0.18811811749986806, 0.16719192197418886, 0.17748257225452257},
    {-0.026604180084998763, 0.16303628871563647, 0.3539530060337439, 0.3134451147418684},
    {0.012627462689404734, -0.027880428602470975, 0.16303628871563647, 0.3526767575162719},
    {-0.003555149685795733, 0.006735500594538202, -0.014190694931141223, 0.08696371128436353}};
static const double QUADRATURE_GATHER_1[4][4] = {
    {1.0, 0.0, 0.0, 0.0},
    {0.0, 1.0, 0.0, 0.0},
    {0.0, 0.0, 1.0, 0.0},
    {0.0, 0.0, 0.0, 1.0}};
static const double QUADRATURE_SCATTER_0[4][5] = {
    {0.08696371128436331, 0.3526767575162719, 0.3134451147418684, 0.17748257225452257, 1.0},
    {-0.014190694931141223, 0.1630362887156367, 0.35395300603374413, 0.16719192197418864, 1.0},
    {0.00673550059453798, -0.027880428602470753, 0.1630362887156367, 0.18811811749986806, 1.0},
    {-0.003555149685795733, 0.012627462689404734, -0.026604180084998763, 0.08696371128436331, 1.0}};
static const double QUADRATURE_SCATTER_1[4][5] = {
    {-1.0, 0.0, 0.0, 0.0, 0.0},
    {0.0, -1.0, 0.0, 0.0, 0.0},
    {0.0, 0.0, -1.0, 0.0, 0.0},
    {0.0, 0.0, 0.0, -1.0, 0.0}};
static const int QUADRATURE_DERIVATIVES_0[4][2] = {{0, 0}, {0, 1}, {1, 0}, {1, 1}};
static const int QUADRATURE_DERIVATIVES_1[2][2] = {{0, 0}, {1, 1}};

/* Position of each coordinate in a bandwidth-reducing ordering; {i, j}: d y_i / d x_j. */
static const int POSITION_IN_MATRIX[SITES] = {0, 1};
#define MASS_POSITION POSITION_IN_MATRIX
static const int MASS_ENTRY[2][2] = {{0, 0}, {1, 1}};

/* x^(-1/2). */
static inline real inverse_root_1(real x)
{
  const real inverse = 1 / x;
  return inverse * MATH(sqrt)(x);
}

/* x^(-3/2). */
static inline real inverse_root_3(real x)
{
  const real inverse = 1 / x;
  return inverse * inverse * MATH(sqrt)(x);
}

/* x^(-5/2). */
static inline real inverse_root_5(real x)
{
  const real inverse = 1 / x;
  return inverse * inverse * inverse * MATH(sqrt)(x);
}

/* L_q and L_v at u = (q, v). Operations: 5 *, 1 +, 1 inverse_root_3, 2 neg. */
static void quadrature_value(const double *u, double t, const double *parameters, double *value)
{
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

/* Momenta L_v and mass matrix L_vv at u = (q, v). Operations: constants. */
static void legendre(const double *u, double t, const double *parameters, double *value, double *derivative)
{
  value[0] = u[2];
  value[1] = u[3];
  derivative[0] = 1.0;
  derivative[1] = 1.0;
}

/* L at u = (q, v). Operations: 7 *, 3 +, 1 inverse_root_1. */
static void lagrangian(const double *u, double t, const double *parameters, double *value)
{
  value[0] = 0.5 * (u[2] * u[2] + u[3] * u[3] + 2.0 * parameters[0] * inverse_root_1(u[0] * u[0] + u[1] * u[1]));
}

/* Momentum maps at u = (q, p), then the sums of the squares of their terms. Operations: 8 *, 1 +, 1 -. */
static void momentum_maps(const double *u, double t, const double *parameters, double *value)
{
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
  double *u = step->scratch, *value = u + 16, *derivative = value + 16;
  gather(QUADRATURE_GATHER_0[0], 4, h, z, 2, u + 0, 4, 1);
  offset(step, 4, u + 0, 4);
  gather(QUADRATURE_GATHER_1[0], 4, 1, z, 2, u + 2, 4, 1);
  for (int n = 0; n < 4; n++) {
    if (jacobian)
      quadrature_derivatives(u + n * 4, step->t, step->parameters, value + n * 4, derivative + n * 6);
    else
      quadrature_value(u + n * 4, step->t, step->parameters, value + n * 4);
  }
  scatter(QUADRATURE_SCATTER_0[0], 4, QUADRATURE_WEIGHT, h, value + 0, 4, 2, rows, size);
  scatter(QUADRATURE_SCATTER_1[0], 4, QUADRATURE_WEIGHT, 1, value + 2, 4, 2, rows, size);
  if (!jacobian)
    return;
  scatter_derivatives(QUADRATURE_SCATTER_0[0], QUADRATURE_GATHER_0[0], 4, QUADRATURE_WEIGHT, h * h,
      QUADRATURE_DERIVATIVES_0, 4, &derivative[0], 6, jacobian, shape);
  scatter_derivatives(QUADRATURE_SCATTER_1[0], QUADRATURE_GATHER_1[0], 4, QUADRATURE_WEIGHT, 1,
      QUADRATURE_DERIVATIVES_1, 2, &derivative[4], 6, jacobian, shape);
}

/* Evaluates the stage equations: for every coordinate B residuals and p1 - p0 in rows; the sizes of p1 and q1 before
 * cancellation; and the Jacobian in the given shape, unless it is NULL. */
static void evaluate(const step_data *step, const double *z, double *rows, double *size_p, double *size_q,
    double *jacobian, const band *shape)
{
  begin_rows(step, z, rows, size_p, size_q, jacobian, shape);
  add_quadrature(step, z, rows, size_p, jacobian, shape);
}

#include "support/newton/newton.h"

#define STAGE_POWER 1.8 /* exponent from the curve's estimate to the error of the end */
static const double STAGE_HIGHEST[4] = {-3.710270034019473, 9.39772470377753, -9.39772470377753, 3.710270034019473};
static const double STAGE_NEXT[4] = {3.195048252113469, -3.195048252113469, -3.195048252113469, 3.195048252113469};
static const double STAGE_CURVATURE[4] = {-1.0, 0.0, 0.0, 1.0};
static const double STAGE_OTHER_CURVATURE[4] = {-1.0, 0.0, 1.0, 0.0};

#include "support/step_size/stage_error.h"
#include "support/newton/newton_from_line.h"

#ifndef NEWTON_ALONE
#define POINTS 4
#define HOT static inline __attribute__((always_inline))
#define FINAL_ITERATIONS 1
#define LARGEST_STIFFNESS 32.904471205000526

#define INVERSE_ROOTS
#include "support/core/vectors.h"
#include "support/core/points.h"

LANES_INVERSE_ROOT(lanes_inverse_root_3_times, 3, (square * y), (inverse * inverse));
INVERSE_ROOT_ALONE(lanes_inverse_root_3, lanes_inverse_root_3_times);

static const lanes ABSCISSA[GROUPS] = {
    0.06943184420297371, 0.33000947820757187, 0.6699905217924281, 0.9305681557970263};
static const lanes DRIFT[GROUPS] = {0.06943184420297371, 0.33000947820757187, 0.6699905217924281, 0.9305681557970263};
static const lanes DRIFT_LOW[GROUPS] = {
    -1.3430706493351195e-18, -3.745660853481089e-18, 3.745660853481089e-18, -5.416808058192271e-17};
static const lanes PRODUCT[POINTS * GROUPS] = {
    0.0040381914508467315, 0.04356358090239626, 0.10586435263357641, 0.1487984961926378,
    -0.003295860944944696, 0.013818951406296126, 0.10651836096505307, 0.1984704988523772,
    0.0026447829520668538, -0.004340134194434996, 0.013818951406296126, 0.08167135979587757,
    -0.0009767229632558817, 0.0014107297391595338, -0.0017580153590805495, 0.0040381914508467315};
static const lanes PRODUCT_LOW[POINTS * GROUPS] = {
    -3.485372364108161e-19, 1.789851241017816e-18, -8.248701767628471e-19, 6.084357307354379e-18,
    -4.092132371756447e-20, -3.9491568186495837e-19, 2.340447306412321e-18, -1.8543710150741996e-18,
    2.5177426944025155e-20, 3.6985428027922127e-19, -3.9491568186495837e-19, -4.216158399152748e-19,
    9.579892033521483e-20, -4.461394225875459e-20, 8.366612927879591e-21, -3.485372364108161e-19};
static const lanes POINT_END_POSITION[GROUPS] = {
    0.1618513208623103, 0.21846553629538057, 0.1076070411358925, 0.012076101706416622};
static const lanes POINT_END_POSITION_LOW[GROUPS] = {
    7.186187852916501e-18, 1.2386167608501986e-18, -5.068784955224919e-18, 1.134272934118331e-19};
static const lanes POINT_END_MOMENTUM[GROUPS] = {
    0.17392742256872692, 0.32607257743127305, 0.32607257743127305, 0.17392742256872692};
static const lanes POINT_END_MOMENTUM_LOW[GROUPS] = {
    3.830168194374721e-18, 2.3925407421254193e-17, 2.3925407421254193e-17, 3.830168194374721e-18};
static const lanes REMAINDER_POSITION[POINTS * GROUPS] = {
    -0.02335938320745366, -0.01634440076265735, -0.00195317998963355, -9.702706922111384e-06,
    0.00018030248388853408, -0.00022488016532503117, -5.112948972836089e-05, -3.499178041491222e-06,
    -2.875126897757819e-06, -2.665896925317689e-06, -1.9553130722910563e-06, 4.101690949130498e-07,
    -5.7345280917768674e-08, -7.740417244025673e-08, -3.812607749996191e-08, -4.278664153350561e-09};
static const lanes REMAINDER_MOMENTUM[POINTS * GROUPS] = {
    -0.07530684258407644, -0.07318491932810234, -0.017755671748358303, -0.0004192330061295919,
    0.0027448444456905996, 0.00012390127997854145, -0.0004729891565638298, -1.4804188152930354e-05,
    -2.1839046703802726e-05, 4.645797327805849e-06, -1.2565001563897348e-05, 1.4135797380801652e-06,
    -6.162394507111924e-08, -1.1553024994021863e-07, -1.1553024994021863e-07, -6.162394507111924e-08};
static const lanes REMAINDER_DETERMINANT[GROUPS] = {
    0.03571428571428571, 0.0007653061224489796, 1.417233560090703e-05, 3.5430839002267574e-07};
static const lanes LAST_ALONE[POINTS * GROUPS] = {
    0.00039681535159839207, -0.029504138216618767, -0.31588704803200224, -1.0944993417524072,
    -0.0006159736538548244, 0.09740091828952009, 1.0055973963777949, 3.3896437163261757,
    -0.0007480595782696969, -0.16447566300062685, -1.525867760983847, -4.825950141339043,
    0.0033776083752391365, 0.15103201078114245, 1.0606010622838993, 2.963784313057014};
static const lanes LAST[POINTS * GROUPS] = {
    0.08319060417122251, -0.3459646936280158, -3.7072096171583238, -17.265518328081242,
    -0.1424769150297397, 0.7499144190569107, 8.074520972710335, 35.53430983434068,
    0.06696855362322024, -0.504529311740835, -5.242038557529752, -21.401526193883196,
    -0.01367708701741958, 0.2416275660243193, 2.056100217602042, 7.353446066197159};
static const lanes BEFORE[POINTS * GROUPS] = {
    -0.00979468736704034, 0.036416150556434365, 0.3789777164120164, 1.816316943022917,
    0.04555177197165148, -0.17664461024168146, -1.8543116628735559, -8.786915109053945,
    -0.11924868100975577, 0.501096120011918, 5.325243917524667, 24.716673635935365,
    0.09189683115257419, -0.447462512185633, -4.806839337041585, -21.533808302186};

/* L_q at all points. Operations: 4 *, 1 +, 2 inverse_root_3_times, 2 neg. */
static inline void force_lanes(const lanes *u, lanes t, const double *parameters, lanes *value)
{
  const lanes w0 = u[0] * u[0] + u[1] * u[1];
  value[0] = lanes_inverse_root_3_times(w0, -(parameters[0] * u[0]));
  value[1] = lanes_inverse_root_3_times(w0, -(parameters[0] * u[1]));
}

/* The constant masses. Operations: constants. */
static void mass(const double *u, double t, const double *parameters, double *value)
{
  value[0] = 1.0;
  value[1] = 1.0;
}

#include "support/iteration/convergence.h"
#include "support/core/progress.h"
#include "support/iteration/one_trajectory.h"
#include "support/iteration/separable_iteration.h"
#include "support/iteration/iteration_solver.h"

/* Error estimate of a curve, and its exponent in the relative error of the end of the step. */
#define KEPT 4
#define KEPT_VELOCITIES 0
#define KEPT_UNIT(i) (data->square * data->inverse_mass[i])
#define RESOLVED 1.0
#define NEXT_RESOLVED 1.0
#define ERROR_POWER 1.2857142857142858
static const lanes HIGHEST[GROUPS] = {-0.37102700340194733, 0.939772470377753, -0.939772470377753, 0.37102700340194733};
static const lanes NEXT[GROUPS] = {0.5325080420189116, -0.5325080420189116, -0.5325080420189116, 0.5325080420189116};

#else
static const double EXTRAPOLATION[4][4] = {
    {-0.3043475322896335, -1.956342611081263, -7.352359801851611, -14.971892910590412},
    {1.0425440204501055, 6.246427614654768, 22.244205449220566, 44.09613181879383},
    {-1.929896390297009, -9.46401244076669, -29.80681363156252, -55.9889724574008},
    {2.191699902136537, 6.173927437193185, 15.914967984193565, 27.864733549197386}};

#include "support/newton/newton_solver.h"
#define ERROR_POWER STAGE_POWER
#endif

#include "support/run/run.h"

/* Adds h^1 sum_n w_n lagrangian along the curve with unknowns z. */
static void add_quadrature_sums(const step_data *step, const double *z, double *sum)
{
  const double h = step->h;
  double *u = step->scratch, own[SUMS] = {0};
  gather(QUADRATURE_GATHER_0[0], 4, h, z, 2, u + 0, 4, 1);
  offset(step, 4, u + 0, 4);
  gather(QUADRATURE_GATHER_1[0], 4, 1, z, 2, u + 2, 4, 1);
  for (int n = 0; n < 4; n++) {
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
