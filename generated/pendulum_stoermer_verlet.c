/* planar pendulum: Stoermer-Verlet (Lobatto IIIA-IIIB pair of two stages); see pendulum_stoermer_verlet.h. */
#include "pendulum_stoermer_verlet.h"

#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

#define NAME(word) pendulum_stoermer_verlet_##word /* prefix of every exported name */
#define STATUS(word) PENDULUM_STOERMER_VERLET_##word
#define TOLERANCE 2.220446049250313e-16 /* default */

/* Choices of this integrator among the alternatives of the support headers. */
#define NO_ERROR_ESTIMATE
#define CONSTANT_MASSES /* drifts are by constant masses */
#define EXPLICIT_STEPS /* their discrete Lagrangian is summed along the steps */

enum {
  M = 1, /* coordinates */
  MAX_ITERATIONS = 50, /* default */
  BAND = 0, /* largest distance of coupled coordinates in the ordering POSITION_IN_MATRIX */
  MASS_ENTRIES = 1, /* nonzero entries of the Legendre transform */
  MEMORY = 1, /* numbers kept from step to step */
  SCRATCH = 2 /* arguments, values and derivatives at all points, or the mass matrix with its derivatives */
};

#include "support/core/numbers.h"
#include "support/core/status_codes.h"
#include "support/core/step.h"

/* Position of each coordinate in a bandwidth-reducing ordering; {i, j}: d y_i / d x_j. */
static const int POSITION_IN_MATRIX[M] = {0};
#define MASS_POSITION POSITION_IN_MATRIX
static const int MASS_ENTRY[1][2] = {{0, 0}};

/* Momenta L_v and mass matrix L_vv at u = (q, v). Operations: 3 *. */
static void legendre(const double *u, double t, const double *parameters, double *value, double *derivative)
{
  (void)t;
  const double w0 = parameters[0] * (parameters[1] * parameters[1]);
  value[0] = w0 * u[1];
  derivative[0] = w0;
}

/* L at u = (q, v). Operations: 9 *, 1 +, 1 cos. */
static void lagrangian(const double *u, double t, const double *parameters, double *value)
{
  /* clang-format off */
  (void)t;
  value[0] = 0.5 * (parameters[0] * (parameters[1] * parameters[1]) * (u[1] * u[1]) + 2.0 * parameters[0] *
      parameters[1] * parameters[2] * cos(u[0]));
  /* clang-format on */
}

#include "support/newton/band.h"
#include "support/mechanics/legendre.h"
#include "support/mechanics/energies.h"

enum { LEAPS = 2 };
static const double KICK[2] = {0.5, 0.5};
static const double DRIFT[2] = {1.0, 0.0};
static const double KICK_ABSCISSA[2] = {0.0, 1.0};

/* L_q at u = q. Operations: 3 *, 1 neg, 1 sin. */
static void force(const double *u, double t, const double *parameters, double *value)
{
  (void)t;
  value[0] = -(parameters[2] * parameters[1] * parameters[0] * sin(u[0]));
}

/* The constant masses. Operations: 2 *. */
static void mass(const double *u, double t, const double *parameters, double *value)
{
  (void)u, (void)t;
  value[0] = parameters[0] * (parameters[1] * parameters[1]);
}

#define SPLITTING static inline
#include "support/iteration/splitting.h"

#include "support/run/run.h"
#include "support/mechanics/discrete_legendre.h"
